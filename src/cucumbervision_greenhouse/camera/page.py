"""The capture page: its files and pictures, the walk, presses, undo and outlines, as JSON.

The page is used while walking, where connections drop, so it is made of plain modules without
Streamlit, and asks for news and pictures again and again.
"""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar
from urllib.parse import quote

import streamlit as st
from pydantic import Field, model_validator
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route

from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.crop.grades import grade
from cucumbervision.errors import CucumberVisionError, Message, StoreError
from cucumbervision.names import LONGEST_NAME
from cucumbervision.run.overlay import as_jpeg
from cucumbervision_greenhouse import fruit_pictures, resources, round_view, tasks
from cucumbervision_greenhouse import words as texts
from cucumbervision_greenhouse.access import Key, Sent, answer
from cucumbervision_greenhouse.camera import cameras
from cucumbervision_greenhouse.camera.cameras import Preview
from cucumbervision_greenhouse.camera.shutter import Shutter, is_lost
from cucumbervision_greenhouse.language import (
    ask_for,
    counted,
    language,
    marked,
    page_text,
    words_of,
)
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.resources import Job, fault_of
from cucumbervision_greenhouse.rounds.walking import DEMONSTRATION, next_place, sides_of
from cucumbervision_greenhouse.store.marks import TAKE_BACK
from cucumbervision_greenhouse.store.records import LogEntry, Round, StopRecord, Verdict
from cucumbervision_greenhouse.store.repository import Store
from cucumbervision_greenhouse.store.waiting import Waiting
from cucumbervision_greenhouse.theme import style_sheet

SentT = TypeVar("SentT", bound=Sent)

_STATIC = Path(__file__).with_name("static")
_MEDIA_TYPES = {"html": "text/html", "js": "text/javascript"}  # of files with texts
_UNDO_S = 60.0  # longest wait for a stop that is being measured
_PRESS_S = 4.0  # longest delay of the answer until presses are saved
_MOST_TOGETHER = 50  # presses in one request

Source = Literal["camera", "replay"]
Moment = Annotated[float, Field(ge=0, lt=4_102_444_800)]
"""Seconds since the epoch, before the year 2100."""


class SentPress(Sent):
    """A press as a browser sends it: its number, its time by this machine's clock, its place."""

    number: Annotated[str, Field(pattern=r"^[\w-]{1,64}$")]
    at_s: Moment
    round: Key
    source: Source
    row: Annotated[str, Field(max_length=LONGEST_NAME)] = ""
    side: Annotated[str, Field(max_length=LONGEST_NAME)] = "left"
    position_m: Annotated[float, Field(ge=0)]


class SentPresses(Sent):
    """Presses that are sent together."""

    presses: Annotated[list[SentPress], Field(max_length=_MOST_TOGETHER)]


class SentRound(Sent):
    """A new round."""

    name: Annotated[str, Field(max_length=LONGEST_NAME)] = ""
    house: Annotated[str, Field(max_length=LONGEST_NAME)] = ""


class SentUndo(Sent):
    """The request to undo a browser's last action in a round.

    That is its last press (the stop and the time), or a later action.
    """

    round: Key
    stop: Key | None = None
    at_s: Moment | None = None


class SentPicture(Sent):
    """A picture: its stop and capture."""

    stop: Key
    capture: Annotated[str, Field(max_length=500)]


class SentFruit(SentPicture):
    """A point in a fruit, or a box around it, in pixels of its capture.

    `fruit` names the one that is outlined anew; without it one was missed.
    """

    fruit: Key | None = None
    point: tuple[float, float] | None = None
    box: tuple[float, float, float, float] | None = None

    @model_validator(mode="after")
    def _names_a_place(self) -> SentFruit:
        if self.point is None and self.box is None:
            raise ValueError("neither a point nor a box")
        return self


@st.cache_resource(show_spinner=False)
def _shutter() -> Shutter:
    """Return the shutter of all viewers."""
    return Shutter(resources.store(), resources.waiting(), tasks.wake)


@answer
def _walk(request: Request, _: bytes) -> Any:
    asked = request.query_params
    return walk(resources.store_of(request), asked.get("round", ""), asked.get("source", ""))


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
    home = opened = round_summary.key if round_summary else ""
    with suppress(CucumberVisionError):
        preview = cameras.feed(source).preview().capture
        home = DEMONSTRATION if preview is not None and preview.simulated else home
    stops = resources.store().stops(home) if any(x.key == home for x in rounds) else []
    waiting = [x.stop for x in resources.waiting().captures() if x.round_key == home]
    place, last = next_place([*stops, *waiting]), stops[-1] if stops else None
    aside = [x for x in resources.waiting().set_aside() if x.round_key == home]
    progress, action = tasks.progress(home), _last_action(store, home)
    first = progress.first
    if opened and home != opened and not first:  # the open round itself may have stops
        first = _("No photo in the round 'Demonstration' yet: each photo's result is shown here")
    return {
        "now_s": time.time(),
        "zone_s": time.localtime().tm_gmtoff,
        "rounds": [{"key": x.key, "name": texts.round_name(x)} for x in rounds],
        "houses": resources.houses(rounds),
        "round": opened,
        "missing": bool(round_key) and round_summary is None,
        "house": round_summary.house if round_summary else "",
        "home": home,
        "source": source,
        "place": asdict(place),
        "along": resources.settings().units.along,
        "rows": _rows([*stops, *waiting]),
        "from": last and {"key": last.key, **_place(last)},
        "sides": sides_of(stops),
        "work": vars(progress),
        "first": first,
        "doubts": [
            words_of(line) for x in rounds if x.key == home for line in round_view.view_of(x).doubts
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
        "done": action and {"at_s": action.at_s, "words": texts.action_words(action)},
    }


def _rows(stops: Sequence[Stop]) -> dict[str, dict[str, Any]]:
    """Return where the walk of each row goes on, by the rows' names."""
    rows = dict.fromkeys(stop.row or "" for stop in stops)
    return {row: asdict(next_place([x for x in stops if (x.row or "") == row])) for row in rows}


def _last_stop(round_summary: Round, last: StopRecord) -> dict[str, Any]:
    """Return the last measured stop: its pictures, with the outlines of its fruit."""
    store, units = resources.store(), resources.settings().units
    record, profile = store.stop(last.key), resources.profile_of(round_summary)[1]
    views = [
        view
        for view in store.detections(last.round_key, last.key, shapes=True)
        if view.verdict is not Verdict.REJECTED
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
                "layers": fruit_pictures.stop_layers(taken, capture_views, names, units),
                "fruit": [
                    {
                        "key": view.key,
                        "number": view.fruit,
                        "length": texts.length_words(view, units),
                        "class": texts.grade_words(grades[view.key]),
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
        "name": texts.stop_name(last, units),
        "fault": fault,
        "captures": captures,
    }


def _press(_store: Store, sent: SentPresses) -> dict[str, Any]:
    open_rounds = {round_summary.key for round_summary in resources.rounds()}
    # All at once, so that no press waits for the last frames of another.
    taken = [(press, _pressed(press, open_rounds)) for press in sent.presses]
    until_s = time.monotonic() + _PRESS_S
    return {"presses": [_outcome(*pressed, until_s - time.monotonic()) for pressed in taken]}


def _pressed(sent: SentPress, open_rounds: set[str]) -> Future[Waiting] | str | None:
    """Press the shutter; return the reason instead where a press is refused."""
    try:
        stop = Stop(sent.row.strip() or None, sent.side or None, sent.position_m)
    except CucumberVisionError as error:
        return words_of(error)
    if sent.round not in open_rounds:
        return _("the round was deleted")
    feed, burst = cameras.feed(sent.source), resources.settings().burst
    return _shutter().press(feed, burst, sent.round, stop, sent.number, sent.at_s)


def _begin(store: Store, sent: SentRound) -> dict[str, Any]:
    record = resources.new_round(sent.name, sent.house)
    store.save_round(record)
    return {"round": record.key}


def _outcome(
    sent: SentPress, queued: Future[Waiting] | str | None, patience_s: float
) -> dict[str, Any]:
    """Return the outcome of a press, once it is saved or has failed.

    Parameters
    ----------
    sent : SentPress
        The press.
    queued : Future of Waiting, str or None
        As `Shutter.press` returned it; a text is the reason for a refusal.
    patience_s : float
        Longest wait; then the outcome is 'waiting', and the browser asks again.
    """
    outcome: dict[str, Any] = {"number": sent.number, "state": "saved", "words": _("Saved")}
    if queued is None:  # saved before this program was started
        return outcome
    if isinstance(queued, str):
        return outcome | {"state": "refused", "words": queued}
    try:
        saved = queued.result(max(patience_s, 0.0))
    except Exception:  # the fault is empty while it is undecided
        lost = is_lost(queued)
        state = "refused" if lost else "waiting"
        return outcome | {"state": state, "words": fault_of(queued), "lost": lost}
    units = resources.settings().units
    words = _("{stop}: saved").format(stop=texts.stop_name(saved.stop, units))
    if saved.stop.position_m != sent.position_m:
        taken = _("Another stop is already at {position}")
        words += f". {taken.format(position=texts.position_words(sent.position_m, units))}"
    where = {"stop": saved.key, "home": saved.round_key, "place": _place(saved.stop)}
    return outcome | {"words": words, **where}


def _place(stop: Stop) -> dict[str, Any]:
    return {"row": stop.row or "", "side": stop.side or "", "position_m": stop.position_m}


def _take_back(store: Store, asked: SentUndo) -> dict[str, Any]:
    """Undo a browser's last action in a round, and return it in words.

    A press is taken back by deleting its stop, measured or not.

    Raises
    ------
    StoreError
        If there is nothing to undo, the stop does not exist, or is still being measured.
    """
    action = _last_action(store, asked.round)
    if action is not None and action.at_s > (asked.at_s or 0.0):
        tasks.undo(store, asked.round, number=action.number)
        return {"words": texts.taken_back(action), "action": action.number}
    if asked.stop is None:
        raise StoreError("nothing to undo", remedy="delete a stop on the row map")
    return {"words": _delete_stop(store, asked.stop)}


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
        return _("{stop}: deleted").format(
            stop=texts.stop_name(waiting.stop, resources.settings().units)
        )
    until = time.monotonic() + _UNDO_S
    while resources.waiting().holds(key):  # it is being measured
        if time.monotonic() > until:
            raise StoreError("this stop is still being measured", remedy="try again")
        time.sleep(0.05)
    stop = store.stop(key)
    store.delete_stop(key, taken_back=True)
    tasks.merge(stop.round_key)
    return _("The last stop was deleted. 'Undo' on the row map brings it back")


def _work(title: str, round_key: str, work: Callable[[Job], Any]) -> Any:
    """Do work in its turn, since the networks serve one request at a time; return its result."""
    return resources.worker().submit(title, work, round_key).future.result()


def _outline(_store: Store, asked: SentFruit) -> dict[str, Any]:
    """Return the outlines of the object at a point or in a box, as a preview."""
    record, capture = _picture_of(asked)
    measurer = resources.measurer()
    mask = _work(
        marked("Outlining the fruit"),
        record.round_key,
        lambda _: measurer.draft_of(capture, asked.point, asked.box),
    )
    return {"outline": fruit_pictures.mask_outline(mask)}


def _prepare(_store: Store, asked: SentPicture) -> dict[str, Any]:
    """Begin to compute what outlining needs of a picture, since somebody is about to tap into it.

    Raises
    ------
    StoreError
        If the picture is not there.
    """
    record, capture = _picture_of(asked)
    measurer = resources.measurer()
    title = marked("Preparing the picture")
    resources.worker().submit(title, lambda _: measurer.prepare(capture), record.round_key)
    return {}


def _add_fruit(store: Store, asked: SentFruit) -> dict[str, Any]:
    """Outline and measure a fruit that was missed, or one anew.

    Raises
    ------
    InstancesError
        If there is no fruit, it is another one, or it was found before.
    """
    record, capture = _picture_of(asked)
    options, measurer = resources.settings().options, resources.measurer()

    def work(_: Job) -> Any:
        mask = measurer.mask_of(capture, asked.point, asked.box)
        if asked.fruit is None:
            return measurer.add(store, record, capture, mask, options)
        return measurer.correct(store, store.detection(asked.fruit), capture, mask, options)

    measured = _work(marked("Measuring the fruit"), record.round_key, work)
    if asked.fruit is not None:
        return {"action": measured}
    return {"words": texts.added_words(doubtful=store.detection(measured).view.doubtful)}


def _picture_of(asked: SentPicture) -> tuple[StopRecord, Capture]:
    store = resources.store()
    record = store.stop(asked.stop)
    taken = next((capture for capture in record.captures if capture.name == asked.capture), None)
    if taken is None:
        raise StoreError("this picture is not there any more", remedy="reload the page")
    return record, round_view.capture_of(record, taken)


@answer
def _retry(request: Request, content: bytes) -> Any:  # noqa: ARG001
    cameras.camera().retry()
    return {}


@answer
def _news(request: Request, _: bytes) -> Any:
    return round_view.news(request.query_params.get("round", ""))


@answer
def _preview(request: Request, _: bytes) -> Any:
    asked = request.query_params
    picture = newest(asked.get("source", "camera"), asked.get("shown", ""))
    return Response(picture, 200 if picture else 204, {"cache-control": "no-store"})


@answer
def _picture(request: Request, _: bytes) -> Any:
    stop, name = request.path_params["stop"], request.path_params["capture"]
    taken = {capture.name: capture for capture in resources.store().stop(stop).captures}.get(name)
    if taken is None or taken.color is None:
        raise HTTPException(404)
    picture = as_jpeg(resources.store().images.read_color(taken.color))
    headers = {"cache-control": "private, max-age=86400, immutable"}
    return Response(picture, media_type="image/jpeg", headers=headers)


async def _capture_page(request: Request) -> Response:
    return _file(request, _STATIC / "capture.html", {})


def _file(request: Request, path: Path, headers: dict[str, str]) -> Response:
    """Answer with a file; one with texts has them in the language of its reader."""
    headers = {"cache-control": "no-cache", "vary": "accept-language", **headers}
    kind = path.suffix.removeprefix(".")
    if kind not in _MEDIA_TYPES:
        return FileResponse(path, headers=headers)
    ask_for(request.headers.get("accept-language"))
    content = page_text(path.read_text(encoding="utf-8"), kind)
    return Response(content, media_type=_MEDIA_TYPES[kind], headers=headers)


async def _static(request: Request) -> Response:
    """Answer with a file of the package's folder, and of no other."""
    name = request.path_params["name"]
    if name == "theme.css":
        return Response(style_sheet(), media_type="text/css", headers={"cache-control": "no-cache"})
    shared = name.startswith("picture.")
    path = (fruit_pictures.PICTURE_FILES if shared else _STATIC) / name
    if path.parent not in {fruit_pictures.PICTURE_FILES, _STATIC} or not path.is_file():
        raise HTTPException(404)
    # A service worker must lie at or above the address of the page that it caches.
    return _file(request, path, {"service-worker-allowed": "/capture"})


def _post(path: str, kind: type[SentT], act: Callable[[Store, SentT], Any]) -> Route:
    """Return a route that does something with the content of a request."""

    @answer
    def work(request: Request, content: bytes) -> Any:
        return act(resources.store_of(request), kind.model_validate_json(content))

    return Route(path, work, methods=["POST"])


def routes() -> list[Route]:
    """Return the routes of the capture page."""
    return [
        Route("/capture", _capture_page),
        Route("/capture/{name}", _static),
        Route("/api/walk", _walk),
        _post("/api/press", SentPresses, _press),
        _post("/api/rounds", SentRound, _begin),
        _post("/api/undo", SentUndo, _take_back),
        _post("/api/fruit", SentFruit, _add_fruit),
        _post("/api/prepare", SentPicture, _prepare),
        _post("/api/outline", SentFruit, _outline),
        Route("/api/camera", _retry, methods=["POST"]),
        Route("/api/picture/{stop}/{capture:path}", _picture),
        Route("/api/preview", _preview),
        Route("/api/news", _news),
    ]


# What the core advises.
_ADVICE = (
    marked("No depth: too near, or the lens is covered"),
    marked("Too near: step back"),
    marked("Too far: step closer"),
    marked("The camera moves: hold still"),
    marked("Many holes: avoid glare, hold still"),
    marked("Good distance and depth"),
)
_PREVIEW_PX = 640


def newest(source: str, shown: str) -> bytes:
    """Return the newest picture of a source as `encoded`; nothing if it is the one shown already.

    Parameters
    ----------
    source : str
        'camera' or 'replay'.
    shown : str
        The number of the picture that a page shows; empty for none.
    """
    try:
        preview = cameras.feed(source).preview()
    except CucumberVisionError as error:
        header = {"state": "absent", "message": words_of(error), "number": "fault"}
        return b"" if shown == "fault" else _framed(header)
    return b"" if shown == str(preview.number) else encoded(preview, language())


@lru_cache(maxsize=4)  # encoded once for all viewers
def encoded(preview: Preview, _language: str = "en") -> bytes:
    """Return a preview as a message: the header's length, the header as JSON, colour, depth.

    Two JPEGs follow the header where there is a picture; it gives the first one's length.
    """
    header: dict[str, Any] = {
        "state": preview.state,
        "message": words_of(preview.message),
        "number": preview.number,
    }
    capture, quality = preview.capture, preview.quality
    if capture is None:
        return _framed(header)
    color = as_jpeg(capture.color, _PREVIEW_PX)
    units = resources.settings().units
    depth, words = fruit_pictures.depth_picture(capture.depth_m[::2, ::2], units)
    distance_m = None if quality is None else quality.distance_m
    header |= {
        "color_bytes": len(color),
        "size": [capture.width, capture.height],
        "name": capture.name,
        "simulated": capture.simulated,
        "depth": words,
        "bar": fruit_pictures.scale_bar(capture.intrinsics, distance_m, units),
    }
    if quality is not None:
        header["quality"] = {
            "seen": f"{100 * quality.fill:.0f} %",
            "distance": units.text(quality.distance_m),
            "verdict": quality.verdict,
            "advice": _(quality.advice),
        }
    return _framed(header, color, as_jpeg(depth, _PREVIEW_PX))


def _framed(header: dict[str, Any], *parts: bytes) -> bytes:
    words = json.dumps(header).encode()
    return b"".join((struct.pack("<I", len(words)), words, *parts))
