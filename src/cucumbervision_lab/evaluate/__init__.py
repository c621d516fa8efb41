"""Evaluation of the methods on simulated fruit and of the networks on labelled pictures."""

from cucumbervision.errors import MissingExtraError

try:
    import pandas as _pandas  # noqa: F401
except ImportError:
    raise MissingExtraError("pandas", "benchmark") from None
