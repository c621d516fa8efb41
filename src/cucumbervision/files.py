"""Paths and URLs, files, JSON, CSV and text, with errors that name the file."""

from __future__ import annotations

import csv
import errno
import json
import logging
import math
import os
import re
import stat
import time
import uuid
from collections.abc import Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from cucumbervision.errors import (
    CaptureError,
    CucumberVisionError,
    MissingExtraError,
    wrap_os_errors,
    wrap_reader_errors,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from pydantic import TypeAdapter


ModelT = TypeVar("ModelT")
_FORMULA_STARTS = frozenset("=+-@\t\r\n＝＋－＠")
# Where a spreadsheet may split a cell of a CSV file in spite of quotes: Excel at semicolons
# if commas are decimal, others at tabs and line ends; before spaces and quotes of a formula.
_INNER_FORMULA = re.compile(r"([;\t\r\n\v\f\x85\u2028\u2029])(?=[\s\"']*[=+\-@＝＋－＠])")


_held: ContextVar[dict[str, bytes] | None] = ContextVar("held", default=None)


@contextmanager
def each_file_read_once() -> Iterator[None]:
    """Cache every file read inside the context.

    Captures are hashed and then read; without the cache, remote files would be fetched twice.
    """
    before = _held.set({})
    try:
        yield
    finally:
        _held.reset(before)


def read_bytes(
    path: Path,
    error: type[CucumberVisionError] = CaptureError,
    remedy: str = "copy the capture again",
) -> bytes:
    """Read a file; raises a one-line error on failure."""
    held = _held.get()
    if held is not None and str(path) in held:
        return held[str(path)]
    data = None
    with (
        wrap_os_errors("cannot be read", path, "check the path", error),
        suppress(FileNotFoundError),
    ):
        _require_regular(path, error)
        data = with_retries(path, path.read_bytes)
    if not data:
        fault = "the file is missing" if data is None else "the file is empty"
        raise error(fault, source=path, remedy=remedy)
    if held is not None:
        held[str(path)] = data
    return data


def read_head(path: Path, size: int) -> bytes:
    """Return up to `size` bytes from the start of a file."""
    with wrap_os_errors("cannot be read", path, "check the path", CaptureError):
        _require_regular(path, CaptureError)
        with path.open("rb") as stream:
            return stream.read(size)


def _require_regular(path: Path, error: type[CucumberVisionError]) -> None:
    # Reading a pipe would block, and reading a device might never end.
    if is_remote(path):
        return
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise error("is a pipe or a device, not a file", source=path, remedy="give the file itself")


def write_bytes(path: Path, data: bytes) -> None:
    """Put a whole file in place at once; raises a one-line error on failure."""
    remedy = "choose another folder"
    with wrap_os_errors("cannot be written", path, remedy, CaptureError), replacing(path) as part:
        part.write_bytes(data)


@contextmanager
def replacing(path: Path, folder: Path | None = None) -> Iterator[Path]:
    """Yield a temporary file, which replaces `path` when the block succeeds, on disk and whole.

    Parameters
    ----------
    path : Path
        The file, on this machine.
    folder : Path, optional
        Folder of the temporary file, on the same file system; by default that of `path`.

    Raises
    ------
    OSError
        If it cannot be written; what was there before is still there.
    """
    # Writers recognise the format by the extension.
    part = (folder or path.parent) / f".{uuid.uuid4().hex}{path.suffix}"
    try:
        yield part
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        part.replace(path)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Flush a folder's directory entries to disk, if the system supports it."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_json(
    path: Path,
    error: type[CucumberVisionError] = CaptureError,
    remedy: str = "correct or export it again",
) -> Any:
    """Read a JSON file.

    Raises
    ------
    CaptureError
        Of class `error`, if the file is missing, not text, not valid JSON (with line and column),
        nested too deeply, or contains numbers with thousands of digits.
    """
    data = read_bytes(path, error, remedy)
    with wrap_reader_errors(path, error, remedy):
        # Decode here, because json accepts lone surrogates in bytes.
        text = data.decode(json.detect_encoding(data))
        try:
            value = json.loads(text)
        except json.JSONDecodeError as wrong:
            fault = f"is not JSON (line {wrong.lineno}, column {wrong.colno}: {wrong.msg})"
            raise error(fault, source=path, remedy=remedy) from None
        if "\\ud" in text.lower():
            # Lone surrogates cannot be encoded in files and pages.
            json.dumps(value, ensure_ascii=False).encode()
        return value


def read_text(path: Path, error: type[CucumberVisionError] = CaptureError) -> str:
    r"""Read a text file in any common encoding, with line endings converted to line feeds.

    UTF-8 with or without byte order mark, UTF-16 with byte order mark, otherwise Windows-1252.

    Raises
    ------
    CaptureError
        Of class `error`, if the file is missing or not text.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "classes.txt"
    >>> _ = path.write_bytes("gürkchen\r\nzucchini\r".encode("cp1252"))
    >>> read_text(path)
    'gürkchen\nzucchini\n'
    """
    with wrap_os_errors("cannot be read", path, "check the path", error):
        _require_regular(path, error)
        data = path.read_bytes()
    marked = data[:2] in (b"\xff\xfe", b"\xfe\xff")
    for code in ("utf-16",) if marked else ("utf-8-sig", "cp1252"):
        with suppress(UnicodeDecodeError):
            return data.decode(code).replace("\r\n", "\n").replace("\r", "\n")
    raise error("is not text", source=path, remedy="save it as UTF-8")


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write a table as CSV at once; texts are defused, None leaves a cell empty.

    Parts of a text at which Excel may split the cell are defused, too.

    Parameters
    ----------
    path : Path
        The file: UTF-8 with a byte order mark, which Excel needs to read accents.
    columns : sequence of str
        The header.
    rows : iterable of mapping
        The rows; each is written before the next is requested.

    Raises
    ------
    OSError
        If it cannot be written.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "a.csv"
    >>> write_csv(path, ["name", "length_cm"], [{"name": "=1+1", "length_cm": 12.5}])
    >>> path.read_text(encoding="utf-8-sig").split()
    ['name,length_cm', "'=1+1,12.5"]
    """
    # A file name may contain bytes that are not text.
    with (
        replacing(path) as part,
        part.open("w", encoding="utf-8-sig", errors="backslashreplace", newline="") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows([_csv_value(row[name]) for name in columns] for row in rows)


def _csv_value(value: str | float | bool | None) -> str | int | float | None:
    """Return the content of a CSV cell: as `cell_value`, for every part of a text.

    Examples
    --------
    >>> _csv_value("x;=1+1"), _csv_value("a; b"), _csv_value("=1; @2")
    ("x;'=1+1", 'a; b', "'=1;' @2")
    """
    cell = cell_value(value)
    return _INNER_FORMULA.sub(r"\1'", cell) if isinstance(cell, str) else cell


def cell_value(value: str | float | bool | None) -> str | int | float | None:
    """Return the content of a spreadsheet cell: booleans as words, and no text as a formula.

    A leading =, +, -, @, tab or carriage return gets an apostrophe before it (OWASP, CSV
    injection), as do their full-width forms, which some spreadsheets interpret in the same way.

    Examples
    --------
    >>> cell_value("@home"), cell_value(True), cell_value(-1.5)
    ("'@home", 'true', -1.5)
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    is_formula = isinstance(value, str) and value[:1] in _FORMULA_STARTS
    return f"'{value}" if is_formula else value


def write_json(path: Path, report: Mapping[str, Any]) -> None:
    """Write a report as JSON at once, UTF-8, one value per line."""
    with replacing(path) as part:
        part.write_text(json.dumps(report, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def json_value(value: Any) -> Any:
    """Convert a value for JSON.

    NumPy numbers and arrays become Python ones, numbers that are not finite become None, and other
    types (paths, dates, enums) become strings.

    Examples
    --------
    >>> import numpy as np
    >>> json_value({"length_m": np.float32(0.25), "box": np.array([1.0, np.nan])})
    {'length_m': 0.25, 'box': [1.0, None]}
    """
    if hasattr(value, "tolist"):  # of NumPy, which is not imported for the help of commands
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): json_value(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [json_value(entry) for entry in value]
    plain = value is None or isinstance(value, bool | int) or type(value) is str
    return value if plain else str(value)


def parse_model(
    model: type[ModelT],
    data: Any,
    *,
    source: object,
    error: type[CucumberVisionError] = CaptureError,
    remedy: str = "correct the file",
) -> ModelT:
    """Validate values with a pydantic model or a dataclass.

    Raises
    ------
    CaptureError
        Of class `error`, with the first invalid field and its fault.
    """
    from pydantic import ValidationError

    try:
        with wrap_reader_errors(source, error):
            return cast("ModelT", adapter(cast("Any", model)).validate_python(data))
    except error as refused:
        invalid = refused.__cause__
        if not isinstance(invalid, ValidationError):
            raise
        faults = invalid.errors(include_url=False, include_context=False, include_input=False)
    first = faults[0]
    where = ".".join(str(part) for part in first["loc"]) or "the whole"
    remainder = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
    what = first["msg"][0].lower() + first["msg"][1:]
    raise error(f"'{where}': {what}{remainder}"[:500], source=source, remedy=remedy)


@lru_cache(maxsize=64)
def adapter(model: Any) -> TypeAdapter[Any]:
    """Return a validator for a pydantic model or a dataclass."""
    from pydantic import TypeAdapter

    return TypeAdapter(model)


_log = logging.getLogger(__name__)

_WAITS_S = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 32.0)
_FINAL = (
    *(CucumberVisionError, FileNotFoundError, FileExistsError, PermissionError),
    *(IsADirectoryError, NotADirectoryError),
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
    waits = iter(waits_s)
    while True:
        try:
            return call()
        except _FINAL:
            raise
        # Each protocol has its own exception classes.
        except Exception as error:
            wait_s = next(waits, None)
            if wait_s is None:
                silence = f"the store does not answer ({type(error).__name__}: {error})"
                raise OSError(errno.EIO, silence, str(place)) from error
            fault = f"does not answer ({type(error).__name__})"
            _log.warning("%s: %s; asked again in %g s", place, fault, wait_s)
            time.sleep(wait_s)
