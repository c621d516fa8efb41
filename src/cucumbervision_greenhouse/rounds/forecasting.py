"""The forecast of a round, its age, and the fruit that are ready today."""

from __future__ import annotations

import datetime
import math
from collections import defaultdict
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.crop.grades import class_of, grade
from cucumbervision.methods.intervals import SCALE_SD
from cucumbervision.methods.result import UNKNOWN_SD
from cucumbervision_greenhouse.forecast.forecast import DetectionRates, forecast
from cucumbervision_greenhouse.forecast.growth import GrowthPrior, Link, fit_growth
from cucumbervision_greenhouse.forecast.length_draws import FruitState
from cucumbervision_greenhouse.forecast.picking import Pick, PickKind, pick_list
from cucumbervision_greenhouse.rounds.day_linking import SURE
from cucumbervision_greenhouse.rounds.from_store import read_round
from cucumbervision_greenhouse.rounds.fruit_table import fruit_table
from cucumbervision_greenhouse.rounds.merge_and_link import DAY_S
from cucumbervision_greenhouse.store.links import LinkKind

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from cucumbervision.crop.profiles import CropProfile
    from cucumbervision.methods.result import Length
    from cucumbervision_greenhouse.forecast.forecast import Forecast
    from cucumbervision_greenhouse.rounds.from_store import RoundContent
    from cucumbervision_greenhouse.store.records import ArtifactRecord, FruitRow, Round
    from cucumbervision_greenhouse.store.repository import Store


def detection_rates(table: Sequence[FruitRow]) -> DetectionRates:
    """Return the share of a round's fruit that have a length: the others are as good as missed."""
    hanging = [line.known_length for line in table if line.picked_s is None]
    measured = sum(length is not None for length in hanging)
    return DetectionRates(measured / len(hanging) if measured else 1.0)


def shared_scale_sd(artifacts: Iterable[Sequence[ArtifactRecord]]) -> float:
    """Return the relative standard deviation of the error that all lengths of a round share.

    That of the camera's depth scale where each stop was measured with a calibration that holds
    one, from captures of a bar of known length; otherwise that of an uncalibrated camera.

    Parameters
    ----------
    artifacts : iterable of sequences of ArtifactRecord
        What each stop was measured with.

    Examples
    --------
    >>> from cucumbervision_greenhouse.store.records import ArtifactRecord
    >>> scale = {"value": 1.02, "standard_error": 0.00204}
    >>> site = ArtifactRecord("calibration", "bench", details={"depth_scale": scale})
    >>> shared_scale_sd([[site]]), shared_scale_sd([[site], []])
    (0.002, 0.01)
    """
    scales_sd = []
    for used in artifacts:
        scales = [made.details.get("depth_scale") for made in used if made.kind == "calibration"]
        relative_sds = [scale["standard_error"] / scale["value"] for scale in scales if scale]
        scales_sd.append(max(relative_sds, default=SCALE_SD))
    return max(scales_sd, default=SCALE_SD)


def fruit_states(
    table: Sequence[FruitRow], day: float, profile: CropProfile, picked_before_s: float = math.inf
) -> list[FruitState]:
    """Return a round's measured fruit as the forecast takes them; picked ones are marked.

    Fruit that were picked at `picked_before_s` or later count as hanging.
    """
    states = []
    for view in table:
        length = view.known_length
        if view.doubtful or length is None or not length.value_m > 0:
            continue
        length_m, sd_m = _median_and_sd(length)
        graded = grade(view, profile)
        states.append(
            FruitState(
                fruit_id=view.key,
                row=view.row or "",
                position_m=view.along_m or 0.0,
                length_m=length_m,
                sd_m=sd_m,
                day=day,
                side=view.side or "",
                best_class=graded.best_class,
                picked=view.picked_s is not None and view.picked_s < picked_before_s,
                possible=graded.possible,
                at_least=view.at_least,
            )
        )
    return states


def _median_and_sd(length: Length) -> tuple[float, float]:
    """Return the median of a measured length and its standard deviation, metres."""
    if length.sides is None:
        return length.value_m, UNKNOWN_SD * length.value_m
    median_m, *sides = length.sides
    return median_m, max(median_m * math.hypot(*sides) / math.sqrt(2), 1e-3)


def growth_links(store: Store, round_key: str, content: RoundContent | None = None) -> list[Link]:
    """Return the links of growth up to a round: its fruit followed back through earlier rounds.

    Links count that are sure enough (`day_linking.SURE`), and all that were made by hand. Lengths
    are the fruit's, of all their views (`fruit_table`).

    Parameters
    ----------
    store : Store
        Where the rounds are.
    round_key : str
        The round.
    content : RoundContent, optional
        What `from_store.read_round` gave of the round, where it was read already.
    """
    days = {round_summary.key: round_summary.walked_s / DAY_S for round_summary in store.rounds()}
    rounds = {round_key: _Measured(content or read_round(store, round_key))}
    # A fruit has one name in all rounds: the key of the representative view in the last one.
    names = {key: view.group for key, view in rounds[round_key].views.items()}
    links: list[Link] = []
    queue = [round_key]
    for later in queue:
        for link in store.links(later, LinkKind.GROWTH):
            is_known = link.second in rounds[later].views and link.second in names
            if not is_known or not (link.by_hand or (link.score or 0.0) >= SURE):
                continue
            home = next((key for key, x in rounds.items() if link.first in x.views), None)
            # Most fruit are followed to the round before; a season need not be read.
            unread = [key for key in days if days[key] < days[later] and key not in rounds]
            while home is None and unread:
                nearest = max(unread, key=days.__getitem__)
                unread.remove(nearest)
                rounds[nearest] = _Measured(read_round(store, nearest))
                home = nearest if link.first in rounds[nearest].views else None
            if home is None:
                continue
            name = names[link.second]
            for key in rounds[home].same_fruit(link.first):
                names.setdefault(key, name)
            first, last = rounds[home].fruit(link.first), rounds[later].fruit(link.second)
            before_m, after_m = first.whole_length, last.whole_length
            if before_m is not None and after_m is not None and days[home] < days[later]:
                ends = *_median_and_sd(before_m), days[later], *_median_and_sd(after_m)
                links.append(Link(name, last.row or "", days[home], *ends))
            if home not in queue:
                queue.append(home)
    return links


class _Measured:
    """A round's views by key, and its fruit with the lengths of all their views."""

    def __init__(self, content: RoundContent) -> None:
        self.views = {view.key: view for view in content.views}
        self._content = content

    @cached_property
    def _groups(self) -> dict[str, list[str]]:
        groups: dict[str, list[str]] = {}
        for view in self.views.values():
            groups.setdefault(view.group, []).append(view.key)
        return groups

    def same_fruit(self, key: str) -> list[str]:
        """Return the keys of all views of a view's fruit."""
        return self._groups[self.views[key].group]

    @cached_property
    def _table(self) -> dict[str, FruitRow]:
        return {line.group: line for line in fruit_table(self._content)}

    def fruit(self, key: str) -> FruitRow:
        """Return the fruit of a view; where it was rejected, its best view."""
        group = self.views[key].group
        return self._table.get(group) or self.views.get(group, self.views[key])


_FRESH_DAYS, _USEFUL_DAYS = 2, 7


class Age(StrEnum):
    """The use of a round by its age."""

    FRESH = "fresh"  # its lengths are still valid
    OLD = "old"  # its lengths are extrapolated by the expected growth
    USELESS = "useless"  # its fruit are picked by now, or far too long


@dataclass(frozen=True)
class RowPicks:
    """The fruit to be picked in one row, in walking order.

    Parameters
    ----------
    row : str
        The row.
    picks : tuple of Pick
        All of them.
    """

    row: str
    picks: tuple[Pick, ...]

    def of(self, kind: PickKind) -> tuple[Pick, ...]:
        """Return those of a kind."""
        return tuple(pick for pick in self.picks if pick.kind is kind)


@dataclass(frozen=True, eq=False)
class Today:
    """A round today.

    Parameters
    ----------
    age_days : int
        Days of the calendar since it was walked.
    age : Age
        What it is worth by that.
    forecast : Forecast, optional
        Of today alone; None where the round is too old.
    rows : tuple of RowPicks
        What is to be picked, in the order of the walk; fruit picked today are still in it.
    best : mapping of str to str
        The representative view of each fruit, by the keys of all views.
    simulated : frozenset of str
        Views of simulated captures.
    """

    age_days: int
    age: Age
    forecast: Forecast | None
    rows: tuple[RowPicks, ...]
    best: Mapping[str, str]
    simulated: frozenset[str] = frozenset()

    def of(self, kind: PickKind) -> tuple[Pick, ...]:
        """Return all fruit of the pick list of a kind."""
        return tuple(pick for row in self.rows for pick in row.of(kind))

    def left(self, picked: set[str]) -> Today:
        """Return a copy without the fruit of these keys, which were picked meanwhile."""
        rows = [
            RowPicks(row.row, tuple(p for p in row.picks if p.fruit.fruit_id not in picked))
            for row in self.rows
        ]
        return replace(self, rows=tuple(row for row in rows if row.picks))

    def by_class(self) -> dict[str, dict[str, int]]:
        """Return how many fruit are on the pick list, by row and class.

        Those that may be ready and too long ones are classes of their own; one that no row has is
        left out.
        """
        counts: dict[str, dict[str, int]] = {}
        for row in self.rows:
            of_class = counts.setdefault(row.row, {})
            for pick in row.picks:
                name = pick.name if pick.kind is PickKind.READY else str(pick.kind)
                of_class[name] = of_class.get(name, 0) + 1
        return counts


def midnight_s(now_s: float) -> float:
    """Return the local midnight before a time, seconds since 1970."""
    # Without a zone: midnight may have had another offset, on the day that summer time begins.
    local_time = datetime.datetime.fromtimestamp(now_s)
    return local_time.replace(hour=0, minute=0, second=0, microsecond=0).timestamp()


def age_of(walked_s: float, now_s: float) -> tuple[int, Age]:
    """Return a round's age in calendar days, and its use.

    Examples
    --------
    >>> age_of(1_700_000_000.0, 1_700_000_000.0 + 3 * DAY_S)
    (3, <Age.OLD: 'old'>)
    """
    days = round((midnight_s(now_s) - midnight_s(walked_s)) / DAY_S)
    if days > _USEFUL_DAYS:
        return days, Age.USELESS
    return days, Age.OLD if days > _FRESH_DAYS else Age.FRESH


def forecast_today(
    store: Store,
    round_summary: Round,
    profile: CropProfile,
    now_s: float,
    content: RoundContent | None = None,
    *,
    days: int = 7,
    picked_before_s: float = math.inf,
) -> Forecast:
    """Forecast a round from today on: growth from its links, classes from a profile.

    Today's numbers are those of the fruit as they are counted everywhere.
    Later fruit without a length are allowed for (`detection_rates`), and the error that all lengths
    share (`shared_scale_sd`). For a round that is too old for a forecast of today, day 0 is the day
    of its walk.

    Parameters
    ----------
    store, round_summary, profile, now_s, content
        As `read_today` takes them.
    days : int
        Days ahead; 0 for today alone.
    picked_before_s : float
        Fruit that were picked later than that still count, as on the morning of a day.
    """
    content = content or read_round(store, round_summary.key)
    table = fruit_table(content)
    result = forecast(
        fruit_states(table, round_summary.walked_s / DAY_S, profile, picked_before_s),
        fit_growth(growth_links(store, round_summary.key, content), GrowthPrior.of(profile)),
        profile,
        days,
        today=day_0_s(round_summary, now_s) / DAY_S,
        detection=detection_rates(table),
        scale_sd=shared_scale_sd(stop.artifacts for stop in content.stops),
    )
    _count_today(result)
    return result


def _count_today(result: Forecast) -> None:
    """Make the numbers of today those of its fruit, each counted in its class.

    The undecided are in no class. The ranges hold these numbers, and reach as far as the forecast's
    for undecided, missed and mistaken fruit; of what is ready today they are the same.
    """
    counted = np.zeros(result.by_row.expected[:, 0].shape)
    index_of = {row: index for index, row in enumerate(result.rows)}
    for state, possible in zip(result.fruit, result.possible, strict=True):
        name = class_of(possible)
        if name in result.classes:
            counted[index_of[state.row], result.classes.index(name)] += 1
    picked = np.isin(result.classes, result.pick)
    for standing, ready, number in (
        (result.by_row, result.row_picks, counted),
        (result.house, result.picks, counted.sum(axis=0)),
    ):
        standing.expected[..., 0, :] = number
        np.minimum(standing.low[..., 0, :], number, out=standing.low[..., 0, :])
        np.maximum(standing.high[..., 0, :], number, out=standing.high[..., 0, :])
        for name in ("expected", "low", "high"):
            getattr(ready, name)[..., 0, picked] = getattr(standing, name)[..., 0, picked]


def day_0_s(round_summary: Round, now_s: float) -> float:
    """Return day 0 of a round's forecast, seconds since 1970: today unless it is too old."""
    days, age = age_of(round_summary.walked_s, now_s)
    # Without a zone: the same time of day, also beyond the day on which the clocks change.
    walked = datetime.datetime.fromtimestamp(round_summary.walked_s)
    later = datetime.timedelta(0 if age is Age.USELESS else max(days, 0))
    # Added to the moment itself, which a date with microseconds may be a little before.
    return round_summary.walked_s + ((walked + later).timestamp() - walked.timestamp())


def date_after(at_s: float, days: int) -> datetime.date:
    """Return the local date some days after a moment; a day may have 23 or 25 hours."""
    return datetime.date.fromtimestamp(at_s) + datetime.timedelta(days)


def read_today(
    store: Store,
    round_summary: Round,
    profile: CropProfile,
    now_s: float,
    content: RoundContent | None = None,
) -> Today:
    """Return today's figures of a round.

    Parameters
    ----------
    store : Store
        Where it is.
    round_summary : Round
        The round.
    profile : CropProfile
        Its classes, and the growth that is expected.
    now_s : float
        Now, seconds since 1970.
    content : RoundContent, optional
        What `from_store.read_round` gave of the round, where it was read already.
    """
    days, age = age_of(round_summary.walked_s, now_s)
    content = content or read_round(store, round_summary.key)
    best = content.group_of
    if age is Age.USELESS:
        return Today(age_days=days, age=age, forecast=None, rows=(), best=best)
    result = forecast_today(
        store, round_summary, profile, now_s, content, days=0, picked_before_s=midnight_s(now_s)
    )
    simulated = frozenset(view.key for view in content.views if view.simulated)
    return Today(
        age_days=days,
        age=age,
        forecast=result,
        rows=_by_row(pick_list(result)),
        best=best,
        simulated=simulated,
    )


def _by_row(picks: Sequence[Pick]) -> tuple[RowPicks, ...]:
    rows = defaultdict(list)
    for pick in picks:
        rows[pick.fruit.row].append(pick)
    return tuple(RowPicks(row, tuple(of_row)) for row, of_row in rows.items())
