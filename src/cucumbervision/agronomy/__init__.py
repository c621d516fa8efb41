"""What a crop is: its profile, and the classes that it is sold by."""
