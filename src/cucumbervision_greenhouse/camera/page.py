"""Routes of the capture page: the page, its pictures, presses and news.

The page is used while walking, where connections drop, so it is made of plain modules without
Streamlit, and asks for news and pictures again and again.
"""

from __future__ import annotations

import json
import struct
import time
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import streamlit as st
from pydantic import Field, model_validator
from starlette.exceptions import HTTPException
from starlette.responses import FileResponse, Response
from starlette.routing import Route

from cucumbervision.capture.frames import Stop
from cucumbervision.errors import CucumberVisionError, NameRefusedError
from cucumbervision.names import LONGEST_NAME
from cucumbervision.run.overlay import as_jpeg
from cucumbervision_greenhouse import resources, round_view, tasks
from cucumbervision_greenhouse.answers import Key, Sent, answer, store_of
from cucumbervision_greenhouse.camera import cameras, state
from cucumbervision_greenhouse.camera.shutter import Press, Shutter
from cucumbervision_greenhouse.fruit_pictures import PICTURE_FILES, depth_picture, scale_bar
from cucumbervision_greenhouse.language import ask_for, language, marked, page_text, words_of
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.store.records import Round
from cucumbervision_greenhouse.theme import style_sheet

if TYPE_CHECKING:
    from starlette.requests import Request

    from cucumbervision_greenhouse.camera.cameras import Preview
    from cucumbervision_greenhouse.camera.shutter import Pressed


_STATIC = Path(__file__).with_name("static")
_MEDIA_TYPES = {"html": "text/html", "js": "text/javascript"}  # of files with texts
_PRESS_S = 4.0  # longest delay of the answer until presses are saved
_LONGEST_ROW_M = 1000.0
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

    stop: Key | None = None
    at_s: Moment | None = None
    round: Key | None = None


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
    return state.walk(store_of(request), asked.get("round", ""), asked.get("source", ""))


@answer
def _press(request: Request, content: bytes) -> Any:  # noqa: ARG001
    sent = SentPresses.model_validate_json(content).presses
    burst, round_keys = (
        resources.settings().burst,
        {round_summary.key for round_summary in resources.rounds()},
    )
    taken: list[Pressed | str | None] = []
    for sent_press in sent:  # all at once, so that no press waits for the last frames of another
        try:
            stop = Stop(
                sent_press.row.strip() or None, sent_press.side or None, sent_press.position_m
            )
        except NameRefusedError as error:
            taken.append(words_of(error))
            continue
        if sent_press.position_m > _LONGEST_ROW_M:
            taken.append(_("no row is as long as this position: correct it and press again"))
            continue
        press = Press(sent_press.number, sent_press.at_s)
        if sent_press.round not in round_keys:
            taken.append(_("the round was deleted"))
            continue
        feed = cameras.feed(sent_press.source)
        taken.append(_shutter().press(feed, burst, sent_press.round, stop, press))
    until_s = time.monotonic() + _PRESS_S
    return {
        "presses": [
            {"number": sent_press.number, **state.outcome(pressed, until_s - time.monotonic())}
            for sent_press, pressed in zip(sent, taken, strict=True)
        ]
    }


@answer
def _begin(request: Request, content: bytes) -> Any:
    sent = SentRound.model_validate_json(content)
    profile = resources.settings().profile
    record = Round(name=sent.name, house=sent.house, profile=profile)
    store_of(request).save_round(record)
    return {"round": record.key}


@answer
def _undo(request: Request, content: bytes) -> Any:
    return state.take_back(store_of(request), SentUndo.model_validate_json(content))


@answer
def _add_fruit(request: Request, content: bytes) -> Any:
    sent = SentFruit.model_validate_json(content)
    if sent.fruit is not None:
        return state.correct_fruit(store_of(request), sent, sent.fruit)
    return state.add_fruit(store_of(request), sent)


@answer
def _prepare(request: Request, content: bytes) -> Any:  # noqa: ARG001
    state.prepare(SentPicture.model_validate_json(content))
    return {}


@answer
def _outline(request: Request, content: bytes) -> Any:  # noqa: ARG001
    sent = SentFruit.model_validate_json(content)
    return state.outline(sent)


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
    path = (PICTURE_FILES if shared else _STATIC) / name
    if path.parent not in {PICTURE_FILES, _STATIC} or not path.is_file():
        raise HTTPException(404)
    # A service worker must lie at or above the address of the page that it caches.
    return _file(request, path, {"service-worker-allowed": "/capture"})


def routes() -> list[Route]:
    """Return the routes of the capture page."""
    post = ["POST"]
    return [
        Route("/capture", _capture_page),
        Route("/capture/{name}", _static),
        Route("/api/walk", _walk),
        Route("/api/press", _press, methods=post),
        Route("/api/rounds", _begin, methods=post),
        Route("/api/undo", _undo, methods=post),
        Route("/api/fruit", _add_fruit, methods=post),
        Route("/api/prepare", _prepare, methods=post),
        Route("/api/outline", _outline, methods=post),
        Route("/api/camera", _retry, methods=post),
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
_LOOK_S = 0.03  # interval between checks for a new picture
_PREVIEW_PX = 640
_STILL_PX, _STILL_LEVELS = (64, 36), 3  # blocks of this size average a camera's noise


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
    depth, words = depth_picture(capture.depth_m[::2, ::2], units)
    distance_m = None if quality is None else quality.distance_m
    header |= {
        "color_bytes": len(color),
        "size": [capture.width, capture.height],
        "name": capture.name,
        "simulated": capture.simulated,
        "depth": words,
        "bar": scale_bar(capture.intrinsics, distance_m, units),
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
