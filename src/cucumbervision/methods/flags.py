"""The table of flags of a measurement, with their texts and effects."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from cucumbervision.errors import Message


class Flag(StrEnum):
    """Codes of flags; stable, for tables."""

    CUT_BY_FRAME = "cut-by-frame"
    BOX_CLIPPED = "box-clipped"
    END_HIDDEN = "end-hidden"
    ENDS_DISAGREE = "ends-disagree"
    ENDS_UNSURE = "ends-unsure"
    UPPER_END = "upper-end-doubtful"
    LOWER_END = "lower-end-doubtful"
    LEFT_END = "left-end-doubtful"
    RIGHT_END = "right-end-doubtful"
    END_ON = "end-on"
    PART_HIDDEN = "part-hidden"
    POOR_FIT = "poor-fit"
    UNCERTAIN = "uncertain"
    INTERVAL_TOO_WIDE = "interval-too-wide"
    DETECTOR_MASK = "detector-mask"
    SAM_MASK_EMPTY = "sam-mask-empty"
    SAM_MASK_SMALL = "sam-mask-small"
    SAM_MASK_OFF_BOX = "sam-mask-off-box"
    SAM_MASK_OFF_DETECTOR = "sam-mask-off-detector"
    NOT_COVERED = "calibration-not-covered"
    OTHER_MASK = "calibration-other-mask"
    OTHER_VERSION = "calibration-other-version"
    OUTSIDE_RANGE = "outside-calibrated-range"
    DEPTH_UNIT = "depth-unit"
    DEPTH_TOO_NEAR = "depth-too-near"
    DEPTH_SPARSE = "depth-sparse"
    DEPTH_HOLLOW = "depth-hollow"
    DEPTH_GAP = "depth-gap"
    DEPTH_UNALIGNED = "depth-unaligned"
    DEPTH_COARSE = "depth-coarse"
    DEPTH_ALONG_RAY = "depth-along-ray"
    OUTLINE_SHORT = "outline-short"
    OUTLINE_STEM = "outline-stem"
    PRINCIPAL_POINT = "principal-point"
    DEPTH_RESAMPLED = "depth-resampled"
    PLUGIN_FAILED = "plugin-failed"
    DOUBTFUL = "doubtful"


class Effect(StrEnum):
    """Effect of a flag on the length."""

    NONE = "none"
    LOWER_BOUND = "lower bound"
    """The fruit goes on out of sight: it is at least as long as was measured."""
    NO_DEPTH = "no depth"
    """Its depth cannot be its distance: the length is no lower bound either."""


@dataclass(frozen=True)
class FlagMeaning:
    """One line of `flags.csv`.

    Parameters
    ----------
    meaning : str
        Description in the documentation.
    effect : Effect
        Effect on the length.
    shows_less : bool
        Whether a view with it shows its fruit less well than one without.
    remark : str
        Remark beside a fruit; empty if the length does not depend on the flag.
    data_fault, remedy : str
        Doubt about the data and its remedy, reported once per run if fruit have the flag. Empty if
        the data are not the cause.
    """

    meaning: str
    effect: Effect
    shows_less: bool
    remark: str
    data_fault: str
    remedy: str


def _read_flags() -> dict[Flag, FlagMeaning]:
    text = Path(__file__).with_name("flags.csv").read_text(encoding="utf-8")
    flags = {}
    for code, effect, shows_less, meaning, *texts in list(csv.reader(text.splitlines()))[1:]:
        effects = Effect(effect or "none"), bool(shows_less)
        flags[Flag(code)] = FlagMeaning(meaning, *effects, *texts)
    return flags


FLAGS: Mapping[Flag, FlagMeaning] = _read_flags()
"""All flags, in the order of the documentation."""


def _with_effect(effect: Effect) -> frozenset[Flag]:
    return frozenset(flag for flag, line in FLAGS.items() if line.effect is effect)


LOWER_BOUND = _with_effect(Effect.LOWER_BOUND)
"""Flags of a fruit that goes on out of sight."""

NO_DEPTH = _with_effect(Effect.NO_DEPTH)
"""Flags of a fruit whose depth cannot be its distance."""

SHOWS_LESS = frozenset(flag for flag, line in FLAGS.items() if line.shows_less)
"""Flags of a view that shows its fruit less well than one without."""


def is_lower_bound(flags: Iterable[str]) -> bool:
    """Return whether flags mark a length as a lower bound: the fruit continues out of sight.

    Examples
    --------
    >>> is_lower_bound(["end-hidden"]), is_lower_bound(["end-hidden", "depth-hollow"])
    (True, False)
    """
    codes = {*flags}
    return not LOWER_BOUND.isdisjoint(codes) and NO_DEPTH.isdisjoint(codes)


def flag_remarks(flags: str, at_least: str = "") -> str:
    """Return the flags of a measurement that affect its length, as short sentences.

    Parameters
    ----------
    flags : str
        Flags separated by blanks, as in the store.
    at_least : str
        Text for a length that is a lower bound.

    Examples
    --------
    >>> flag_remarks("ends-unsure end-hidden", "at least 24.0 cm")
    'an end is hidden: at least 24.0 cm'
    """
    remarks = {str(flag): line.remark for flag, line in FLAGS.items() if line.remark}
    words = "; ".join(dict.fromkeys(remarks[code] for code in flags.split() if code in remarks))
    return f"{words or 'partly hidden'}: {at_least}" if at_least else words


def data_doubts(flags: Mapping[str, int], fruit: int) -> list[str]:
    """Return the doubts about the data of a batch, one line per flag, with the remedy.

    Parameters
    ----------
    flags : mapping of str to int
        Number of fruit with each flag.
    fruit : int
        Number of fruit.

    Examples
    --------
    >>> data_doubts({"principal-point": 3, "ends-unsure": 2}, 4)[0]
    "3 of 4 fruit: the intrinsics' principal point lies off the middle of the picture; check ..."
    """
    return [
        Message(
            "{count} of {fruit} fruit: {fault}; {remedy}",
            count=flags[flag],
            fruit=fruit,
            fault=Message(line.data_fault),
            remedy=Message(line.remedy),
        )
        for flag, line in FLAGS.items()
        if line.data_fault and flags.get(flag)
    ]


def is_length_unknown(flags: Iterable[str]) -> bool:
    """Return whether flags say that nothing is known of a length: it counts in no statistics.

    Its depth cannot be its distance, or its interval would be too wide; it is no lower bound.

    Examples
    --------
    >>> is_length_unknown(["depth-hollow"]), is_length_unknown(["end-hidden"])
    (True, False)
    """
    codes = {*flags}
    return not (NO_DEPTH | {Flag.INTERVAL_TOO_WIDE}).isdisjoint(codes) and not is_lower_bound(codes)
