"""Detected fruit: instances, their boxes and masks, and the files and libraries that hold them."""
