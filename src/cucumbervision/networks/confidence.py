"""Confidence thresholds and input sizes; imports no NumPy: commands show them in their help."""

from cucumbervision.errors import CucumberVisionError

DEFAULT_CONFIDENCE = 0.20
"""Default threshold for a fruit, after all votes."""

CANDIDATE_CONFIDENCE = 0.02
"""Threshold for candidates that the network that looks at each fruit may raise."""

_POSE_CONFIDENCE = 0.05
_FLOOR_SHARE = 1 / 3


def detector_floor(confidence: float, *, votes: bool) -> float:
    """Return the detector's threshold for candidates.

    Parameters
    ----------
    confidence : float
        Threshold for a fruit.
    votes : bool
        Whether other input sizes or a pose network vote, which may lift a candidate over the
        threshold.

    Examples
    --------
    >>> detector_floor(0.3, votes=False)
    0.3
    >>> round(detector_floor(0.3, votes=True), 3)
    0.1
    """
    return confidence * (_FLOOR_SHARE if votes else 1)


def pose_floor(confidence: float) -> float:
    """Return the pose network's threshold for keypoints of a fruit that the detector found.

    Parameters
    ----------
    confidence : float
        Threshold for a fruit.

    Examples
    --------
    >>> pose_floor(0.3)
    0.05
    >>> pose_floor(0.01)
    0.01
    """
    return min(confidence, _POSE_CONFIDENCE)


DETECTOR_SIZES_PX = (640, 896)
"""Default input sizes of the detectors that are exported here.

At these two, on real photos, scenes on the plant and drawn scenes, more fruit are found and fewer
false positives than at 640 alone, for three times its computing time.
"""

LARGEST_INPUT_PX = 4096
"""Longest side of a network's input: a larger one would take gigabytes."""

_SIZE_STEP_PX = 32


def parse_input_sizes(text: str) -> tuple[int, ...]:
    """Parse the option `--input-size`: one size in pixels, or several to merge.

    Parameters
    ----------
    text : str
        Multiples of 32 up to 4096, joined by commas; empty for the network's own size.

    Returns
    -------
    tuple of int
        Each size once, the smallest first.

    Raises
    ------
    CucumberVisionError
        For anything else.

    Examples
    --------
    >>> parse_input_sizes("1280,640"), parse_input_sizes("")
    ((640, 1280), ())
    """
    parts = [part.strip() for part in text.split(",")] if text.strip() else []
    sizes = {int(part) if part.isdecimal() and len(part) < 6 else 0 for part in parts}
    if not all(0 < size <= LARGEST_INPUT_PX and size % _SIZE_STEP_PX == 0 for size in sizes):
        raise CucumberVisionError(
            f"{text!r} is not an input size",
            source="--input-size",
            remedy=f"give a multiple of {_SIZE_STEP_PX} up to {LARGEST_INPUT_PX}, such as 640, "
            "or several joined by commas",
        )
    return tuple(sorted(sizes))
