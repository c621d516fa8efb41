"""Rows out of the store as arrays, and what was found of them back into it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.errors import RoundError
from cucumbervision.rounds.merge import NO_PAIRS, ByHand, Merged, cluster_pairs
from cucumbervision.rounds.poses import (
    MIDDLE_SD_M,
    middle_offset,
    middle_sd,
    pose_matrix,
    sign_of_side,
)
from cucumbervision.rounds.row_views import ALONG, UP, RowStops, RowViews
from cucumbervision.rounds.stop_alignment import FittedStops
from cucumbervision.store.views import LinkKind, Verdict

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from cucumbervision.store.records import DetectionRecord
    from cucumbervision.store.repository import Store
    from cucumbervision.store.views import DetectionView, LinkRecord, StopView

__all__ = [
    "RoundContent",
    "StoredRow",
    "by_hand_of",
    "load_rows",
    "read_round",
    "stored_merging",
]

CAMERA_SD_M = 0.03  # how far a camera is from its usual height and distance
REACH = (0.687, 0.384)  # a D435's colour camera, where a stop does not say which it had
LENGTH_Z = 1.6449  # of 90 % intervals
UNKNOWN_SD, LEAST_SD = 0.08, 0.01  # relative, of a length without interval, and of any
DIAMETER_SD = 0.05
TUBE_KINDS = frozenset({"thread", "centreline", "chord"})


@dataclass(frozen=True, eq=False)
class StoredRow:
    """One row of a round.

    Parameters
    ----------
    name : str
        The row; empty where it has no name.
    stops : RowStops
        Its stops with a position.
    views : RowViews
        Their detections with a place, rejected ones left out.
    stop_keys, fruit_keys : tuple of str
        Keys of both, in order.
    sides : tuple of str
        Names of the sides: 0, and 1 where there is one.
    unplaced : tuple of str
        Detections that cannot be merged: no position, or no depth.
    """

    name: str
    stops: RowStops
    views: RowViews
    stop_keys: tuple[str, ...]
    fruit_keys: tuple[str, ...]
    sides: tuple[str, ...]
    unplaced: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class RoundContent:
    """What the store holds of a round: read once, used by all that ask for it.

    Parameters
    ----------
    key : str
        The round's.
    stops : tuple of StopView
        Its stops.
    views : tuple of DetectionView
        Its detections, in groups.
    frames : mapping
        Poses and cameras by the stops' keys.
    """

    key: str
    stops: tuple[StopView, ...]
    views: tuple[DetectionView, ...]
    frames: Mapping[str, _Frame]


def read_round(store: Store, round_key: str) -> RoundContent:
    """Read a round.

    Raises
    ------
    StoreError
        If it is not there.
    """
    stops, views = store.stops(round_key), store.detections(round_key)
    return RoundContent(round_key, tuple(stops), tuple(views), _frames(store, round_key))


def load_rows(content: RoundContent) -> list[StoredRow]:
    """Return a round's rows as arrays.

    Raises
    ------
    RoundError
        If a row has more than two sides.
    """
    by_row: dict[str, list[StopView]] = {}
    for stop in content.stops:
        by_row.setdefault(stop.row or "", []).append(stop)
    known = {stop.key for stop in content.stops}  # a stop may be saved while we read
    fruit: dict[str, list[DetectionView]] = {}
    for view in content.views:
        if view.verdict is not Verdict.REJECTED and view.stop_key in known:
            fruit.setdefault(view.row or "", []).append(view)
    return [
        _row(name, stops, fruit.get(name, []), content.frames)
        for name, stops in sorted(by_row.items())
    ]


@dataclass(frozen=True, eq=False)
class _Frame:
    """A stop's pose, and its captures' numbers and fields of view."""

    pose: NDArray[np.float64] | None
    captures: Mapping[str, int]
    reach: tuple[float, float]


def _frames(store: Store, round_key: str) -> dict[str, _Frame]:
    return {
        key: _Frame(
            np.array(at.pose, float).reshape(4, 4) if len(at.pose) == 16 else None,
            at.captures,
            _reach(at.camera),
        )
        for key, at in store.cameras(round_key).items()
    }


def _reach(camera: Mapping[str, Any]) -> tuple[float, float]:
    size = [camera.get(name) for name in ("width", "fx", "height", "fy")]
    if not all(isinstance(one, int | float) and one > 0 for one in size):
        return REACH
    width, fx, height, fy = (float(one) for one in size if one is not None)
    return width / 2 / fx, height / 2 / fy


def _row(
    name: str,
    stops: Sequence[StopView],
    fruit: Sequence[DetectionView],
    frames: Mapping[str, _Frame],
) -> StoredRow:
    sides = tuple(sorted({stop.side or "" for stop in stops}))
    if len(sides) > 2:
        raise RoundError(
            f"row '{name}' has {len(sides)} sides: {', '.join(sides)}",
            remedy="call the two sides of a row by two names",
        )
    placed = [stop for stop in stops if stop.position_m is not None]
    index = {stop.key: k for k, stop in enumerate(placed)}
    known = [view for view in fruit if view.stop_key in index and _has_place(view.record)]
    return StoredRow(
        name,
        _stops(placed, sides, frames),
        _views(known, index, sides, frames),
        tuple(index),
        tuple(view.key for view in known),
        sides,
        tuple(sorted({view.key for view in fruit} - {view.key for view in known})),
    )


def _has_place(record: DetectionRecord) -> bool:
    return None not in (record.centre_x_m, record.centre_y_m, record.centre_z_m)


def _stops(
    stops: Sequence[StopView], sides: Sequence[str], frames: Mapping[str, _Frame]
) -> RowStops:
    poses = [frames[stop.key].pose for stop in stops]
    heights = [0.0 if pose is None else float(pose[UP, 3]) for pose in poses]
    at_m = np.zeros((len(stops), 3))
    sd_m = np.full((len(stops), 3), CAMERA_SD_M)
    at_m[:, ALONG] = [stop.position_m or 0.0 for stop in stops]
    at_m[:, UP] = heights
    sd_m[:, ALONG] = [stop.position_sd_m or MIDDLE_SD_M for stop in stops]
    side = np.array([sides.index(stop.side or "") for stop in stops], np.int64)
    reach = np.array([frames[stop.key].reach for stop in stops]).reshape(-1, 2)
    return RowStops(at_m, sd_m, side, reach)


def _views(
    fruit: Sequence[DetectionView],
    index: Mapping[str, int],
    sides: Sequence[str],
    frames: Mapping[str, _Frame],
) -> RowViews:
    count = len(fruit)
    offset, sd, sizes = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 4))
    partial = np.zeros(count, bool)
    for k, view in enumerate(fruit):
        record, frame = view.record, frames[view.stop_key]
        pose = frame.pose if frame.pose is not None else pose_matrix(0.0, sign_of_side(view.side))
        middle = np.array([record.centre_x_m, record.centre_y_m, record.centre_z_m], float)
        offset[k] = middle_offset(middle, pose)
        partial[k] = record.partial
        tube = record.diameter_max_m is not None
        sd[k] = middle_sd(offset[k], tube=tube, partial=bool(partial[k]), length_m=record.length_m)
        offset[k, 2] *= -1.0 if sides.index(view.side or "") else 1.0
        sizes[k] = *_length(record), record.diameter_max_m or np.nan, DIAMETER_SD
    return RowViews(
        np.array([index[view.stop_key] for view in fruit], np.int64),
        np.array([frames[v.stop_key].captures[v.capture] for v in fruit], np.int64),
        offset,
        sd,
        sizes[:, 0],
        sizes[:, 1],
        sizes[:, 2],
        sizes[:, 3],
        partial,
        np.array([view.record.score for view in fruit], float),
        np.array([view.record.view_score for view in fruit], float),
    )


def _length(record: DetectionRecord) -> tuple[float, float]:
    """Return the length and its relative standard deviation."""
    if record.length_m is None or not record.length_m > 0:
        return np.nan, UNKNOWN_SD
    low, high = record.interval_low_m, record.interval_high_m
    sd = UNKNOWN_SD
    if low and high and low < high:
        sd = float(np.log(high / low)) / (2 * LENGTH_Z)
    elif record.length_sd_m:
        sd = record.length_sd_m / record.length_m
    # Lengths of another kind may differ by more than any of them errs.
    least = LEAST_SD if record.length_kind in TUBE_KINDS else UNKNOWN_SD
    return record.length_m, max(sd, least)


def by_hand_of(row: StoredRow, links: Sequence[LinkRecord]) -> ByHand:
    """Return the pairs of a row's views that were decided by hand."""
    index = {key: k for k, key in enumerate(row.fruit_keys)}

    def pairs(kind: LinkKind) -> NDArray[np.int64]:
        chosen = [
            (index[one.first], index[one.second])
            for one in links
            if one.by_hand and one.kind is kind and one.first in index and one.second in index
        ]
        return np.array(chosen, np.int64).reshape(-1, 2) if chosen else NO_PAIRS

    return ByHand(pairs(LinkKind.SAME), pairs(LinkKind.APART))


def stored_merging(content: RoundContent, row: StoredRow) -> Merged:
    """Return a row as it was merged and saved, what was done by hand included."""
    groups = {view.key: view.group for view in content.views}
    names = [groups[key] for key in row.fruit_keys]
    _, cluster = np.unique(np.array(names, dtype=str), return_inverse=True)
    stops = {stop.key: stop for stop in content.stops}
    at_m, sd_m = row.stops.at_m.copy(), row.stops.sd_m.copy()
    for k, key in enumerate(row.stop_keys):
        stop = stops[key]
        if stop.fitted_m is not None:
            at_m[k, ALONG], sd_m[k, ALONG] = stop.fitted_m, stop.fitted_sd_m or sd_m[k, ALONG]
    covariance = np.zeros((3, len(at_m), len(at_m)))
    at = np.arange(len(at_m))
    covariance[:, at, at] = sd_m.T**2
    numbers = cluster.astype(np.int64)
    pairs = np.column_stack(cluster_pairs(numbers))
    return Merged(numbers, FittedStops(at_m, covariance), pairs, np.ones(len(pairs)))
