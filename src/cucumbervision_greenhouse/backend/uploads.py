"""Uploads on disk: files that arrive in parts, and their outcomes; both survive a restart."""

from __future__ import annotations

import os
import shutil
import threading
import time
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from cucumbervision.errors import NameRefusedError, UploadError
from cucumbervision.names import LONGEST_NAME, checked_name
from cucumbervision_greenhouse.backend.core_words import StoredMessage
from cucumbervision_greenhouse.backend.settings import replace_text
from cucumbervision_greenhouse.rounds.walking import NextPlace
from cucumbervision_greenhouse.store.records import key_of

MOST_TRIES = 3  # limit for an upload that crashes the program each time
_ABOUT = "upload.json"
MOST_FILES = 1000
_KEPT = 20  # number of uploads whose outcomes are kept
_UNCOUNTED = {"captures": None, "measured": 0}
_RESERVE_BYTES = 500_000_000  # disk space that is left for new captures


def _given(name: str) -> str:
    try:
        return checked_name(name, "row or side")
    except NameRefusedError as error:
        raise ValueError(str(error)) from None


FileName = Annotated[str, Field(max_length=500)]  # with its folders
GivenName = Annotated[str, Field(max_length=LONGEST_NAME), AfterValidator(_given)]
Length = Annotated[float, Field(ge=0, le=10_000, allow_inf_nan=False)]


class _Frozen(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SentFile(_Frozen):
    """A file as announced: its name, its size in bytes, the time of its last change."""

    name: FileName
    size: Annotated[int, Field(ge=0)]
    changed: Annotated[float, Field(allow_inf_nan=False)] = 0.0


class SentPlace(_Frozen):
    """Place of the first capture that names none, as `NextPlace`."""

    row: GivenName = ""
    side: GivenName = "left"
    position_m: Length = 0.0
    step_m: Length = 0.4
    back: bool = False

    @property
    def next_place(self) -> NextPlace:
        """The same for a walk."""
        return NextPlace(
            row=self.row,
            side=self.side,
            position_m=self.position_m,
            step_m=self.step_m,
            back=self.back,
        )


class UploadOutcome(_Frozen):
    """The outcome of a file, or of a capture in it.

    Parameters
    ----------
    name : str
        By its sender's name.
    saved : bool
        Whether it is a stop now.
    words : Message
        How many fruit, and where; or why not.
    """

    name: str
    saved: bool
    words: StoredMessage


class Sending(_Frozen):
    """An upload as a browser announces it."""

    round: Annotated[str, Field(pattern=r"^[0-9a-f-]{36}$")]
    files: Annotated[tuple[SentFile, ...], Field(min_length=1, max_length=MOST_FILES)]
    place: SentPlace = SentPlace()
    camera: Annotated[str, Field(max_length=LONGEST_NAME)] = ""

    @property
    def key(self) -> str:
        """Key of the upload: the same for the same files and round."""
        parts = (f"{file.name}/{file.size}/{file.changed}" for file in self.files)
        return key_of("upload", self.round, *parts)

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(file.size for file in self.files)


class Upload(_Frozen):
    """An upload as it stands.

    Parameters
    ----------
    sending : Sending
        What was announced.
    begun_s : float
        When, seconds since 1970.
    done : bool
        Whether it was measured completely; then its files are deleted.
    tries : int
        How often its measurement was started.
    outcomes : tuple of UploadOutcome
        Outcomes so far.
    captures : int, optional
        Number of captures; None while its files are checked.
    measured : int
        Number of finished captures.
    """

    sending: Sending
    begun_s: float
    done: bool = False
    tries: int = 0
    outcomes: tuple[UploadOutcome, ...] = ()
    captures: int | None = None
    measured: int = 0


class Uploads:
    """A folder of uploads.

    Parameters
    ----------
    folder : Path
        Created with the first upload.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.changes = 0
        self._lock = threading.Lock()

    def begin(self, sending: Sending, limit_bytes: int) -> list[int]:
        """Begin or resume an upload; return how many bytes of each file have arrived.

        Raises
        ------
        UploadError
            If it is larger than the limit, or than the disk has room for; nothing is kept.
        """
        if sending.size > limit_bytes:
            raise UploadError(
                "{size:.0f} MB are more than the {limit:.0f} MB that are taken",
                remedy="send it in smaller parts, or change the limit in 'Settings'",
                size=sending.size / 1e6,
                limit=limit_bytes / 1e6,
            )
        with self._lock:
            upload = self.read(sending.key)
            if upload is None or upload.done:
                self.folder.mkdir(parents=True, exist_ok=True)
                free = shutil.disk_usage(self.folder).free
                if sending.size + _RESERVE_BYTES > free:
                    raise UploadError(
                        "the disk has room for {size:.0f} MB",
                        remedy="free some space on the disk",
                        size=max(free - _RESERVE_BYTES, 0) / 1e6,
                    )
                shutil.rmtree(self.folder / sending.key, ignore_errors=True)
                try:
                    (self.folder / sending.key).mkdir()
                    self._write(Upload(sending=sending, begun_s=time.time()))
                except BaseException:
                    shutil.rmtree(self.folder / sending.key, ignore_errors=True)
                    raise
        return self.received(sending.key)

    def received(self, key: str) -> list[int]:
        """Return how many bytes of each file have arrived.

        Raises
        ------
        UploadError
            If there is no such upload.
        """
        return [
            path.stat().st_size if path.exists() else 0
            for path in (self._part(key, number) for number in range(len(self._known(key).files)))
        ]

    def append(self, key: str, number: int, offset: int, data: bytes) -> int:
        """Append a part to a file unless it has arrived before; return the file's size.

        Raises
        ------
        UploadError
            If there is no such file, or it would be larger than it was announced.
        """
        sending = self._known(key)
        if not 0 <= number < len(sending.files):
            raise UploadError("there is no such file", remedy="choose the files again")
        path = self._part(key, number)
        with self._lock, path.open("ab") as stream:
            received = stream.tell()
            if received != offset:  # a part that is sent again
                return received
            if received + len(data) > sending.files[number].size:
                raise UploadError(
                    "is larger than it was",
                    source=sending.files[number].name,
                    remedy="choose the files again",
                )
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
            return received + len(data)

    def is_whole(self, key: str) -> bool:
        """Return whether every file has arrived."""
        return self.received(key) == [file.size for file in self._known(key).files]

    def files(self, key: str) -> list[tuple[str, Path]]:
        """Return the files of an upload by their senders' names."""
        files = self._known(key).files
        for number in range(len(files)):
            self._part(key, number).touch()  # an empty file has no parts
        return [(file.name, self._part(key, number)) for number, file in enumerate(files)]

    def to_measure(self) -> list[str]:
        """Return the complete uploads that were not measured, the oldest first."""
        return [
            upload.sending.key
            for upload in reversed(self.all())
            if not upload.done and self.is_whole(upload.sending.key)
        ]

    def all(self, round_key: str | None = None) -> list[Upload]:
        """Return the uploads, or those into a round, the newest first."""
        uploads = [self.read(path.parent.name) for path in self.folder.glob(f"*/{_ABOUT}")]
        of_round = [
            upload for upload in uploads if upload and round_key in (None, upload.sending.round)
        ]
        return sorted(of_round, key=lambda upload: upload.begun_s, reverse=True)

    def try_once(self, key: str) -> Upload:
        """Count a start of its measurement, and return the upload as it was before."""
        with self._lock:
            upload = self.read(key)
            if upload is None:
                raise UploadError("this upload is gone", remedy="choose the files again")
            self._write(upload.model_copy(update={**_UNCOUNTED, "tries": upload.tries + 1}))
            return upload

    def note(
        self, key: str, outcomes: list[UploadOutcome], *, done: bool = False, **counts: int
    ) -> None:
        """Save outcomes and counts of captures, with the names of `Upload`'s fields.

        Once it is done, its files and the oldest uploads are deleted.
        """
        with self._lock:
            upload = self.read(key)
            if upload is None:
                return
            # A capture that a killed run saved keeps its outcome; now it would be a repetition.
            saved = {outcome.name: outcome for outcome in upload.outcomes if outcome.saved}
            merged = tuple(
                outcome if outcome.saved else saved.get(outcome.name, outcome)
                for outcome in outcomes
            )
            self._write(upload.model_copy(update={"outcomes": merged, "done": done, **counts}))
            if done:
                for number in range(len(upload.sending.files)):
                    self._part(key, number).unlink(missing_ok=True)
                for old in self.all()[_KEPT:]:
                    shutil.rmtree(self.folder / old.sending.key, ignore_errors=True)

    def _known(self, key: str) -> Sending:
        upload = self.read(key)
        if upload is None:
            raise UploadError("this upload is gone", remedy="choose the files again")
        return upload.sending

    def _part(self, key: str, number: int) -> Path:
        return self.folder / key / f"{number:04d}"

    def read(self, key: str) -> Upload | None:
        """Return an upload; None if there is none of that key."""
        try:
            text = (self.folder / key / _ABOUT).read_text(encoding="utf-8")
            return Upload.model_validate_json(text)
        except (OSError, ValueError):  # a ValidationError is a ValueError
            return None

    def _write(self, upload: Upload) -> None:
        path = self.folder / upload.sending.key / _ABOUT
        replace_text(path, upload.model_dump_json())
        self.changes += 1
