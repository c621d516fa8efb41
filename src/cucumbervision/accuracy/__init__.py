"""A site's own truth: lengths measured by hand, and how well the program meets them."""
