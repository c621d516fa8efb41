"""Live RGB-D cameras."""
