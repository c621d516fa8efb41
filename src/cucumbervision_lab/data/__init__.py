"""Labelled pictures on disk: types, readers, writers, checks, splits."""
