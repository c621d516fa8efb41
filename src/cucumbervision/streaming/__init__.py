"""Frames as they come: the newest first, the same fruit from frame to frame, smoothed lengths."""
