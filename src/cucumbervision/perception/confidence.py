"""From which confidence on a find counts; without NumPy, since commands show it in their help."""

DEFAULT_CONFIDENCE = 0.20
"""Which a fruit's must exceed where none is asked for, with the pose network's vote."""

_POSE_CONFIDENCE = 0.05
_FLOOR_SHARE = 1 / 3


def detector_floor(confidence: float, *, votes: bool) -> float:
    """Return how sure a detector must be for its find to be looked at.

    Parameters
    ----------
    confidence : float
        Which a fruit's must exceed.
    votes : bool
        Whether further looks have a say (other input sizes, a pose network), which may lift a find
        over it.

    Examples
    --------
    >>> detector_floor(0.3, votes=False)
    0.3
    >>> round(detector_floor(0.3, votes=True), 3)
    0.1
    """
    return confidence * (_FLOOR_SHARE if votes else 1)


def pose_floor(confidence: float) -> float:
    """Return how sure a pose must be to give its keypoints to a fruit that the detector found.

    Parameters
    ----------
    confidence : float
        Which a fruit's must exceed.

    Examples
    --------
    >>> pose_floor(0.3)
    0.05
    >>> pose_floor(0.01)
    0.01
    """
    return min(confidence, _POSE_CONFIDENCE)
