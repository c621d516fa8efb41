"""Labelled pictures on disk: types, readers, writers, checks, splits and the set's card."""
