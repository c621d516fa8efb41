"""The captures that come with the package: drawn, free to pass on, with exact truth."""

from __future__ import annotations

from pathlib import Path

__all__ = ["bundled_captures"]


def bundled_captures() -> Path:
    """Give the folder of the captures that come with the package.

    Examples
    --------
    >>> sorted(p.name for p in bundled_captures().iterdir())
    ['simulated-bench', 'simulated-row-a', 'simulated-row-b']
    """
    return Path(__file__).with_name("bundled_captures")
