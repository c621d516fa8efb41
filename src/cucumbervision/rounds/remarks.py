"""What else to know of a fruit's measurement, as short sentences."""

from __future__ import annotations

from cucumbervision.measurement.result import Flag

SAYINGS = {
    Flag.CUT_BY_FRAME: "cut by the picture's edge",
    Flag.BOX_CLIPPED: "cut by the picture's edge",
    Flag.END_HIDDEN: "an end is hidden",
    Flag.ENDS_DISAGREE: "its ends were found at two places",
    Flag.ENDS_UNSURE: "its ends are not sure",
    Flag.END_ON: "seen end on",
    Flag.PART_HIDDEN: "partly hidden",
    Flag.POOR_FIT: "its shape fits badly",
    Flag.UNCERTAIN: "the length is uncertain",
    Flag.INTERVAL_TOO_WIDE: "the length is uncertain",
    Flag.NOT_COVERED: "the site's calibration does not cover it",
    Flag.OTHER_MASK: "the site's calibration was made with other outlines",
    Flag.OUTSIDE_RANGE: "longer or shorter than the site's calibration",
}


def remarks(flags: str, at_least: str = "") -> str:
    """Return a measurement's flags as short sentences; what only we need is left out.

    Parameters
    ----------
    flags : str
        As the store has them, separated by blanks.
    at_least : str
        The length as a lower bound, in words, where it is one.

    Examples
    --------
    >>> remarks("keypoints-logged end-hidden", "at least 24.0 cm")
    'an end is hidden: at least 24.0 cm'
    """
    known = {str(flag): words for flag, words in SAYINGS.items()}
    words = "; ".join(dict.fromkeys(known[one] for one in flags.split() if one in known))
    return f"{words or 'partly hidden'}: {at_least}" if at_least else words
