"""From which confidence on a find counts; without NumPy, since commands show it in their help."""

DEFAULT_CONFIDENCE = 0.25
"""Which a fruit's must exceed where none is asked for, with the pose network's vote."""

POSE_CONFIDENCE = 0.05
"""From which a pose gives its keypoints to a fruit that the detector is sure of."""

FLOOR_SHARE = 1 / 3
"""Of the confidence asked: what one look of several finds below it is not looked at."""
