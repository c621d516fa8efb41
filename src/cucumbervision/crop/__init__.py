"""Crop profiles, and the classes by which a crop is sold."""
