"""What the software bears: broken files by the million, and faults on purpose."""
