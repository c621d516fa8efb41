"""How the command tells the server's pages what to show: by the environment, and the defaults."""

from __future__ import annotations

from pathlib import Path

__all__ = [
    "IMAGES_VARIABLE",
    "LOGIN_VARIABLE",
    "REPLAY_VARIABLE",
    "STORE_VARIABLE",
    "default_store",
]

STORE_VARIABLE = "CUCUMBERVISION_STORE"
IMAGES_VARIABLE = "CUCUMBERVISION_IMAGES"
REPLAY_VARIABLE = "CUCUMBERVISION_REPLAY"
LOGIN_VARIABLE = "CUCUMBERVISION_LOGIN"


def default_store() -> str:
    """Give where the store is unless somebody says otherwise.

    Examples
    --------
    >>> default_store().endswith("rounds.db")
    True
    """
    import platformdirs

    return str(Path(platformdirs.user_data_dir("cucumbervision", appauthor=False)) / "rounds.db")
