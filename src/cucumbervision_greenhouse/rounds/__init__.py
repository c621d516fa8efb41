"""Rounds through a house: rows, fruit merged between stops, fruit linked between days."""
