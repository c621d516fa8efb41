"""A round as files: one set of typed tables, and what writes them."""
