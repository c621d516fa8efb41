"""From a capture to a result: find fruit, measure, record."""
