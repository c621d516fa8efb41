"""Rounds on disk: database, pictures, and the log of what was done by hand."""
