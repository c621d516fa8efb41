"""Rounds on disk: the database, the pictures, and the log of manual actions."""
