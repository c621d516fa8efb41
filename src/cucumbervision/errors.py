"""Every error that a user can cause, each with one line: the file, the fault and the remedy.

All of them derive from `CucumberVisionError`, so that a batch can catch one class, note the
failure and continue; `named_error` converts any other exception to one of them.
"""

from __future__ import annotations

import errno
import re
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Self


class Message(str):
    """A sentence in English that keeps its template and parts, so that a page can translate it.

    Parameters
    ----------
    template : str
        As `str.format` takes it. Without parts it is the sentence itself, braces included.
    **parts
        What the names in braces stand for: numbers, text, or messages, which are translated too.

    Examples
    --------
    >>> message = Message("holds {count} pages of {size_mb:.1f} MB", count=3, size_mb=0.25)
    >>> message, message.parts
    ('holds 3 pages of 0.2 MB', {'count': 3, 'size_mb': 0.25})
    >>> Message.from_json(message.as_json()).template
    'holds {count} pages of {size_mb:.1f} MB'
    """

    template: str
    parts: dict[str, object]

    def __new__(cls, template: str, /, **parts: object) -> Self:
        """Fill in the parts; a message is returned as it is."""
        if isinstance(template, cls):
            return template
        text = template.format(**parts) if parts else template
        message = super().__new__(cls, " ".join(text.split()))
        message.template, message.parts = template, {k: _plain(v) for k, v in parts.items()}
        return message

    def as_json(self) -> dict[str, Any]:
        """Return template and parts, as `from_json` reads them."""
        parts = {k: v.as_json() if isinstance(v, Message) else v for k, v in self.parts.items()}
        return {"template": self.template, "parts": parts}

    @classmethod
    def from_json(cls, value: Any) -> Self:
        """Return a message that was written by `as_json`, or a text of an older version."""
        if not isinstance(value, dict):
            return cls(value)
        read = {k: cls.from_json(v) for k, v in value["parts"].items() if isinstance(v, dict)}
        return cls(value["template"], **value["parts"] | read)


def _plain(part: object) -> object:
    """Return a part as what JSON holds: NumPy's numbers become Python's, all else text."""
    if isinstance(part, Real):
        return int(part) if isinstance(part, Integral) else float(part)
    return part if isinstance(part, Message) else str(part)


def with_reason(fault: str, reason: str) -> Message:
    """Return a fault with its reason in brackets.

    Examples
    --------
    >>> with_reason("cannot be read", "Permission denied")
    'cannot be read (Permission denied)'
    """
    return Message("{fault} ({reason})", fault=Message(fault), reason=Message(reason))


def joined(words: Iterable[str], last: str = "{first}, {second}") -> Message:
    """Return several words with commas between them, and perhaps 'or' before the last.

    Examples
    --------
    >>> joined(["a", "b", "c"], "{first} or {second}")
    'a, b or c'
    """
    messages = [Message(word) for word in words]
    text = messages[0] if messages else Message("")
    for number, word in enumerate(messages[1:], 2):
        template = last if number == len(messages) else "{first}, {second}"
        text = Message(template, first=text, second=word)
    return text


class CucumberVisionError(Exception):
    """Base of all named errors.

    Parameters
    ----------
    template : str
        The fault, in plain words, as `Message` takes it.
    source : str, optional
        The file, folder or device at fault; put first in the line.
    remedy : str, optional
        What the user can do about it, as `Message` takes it; put last in the line.
    **parts
        What the names in braces of both stand for.

    Examples
    --------
    >>> error = CucumberVisionError("{n} bytes", source="a.png", remedy="copy it again", n=0)
    >>> print(error)
    a.png: 0 bytes; copy it again
    >>> error.message.template
    '{n} bytes'
    """

    def __init__(
        self, template: str, /, *, source: object = None, remedy: str = "", **parts: object
    ) -> None:
        self.message = Message(template, **parts)
        self.source = source if isinstance(source, str) else str(source or "")
        self.remedy = Message(remedy, **parts)
        lines = {"source": self.source, "fault": self.message, "remedy": self.remedy}
        form = "{source}: " * bool(self.source) + "{fault}" + "; {remedy}" * bool(self.remedy)
        self.line = Message(form, **lines)
        super().__init__(self.line)

    def __str__(self) -> str:
        return self.line

    @property
    def code(self) -> str:
        """Stable name of the error's class, as `failures.csv` gives it."""
        return type(self).__name__

    def at(self, source: object) -> Self:
        """Return the same error of another source."""
        return type(self)(self.message, source=source, remedy=self.remedy)


class FileError(CucumberVisionError):
    """The operating system cannot read or write a file: a full disk, a name that is too long."""


class DiskFullError(FileError):
    """The disk is full; batches stop, since later captures cannot be written either."""


class OutOfMemoryError(CucumberVisionError):
    """There is not enough memory for an image or a network."""


class InternalError(CucumberVisionError):
    """A defect of this software: an exception of no other class here."""


class CaptureError(CucumberVisionError):
    """A capture cannot be read: missing, truncated, or its parts disagree."""


class DepthError(CaptureError):
    """A depth image cannot be what it is declared to be (unit, bit depth, no readings)."""


class IntrinsicsError(CaptureError):
    """Intrinsics that would deproject wrongly: another stream's, another size's, or malformed."""


class InstancesError(CucumberVisionError):
    """A file of boxes or masks cannot be read, or does not fit its images."""


class ModelError(CucumberVisionError):
    """A network cannot be loaded, or does not have the outputs that its task needs."""


class UnknownModelError(ModelError):
    """No model of that name is in the registry."""


class ModelHashError(ModelError):
    """A model file's SHA-256 is not the registry's."""


class PluginError(CucumberVisionError):
    """A plug-in of another package cannot be loaded, raises, or returns what is no result."""


class CameraError(CucumberVisionError):
    """No camera, a camera in use, or a stream that stopped."""


class TruthError(CucumberVisionError):
    """Hand-measured lengths that cannot be what they are declared to be, or fit no measurement."""


class TrainingError(CucumberVisionError):
    """A training that cannot begin or go on: its plan, its data, its weights or its folder."""


class CalibrationError(CucumberVisionError):
    """A site's calibration that cannot be made or read, or belongs to another camera."""


class DataSetError(CucumberVisionError):
    """Labelled images that cannot be read, written or trained on."""


class StoreError(CucumberVisionError):
    """A store of rounds cannot be opened, read or written, or does not hold what was asked."""


class StoreAwayError(StoreError):
    """The database is locked or cannot be reached: no fault of what was to be stored."""


class StoreVersionError(StoreError):
    """A store that was written by a newer version of the software."""


class StoreConflictError(StoreError):
    """A key that exists with other content, or an action that a later one depends on."""


class StoredImageError(StoreError):
    """A stored image is missing, or its content does not match its name."""


class ProfileError(CucumberVisionError):
    """A crop profile that cannot be read, or whose figures contradict each other."""


class RoundError(CucumberVisionError):
    """Poses, stops or fruit of a round that cannot be what they are declared to be."""


class NameRefusedError(CucumberVisionError):
    """A name that is not readable: control characters, changes of the writing direction."""


class UploadError(CaptureError):
    """An upload that is not accepted: too large, of no known kind, or harmful."""


class AccessError(CucumberVisionError):
    """A page that may not be opened to others: no login, a wrong password, too many attempts."""


class MissingExtraError(CucumberVisionError):
    """A feature needs a package that is not installed: of an optional extra, or any other.

    Examples
    --------
    >>> print(MissingExtraError("pyrealsense2", "camera"))
    pyrealsense2 is not installed; pip install 'cucumbervision[camera]'
    >>> print(MissingExtraError("pandas"))
    pandas is not installed; pip install pandas
    """

    def __init__(self, package: str, extra: str = "") -> None:
        requirement = f"'cucumbervision[{extra}]'" if extra else package
        parts = {"package": package, "requirement": requirement}
        super().__init__("{package} is not installed", remedy="pip install {requirement}", **parts)

    def at(self, source: object) -> Self:  # noqa: ARG002 - no file is at fault
        """Return the error itself."""
        return self


@contextmanager
def as_errors_of(source: object) -> Iterator[None]:
    """Name the source in every named error that is raised inside.

    Examples
    --------
    >>> with as_errors_of("a.json"):
    ...     raise IntrinsicsError("holds no numbers")
    Traceback (most recent call last):
    ...
    cucumbervision.errors.IntrinsicsError: a.json: holds no numbers
    """
    try:
        yield
    except CucumberVisionError as error:
        raise error.at(source) from None


@contextmanager
def wrap_os_errors(
    fault: str,
    source: object,
    remedy: str = "choose another --out",
    kind: type[CucumberVisionError] = CucumberVisionError,
) -> Iterator[None]:
    """Raise a named error for an OSError raised inside the context.

    Parameters
    ----------
    fault : str
        What cannot be done; the system's reason is added in brackets.
    source : object
        The file or folder at fault.
    remedy : str
        What the user can do about it.
    kind : type
        The error's class.

    Examples
    --------
    >>> with wrap_os_errors("cannot be read", "a.csv", "check the path"):
    ...     raise PermissionError(13, "Permission denied")
    Traceback (most recent call last):
    ...
    cucumbervision.errors.CucumberVisionError: a.csv: cannot be read (Permission denied); ...
    """
    try:
        yield
    except OSError as error:
        text = error.strerror or " ".join(str(error).split()) or type(error).__name__
        if error.errno in _FULL:
            kind, remedy = DiskFullError, _FILE_REMEDIES[errno.ENOSPC]
        raise kind(with_reason(fault, text), source=source, remedy=remedy) from error
    except ValueError as error:
        # An invalid file name: Python raises this without a system call.
        name = str(source).encode(errors="replace").decode()
        if "\0" not in name and name == str(source):
            raise
        reason = "its name holds a null" if "\0" in name else "its name holds half of a letter"
        name = name.replace("\0", "�")
        raise kind(with_reason(fault, reason), source=name, remedy=remedy) from error


@contextmanager
def wrap_reader_errors(
    source: object,
    kind: type[CucumberVisionError] = CucumberVisionError,
    remedy: str = "correct or export it again",
) -> Iterator[None]:
    """Convert any exception that a reader raises for a damaged file to a named error.

    Named errors pass as they are; the original error stays their cause.

    Parameters
    ----------
    source : object
        The file that is read inside.
    kind : type
        The error's class.
    remedy : str
        What the user can do about it.

    Examples
    --------
    >>> with wrap_reader_errors("run.json", TruthError):
    ...     {"captures": 3}["fruit"]
    Traceback (most recent call last):
    ...
    cucumbervision.errors.TruthError: run.json: has no 'fruit'; correct or export it again
    """
    try:
        yield
    except CucumberVisionError:
        raise
    except MemoryError as error:
        raise named_error(error, source) from error
    except Exception as error:
        raise kind(_fault_of(error), source=source, remedy=remedy) from error


def _fault_of(error: Exception) -> Message:
    text = " ".join(str(error).split())
    if isinstance(error, OSError):
        return with_reason("cannot be read", error.strerror or text)
    if isinstance(error, RecursionError):
        return Message("is nested too deeply")
    if isinstance(error, UnicodeError):
        return Message("is not readable text")
    if isinstance(error, KeyError):
        return Message("has no {name}", name=text[:_LONGEST_FAULT])
    if len(text) > _LONGEST_FAULT:
        text = f"{text[:_LONGEST_FAULT]}…"
    return with_reason("is damaged or of another form", text or type(error).__name__)


_LONGEST_FAULT = 200  # of a library's message

_FULL = frozenset((errno.ENOSPC, errno.EDQUOT))
_FILE_REMEDIES = {
    errno.ENAMETOOLONG: "shorten the name",
    errno.ENOSPC: "free some space on the disk",
    errno.EDQUOT: "free some space on the disk",
    errno.EACCES: "check who may read and write it",
    errno.EMFILE: "close other programs",
}


# Messages of libraries and the dynamic loader that mean MemoryError.
_NO_MEMORY = re.compile(
    "cannot allocate memory|insufficient memory|failed to map segment|can't start new thread|"
    "bad.?alloc|bfc_arena|failed to allocate",
    re.IGNORECASE,
)


def named_error(error: Exception, source: object = None) -> CucumberVisionError:
    """Return a named error for any exception.

    Parameters
    ----------
    error : Exception
        The exception; a named error is returned unchanged.
    source : object, optional
        The file or capture that was processed.

    Returns
    -------
    CucumberVisionError
        `OutOfMemoryError` where memory was short, `FileError` for an OSError, and `InternalError`,
        with the place in the code, for everything else.

    Examples
    --------
    >>> print(named_error(OSError(28, "No space left on device"), "house/a"))
    house/a: No space left on device; free some space on the disk
    """
    if isinstance(error, CucumberVisionError):
        return error
    if isinstance(error, MemoryError) or _NO_MEMORY.search(str(error)):
        remedy = "close other programs, or use smaller pictures"
        return OutOfMemoryError("there is not enough memory", source=source, remedy=remedy)
    if isinstance(error, OSError):
        text = error.strerror or str(error) or type(error).__name__
        # A name that is too long is not useful in a message.
        file = error.filename if error.errno != errno.ENAMETOOLONG else None
        remedy = _FILE_REMEDIES.get(error.errno or 0, "check the disk and its permissions")
        kind = DiskFullError if error.errno in _FULL else FileError
        return kind(text, source=file or source, remedy=remedy)
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    text = f"{type(error).__name__}: {error}".rstrip(": ")[:300]
    remedy = "this is a defect of the software: please report it with the file"
    return InternalError(f"{text}{place}", source=source, remedy=remedy)
