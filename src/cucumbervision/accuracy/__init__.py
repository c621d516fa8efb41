"""Evaluate lengths against manual measurements."""
