"""Networks, and the thresholds and sizes that commands show in their help."""

DEFAULT_CONFIDENCE = 0.20
"""Default threshold for a fruit, after all votes."""

CANDIDATE_CONFIDENCE = 0.02
"""Threshold for candidates that the network that looks at each fruit may raise."""

DETECTOR_SIZES_PX = (640, 896)
"""Default input sizes of the detectors that are exported here.

At these two, on real photos, scenes on the plant and drawn scenes, more fruit are found and fewer
false positives than at 640 alone, for three times its computing time.
"""

LARGEST_INPUT_PX = 4096
"""Longest side of a network's input: a larger one would take gigabytes."""
