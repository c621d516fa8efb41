"""Evaluate detection, masks and lengths: simulated captures, drawn scenes, audited photos."""
