"""Measures greenhouse cucumbers without touching them."""
