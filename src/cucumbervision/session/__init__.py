"""Many captures in one go: rows, overlays and exports."""
