"""The parts of `speed.py`, one to a file."""
