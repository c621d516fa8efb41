"""One reader per source, each found by what a path holds."""
