"""Errors, doubts and rules of the core as a page shows them: its own remedies, in its language."""

from __future__ import annotations

import string
from typing import Annotated, Any

from pydantic import PlainSerializer, PlainValidator

from cucumbervision.errors import CucumberVisionError, Message
from cucumbervision_greenhouse.language import decimal_words, marked, ngettext
from cucumbervision_greenhouse.language import gettext as _

# Remedies of the core that name options of commands, and what a page has instead of them.
ON_PAGES = {
    "calibrate this camera, or measure it without --calibration": marked(
        "calibrate this camera, or choose no calibration in 'Settings'"
    ),
    "align depth to colour, so that both have one size; or, if depth has the colour camera's "
    "field of view in fewer pixels, say so with --aligned-to color": marked(
        "align depth to colour, so that both have one size; or, if depth has the colour camera's "
        "field of view in fewer pixels, say aligned_to: color in the camera file sent with it"
    ),
    "give the colour stream's intrinsics; or, if the colour picture was aligned to depth, say so "
    "with --aligned-to depth": marked(
        "give the colour stream's intrinsics; or, if the colour picture was aligned to depth, "
        "say aligned_to: depth in the camera file sent with it"
    ),
    "check the unit of depth (--depth-unit 0.001 is 1 mm a step)": marked(
        "check the unit of depth (depth_unit_m: 0.001 in the camera file is 1 mm a step)"
    ),
    "is one step of depth really 1 mm? --depth-unit {steps} would explain it": marked(
        "is one step of depth really 1 mm? depth_unit_m: {steps} in the camera file would "
        "explain it"
    ),
    "read such depth with --depth-along ray": marked(
        "say depth_along: ray in the camera file sent with it"
    ),
    "leave out --depth-along and --aligned-to": marked("leave both out of the camera file"),
    "give the colour camera's with --intrinsics FILE": marked(
        "give the colour camera's as an intrinsics file"
    ),
    "begin its name as the pictures' (cam1_intrinsics.json), or give --intrinsics": marked(
        "begin its name as the pictures' (cam1_intrinsics.json), or send one camera file alone"
    ),
    "leave --input-size out, or export the network with dynamic sizes": marked(
        "choose the input size in 'Settings'"
    ),
    "choose another --input-size": marked("choose the input size in 'Settings'"),
    "put them into mask_visib/, or choose other --instances": marked(
        "choose where fruit come from in 'Settings'"
    ),
    "measured as fruit: {classes}; --classes chooses among them": marked(
        "measured as fruit: {classes}"
    ),
}


class _Local(string.Formatter):
    """Fills parts in as the language writes them."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, Message):
            return words_of(value)
        text = super().format_field(value, format_spec)
        return decimal_words(text) if isinstance(value, float) else text


def words_of(text: object) -> str:
    """Return an error, a doubt or a rule of the core in the language shown.

    What has no translation, or is no `Message`, stays English.

    Examples
    --------
    >>> words_of(CucumberVisionError("no fruit", remedy="choose another --input-size"))
    "no fruit; choose the input size in 'Settings'"
    """
    message = text.line if isinstance(text, CucumberVisionError) else text
    if not isinstance(message, Message):
        return str(text)
    template, parts = ON_PAGES.get(message.template, message.template), message.parts
    if isinstance(number := parts.get("n"), int):
        template = ngettext(template, template, number)
    else:
        template = _(template)
    return _Local().vformat(template, (), parts) if parts else template


StoredMessage = Annotated[str, PlainValidator(Message.from_json), PlainSerializer(Message.as_json)]
"""A message within a Pydantic model, which keeps its parts in JSON."""
