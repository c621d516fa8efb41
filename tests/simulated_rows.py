"""Simulated rows of known truth: fruit along a row, and what each stop's capture shows of them.

Fruit have the sizes of `cucumbervision_lab.scenes.bodies`; what a capture shows of them is drawn
at random, with the errors that the benchmark of single captures found. No pictures are drawn.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from cucumbervision.arrays import Array, Ints, Mask, Numbers
from cucumbervision.methods.matching import ALONG, DEPTH, UP
from cucumbervision_greenhouse.rounds.row_views import RowStops, RowViews
from cucumbervision_lab.scenes.bodies import random_fruit

_SIZES = 64  # bodies drawn, from which fruit take their thickness
_UNFLAGGED = 0.2  # share of hidden fruit that nothing tells from whole ones


@dataclass(frozen=True)
class SimulatedRow:
    """What to simulate.

    Parameters
    ----------
    fruit, per_m : int, float
        How many fruit, and how many in a metre of row.
    spacing_m, operator_sd_m : float
        From stop to stop, and how far stops are from where the operator says.
    missed, false : float
        Share of visible fruit that a capture misses, and of false positives among the detections.
    hidden : float
        Share of views of which part is hidden, by 5 to 50 % of the length.
    length_sd, diameter_sd : float
        Relative errors of whole fruit.
    place_sd_m : float
        Error of a fruit's middle across the view; into the row half as large again.
    camera_sd_m, yaw_sd_deg : float
        How far the camera is from its usual height and distance, and how far it is turned.
    distance_m : float
        From the camera to the middle of the row.
    reach : tuple of float
        Tangents of half the field of view, along and up: a D435's colour camera, upright picture
        or lying.
    sides : int
        1, or 2 for both aisles.
    open_share : float
        Share of fruit that can be seen from both aisles; the others from a random one.
    thickness_m, band_m : float
        How deep and how high the fruit hang.
    """

    fruit: int = 200
    per_m: float = 10.0
    spacing_m: float = 0.4
    operator_sd_m: float = 0.03
    missed: float = 0.05
    false: float = 0.02
    hidden: float = 0.2
    length_sd: float = 0.015
    diameter_sd: float = 0.03
    place_sd_m: float = 0.006
    camera_sd_m: float = 0.01
    yaw_sd_deg: float = 1.0
    distance_m: float = 0.7
    reach: tuple[float, float] = (0.687, 0.384)
    sides: int = 1
    open_share: float = 0.4
    thickness_m: float = 0.25
    band_m: float = 0.4


@dataclass(frozen=True, eq=False)
class Plants:
    """The fruit of a row: middle (F, 3), length, diameter, and the sides that can show each.

    Metres; `seen_from` is bool of shape (F, 2), `name` numbers a fruit through all days.
    """

    place_m: Array
    length_m: Array
    diameter_m: Array
    seen_from: Mask
    name: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Walk:
    """One walk along a row, and its truth.

    Parameters
    ----------
    stops, views : RowStops, RowViews
        What merging gets to see.
    of_fruit : ndarray of int64, shape (N,)
        The name of each view's fruit, -1 for a false positive.
    plants : Plants
        The fruit.
    in_view : int
        How many of them at least one capture could show.
    """

    stops: RowStops
    views: RowViews
    of_fruit: NDArray[np.int64]
    plants: Plants
    in_view: int


def simulate_row(settings: SimulatedRow, seed: int) -> Walk:
    """Simulate a row and a walk along it.

    Examples
    --------
    >>> row = simulate_row(SimulatedRow(fruit=100), seed=1)
    >>> len(row.stops), row.in_view
    (26, 100)
    """
    rng = np.random.default_rng([11, seed])
    return walk(_simulate_plants(settings, rng), settings, rng)


def _simulate_plants(settings: SimulatedRow, rng: np.random.Generator) -> Plants:
    """Simulate the fruit of a row; none reaches into another."""
    bodies = np.sort(rng.uniform(0.06, 0.38, _SIZES))
    thickness = [2 * float(random_fruit(rng, size, balls=24).radii_m.max()) for size in bodies]
    row_m = settings.fruit / settings.per_m
    table = np.zeros((0, 5))
    while len(table) < settings.fruit:
        length = rng.uniform(0.06, 0.38)
        diameter = float(np.interp(length, bodies, thickness)) * rng.normal(1.0, 0.04)
        place = rng.uniform([0, -0.5, -0.5], [1, 0.5, 0.5])
        place *= [row_m, settings.band_m, settings.thickness_m]
        body = np.append(place, [length, diameter])
        if not _touches(body, table).any():
            table = np.vstack([table, body])
    seen = np.ones((settings.fruit, 2), bool)
    if settings.sides > 1:
        hidden = rng.random(settings.fruit) >= settings.open_share
        seen[hidden, rng.integers(0, 2, settings.fruit)[hidden]] = False
    names = np.arange(settings.fruit)
    return Plants(table[:, :3], table[:, 3], table[:, 4], seen, names)


def _touches(one: Array, others: Array) -> Mask:
    gap = np.abs(others - one)
    across = np.hypot(gap[:, ALONG], gap[:, DEPTH])
    level = gap[:, UP] < (others[:, 3] + one[3]) / 2
    return np.asarray(level & (across < (others[:, 4] + one[4]) / 2))


def walk(plants: Plants, settings: SimulatedRow, rng: np.random.Generator) -> Walk:
    """Walk along a row, with a stop every `spacing_m` on each side."""
    row_m = float(plants.place_m[:, ALONG].max())
    true_at = np.arange(0.0, row_m + settings.spacing_m, settings.spacing_m)
    count = len(true_at)
    side = np.repeat(np.arange(settings.sides), count)
    declared = np.zeros((len(side), 3))
    declared[:, ALONG] = np.tile(true_at, settings.sides)
    sd = np.full((len(side), 3), 1.5 * settings.camera_sd_m)
    sd[:, ALONG] = settings.operator_sd_m
    stops = RowStops(declared, sd, side, np.full(len(side), settings.reach[0]))
    error = rng.normal(0.0, [settings.operator_sd_m, *[settings.camera_sd_m] * 2], sd.shape)
    shown = np.zeros(len(plants.name), bool)
    tables, names = [], []
    for number in range(len(side)):
        table, of, could = _capture(
            plants, declared[number] + error[number], int(side[number]), settings, rng
        )
        shown |= could
        tables.append(np.column_stack([np.full(len(of), number), table]))
        names.append(of)
    found = _views(np.vstack(tables), settings)
    return Walk(stops, found, np.concatenate(names), plants, int(shown.sum()))


def _capture(
    plants: Plants, camera_m: Array, side: int, s: SimulatedRow, rng: np.random.Generator
) -> tuple[Array, NDArray[np.int64], Mask]:
    """Return columns along, up, depth, length, diameter, partial, score; names; what is in view."""
    sign = 1.0 - 2.0 * side
    offset = plants.place_m - camera_m
    offset[:, DEPTH] = sign * offset[:, DEPTH] + s.distance_m
    yaw = np.deg2rad(rng.normal(0.0, s.yaw_sd_deg))
    turned = offset[:, ALONG] * np.cos(yaw) + offset[:, DEPTH] * np.sin(yaw)
    offset[:, DEPTH] = offset[:, DEPTH] * np.cos(yaw) - offset[:, ALONG] * np.sin(yaw)
    offset[:, ALONG] = turned
    half = np.array(s.reach) * offset[:, DEPTH, None]
    could = plants.seen_from[:, side] & (np.abs(offset[:, :2]) < half).all(axis=1)
    seen = np.flatnonzero(could & (rng.random(len(could)) >= s.missed))
    length, middle = plants.length_m[seen], offset[seen]
    low = np.maximum(middle[:, UP] - length / 2, -half[seen, 1])
    high = np.minimum(middle[:, UP] + length / 2, half[seen, 1])
    cut = (high - low) < length - 1e-9
    hidden = rng.random(len(seen)) < s.hidden
    lost = np.where(hidden, rng.uniform(0.05, 0.5, len(seen)), 0.0) * (high - low)
    below = rng.random(len(seen)) < 0.5
    low, high = low + lost * below, high - lost * ~below
    middle[:, UP] = (low + high) / 2
    partial = cut | (hidden & (rng.random(len(seen)) >= _UNFLAGGED))
    invented = int(rng.binomial(max(len(seen), 1), s.false / (1 - s.false)))
    size = np.array([s.reach[0], s.reach[1], 0.5 * s.thickness_m / s.distance_m]) * s.distance_m
    ahead = np.array([0.0, 0.0, s.distance_m])
    middle = np.vstack([middle, rng.uniform(-size, size, (invented, 3)) + ahead])
    length = np.append(high - low, rng.uniform(0.06, 0.38, invented))
    diameter = np.append(plants.diameter_m[seen], rng.uniform(0.025, 0.05, invented))
    score = np.append(rng.beta(9, 1.5, len(seen)), rng.beta(4, 3, invented))
    middle += rng.normal(0.0, s.place_sd_m, middle.shape) * [1.0, 1.0, 1.5]
    middle[:, DEPTH] *= sign
    length *= np.exp(rng.normal(0.0, s.length_sd, len(length)))
    diameter *= np.exp(rng.normal(0.0, s.diameter_sd, len(length)))
    flags = np.append(partial, np.zeros(invented, bool))
    table = np.column_stack([middle, length, diameter, flags, score])
    return table, np.append(plants.name[seen], np.full(invented, -1)), could


def _views(table: Array, s: SimulatedRow) -> RowViews:
    stop = table[:, 0].astype(np.int64)
    length, partial = table[:, 4], table[:, 6] > 0
    sd = np.tile(s.place_sd_m * np.array([1.0, 1.0, 1.5]), (len(stop), 1))
    # A hidden end moves the middle that is seen along the fruit, which hangs.
    sd[:, UP] = np.where(partial, np.hypot(sd[:, UP], 0.15 * length), sd[:, UP])
    return RowViews(
        stop,
        stop,
        table[:, 1:4],
        sd,
        length,
        np.full(len(stop), max(s.length_sd, 1e-3)),
        table[:, 5],
        np.full(len(stop), max(s.diameter_sd, 1e-3)),
        partial,
        table[:, 7] * np.where(partial, 0.5, 1.0),
    )


def grow_plants(
    plants: Plants,
    days: float,
    shift_m: Array,
    rng: np.random.Generator,
    *,
    picked_over_m: float = 0.30,
    new_share: float = 0.15,
    swing_m: float = 0.03,
    growth_m: float = 0.03,
) -> Plants:
    """Simulate a row that grows, is picked, lowered and hung anew.

    Parameters
    ----------
    plants : Plants
        The row before.
    days : float
        How long.
    shift_m : ndarray of float64, shape (F, 3)
        How far each fruit's plant is moved.
    rng : numpy.random.Generator
        Random generator.
    picked_over_m : float
        Nearly all fruit longer than that are picked.
    new_share : float
        New fruit, as a share of those that were there.
    swing_m : float
        How far a fruit hangs off its plant's shift, standard deviation.
    growth_m : float
        Metres a day.
    """
    rate = rng.normal(growth_m, 0.2 * growth_m, len(plants.name)).clip(0.0)
    stay = (plants.length_m < picked_over_m) | (rng.random(len(rate)) < 0.1)
    length = plants.length_m + rate * days
    place = plants.place_m + shift_m + rng.normal(0.0, swing_m, plants.place_m.shape)
    place[:, UP] -= (length - plants.length_m) / 2  # the stem end stays, the other one sinks
    diameter = plants.diameter_m * (length / plants.length_m) ** 0.5
    grown = Plants(place, length, diameter, plants.seen_from, plants.name)
    grown = _some(grown, np.flatnonzero(stay))
    count = round(new_share * len(plants.name))
    young = _some(grown, rng.integers(0, len(grown.name), count))
    row_m = float(place[:, ALONG].max())
    spot = young.place_m.copy()
    spot[:, ALONG] = rng.uniform(0, row_m, count)
    names = int(plants.name.max()) + 1 + np.arange(count)
    young = replace(
        young,
        place_m=spot,
        length_m=rng.uniform(0.06, 0.12, count),
        diameter_m=rng.uniform(0.024, 0.032, count),
        name=names,
    )
    return Plants(
        *(np.concatenate(both) for both in zip(_arrays(grown), _arrays(young), strict=True))
    )


def _some(plants: Plants, which: Ints) -> Plants:
    return Plants(*(array[which] for array in _arrays(plants)))


def _arrays(plants: Plants) -> list[Numbers]:
    return [getattr(plants, field.name) for field in fields(plants)]
