"""Files, JSON and texts on disk: read whole or refused, with the file's name in the error."""

from __future__ import annotations

import json
import math
import os
import stat
from collections.abc import Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from cucumbervision.capture.urls import is_remote, with_retries
from cucumbervision.errors import (
    CaptureError,
    CucumberVisionError,
    wrap_os_errors,
    wrap_reader_errors,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from pydantic import TypeAdapter

ModelT = TypeVar("ModelT")


_held: ContextVar[dict[str, bytes] | None] = ContextVar("held", default=None)


@contextmanager
def each_file_read_once() -> Iterator[None]:
    """Hold every file that is read inside, so that reading it again costs nothing.

    For what hashes a capture's files and then reads them: from a store on the network each would
    come twice.
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
    """Read a file, or say in one line why not."""
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
    """Return the first bytes of a file; fewer, or none, where it has no more."""
    with wrap_os_errors("cannot be read", path, "check the path", CaptureError):
        _require_regular(path, CaptureError)
        with path.open("rb") as stream:
            return stream.read(size)


def _require_regular(path: Path, error: type[CucumberVisionError]) -> None:
    # A pipe would be waited for, and a device read without an end.
    if is_remote(path):
        return
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise error("is a pipe or a device, not a file", source=path, remedy="give the file itself")


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file, or say in one line why not."""
    with wrap_os_errors("cannot be written", path, "choose another folder", CaptureError):
        path.write_bytes(data)


def sync_folder(folder: Path) -> None:
    """Put a folder's list of names on disk, where the system lets folders be opened."""
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
        Of the class `error`: it is missing, no text, no JSON (with line and column), nested too
        deeply, or holds numbers of thousands of digits.
    """
    data = read_bytes(path, error, remedy)
    try:
        # Decoded here: given bytes, json lets halves of pairs pass, and UTF-16 hides their escapes.
        text = data.decode(json.detect_encoding(data))
        value = json.loads(text)
        if "\\ud" in text.lower():
            # Half of a pair that stands for one letter: no file and no page could take it.
            json.dumps(value, ensure_ascii=False).encode()
        return value
    except json.JSONDecodeError as wrong:
        fault = f"is no JSON (line {wrong.lineno}, column {wrong.colno}: {wrong.msg})"
    except UnicodeError:
        fault = "is no JSON text"
    except RecursionError:
        fault = "is nested too deeply"
    except ValueError:
        fault = "holds a number of thousands of digits"
    raise error(fault, source=path, remedy=remedy)


def read_text(path: Path, error: type[CucumberVisionError] = CaptureError) -> str:
    r"""Read a text as editors save it, with line ends of any system as line feeds.

    UTF-8 with or without its mark, UTF-16 with its mark, else Windows-1252 ("ANSI").

    Raises
    ------
    CaptureError
        Of the class `error`: the file is missing or no text. An empty file is an empty text.

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
    raise error("is no text", source=path, remedy="save it as UTF-8")


def json_value(value: Any) -> Any:
    """Return a value as JSON can hold it.

    NumPy's numbers and arrays become Python's, numbers that are not finite None, whatever JSON
    does not know (paths, dates, enums) its text.

    Examples
    --------
    >>> json_value({"length_m": np.float32(0.25), "box": np.array([1.0, np.nan])})
    {'length_m': 0.25, 'box': [1.0, None]}
    """
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): json_value(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [json_value(one) for one in value]
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
    """Check what people or programs wrote against a pydantic model or a dataclass.

    Raises
    ------
    CaptureError
        Of the class `error`, naming the first field at fault and what is wrong with it.
    """
    from pydantic import ValidationError

    try:
        with wrap_reader_errors(source, error):
            return cast("ModelT", _adapter(cast("Any", model)).validate_python(data))
    except error as refused:
        invalid = refused.__cause__
        if not isinstance(invalid, ValidationError):
            raise
        faults = invalid.errors(include_url=False, include_context=False, include_input=False)
    first = faults[0]
    where = ".".join(str(part) for part in first["loc"]) or "the whole"
    more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
    what = first["msg"][0].lower() + first["msg"][1:]
    raise error(f"'{where}': {what}{more}"[:500], source=source, remedy=remedy)


@lru_cache(maxsize=64)
def _adapter(model: Any) -> TypeAdapter[Any]:
    from pydantic import TypeAdapter

    return TypeAdapter(model)
