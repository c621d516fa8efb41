"""The table of flags of a measurement, with their texts and effects."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from cucumbervision.errors import Message

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


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


DOUBTFUL_END = {
    "upper": Flag.UPPER_END,
    "lower": Flag.LOWER_END,
    "left": Flag.LEFT_END,
    "right": Flag.RIGHT_END,
}
"""Flags of an end that may go on out of sight, by where it is in the picture."""


class Effect(StrEnum):
    """Effect of a flag on the length."""

    NONE = "none"
    LOWER_BOUND = "lower bound"
    """The fruit goes on out of sight: it is at least as long as was measured."""
    NO_DEPTH = "no depth"
    """Its depth cannot be its distance: the length is no lower bound either."""


@dataclass(frozen=True)
class FlagMeaning:
    """One line of the table of flags.

    Parameters
    ----------
    meaning : str
        Description in the documentation.
    remark : str
        Remark beside a fruit; empty if the length does not depend on the flag.
    effect : Effect
        Effect on the length.
    shows_less : bool
        Whether a view with it shows its fruit less well than one without.
    data_fault, remedy : str
        Doubt about the data and its remedy, reported once per run if fruit have the flag. Empty if
        the data are not the cause.
    """

    meaning: str
    remark: str = ""
    effect: Effect = Effect.NONE
    shows_less: bool = False
    data_fault: str = ""
    remedy: str = ""


FLAGS: Mapping[Flag, FlagMeaning] = {
    Flag.CUT_BY_FRAME: FlagMeaning(
        "the fruit reaches the picture's edge: it is longer than measured",
        remark="cut by the picture's edge",
        effect=Effect.LOWER_BOUND,
        shows_less=True,
    ),
    Flag.BOX_CLIPPED: FlagMeaning(
        "the box reached beyond the picture and was clipped",
        remark="cut by the picture's edge",
        effect=Effect.LOWER_BOUND,
        shows_less=True,
    ),
    Flag.END_HIDDEN: FlagMeaning(
        "an end is not visible: the length is a lower bound",
        remark="an end is hidden",
        effect=Effect.LOWER_BOUND,
        shows_less=True,
    ),
    Flag.ENDS_DISAGREE: FlagMeaning(
        "mask and keypoints disagree about an end by over 10 % of the length",
        remark="its ends were found at two places",
    ),
    Flag.ENDS_UNSURE: FlagMeaning(
        "which end is the stem's is less than 90 % certain; the length is the same either way"
    ),
    **{
        flag: FlagMeaning(
            f"the {place} end may go on behind what covers it",
            remark=f"the {place} end may go on behind what covers it",
        )
        for place, flag in DOUBTFUL_END.items()
    },
    Flag.END_ON: FlagMeaning(
        "an end points along the view, or lies behind the fruit's own thick middle",
        remark="seen end on",
        shows_less=True,
    ),
    Flag.PART_HIDDEN: FlagMeaning(
        "something nearer hides a part, which was bridged", remark="partly hidden", shows_less=True
    ),
    Flag.POOR_FIT: FlagMeaning(
        "the tube fits the mask or the outline badly, as where one outline holds two fruit",
        remark="its shape is not that of one fruit",
        shows_less=True,
    ),
    Flag.UNCERTAIN: FlagMeaning(
        "the fit's standard deviation is above 5 % of the length",
        remark="the length is uncertain",
        shows_less=True,
    ),
    Flag.INTERVAL_TOO_WIDE: FlagMeaning(
        "the interval would span more than a factor of four: none is given",
        remark="the length is uncertain",
        shows_less=True,
    ),
    Flag.DETECTOR_MASK: FlagMeaning(
        "the detector's mask was measured because there was no better one", shows_less=True
    ),
    Flag.SAM_MASK_EMPTY: FlagMeaning("the mask that was drawn was rejected: it is empty"),
    Flag.SAM_MASK_SMALL: FlagMeaning("the mask that was drawn was rejected: under 100 px"),
    Flag.SAM_MASK_OFF_BOX: FlagMeaning("the mask that was drawn was rejected: it is off the box"),
    Flag.SAM_MASK_OFF_DETECTOR: FlagMeaning(
        "the mask that was drawn was rejected: it is unlike the detector's"
    ),
    Flag.NOT_COVERED: FlagMeaning(
        "the site's calibration does not cover this method: not corrected",
        remark="the site's calibration does not cover it",
    ),
    Flag.OTHER_MASK: FlagMeaning(
        "the site's calibration was made with another kind of mask: not corrected",
        remark="the site's calibration was made with other outlines",
    ),
    Flag.OUTSIDE_RANGE: FlagMeaning(
        "longer or shorter than the fruit used for the calibration",
        remark="longer or shorter than the site's calibration",
    ),
    Flag.DEPTH_UNIT: FlagMeaning(
        "too long or too thick for the crop, or half of the picture's fruit are: check "
        "`--depth-unit` and `--profile`",
        remark="too large: check the depth's unit",
    ),
    Flag.DEPTH_TOO_NEAR: FlagMeaning(
        "nearer than 12 cm, where no camera reads: check the depth's unit; no lower bound",
        remark="nearer than a camera reads: check the depth's unit",
        effect=Effect.NO_DEPTH,
        data_fault="nearer than 12 cm, where no camera reads",
        remedy="check the unit of depth (--depth-unit 0.001 is 1 mm a step)",
    ),
    Flag.DEPTH_SPARSE: FlagMeaning(
        "less than half of the fruit has depth, as where it is nearer than the camera reads: no "
        "interval, no lower bound",
        remark="hardly any depth on it: hold the camera farther away",
        effect=Effect.NO_DEPTH,
        shows_less=True,
        data_fault="less than half of their pixels have depth",
        remedy="hold the camera at least 30 cm away",
    ),
    Flag.DEPTH_HOLLOW: FlagMeaning(
        "its middle is farther away than its sides, and its surroundings are nearer: inverse or "
        "relative depth",
        remark="hollow by its depth: check what the depth picture holds",
        effect=Effect.NO_DEPTH,
        data_fault="the depth of their middle lies behind that of their flanks",
        remedy="check that the depth picture holds distances, and not their inverse or relative "
        "depth",
    ),
    Flag.DEPTH_GAP: FlagMeaning(
        "its outline has pieces or a waist, with something clearly farther away between: give "
        "each fruit an outline of its own",
        remark="an outline of several things with a gap between them",
        effect=Effect.NO_DEPTH,
        data_fault="their outline has pieces with a gap between them that lies behind",
        remedy="give each fruit an outline of its own",
    ),
    Flag.DEPTH_UNALIGNED: FlagMeaning(
        "its outline lies partly on what is far behind, fits far better elsewhere, or nothing "
        "stands out: check that depth is aligned",
        remark="outline and depth do not lie together: check that depth is aligned",
        effect=Effect.NO_DEPTH,
        data_fault="outline and depth do not lie together",
        remedy="check that depth is aligned to colour, and masks are of this picture",
    ),
    Flag.DEPTH_COARSE: FlagMeaning(
        "depth of one value, in steps of over 1.2 % of the distance, or in whole millimetres up "
        "to 255, as in an 8-bit picture",
        remark="depth in coarse steps: check what the depth picture holds",
        effect=Effect.NO_DEPTH,
        data_fault="their depth has coarse steps, as in a picture of 8 bits or in whole "
        "centimetres",
        remedy="give depth as the camera recorded it, with 16 bits in millimetres or finer",
    ),
    Flag.DEPTH_ALONG_RAY: FlagMeaning(
        "depth seems to be the distance along each pixel's ray, as simulators write it",
        remark="depth may be measured along the pixels' rays",
        effect=Effect.NO_DEPTH,
        data_fault="what is behind them is a plane only if depth is the distance along each "
        "pixel's ray",
        remedy="read such depth with --depth-along ray",
    ),
    Flag.OUTLINE_SHORT: FlagMeaning(
        "the fruit's surface goes on beyond its outline: a lower bound without an interval",
        remark="its outline ends too early",
        effect=Effect.LOWER_BOUND,
        shows_less=True,
    ),
    Flag.OUTLINE_STEM: FlagMeaning(
        "an end of its outline is as narrow as a stem: no interval",
        remark="its outline takes in the stem",
        effect=Effect.NO_DEPTH,
        data_fault="an end of their outline is as narrow as a stem",
        remedy="draw outlines from the stem's attachment to the blossom's end",
    ),
    Flag.PRINCIPAL_POINT: FlagMeaning(
        "the intrinsics' principal point is off the middle of the picture: wrong size, or cut "
        "out of a larger picture?",
        remark="check the camera's intrinsics",
        data_fault="the intrinsics' principal point lies off the middle of the picture",
        remedy="check that they are of this size of picture",
    ),
    Flag.DEPTH_RESAMPLED: FlagMeaning(
        "depth has fewer pixels than colour: ends are known less well",
        remark="depth is coarser than colour",
        data_fault="depth has fewer pixels than colour and was enlarged",
        remedy="record depth aligned to colour at its size",
    ),
    Flag.PLUGIN_FAILED: FlagMeaning(
        "a method or trait of another package failed: `failures.csv` says which, and why"
    ),
    Flag.DOUBTFUL: FlagMeaning(
        "added by hand, but does not look like a fruit: not on the pick list until accepted",
        remark="added by hand, and may be no fruit",
    ),
}
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
