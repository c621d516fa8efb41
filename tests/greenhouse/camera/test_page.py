from __future__ import annotations

import json
import struct
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from tests.greenhouse.conftest import whole_stop

pytest.importorskip("streamlit")
pytest.importorskip("httpx2")

from starlette.testclient import TestClient

from cucumbervision_greenhouse import resources, tasks
from cucumbervision_greenhouse.access import DEVICE, AccessGuard
from cucumbervision_greenhouse.rounds.walking import DEMONSTRATION
from cucumbervision_greenhouse.store.images import ImageStore
from cucumbervision_greenhouse.store.records import StopRecord, Verdict, key_of
from cucumbervision_greenhouse.store.repository import Store

WALK = key_of("walk")

pytestmark = pytest.mark.usefixtures("fresh_caches")


def sent(number: str, at_s: float, position_m: float = 9.0, **other: Any) -> dict[str, Any]:
    place = {"row": "1", "side": "left", "position_m": position_m}
    return {"number": number, "at_s": at_s, "round": WALK, "source": "replay", **place, **other}


def press(asked: TestClient, *presses: dict[str, Any]) -> list[dict[str, Any]]:
    while True:  # as the page does, while any waits
        answer = asked.post("/api/press", json={"presses": presses})
        assert answer.status_code == 200, answer.text
        told = list(answer.json()["presses"])
        if all(one["state"] != "waiting" for one in told):
            return told


def wait_for_jobs() -> None:
    while jobs := resources.worker().unfinished():
        assert jobs[0].wait(600)


def test_a_press_sent_again_is_the_same_stop_and_is_measured(
    asked: TestClient, store: Store
) -> None:
    resources.change_settings(fruit_from="dataset")
    shown = {"round": WALK, "source": "replay"}
    walk = asked.get("/api/walk", params=shown).json()
    assert walk["home"] == DEMONSTRATION  # at once, so that no position of the other round counts
    assert walk["last"] is None  # the open round has stops: that there are none would be wrong
    assert walk["first"].startswith("No photo in the round 'Demonstration' yet")
    first = sent("a", time.time() + 0.01)
    (saved,) = press(asked, first)
    assert saved["state"] == "saved"
    assert saved["words"] == "Stop 1: row 1, left, 9.00 m: saved"
    again = press(asked, first, first, sent("b", time.time()))
    assert [one["state"] for one in again] == ["saved"] * 3
    assert again[0] == again[1] == saved
    # The place is taken meanwhile: one step on from there, and that is said.
    assert again[2]["place"]["position_m"] == 9.4
    assert "already at 9.00 m" in again[2]["words"]
    wait_for_jobs()
    # Computer-made captures never go into a grower's round.
    assert [stop.position_m for stop in store.stops(DEMONSTRATION)] == [9.0, 9.4]
    walk = asked.get("/api/walk", params={"round": WALK, "source": "replay"}).json()
    assert (walk["round"], walk["home"]) == (WALK, DEMONSTRATION)
    assert walk["place"]["position_m"] == 9.8
    assert walk["last"]["name"] == "Stop 2: row 1, left, 9.40 m"
    (capture,) = walk["last"]["captures"]
    assert all(one["length"].endswith(" cm") for one in capture["fruit"])
    picture = asked.get(capture["picture"])
    assert picture.headers["content-type"] == "image/jpeg"
    assert picture.content[:2] == b"\xff\xd8"


def test_a_press_is_refused_where_its_round_is_gone_or_its_place_is_too_far(
    asked: TestClient,
) -> None:
    far = sent("c", time.time(), position_m=10_000.0)
    lost, far_off = press(asked, sent("b", 0.0, round=key_of("gone")), far)
    assert lost["state"] == far_off["state"] == "refused"
    assert far_off["words"].startswith("no row is as long")
    assert lost["words"] == "the round was deleted"
    assert resources.waiting().captures() == []


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        json.dumps({"presses": [{"number": "a"}]}),
        json.dumps({"presses": [sent("../../a", 0.0)]}),
        json.dumps({"presses": [sent("a", 0.0, position_m=-1)]}),
        json.dumps({"presses": [sent("a", 0.0, source="/etc")]}),
        *(json.dumps({"presses": [sent("a", at_s)]}) for at_s in (1e308, -1.0, 5e9)),
        json.dumps({"presses": [sent("a", 0.0)] * 51}),
    ],
)
def test_a_damaged_request_is_told_in_a_line(asked: TestClient, content: str) -> None:
    answer = asked.post("/api/press", content=content)
    assert (answer.status_code, answer.json()) == (
        400,
        {"error": "the request is damaged; reload the page"},
    )


@pytest.mark.parametrize(
    ("path", "most_mb"),
    [
        ("/api/press", 0.25),
        ("/api/rounds", 0.25),
        ("/api/uploads", 4),
        (f"/api/uploads/{WALK}/0", 16),
    ],
)
def test_a_body_that_is_too_large_is_refused_while_it_is_read(
    asked: TestClient, path: str, most_mb: float
) -> None:
    def body() -> Iterator[bytes]:
        for _ in range(20):
            yield bytes(2**20)

    guarded = TestClient(AccessGuard(asked.app), "http://localhost")
    refused = guarded.post(path, content=body())  # without its length
    assert refused.status_code == 413
    assert "is larger than" in refused.json()["error"]
    announced = guarded.post(path, content=bytes(int(most_mb * 2**20) + 1))
    assert announced.status_code == 413
    assert guarded.post(path, content=b"x" * int(most_mb * 2**20)).status_code in (400, 409, 422)


def test_the_last_stop_is_taken_back_measured_or_not(
    asked: TestClient, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tasks, "wake", lambda: None)  # nothing is measured
    (saved,) = press(asked, sent("a", time.time() + 0.01))
    pressed = {"round": WALK, "at_s": time.time()}
    answer = asked.post("/api/undo", json={**pressed, "stop": saved["stop"]}).json()
    assert answer == {"words": "Stop 1: row 1, left, 9.00 m: deleted"}
    assert resources.waiting().captures() == []
    last = store.stops(WALK)[-1]
    deleted = asked.post("/api/undo", json={**pressed, "stop": last.key}).json()
    assert "was deleted" in deleted["words"]
    wait_for_jobs()
    assert store.stop_is_deleted(last.key)
    gone = asked.post("/api/undo", json={**pressed, "stop": key_of("no stop")})
    assert gone.status_code == 409
    assert "\n" not in gone.json()["error"]


def test_undo_takes_back_the_last_thing_of_this_browser_and_only_that(
    asked: TestClient, store: Store
) -> None:
    stop = store.stops(WALK)[-1]
    first, second, third = (one.key for one in store.detections(WALK)[:3])
    ana = TestClient(asked.app, cookies={DEVICE: "ana"})
    bert = TestClient(asked.app, cookies={DEVICE: "bert"})

    def rejected() -> set[str]:
        return {x.key for x in store.detections(WALK) if x.verdict is Verdict.REJECTED}

    store.signed("dashboard", "ana").set_verdict([first], Verdict.REJECTED)
    store.signed("dashboard", "ana").set_verdict([second], Verdict.REJECTED)
    store.signed("dashboard", "bert").set_verdict([third], Verdict.REJECTED)
    pressed = {"round": WALK, "stop": stop.key, "at_s": stop.taken_s}  # before all of it
    walk = ana.get("/api/walk", params={"round": WALK, "source": "camera"}).json()
    assert walk["done"]["words"] == "not a fruit"
    undone = "Taken back: not a fruit"
    assert ana.post("/api/undo", json=pressed).json()["words"] == undone
    assert rejected() == {first, third}  # not what bert did since
    assert ana.post("/api/undo", json=pressed).json()["words"] == undone
    assert rejected() == {third}
    # Now the press is ana's last thing: its stop goes, and is not brought back by the next undo.
    assert ana.post("/api/undo", json=pressed).json()["words"].startswith("The last stop")
    assert store.stop_is_deleted(stop.key)
    again = ana.post("/api/undo", json={"round": WALK})
    assert (again.status_code, again.json()["error"].split(";")[0]) == (409, "nothing to undo")
    assert store.stop_is_deleted(stop.key)
    assert bert.post("/api/undo", json={"round": WALK}).json()["words"] == undone
    assert rejected() == set()
    wait_for_jobs()


def test_undo_after_a_fruit_was_added_leaves_its_stop(asked: TestClient, store: Store) -> None:
    stop = store.stops(WALK)[-1]
    capture = whole_stop(store, stop.key).captures[0]
    one = capture.fruit[0]
    store.signed("dashboard").add_fruit(stop.key, capture.name, one.with_(mask=None))
    before = len(store.detections(WALK))
    asked.post("/api/undo", json={"round": WALK, "stop": stop.key, "at_s": stop.taken_s})
    assert store.stop_is_deleted(stop.key) is False
    assert len(store.detections(WALK)) == before - 1


def test_a_round_is_begun(asked: TestClient, store: Store) -> None:
    begun = asked.post("/api/rounds", json={"name": " Evening ", "house": "2"}).json()["round"]
    one = next(one for one in store.rounds() if one.key == begun)
    assert (one.name, one.house) == ("Evening", "2")
    assert one.profile == "long-cucumber"
    walk = asked.get("/api/walk", params={"round": begun, "source": "camera"}).json()
    assert (walk["round"], walk["last"], walk["place"]["row"]) == (begun, None, "1")


def test_a_walk_of_no_round_opens_no_other_one(asked: TestClient) -> None:
    walk = asked.get("/api/walk", params={"round": "nonsense", "source": "camera"}).json()
    assert (walk["missing"], walk["round"], walk["home"], walk["last"]) == (True, "", "", None)
    newest = asked.get("/api/walk", params={"source": "camera"}).json()
    assert (newest["missing"], newest["round"]) == (False, WALK)


def test_a_walk_says_where_each_row_goes_on(asked: TestClient, store: Store) -> None:
    for step, row, at_m in ((1, "8", 0.5), (2, "8", 1.0), (3, "9", 2.0)):
        store.save_stop(StopRecord(row, "left", at_m, step, key_of(step), WALK))
    walk = asked.get("/api/walk", params={"round": WALK, "source": "camera"}).json()
    assert (walk["rows"]["8"]["position_m"], walk["rows"]["9"]["position_m"]) == (1.5, 2.4)
    assert "10" not in walk["rows"]


def test_a_missed_fruit_is_no_second_one_and_none_where_none_is(
    asked: TestClient, store: Store
) -> None:
    view = store.detections(WALK)[0]
    box = view
    middle = [(box.box_x1_px + box.box_x2_px) / 2, (box.box_y1_px + box.box_y2_px) / 2]
    fruit = {"stop": view.stop_key, "capture": view.capture}
    there = asked.post("/api/fruit", json={**fruit, "point": middle})
    assert there.status_code == 409
    assert "there already" in there.json()["error"]
    for path in ("/api/fruit", "/api/outline"):
        gone = asked.post(path, json={**fruit, "capture": "other", "point": middle})
        assert "not there any more" in gone.json()["error"]
        assert asked.post(path, json=fruit).status_code == 400
    assert len(store.detections(WALK)) == 8


def test_a_fruit_is_outlined_before_it_is_measured(asked: TestClient, store: Store) -> None:
    view = store.detections(WALK)[0]
    box = view
    edges = [box.box_x1_px, box.box_y1_px, box.box_x2_px, box.box_y2_px]
    sent = {"stop": view.stop_key, "capture": view.capture, "box": edges}
    (line,) = asked.post("/api/outline", json=sent).json()["outline"]
    points = np.reshape(line, (-1, 2))
    drawn = [*points.min(axis=0), *points.max(axis=0)]
    np.testing.assert_allclose(drawn, edges, atol=0.1 * (edges[2] - edges[0]))
    assert len(store.detections(WALK)) == 8
    assert not store.detection(view.key).view.corrected


@pytest.mark.parametrize("name", ["../routes.py", "%2e%2e%2froutes.py", "none.js", ""])
def test_only_the_page_s_own_files_are_given(asked: TestClient, name: str) -> None:
    assert asked.get(f"/capture/{name}", follow_redirects=False).status_code in (307, 404)


def test_the_capture_page_names_what_it_needs(asked: TestClient) -> None:
    page = asked.get("/capture").text
    for part in ("capture.js", "capture.css", "capture.webmanifest", "icon.svg"):
        assert f"/capture/{part}" in page
        assert asked.get(f"/capture/{part}").status_code == 200
    worker = asked.get("/capture/capture-offline.js")
    assert worker.headers["service-worker-allowed"] == "/capture"


def test_a_fruit_is_outlined_anew_and_its_picture_read_once(
    asked: TestClient, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads: list[object] = []
    read = ImageStore.read_depth

    def reading(images: ImageStore, *given: Any) -> Any:
        reads.append(given)
        return read(images, *given)

    monkeypatch.setattr(ImageStore, "read_depth", reading)
    view = store.detections(WALK)[0]
    box = view
    sent = {
        "stop": view.stop_key,
        "capture": view.capture,
        "point": [(box.box_x1_px + box.box_x2_px) / 2, (box.box_y1_px + box.box_y2_px) / 2],
    }
    assert asked.post("/api/outline", json=sent).status_code == 200
    done = asked.post("/api/fruit", json={**sent, "fruit": view.key}).json()
    assert done["action"] == store.log(WALK)[0].number
    assert store.detection(view.key).view.corrected
    assert store.log(WALK)[0].kind == "correct"
    assert len(store.detections(WALK)) == 8
    assert len(reads) == 1
    other = store.detections(WALK)[1].key
    refused = asked.post("/api/fruit", json={**sent, "fruit": other})
    assert "there already" in refused.json()["error"]


def test_a_picture_is_sent_once_and_the_next_after_a_press(asked: TestClient) -> None:
    def ask(shown: int | str = "") -> Any:
        return asked.get("/api/preview", params={"source": "replay", "shown": shown})

    header, *_ = read(ask().content)
    assert (header["state"], header["simulated"]) == ("replay", True)
    assert header["quality"]["seen"] == "100 %"
    assert ask(header["number"]).status_code == 204
    press(asked, sent("a", time.time()))
    after, color, depth = read(ask(header["number"]).content)
    assert after["name"] != header["name"]
    assert color[:2] == depth[:2] == b"\xff\xd8"
    wait_for_jobs()


def read(message: bytes) -> tuple[dict[str, Any], bytes, bytes]:
    """A message of the preview: header, colour, depth."""
    (length,) = struct.unpack("<I", message[:4])
    header = json.loads(message[4 : 4 + length])
    at = 4 + length + header.get("color_bytes", 0)
    return header, message[4 + length : at], message[at:]
