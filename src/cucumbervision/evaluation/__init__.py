"""How good a length is: metrics, statistics, the protocol and the report."""
