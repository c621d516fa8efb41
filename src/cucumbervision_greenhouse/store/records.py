"""Records of the store: frozen values, in metres and seconds."""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from enum import StrEnum
from typing import Any, TypeAlias

from cucumbervision.errors import StoreError
from cucumbervision.measurement.flags import is_length_unknown, is_lower_bound
from cucumbervision.measurement.result import Choice, Length

Point: TypeAlias = tuple[float, ...]

# Flags of a fruit that is partly out of sight, and the hidden share with the same meaning.
_HIDDEN_SHARE = 0.15

_NAMESPACE = uuid.UUID("6f2d2a4e-5d0b-5c7e-9a4d-6d1c1f0c9b57")


class Saved(StrEnum):
    """Whether a saved record was new."""

    NEW = "new"
    ALREADY_THERE = "already-there"


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


def checked_key(key: str, what: str) -> str:
    """Return a key in canonical form.

    Raises
    ------
    StoreError
        If it is not a UUID.

    Examples
    --------
    >>> checked_key("DC51D2EEB4925DF0B26A3D3A83575247", "stop")
    'dc51d2ee-b492-5df0-b26a-3d3a83575247'
    """
    try:
        return str(uuid.UUID(key))
    except (ValueError, AttributeError, TypeError):
        raise StoreError(
            f"{what} key {key!r} is not a UUID", remedy="take one from records.new_key()"
        ) from None


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


@dataclass(frozen=True)
class ImageRef:
    """A stored picture: its name is the hash of its content.

    Parameters
    ----------
    sha256 : str
        Of the file, hexadecimal.
    suffix : str
        '.png' or '.jpg'.
    size_bytes : int
        Of the file.
    width_px, height_px : int
        Of the picture.
    """

    sha256: str
    suffix: str
    size_bytes: int
    width_px: int
    height_px: int


@dataclass(frozen=True)
class Round:
    """One walk through a house.

    Parameters
    ----------
    key : str
        UUID, made by the program that starts the round.
    name : str
        Its name.
    house : str
        The greenhouse; empty where there is only one.
    started_s : float
        When it began, seconds since 1970 (UTC).
    profile : str
        Name of the crop profile.
    note : str
        The operator's note.
    """

    key: str = field(default_factory=new_key)
    name: str = ""
    house: str = ""
    started_s: float = field(default_factory=time.time)
    profile: str = ""
    note: str = ""


@dataclass(frozen=True)
class MethodRecord:
    """One method on one fruit, see `measurement.result.Measurement`.

    Parameters
    ----------
    method : str
        'M1' to 'M6'.
    length_m : float, optional
        Its own raw length, metres.
    kind, reason, fallback, measured_by
        As in `Measurement`; the path of fallbacks as one text.
    centreline_m, thread_m, chord_m : float, optional
        The three lengths, where a tube was fitted.
    centreline_sd_m, thread_sd_m : float, optional
        Their standard deviations, camera scale left out.
    path_m : tuple of (x, y, z)
        The line that was measured, camera coordinates, metres.
    diameter_m : tuple of float
        The tube's diameter at each point of `path_m`; empty where none was fitted.
    """

    method: str
    length_m: float | None = None
    kind: str | None = None
    reason: str = "ok"
    fallback: str = ""
    measured_by: str | None = None
    centreline_m: float | None = None
    thread_m: float | None = None
    chord_m: float | None = None
    centreline_sd_m: float | None = None
    thread_sd_m: float | None = None
    path_m: tuple[Point, ...] = ()
    diameter_m: Point = ()


@dataclass(frozen=True)
class DetectionRecord:
    """One detected fruit of one capture.

    Names are those of `Column.si_name` of `pipeline.fields.FIELDS`.

    Parameters
    ----------
    number : int
        Its number in the capture, from 1.
    centre_x_m, centre_y_m, centre_z_m : float, optional
        Its middle in camera coordinates: right, down and away from the camera, metres.
    offset_m, offset_sd_m : float, optional
        How far along the row its middle lies from the stop's position, and how sure that is.
    view_score : float
        How well this view shows it, 0 to 1; the highest of several views represents the fruit.
    length, raw_length : Length, optional
        As in `Fruit`: what the fruit counts for, and what was read before the site's
        calibration.
    keypoints : tuple of (u, v, visibility)
        Pixels; empty where there are none.
    mask : str, optional
        The mask that was measured, COCO's compressed run lengths at the capture's size. Lists
        leave it out.
    methods : tuple of MethodRecord
        Every method that was run. Lists leave them out.
    """

    number: int
    label: str = "cucumber"
    score: float = 1.0
    box_x1_px: float = 0.0
    box_y1_px: float = 0.0
    box_x2_px: float = 0.0
    box_y2_px: float = 0.0
    method: str | None = None
    reason: str = ""
    fallback: str = ""
    flags: str = ""
    centreline_m: float | None = None
    thread_m: float | None = None
    chord_m: float | None = None
    inner_arc_m: float | None = None
    diameter_max_m: float | None = None
    diameter_mean_m: float | None = None
    volume_m3: float | None = None
    tilt_deg: float | None = None
    hidden_share: float | None = None
    mask_source: str | None = None
    mask_px: int | None = None
    fill: float | None = None
    distance_m: float | None = None
    stem_x_m: float | None = None
    stem_y_m: float | None = None
    stem_z_m: float | None = None
    blossom_x_m: float | None = None
    blossom_y_m: float | None = None
    blossom_z_m: float | None = None
    stem_confidence: float | None = None
    cut_x_m: float | None = None
    cut_y_m: float | None = None
    cut_z_m: float | None = None
    cut_xx_m2: float | None = None
    cut_xy_m2: float | None = None
    cut_xz_m2: float | None = None
    cut_yy_m2: float | None = None
    cut_yz_m2: float | None = None
    cut_zz_m2: float | None = None
    centre_x_m: float | None = None
    centre_y_m: float | None = None
    centre_z_m: float | None = None
    offset_m: float | None = None
    offset_sd_m: float | None = None
    view_score: float = 0.0
    length: Length | None = None
    raw_length: Length | None = None
    keypoints: tuple[Point, ...] = ()
    mask: str | None = None
    methods: tuple[MethodRecord, ...] = ()

    @property
    def length_m(self) -> float | None:
        """The length's value, metres; None where nothing was measured."""
        return None if self.length is None else self.length.value_m

    @property
    def known_length(self) -> Length | None:
        """The length, which may be a lower bound; None where nothing is known of it.

        Examples
        --------
        >>> from cucumbervision.measurement.result import Length
        >>> DetectionRecord(1, length=Length(0.3), flags="depth-hollow").known_length is None
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
        return 100 * self.inner_arc_m / self.chord_m

    @property
    def at_least(self) -> bool:
        """Whether an end is out of sight, so that its length is a lower bound.

        Examples
        --------
        >>> DetectionRecord(1, flags="sam-mask-small end-hidden").at_least
        True
        """
        return is_lower_bound(self.flags.split())

    @property
    def partial(self) -> bool:
        """Whether its length may be a lower bound, since part of the fruit is out of sight.

        In several views at once the edge of a leaf is at several places along the fruit, and is
        not taken for its end.

        Examples
        --------
        >>> DetectionRecord(1, hidden_share=0.25).partial
        True
        >>> DetectionRecord(1, hidden_share=0.05).partial
        False
        >>> DetectionRecord(1, hidden_share=0.25, reason="several-views").partial
        False
        """
        hides = (self.hidden_share or 0.0) > _HIDDEN_SHARE
        return self.at_least or (hides and self.reason != Choice.SEVERAL_VIEWS)


@dataclass(frozen=True)
class CaptureRecord:
    """One RGB-D frame of a stop, and its fruit.

    Parameters
    ----------
    name : str
        What the capture is called; unique within the stop.
    camera : mapping
        The colour intrinsics, as `capture.camera_file.CameraModel` writes them.
    color, depth, thumbnail : ImageRef, optional
        Its pictures in the `ImageStore`.
    depth_unit_m : float, optional
        Metres of one step of the depth picture.
    gravity : tuple of float, optional
        Direction of gravity in camera coordinates that it was measured with.
    doubts : tuple of str, optional
        What its reader found doubtful, as `capture.frames.Doubt`; None for nothing.
    fruit : tuple of DetectionRecord
        Its fruit, each number once.
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
    color: ImageRef | None = None
    depth: ImageRef | None = None
    thumbnail: ImageRef | None = None
    fruit: tuple[DetectionRecord, ...] = ()


@dataclass(frozen=True)
class StopRecord:
    """One stop of a round: what is saved in one piece.

    Parameters
    ----------
    key : str
        UUID, made by the program that takes the captures, and kept when the stop is sent again.
    round_key : str
        The round, which must be saved first.
    row, side : str, optional
        Row of the house, and side of the row.
    position_m, position_sd_m : float, optional
        Position along the row as the operator or odometry gives it, and its standard deviation.
    step : int, optional
        Number of the stop.
    taken_s : float
        When, seconds since 1970 (UTC).
    pose : tuple of float
        The camera's pose, 4x4 row by row, where one is known.
    captures : tuple of CaptureRecord
        What was taken here.
    artifacts : tuple of ArtifactRecord
        Models, calibration and configuration that were used.
    failures : tuple of mapping
        What could not be read or measured, as `pipeline.measurer.Failure`.
    """

    key: str
    round_key: str
    row: str | None = None
    side: str | None = None
    position_m: float | None = None
    position_sd_m: float | None = None
    step: int | None = None
    taken_s: float = 0.0
    pose: tuple[float, ...] = ()
    note: str = ""
    captures: tuple[CaptureRecord, ...] = ()
    artifacts: tuple[ArtifactRecord, ...] = ()
    failures: tuple[Mapping[str, Any], ...] = ()


@dataclass(frozen=True)
class JointRecord:
    """The joint measurement of one fruit in several views.

    Parameters
    ----------
    key : str
        Of these views as they are: changed by every change of one of them.
    first : str
        Key of the view in whose camera coordinates it is.
    views : int
        How many views the tube was fitted to; 0 where none was.
    reason : str
        'ok', or why no length comes of it: 'end-hidden', 'not-measured', 'no-picture',
        'measured-differently' (with other calibrations).
    record : DetectionRecord, optional
        As measured; box, keypoints and view score are the first view's. Its mask is left out, and
        lists leave out its method with the path as well.
    poses : mapping of str to tuple of float
        From the first view's camera coordinates to those of each view used, by their keys: 4x4,
        row by row. Lists leave them out.
    """

    key: str
    first: str
    views: int
    reason: str = "ok"
    record: DetectionRecord | None = None
    poses: Mapping[str, Point] = field(default_factory=dict)


def record_json(record: Any) -> dict[str, Any]:
    """Return any record as JSON values.

    Raises
    ------
    StoreError
        If it holds a number that is not finite, or a value that JSON has not.

    Examples
    --------
    >>> record_json(MethodRecord("M1", 0.21))["length_m"]
    0.21
    """
    try:
        text = json.dumps(record, default=_values_of, allow_nan=False)
        values: dict[str, Any] = json.loads(text)
    except (ValueError, TypeError) as error:
        raise StoreError(
            f"the record cannot be stored ({error})", remedy="give finite numbers and plain values"
        ) from None
    return values


def _values_of(value: object) -> dict[str, Any]:
    """Return the fields of a record; `asdict` would copy every value inside them first."""
    if not is_dataclass(value):
        raise TypeError(f"{type(value).__name__} has no form in JSON")
    return {column.name: getattr(value, column.name) for column in fields(value)}
