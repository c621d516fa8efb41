"""Drawn scenes with exact truth: bodies, light, camera."""
