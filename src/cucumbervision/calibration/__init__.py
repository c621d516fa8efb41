"""Corrections fitted to one's own truth, and the file that carries them."""
