"""Places that hold files: folders of this machine, and stores on the network named by a URL."""

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

_SAID_S = 2.0  # of shorter waits nothing is said
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
    """Return what reads and writes at a place.

    Parameters
    ----------
    place : Path or str
        A path, or a URL that fsspec knows: s3://bucket/folder, gs://…, https://… (to read),
        memory://…, file:///….

    Returns
    -------
    Path
        Of a URL an object with a path's methods (`upath.UPath`), though no `pathlib.Path`.

    Raises
    ------
    MissingExtraError
        If a URL is named without the extra 'remote', or without what its protocol needs.
    CucumberVisionError
        If no protocol is called so.

    Examples
    --------
    >>> as_path("house/a") == Path("house/a"), is_remote(as_path("house/a"))
    (True, False)
    >>> far = as_path("memory://house/a")
    >>> (far / "capture.json").name, is_remote(far)
    ('capture.json', True)
    """
    if not isinstance(place, str) or "://" not in place:
        return cast("Path", place) if is_remote(place) else Path(place)
    try:
        from upath import UPath

        found = UPath(place)
        _ = found.fs  # loads what the protocol needs
    except ImportError as error:
        raise MissingExtraError(error.name or str(error), "remote") from None
    except ValueError as error:
        raise CucumberVisionError(
            f"is no place that files can be at ({error})",
            source=place,
            remedy="name a folder, or s3://…, gs://… or https://…",
        ) from None
    return Path(found.path) if found.protocol in ("file", "local") else cast("Path", found)


def is_remote(place: object) -> bool:
    """Return whether a place is a store on the network, as `as_path` returns it."""
    return not isinstance(place, str | Path)


def with_retries(
    place: Path, call: Callable[[], Result], waits_s: Sequence[float] = _WAITS_S
) -> Result:
    """Call what reads or writes at a place; a store that does not answer is asked again.

    Parameters
    ----------
    place : Path
        As `as_path` returns it; what fails on this machine fails at once.
    call : callable
        Reads or writes; may be called again.
    waits_s : sequence of float
        Seconds between the attempts: a store may be gone for a minute and a half.

    Raises
    ------
    OSError
        If the store says no, or does not answer at last.
    """
    if not is_remote(place):
        return call()
    for wait_s in (*waits_s, None):
        try:
            return call()
        except _FINAL:
            raise
        # Each protocol has a family of errors of its own.
        except Exception as error:
            if wait_s is None:
                said = f"the store does not answer ({type(error).__name__}: {error})"
                raise OSError(errno.EIO, said, str(place)) from error
            if wait_s >= _SAID_S:
                fault = f"does not answer ({type(error).__name__})"
                _log.warning("%s: %s; asked again in %g s", place, fault, wait_s)
            time.sleep(wait_s)
    raise AssertionError  # the last wait is None
