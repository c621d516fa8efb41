"""What a store takes and gives: rounds, stops, captures and the rows of fruit; metres, seconds."""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import SimpleNamespace
from typing import Any, TypeAlias

from cucumbervision.capture.frames import Stop
from cucumbervision.methods.flags import is_length_unknown, is_lower_bound
from cucumbervision.methods.result import Length
from cucumbervision.run.fields import STORED_FIELDS, stored_length

Point: TypeAlias = tuple[float, ...]

_HIDDEN_SHARE = 0.15  # means the same as a flag of a fruit that is partly out of sight
_SAME_HEIGHT_M = 0.005
_CLOCK_SET_S = 946_684_800.0  # the year 2000
_NAMESPACE = uuid.UUID("6f2d2a4e-5d0b-5c7e-9a4d-6d1c1f0c9b57")


class Verdict(StrEnum):
    """A person's verdict on a measured fruit."""

    ACCEPTED = "accepted"
    REJECTED = "rejected"


def new_key() -> str:
    """Return a key that nothing else has: a random UUID.

    Examples
    --------
    >>> len(new_key())
    36
    """
    return str(uuid.uuid4())


def key_of(*parts: object) -> str:
    """Return the key of these parts: the same parts always give the same UUID.

    Examples
    --------
    >>> key_of("round", 3)
    'dc51d2ee-b492-5df0-b26a-3d3a83575247'
    """
    return str(uuid.uuid5(_NAMESPACE, json.dumps([str(part) for part in parts])))


@dataclass(frozen=True)
class Round:
    """One walk through a house.

    Parameters
    ----------
    key : str
        UUID, made by the program that starts the round.
    name, house, profile, note : str
        Its name; the greenhouse, empty where there is only one; name of the crop profile; the
        operator's note.
    started_s : float
        When it began, seconds since 1970 (UTC).
    stops, fruit : int
        How many it has, in a list.
    last_s : float, optional
        When its last capture was taken.
    """

    key: str = field(default_factory=new_key)
    name: str = ""
    house: str = ""
    started_s: float = field(default_factory=time.time)
    profile: str = ""
    note: str = ""
    stops: int = 0
    fruit: int = 0
    last_s: float | None = None

    @property
    def walked_s(self) -> float:
        """When it was walked: when its last capture was taken, seconds since 1970.

        When it was begun where that is not known: without captures, or from a camera whose clock
        was never set.
        """
        clock_set = self.last_s is not None and self.last_s > _CLOCK_SET_S
        return self.last_s if clock_set and self.last_s else self.started_s


@dataclass(frozen=True)
class ArtifactRecord:
    """A model, calibration, configuration or crop profile that took part in a measurement.

    Parameters
    ----------
    kind : str
        'model', 'calibration', 'config', 'profile' or 'software'.
    name : str
        What it is called.
    sha256 : str
        Hash of its content; empty where it has none.
    details : mapping
        What else is known of it, as JSON values.
    """

    kind: str
    name: str
    sha256: str = ""
    details: Mapping[str, Any] = field(default_factory=dict)


_ROW: dict[str, Any] = {
    **dict.fromkeys(column.si_name for column in STORED_FIELDS),
    **{"fruit": 1, "score": 1.0, "label": "cucumber", "view_score": 0.0},
    **dict.fromkeys(("reason", "fallback", "flags"), ""),
    **dict.fromkeys(("box_x1_px", "box_y1_px", "box_x2_px", "box_y2_px"), 0.0),
    **dict.fromkeys(("offset_m", "offset_sd_m")),
}
_SHAPE: dict[str, Any] = {"mask": None, "keypoints": (), "path_m": (), "diameter_m": ()}
_PLACE: dict[str, Any] = {
    **dict.fromkeys(("key", "stop_key", "round_key", "capture", "group"), ""),
    **dict.fromkeys(("row", "side", "step", "along_m", "along_sd_m", "thumbnail")),
    **{"taken_s": 0.0, "simulated": False, "verdict": None, "picked_s": None, "corrected": False},
    **{"views": 1, "number": 0},
}
_INTERVAL = ("low_m", "high_m", "of", "basis")


class FruitRow(SimpleNamespace):
    """One fruit of one capture: its row, where it hangs, and what people decided about it.

    Attributes are the columns of `fields.csv` in SI units (`Column.si_name`), and those below. A
    row is never changed; `with_` makes another.

    Parameters
    ----------
    fruit : int
        Its number in the capture, from 1.
    length, raw_length : Length, optional
        In place of their columns: what the fruit counts for, and what was read before the site's
        calibration.
    **values
        Any other attributes:

        - `offset_m`, `offset_sd_m`: how far along the row its middle lies from its stop's position;
        - `mask`, `keypoints`, `path_m`, `diameter_m`: compressed run lengths of the measured mask
          at the capture's size; (u, v, visibility); the measured line in camera coordinates and the
          tube's diameter along it. Lists leave them out;
        - `key`, `stop_key`, `round_key`, `capture`, `simulated`, `thumbnail`, `row`, `side`,
          `step`, `taken_s`: its own key, and those of its stop and round; its capture's name and
          small image; where and when it was taken;
        - `along_m`, `along_sd_m`: where it hangs along the row;
        - `verdict`, `picked_s`, `corrected`: a person's verdict, when it was picked, and whether
          its outline was corrected;
        - `group`, `views`, `number`: key of the best view of the same fruit in the round, how many
          views it has, and its number in the round's list.

    Examples
    --------
    >>> fruit = FruitRow(1, length=Length(0.31, low_m=0.30, high_m=0.32), flags="end-hidden")
    >>> fruit.length_m, fruit.interval_high_m, fruit.at_least, fruit.whole_length
    (0.31, 0.32, True, None)
    """

    def __init__(self, fruit: int = 1, /, **values: Any) -> None:
        for before in ("", "raw_"):
            if f"{before}length" in values:
                values |= _length_cells(values.pop(f"{before}length"), before)
        unknown = values.keys() - _ROW.keys() - _SHAPE.keys() - _PLACE.keys()
        if unknown:
            raise TypeError(f"a fruit's row has no {', '.join(sorted(unknown))}")
        cells = {**_ROW, **_SHAPE, **_PLACE, "fruit": fruit, **values}
        cells["at_least"] = is_lower_bound(cells["flags"].split())
        super().__init__(**cells)

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(self.key)

    def with_(self, **values: Any) -> FruitRow:
        """Return a copy with other values."""
        return FruitRow(**{**vars(self), **values})

    @property
    def cells(self) -> dict[str, Any]:
        """Its cells in the table of fruit."""
        return {name: getattr(self, name) for name in _ROW}

    @property
    def shape(self) -> dict[str, Any]:
        """Mask, keypoints, path and diameters, as JSON values."""
        return {name: getattr(self, name) for name in _SHAPE}

    @property
    def length(self) -> Length | None:
        """The length, None where nothing was measured."""
        return stored_length(vars(self))

    @property
    def raw_length(self) -> Length | None:
        """The length before the site's calibration."""
        return stored_length(vars(self), "raw_")

    @property
    def known_length(self) -> Length | None:
        """The length, which may be a lower bound; None where nothing is known of it.

        Examples
        --------
        >>> FruitRow(1, length=Length(0.3), flags="depth-hollow").known_length is None
        True
        """
        return None if is_length_unknown(self.flags.split()) else self.length

    @property
    def whole_length(self) -> Length | None:
        """The length that counts in statistics: known, and no lower bound."""
        return None if self.at_least else self.known_length

    @property
    def inner_arc_mm_per_10cm(self) -> float | None:
        """The inner arc's height in mm for each 10 cm of chord; None where it is not known."""
        if self.inner_arc_m is None or not self.chord_m:
            return None
        return float(100 * self.inner_arc_m / self.chord_m)

    @property
    def partial(self) -> bool:
        """Whether its length may be a lower bound, since part of the fruit is out of sight.

        Examples
        --------
        >>> FruitRow(1, hidden_share=0.25).partial, FruitRow(1, hidden_share=0.05).partial
        (True, False)
        """
        return bool(self.at_least or (self.hidden_share or 0.0) > _HIDDEN_SHARE)

    @property
    def best(self) -> bool:
        """Whether this view represents its fruit."""
        return bool(self.group == self.key)

    @property
    def doubtful(self) -> bool:
        """Whether it was added by hand, does not look like a fruit, and nobody accepted it."""
        return "doubtful" in self.flags.split() and self.verdict is not Verdict.ACCEPTED


def _length_cells(length: Length | None, before: str) -> dict[str, Any]:
    """Return a length's cells in the table of fruit."""
    values = (None,) * 6 if length is None else tuple(vars(length).values())
    names = ("length_m", "length_kind", *(f"interval_{part}" for part in _INTERVAL))
    return {
        before + name: str(value) if isinstance(value, str) else value
        for name, value in zip(names, values, strict=True)
    }


@dataclass(frozen=True)
class CaptureRecord:
    """One RGB-D frame of a stop, and its fruit.

    Parameters
    ----------
    name : str
        What the capture is called; unique within the stop.
    camera : mapping
        The colour intrinsics, as `capture.camera_file.CameraModel` writes them.
    color, depth, thumbnail : str, optional
        Its images in the `ImageStore`.
    depth_unit_m : float, optional
        Metres of one step of the depth image.
    gravity : tuple of float, optional
        Direction of gravity in camera coordinates that it was measured with.
    doubts : tuple of str, optional
        What its reader found doubtful, as `capture.frames.Doubt`; None for nothing.
    fruit : tuple of FruitRow
        Its fruit, each number once, where it is saved; what is read leaves them out.
    """

    name: str
    frame: int = 0
    burst_frame: int = 0
    burst_size: int = 1
    timestamp_s: float | None = None
    width_px: int = 0
    height_px: int = 0
    fill: float | None = None
    simulated: bool = False
    source: str = ""
    camera: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    depth_unit_m: float | None = None
    gravity: tuple[float, float, float] | None = None
    doubts: tuple[str, ...] | None = None
    color: str | None = None
    depth: str | None = None
    thumbnail: str | None = None
    fruit: tuple[FruitRow, ...] = ()


@dataclass(frozen=True)
class StopRecord(Stop):
    """One stop of a round: what is saved in one piece.

    Parameters
    ----------
    row, side, position_m, step : optional
        As in `Stop`: position along the row as the operator or odometry gives it.
    key : str
        UUID, made by the program that takes the captures, and kept when the stop is sent again.
    round_key : str
        The round, which must be saved first.
    position_sd_m : float, optional
        Standard deviation of the position.
    taken_s : float
        When, seconds since 1970 (UTC).
    pose : tuple of float
        The camera's pose, 4x4 row by row, where one is known; as it was saved.
    note : str
        What it is called beside its number.
    captures : tuple of CaptureRecord
        What was taken here.
    artifacts : tuple of ArtifactRecord
        Models, calibration and configuration that were used.
    failures : tuple of mapping
        What could not be read or measured, as `run.measurer.Failure`.
    mirrored : bool
        Whether its side was corrected: offsets along the row count the other way.
    fitted_m, fitted_sd_m : float, optional
        Where the merging puts it.
    fruit : int
        How many fruit it shows, in a list.
    """

    key: str = ""
    round_key: str = ""
    position_sd_m: float | None = None
    taken_s: float = 0.0
    pose: Point = ()
    note: str = ""
    captures: tuple[CaptureRecord, ...] = ()
    artifacts: tuple[ArtifactRecord, ...] = ()
    failures: tuple[Mapping[str, Any], ...] = ()
    mirrored: bool = False
    fitted_m: float | None = None
    fitted_sd_m: float | None = None
    fruit: int = 0

    def __post_init__(self) -> None:
        """Take what an earlier version stored as it is; `check_place` checks before saving."""

    @property
    def at_m(self) -> float | None:
        """Where it is along the row: as the merging fitted it, else as it was given."""
        return self.position_m if self.fitted_m is None else self.fitted_m

    @property
    def pose_now(self) -> Point:
        """The pose on the side on which the stop is now."""
        turned = tuple(-x for x in self.pose[:3]) + tuple(self.pose[3:])
        return turned if self.mirrored else tuple(self.pose)

    @property
    def height_m(self) -> float:
        """Height of the camera, as a pose file gave it; 0 without one."""
        return float(self.pose[7]) if len(self.pose) == 16 else 0.0

    @property
    def camera(self) -> Mapping[str, Any]:
        """The camera of the first capture; empty where there is none."""
        return self.captures[0].camera if self.captures else {}

    @property
    def thumbnail(self) -> str | None:
        """The small image of the first capture."""
        return self.captures[0].thumbnail if self.captures else None

    def has_camera_of(self, stop: StopRecord) -> bool:
        """Return whether both may have one camera: the same intrinsics, if known, and height."""
        level = abs(self.height_m - stop.height_m) < _SAME_HEIGHT_M
        return level and (not (self.camera and stop.camera) or self.camera == stop.camera)


SURE = 0.85
"""Probability from which a pair of two days is linked; below, people are asked."""


class LinkKind(StrEnum):
    """How two detections are related."""

    SAME = "same"  # one fruit, seen twice in a round
    GROWTH = "growth"  # one fruit on an earlier and a later round
    APART = "apart"  # two fruit, decided by hand: no algorithm may link them


@dataclass(frozen=True)
class LinkRecord:
    """Two detections and their relation; for growth the earlier one is first."""

    kind: LinkKind
    first: str
    second: str
    score: float | None = None
    by_hand: bool = False

    @property
    def sure(self) -> bool:
        """Whether it counts; other pairs of two days are offered to be confirmed."""
        return self.by_hand or (self.score or 0.0) >= SURE


@dataclass(frozen=True)
class LogEntry:
    """What a person decided.

    Parameters
    ----------
    number : int
        Its number; later ones have higher ones.
    at_s : float
        When, seconds since 1970 (UTC).
    by : str
        Who.
    kind : str
        'accept', 'reject', 'clear', 'pick', 'unpick', 'correct', 'add', 'merge', 'unmerge',
        'link-growth', 'unlink-growth', 'place-stop', 'delete-stop', 'take-back-stop',
        'rename-round', 'move-round', 'delete-round', 'harvest' or 'undo'.
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
    view : FruitRow
        As in lists, with its mask, keypoints and path.
    capture : CaptureRecord
        Its capture.
    stop : StopRecord
        Its stop, with all captures.
    log : tuple of LogEntry
        What was done to it by hand, newest first.
    """

    view: FruitRow
    capture: CaptureRecord
    stop: StopRecord
    log: tuple[LogEntry, ...]
