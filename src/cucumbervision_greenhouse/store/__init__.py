"""Rounds on disk: the database, the images, and the log of manual actions."""

from importlib.util import find_spec

from cucumbervision.errors import MissingExtraError

if find_spec("sqlalchemy") is None:
    raise MissingExtraError("sqlalchemy", "greenhouse")
