"""The camera's newest picture as the capture page asks for it."""

from __future__ import annotations

import json
import struct
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from cucumbervision.errors import CucumberVisionError
from cucumbervision.run.overlay import as_jpeg
from cucumbervision_greenhouse import resources
from cucumbervision_greenhouse.camera import cameras
from cucumbervision_greenhouse.core_words import words_of
from cucumbervision_greenhouse.fruit_pictures import depth_picture, scale_bar
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.language import language, marked

if TYPE_CHECKING:
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
