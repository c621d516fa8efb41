"""Site calibration: fitting corrections, and the calibration file."""
