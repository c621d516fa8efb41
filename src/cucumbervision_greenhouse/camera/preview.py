"""The camera's pictures by WebSocket: the next one once the last was shown, if it differs."""

from __future__ import annotations

import json
import struct
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from cucumbervision.errors import CucumberVisionError
from cucumbervision.pipeline.overlay import as_jpeg
from cucumbervision_greenhouse import resources
from cucumbervision_greenhouse.answers import send_changes
from cucumbervision_greenhouse.camera import cameras
from cucumbervision_greenhouse.core_words import words_of
from cucumbervision_greenhouse.fruit_pictures import depth_picture, scale_bar
from cucumbervision_greenhouse.language import ask_for, language, marked
from cucumbervision_greenhouse.language import gettext as _

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from starlette.websockets import WebSocket

    from cucumbervision_greenhouse.camera.cameras import Preview


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


async def preview(socket: WebSocket) -> None:
    """Send a feed's pictures, each once the last one was shown, and only if it differs."""
    kind: Any = "replay" if socket.query_params.get("source") == "replay" else "camera"
    sent = Shown()
    ask_for(socket.headers.get("accept-language"))

    def look() -> bytes | None:
        try:
            preview_now = cameras.feed(kind).preview()
        except CucumberVisionError as error:
            return (
                _framed({"state": "absent", "message": words_of(error)}) if sent.fails() else None
            )
        return encoded(preview_now, language()) if sent.changes(preview_now) else None

    await send_changes(socket, look, _LOOK_S)


class Shown:
    """The last picture that a viewer saw, to detect changes."""

    def __init__(self) -> None:
        self._state: tuple[object, ...] = ()
        self._small: NDArray[np.uint8] | None = None

    def fails(self) -> bool:
        """Return whether the absence of a picture has not been sent yet."""
        before, self._state = self._state, ("failed",)
        return before != self._state

    def changes(self, preview: Preview) -> bool:
        """Return whether a picture differs from the one before by more than a camera's noise."""
        words = None if preview.quality is None else preview.quality.advice
        state = preview.state, words, preview.message
        if preview.capture is None:
            changed = state != self._state
        else:
            size = _STILL_PX
            small = cv2.resize(preview.capture.color[::4, ::4], size, interpolation=cv2.INTER_AREA)
            before, changed = self._small, state != self._state
            if before is None or before.shape != small.shape:
                changed = True
            elif not changed:
                levels = np.abs(small.astype(np.int16) - before.astype(np.int16)).max()
                changed = int(levels) > _STILL_LEVELS
            if changed:
                self._small = np.asarray(small, np.uint8)
        self._state = state
        return changed


@lru_cache(maxsize=4)  # encoded once for all viewers
def encoded(preview: Preview, _language: str = "en") -> bytes:
    """Return a preview as a message: the header's length, the header as JSON, colour, depth.

    Two JPEGs follow the header where there is a picture; it gives the first one's length.
    """
    header: dict[str, Any] = {"state": preview.state, "message": words_of(preview.message)}
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
