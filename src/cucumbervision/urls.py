"""Paths of local folders and of remote stores given by a URL."""

from __future__ import annotations

import errno
import logging
import time
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar, cast

from cucumbervision.errors import CucumberVisionError, MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_log = logging.getLogger(__name__)

_SAID_S = 2.0  # shorter waits are not logged
_WAITS_S = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 32.0)
_FINAL = (
    FileNotFoundError,
    FileExistsError,
    PermissionError,
    IsADirectoryError,
    NotADirectoryError,
)

Result = TypeVar("Result")


def as_path(place: Path | str) -> Path:
    """Return a path object for a path or URL.

    Parameters
    ----------
    place : Path or str
        A path, or a URL that fsspec knows: s3://bucket/folder, gs://…, https://… (to read),
        memory://…, file:///….

    Returns
    -------
    Path
        For a URL, a `upath.UPath`, which has the methods of a path but is not a `pathlib.Path`.

    Raises
    ------
    MissingExtraError
        If the extra 'remote' or a package for the protocol is not installed.
    CucumberVisionError
        If the protocol is unknown.

    Examples
    --------
    >>> as_path("house/a") == Path("house/a"), is_remote(as_path("house/a"))
    (True, False)
    >>> folder = as_path("memory://house/a")
    >>> (folder / "capture.json").name, is_remote(folder)
    ('capture.json', True)
    """
    if not isinstance(place, str) or "://" not in place:
        return cast("Path", place) if is_remote(place) else Path(place)
    try:
        from upath import UPath

        remote = UPath(place)
        _ = remote.fs  # imports the package of the protocol
    except ImportError as error:
        raise MissingExtraError(error.name or str(error), "remote") from None
    except ValueError as error:
        raise CucumberVisionError(
            f"is not a supported location ({error})",
            source=place,
            remedy="name a folder, or s3://…, gs://… or https://…",
        ) from None
    return Path(remote.path) if remote.protocol in ("file", "local") else cast("Path", remote)


def is_remote(place: object) -> bool:
    """Return whether a path from `as_path` is remote."""
    return not isinstance(place, str | Path)


def with_retries(
    place: Path, call: Callable[[], Result], waits_s: Sequence[float] = _WAITS_S
) -> Result:
    """Call a function that accesses a path; retry if a remote store does not respond.

    Parameters
    ----------
    place : Path
        Path from `as_path`; local errors are not retried.
    call : callable
        Function to call, possibly repeatedly.
    waits_s : sequence of float
        Seconds between the attempts.

    Raises
    ------
    OSError
        If the store reports an error, or does not respond to the last attempt.
    """
    if not is_remote(place):
        return call()
    for wait_s in (*waits_s, None):
        try:
            return call()
        except _FINAL:
            raise
        # Each protocol has its own exception classes.
        except Exception as error:
            if wait_s is None:
                silence = f"the store does not answer ({type(error).__name__}: {error})"
                raise OSError(errno.EIO, silence, str(place)) from error
            if wait_s >= _SAID_S:
                fault = f"does not answer ({type(error).__name__})"
                _log.warning("%s: %s; asked again in %g s", place, fault, wait_s)
            time.sleep(wait_s)
    raise AssertionError  # unreachable: the last wait is None
