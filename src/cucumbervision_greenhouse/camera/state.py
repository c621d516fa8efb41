"""What the capture page shows, as JSON: rounds, the next place, the last stop with its fruit."""

from __future__ import annotations

import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from cucumbervision.crop.grades import grade
from cucumbervision.errors import CucumberVisionError, Message, StoreError
from cucumbervision_greenhouse import resources, round_view, tasks
from cucumbervision_greenhouse.camera import cameras
from cucumbervision_greenhouse.fruit_pictures import mask_outline, stop_layers
from cucumbervision_greenhouse.language import counted, marked, words_of
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.rounds.walking import DEMONSTRATION, next_place, sides_of
from cucumbervision_greenhouse.store.marks import TAKE_BACK
from cucumbervision_greenhouse.store.records import Verdict
from cucumbervision_greenhouse.words import (
    action_words,
    added_words,
    grade_words,
    length_words,
    position_words,
    round_name,
    stop_name,
    taken_back,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision.capture.frames import Capture, Stop
    from cucumbervision_greenhouse.camera.page import SentFruit, SentPicture, SentUndo
    from cucumbervision_greenhouse.camera.shutter import Pressed
    from cucumbervision_greenhouse.jobs import Job
    from cucumbervision_greenhouse.store.records import LogEntry, Round, StopRecord
    from cucumbervision_greenhouse.store.repository import Store

_UNDO_S = 60.0  # longest wait for a stop that is being measured


def walk(store: Store, round_key: str, source: str) -> dict[str, Any]:
    """Return the state of a walk.

    Parameters
    ----------
    store : Store
        Signed by the viewer.
    round_key : str
        The open round; empty for the newest. An unknown key opens none.
    source : str
        'camera' or 'replay'; with any other value, the one that the server was started with.
    """
    rounds = resources.rounds()
    if source not in ("camera", "replay"):
        source = "replay" if cameras.replay_named() else "camera"
    round_summary = next((x for x in rounds if round_key in ("", x.key)), None)
    home = round_summary.key if round_summary else ""
    if (preview := _preview_of(source)) is not None and preview.simulated:
        home = DEMONSTRATION
    stops = resources.store().stops(home) if any(x.key == home for x in rounds) else []
    waiting = [x.stop for x in resources.waiting().captures() if x.round_key == home]
    place, last = next_place([*stops, *waiting]), stops[-1] if stops else None
    aside = [x for x in resources.waiting().set_aside() if x.round_key == home]
    progress = tasks.progress(home)
    return {
        "now_s": time.time(),
        "zone_s": time.localtime().tm_gmtoff,
        "rounds": [{"key": x.key, "name": round_name(x)} for x in rounds],
        "houses": resources.houses(rounds),
        "round": round_summary.key if round_summary else "",
        "missing": bool(round_key) and round_summary is None,
        "house": round_summary.house if round_summary else "",
        "home": home,
        "source": source,
        "place": asdict(place),
        "along": resources.settings().units.along,
        "rows": _rows([*stops, *waiting]),
        "from": last and {"key": last.key, **_place(last)},
        "sides": sides_of(stops),
        "work": progress.told,
        "first": progress.first_words or _no_photo(home, round_summary),
        "doubts": [
            words_of(line) for x in rounds if x.key == home for line in round_view.doubts_of(x)
        ],
        "aside": counted(
            len(aside),
            "{n} photo failed three times and was not measured; it is kept beside the store in "
            "{folder}.",
            "{n} photos failed three times and were not measured; they are kept beside the store "
            "in {folder}.",
            folder=aside[0].folder.parent.name,
        )
        if aside
        else tasks.measuring_fault(),
        "last": _last_stop(round_summary, last) if round_summary and last else None,
        "done": _done(store, home),
    }


def _no_photo(home: str, round_summary: Round | None) -> str:
    """Return the words where a photo goes into another round than the open one: it has stops."""
    if round_summary is None or home == round_summary.key:
        return ""
    return _("No photo in the round 'Demonstration' yet: each photo's result is shown here")


def _rows(stops: Sequence[Stop | StopRecord]) -> dict[str, dict[str, Any]]:
    """Return where the walk of each row goes on, by the rows' names."""
    rows = dict.fromkeys(stop.row or "" for stop in stops)
    return {row: asdict(next_place([x for x in stops if (x.row or "") == row])) for row in rows}


def _done(store: Store, home: str) -> dict[str, Any] | None:
    """Return the viewer's last action in a round other than a press, for *Undo*."""
    action = _last_action(store, home)
    return None if action is None else {"at_s": action.at_s, "words": action_words(action)}


def _preview_of(source: str) -> Any:
    try:
        return cameras.feed(source).preview().capture
    except CucumberVisionError:
        return None


def _last_stop(round_summary: Round, last: StopRecord) -> dict[str, Any]:
    """Return the last measured stop: its pictures, with the outlines of its fruit."""
    store, units = resources.store(), resources.settings().units
    record, profile = store.stop(last.key), resources.profile_of(round_summary)[1]
    views = [
        view
        for view in store.detections(last.round_key)
        if view.stop_key == last.key and view.verdict is not Verdict.REJECTED
    ]
    grades = {view.key: grade(view, profile) for view in views}
    names = {key: graded.label for key, graded in grades.items()}
    captures = []
    for taken in record.captures:
        capture_views = [view for view in views if view.capture == taken.name]
        captures.append(
            {
                "name": taken.name,
                "picture": f"/api/picture/{last.key}/{quote(taken.name)}",
                "size": [taken.width_px, taken.height_px],
                "layers": stop_layers(taken, capture_views, names, units),
                "fruit": [
                    {
                        "key": view.key,
                        "number": view.fruit,
                        "length": length_words(view, units),
                        "class": grade_words(grades[view.key]),
                    }
                    for view in capture_views
                ],
            }
        )
    failure = next(iter(record.failures), {"message": ""})
    fault = words_of(Message.from_json(failure.get("sentence", failure["message"])))
    return {
        "key": last.key,
        "round": last.round_key,
        "name": stop_name(last, units),
        "fault": fault,
        "captures": captures,
    }


def outcome(pressed: Pressed | str | None, patience_s: float) -> dict[str, Any]:
    """Return the outcome of a press, once it is saved or has failed.

    Parameters
    ----------
    pressed : Pressed, str or None
        As `Shutter.press` returned it; a text is the reason for a refusal.
    patience_s : float
        Longest wait; then the outcome is 'waiting', and the browser asks again.
    """
    if pressed is None:  # saved before this program was started
        return {"state": "saved", "words": _("Saved")}
    if isinstance(pressed, str):
        return {"state": "refused", "words": pressed}
    try:
        queued = pressed.queued.result(max(patience_s, 0.0))
    except Exception:  # `error` is None while it is undecided
        state = "refused" if pressed.is_lost else "waiting"
        return {"state": state, "words": pressed.error, "lost": pressed.is_lost}
    units = resources.settings().units
    words = _("{stop}: saved").format(stop=stop_name(queued.stop, units))
    if pressed.moved is not None:
        taken = _("Another stop is already at {position}")
        words += f". {taken.format(position=position_words(pressed.stop.position_m, units))}"
    where = {"stop": queued.key, "home": queued.round_key, "place": _place(queued.stop)}
    return {"state": "saved", "words": words, **where}


def _place(stop: Stop | StopRecord) -> dict[str, Any]:
    return {"row": stop.row or "", "side": stop.side or "", "position_m": stop.position_m}


def take_back(store: Store, asked: SentUndo) -> dict[str, Any]:
    """Undo a browser's last action in a round, and return it in words.

    A press is taken back by deleting its stop, measured or not.

    Raises
    ------
    StoreError
        If there is nothing to undo, the stop does not exist, or is still being measured.
    """
    home, pressed_s = asked.round or "", 0.0
    if asked.stop is not None:
        home, pressed_s = _round_and_time(store, asked.stop)
    action = _last_action(store, home)
    if action is not None and action.at_s > (asked.at_s or pressed_s):
        tasks.undo(store, home, number=action.number)
        return {"words": taken_back(action), "action": action.number}
    if asked.stop is None:
        raise StoreError("nothing to undo", remedy="delete a stop on the row map")
    return {"words": _delete_stop(store, asked.stop)}


def _round_and_time(store: Store, stop: str) -> tuple[str, float]:
    """Return the round of a measured or queued stop, and when it was taken."""
    for queued in resources.waiting().captures():
        if queued.key == stop:
            return queued.round_key, queued.pressed_s
    saved = store.stop(stop)
    return saved.round_key, saved.taken_s


def _last_action(store: Store, round_key: str) -> LogEntry | None:
    """Return a viewer's last action in a round, ignoring presses that were undone."""
    if store.round(round_key) is None:
        return None
    actions = store.own_actions(round_key)
    return next((action for action in actions if action.kind != TAKE_BACK), None)


def _delete_stop(store: Store, key: str) -> str:
    waiting = next((x for x in resources.waiting().captures() if x.key == key), None)
    if waiting is not None and not waiting.tries:
        resources.waiting().done(waiting)
        return _("{stop}: deleted").format(stop=stop_name(waiting.stop, resources.settings().units))
    until = time.monotonic() + _UNDO_S
    while resources.waiting().holds(key):  # it is being measured
        if time.monotonic() > until:
            raise StoreError("this stop is still being measured", remedy="try again")
        time.sleep(0.05)
    stop = store.stop(key)
    store.delete_stop(key, taken_back=True)
    tasks.merge(stop.round_key)
    return _("The last stop was deleted. 'Undo' on the row map brings it back")


def outline(asked: SentFruit) -> dict[str, Any]:
    """Return the outlines of the object at a point or in a box, as a preview.

    Raises
    ------
    InstancesError
        If there is no object.
    """
    record, capture = _picture_of(asked)
    measurer = resources.measurer()
    job = resources.worker().submit(
        marked("Outlining the fruit"),
        lambda _: measurer.draft_of(capture, asked.point, asked.box),
        record.round_key,
    )
    job.wait()
    return {"outline": mask_outline(job.result)}


def prepare(asked: SentPicture) -> None:
    """Begin to compute what outlining needs of a picture, since somebody is about to tap into it.

    Raises
    ------
    StoreError
        If the picture is not there.
    """
    record, capture = _picture_of(asked)
    measurer = resources.measurer()
    resources.worker().submit(
        marked("Preparing the picture"), lambda _: measurer.prepare(capture), record.round_key
    )


def add_fruit(store: Store, asked: SentFruit) -> dict[str, Any]:
    """Outline and measure the fruit at a point or in a box; return it with words for people.

    Raises
    ------
    InstancesError
        If there is no fruit, or it was found before.
    """
    record, capture = _picture_of(asked)
    options, measurer = resources.settings().options, resources.measurer()

    def work(_: Job) -> str:
        mask = measurer.mask_of(capture, asked.point, asked.box)
        return measurer.add(store, record, capture, mask, options)

    # The networks serve one request at a time.
    job = resources.worker().submit(marked("Measuring the fruit"), work, record.round_key)
    job.wait()
    return {"words": added_words(doubtful=store.detection(job.result).view.doubtful)}


def correct_fruit(store: Store, asked: SentFruit, key: str) -> dict[str, Any]:
    """Outline a fruit anew by a point or a box, and measure it; return the job and the action.

    Raises
    ------
    InstancesError
        If there is no fruit, or it is another one.
    """
    detail = store.detection(key)
    capture = round_view.capture_of(detail.stop, detail.capture)
    options, measurer = resources.settings().options, resources.measurer()

    def work(_: Job) -> int:
        mask = measurer.mask_of(capture, asked.point, asked.box)
        return measurer.correct(store, detail, capture, mask, options)

    title = marked("Measuring with the new outline")
    job = resources.worker().submit(title, work, detail.view.round_key)
    job.wait()
    return {"job": job.number, "action": job.result}


def _picture_of(asked: SentPicture) -> tuple[StopRecord, Capture]:
    store = resources.store()
    record = store.stop(asked.stop)
    taken = next((capture for capture in record.captures if capture.name == asked.capture), None)
    if taken is None:
        raise StoreError("this picture is not there any more", remedy="reload the page")
    return record, round_view.capture_of(record, taken)
