"""Rows of the lists that the store returns, and one detection with everything."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from cucumbervision_greenhouse.store.records import (
    CaptureRecord,
    DetectionRecord,
    ImageRef,
    Round,
    StopRecord,
)

if TYPE_CHECKING:
    from cucumbervision_greenhouse.store.links import LinkRecord


_SAME_HEIGHT_M = 0.005
_CLOCK_SET_S = 946_684_800.0  # the year 2000


@dataclass(frozen=True)
class CameraAt:
    """The camera of a stop and its pose, which lists of stops leave out.

    Parameters
    ----------
    pose : sequence of float
        Camera to row, 4 x 4 row by row; empty where it is not known.
    captures : mapping
        The captures' numbers in the store by their names.
    camera : mapping
        Of the first capture, as it was saved; empty where there is none.
    """

    pose: Sequence[float]
    captures: dict[str, int]
    camera: Mapping[str, Any]

    @property
    def height_m(self) -> float:
        """Of the camera, as a pose file gave it; 0 without one."""
        return float(self.pose[7]) if len(self.pose) == 16 else 0.0

    def is_one_with(self, camera_at: CameraAt) -> bool:
        """Return whether both may be one camera: the same intrinsics, if known, and height."""
        comparable = self.camera and camera_at.camera
        level = abs(self.height_m - camera_at.height_m) < _SAME_HEIGHT_M
        return level and (not comparable or self.camera == camera_at.camera)


class Verdict(StrEnum):
    """A person's verdict on a measured fruit."""

    ACCEPTED = "accepted"
    REJECTED = "rejected"


@dataclass(frozen=True)
class RoundSummary:
    """A round with its numbers of stops and detections, and the time of its last stop."""

    record: Round
    stops: int
    fruit: int
    last_s: float | None

    @property
    def key(self) -> str:
        """The round's key."""
        return self.record.key

    @property
    def walked_s(self) -> float:
        """When it was walked: when its last capture was taken, seconds since 1970.

        When it was begun where that is not known: without captures, or from a camera whose clock
        was never set.
        """
        clock_set = self.last_s is not None and self.last_s > _CLOCK_SET_S
        return self.last_s if clock_set and self.last_s else self.record.started_s


@dataclass(frozen=True)
class StopSummary:
    """A stop in a list.

    Parameters
    ----------
    position_m, position_sd_m : float, optional
        As it was given.
    fitted_m, fitted_sd_m : float, optional
        Where the merging puts it.
    mirrored : bool
        Whether its side was corrected: offsets along the row count the other way.
    captures, fruit, failures : int
        How many.
    thumbnail : ImageRef, optional
        Of its first capture.
    """

    key: str
    round_key: str
    row: str | None
    side: str | None
    position_m: float | None
    position_sd_m: float | None
    fitted_m: float | None
    fitted_sd_m: float | None
    step: int | None
    taken_s: float
    note: str
    mirrored: bool
    captures: int
    fruit: int
    failures: int
    thumbnail: ImageRef | None


@dataclass(frozen=True)
class DetectionSummary:
    """One detection in a list.

    Parameters
    ----------
    key, stop_key, round_key : str
        Its own, its stop's and its round's.
    capture : str
        Name of its capture.
    row, side : str, optional
        Of its stop.
    along_m, along_sd_m : float, optional
        Where it is along the row, and how sure that is: the stop's fitted position, or the
        position as given, and the fruit's offset from it.
    record : DetectionRecord
        The measurement that counts: the corrected one where the mask was corrected. Lists
        leave out mask, keypoints and methods.
    verdict : Verdict, optional
        A person's verdict on it.
    picked_s : float, optional
        When it was picked, from any view of the same fruit.
    corrected : bool
        Whether its mask was corrected.
    group : str
        The same for all views of one fruit in a round: the key of the best one.
    views : int
        How many detections the group has.
    """

    key: str
    stop_key: str
    round_key: str
    capture: str
    row: str | None
    side: str | None
    step: int | None
    taken_s: float
    simulated: bool
    along_m: float | None
    along_sd_m: float | None
    thumbnail: ImageRef | None
    record: DetectionRecord
    verdict: Verdict | None = None
    picked_s: float | None = None
    corrected: bool = False
    group: str = ""
    views: int = 1

    @property
    def best(self) -> bool:
        """Whether this view represents its fruit."""
        return self.group == self.key

    @property
    def doubtful(self) -> bool:
        """Whether it was added by hand, does not look like a fruit, and nobody accepted it."""
        return "doubtful" in self.record.flags.split() and self.verdict is not Verdict.ACCEPTED


@dataclass(frozen=True)
class DetectionFilter:
    """Which fruit a list holds; what is None does not matter.

    Parameters
    ----------
    row, stop_key : str, optional
        Of that row or stop.
    verdict : Verdict, optional
        So marked.
    min_length_m : float, optional
        From that length, metres; fruit without a length are left out then.
    best : bool
        Only the representative view of each fruit: every fruit once.
    """

    row: str | None = None
    stop_key: str | None = None
    verdict: Verdict | None = None
    min_length_m: float | None = None
    best: bool = False

    def keeps(self, fruit: DetectionSummary) -> bool:
        """Return whether a fruit belongs into the list."""
        conditions = (
            (self.row, fruit.row),
            (self.stop_key, fruit.stop_key),
            (self.verdict, fruit.verdict),
        )
        if any(want is not None and want != has for want, has in conditions):
            return False
        if self.min_length_m is not None and (fruit.record.length_m or 0.0) < self.min_length_m:
            return False
        return fruit.best or not self.best


@dataclass(frozen=True)
class LogEntry:
    """A line of the log.

    Parameters
    ----------
    number : int
        Its number; later lines have higher ones.
    at_s : float
        When, seconds since 1970 (UTC).
    by : str
        Who.
    kind : str
        'accept', 'reject', 'clear', 'pick', 'unpick', 'correct', 'add', 'merge', 'unmerge',
        'link-growth', 'unlink-growth', 'place-stop', 'delete-stop', 'take-back-stop',
        'rename-round', 'move-round', 'delete-round', 'measure-again' or 'undo'.
    round_key : str, optional
        Of its last fruit: of growth between two rounds the later.
    fruit : tuple of str
        Keys of the fruit.
    details : mapping
        What else belongs to it.
    undone : bool
        Whether a later line took this one back.
    """

    number: int
    at_s: float
    by: str
    kind: str
    round_key: str | None
    fruit: tuple[str, ...]
    details: Mapping[str, Any] = field(default_factory=dict)
    undone: bool = False


@dataclass(frozen=True)
class DetectionDetail:
    """One detection with everything.

    Parameters
    ----------
    view : DetectionSummary
        As in lists, but its record has mask, keypoints and methods.
    original : DetectionRecord
        As it was first measured, with everything; equal to the view's where it was not corrected.
    capture : CaptureRecord
        Its capture, with all fruit of it.
    stop : StopRecord
        Its stop, with all captures.
    links : tuple of LinkRecord
        What it is linked to.
    log : tuple of LogEntry
        What was done to it by hand, newest first.
    """

    view: DetectionSummary
    original: DetectionRecord
    capture: CaptureRecord
    stop: StopRecord
    links: tuple[LinkRecord, ...]
    log: tuple[LogEntry, ...]
