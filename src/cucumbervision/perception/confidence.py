"""Confidence thresholds; imports no NumPy, since commands show them in their help."""

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
