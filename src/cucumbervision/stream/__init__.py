"""Live measurement: sources of frames, tracking of fruit, lengths from all frames."""
