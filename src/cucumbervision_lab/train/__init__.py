"""Training and export of the networks."""
