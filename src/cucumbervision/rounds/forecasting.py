"""What a round means for picking: summary, grades, forecast, pick list."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

from cucumbervision.agronomy.forecast import forecast
from cucumbervision.agronomy.fruit import FruitState
from cucumbervision.agronomy.grades import GradingTraits, LengthBelief, grade
from cucumbervision.agronomy.growth import GrowthPrior, Link, fit_growth
from cucumbervision.agronomy.picking import pick_list
from cucumbervision.measurement.result import LengthDefinition
from cucumbervision.rounds.day_linking import LinkSettings
from cucumbervision.rounds.from_store import read_round
from cucumbervision.rounds.service import DAY_S, find_round, fruit_table, row_reports
from cucumbervision.store.views import LinkKind

if TYPE_CHECKING:
    from cucumbervision.agronomy.forecast import Forecast
    from cucumbervision.agronomy.grades import Grade
    from cucumbervision.agronomy.picking import Pick
    from cucumbervision.agronomy.profiles import CropProfile
    from cucumbervision.rounds.service import RowReport
    from cucumbervision.store.records import DetectionRecord
    from cucumbervision.store.repository import Store
    from cucumbervision.store.views import DetectionView, RoundView

__all__ = [
    "RoundSummary",
    "forecast_for",
    "fruit_states",
    "grade_of",
    "growth_links",
    "round_pick_list",
    "round_summary",
]

UNKNOWN_SD = 0.08  # relative, of a length without interval


@dataclass(frozen=True)
class RoundSummary:
    """A round in short.

    Parameters
    ----------
    round : RoundView
        The round, its stops and detections.
    rows : tuple of RowReport
        Its rows.
    fruit, measured, picked : int
        Fruit, each once; those with a length; those picked.
    expected, expected_sd : float
        How many fruit there are, invented ones taken off and unseen ones added.
    classes : dict of str to int
        Fruit on the plant by likeliest class, where a profile was given.
    """

    round: RoundView
    rows: tuple[RowReport, ...]
    fruit: int
    measured: int
    picked: int
    expected: float
    expected_sd: float
    classes: dict[str, int]


def round_summary(store: Store, round_key: str, profile: CropProfile | None = None) -> RoundSummary:
    """Give a round in short.

    Raises
    ------
    RoundError
        If it is not there.
    """
    view = find_round(store, round_key)
    content = read_round(store, round_key)
    rows = tuple(row_reports(store, round_key, content))
    fruit = [line.view for line in fruit_table(store, round_key, content)]
    hanging = [one for one in fruit if one.picked_s is None]
    classes: Counter[str] = Counter()
    if profile is not None:
        classes.update(grade_of(one.record, profile).name or "not graded" for one in hanging)
    return RoundSummary(
        view,
        rows,
        len(fruit),
        sum(one.record.length_m is not None for one in fruit),
        len(fruit) - len(hanging),
        sum(row.expected for row in rows),
        sum(row.expected_sd**2 for row in rows) ** 0.5,
        dict(classes),
    )


def grade_of(record: DetectionRecord, profile: CropProfile) -> Grade:
    """Grade a fruit as it is stored.

    Examples
    --------
    >>> from cucumbervision.agronomy.profiles import load_profile
    >>> from cucumbervision.store.records import DetectionRecord
    >>> fruit = DetectionRecord(1, thread_m=0.30, length_m=0.30, length_kind="thread")
    >>> grade_of(fruit, load_profile("long-cucumber")).name
    'I'
    """
    arc = None
    if record.inner_arc_m is not None and record.chord_m:
        arc = 1000 * record.inner_arc_m / (10 * record.chord_m)
    lengths = {
        LengthDefinition.THREAD: record.thread_m,
        LengthDefinition.CENTRELINE: record.centreline_m,
        LengthDefinition.CHORD: record.chord_m,
    }
    if record.length_kind in list(LengthDefinition) and record.length_m:
        lengths[LengthDefinition(record.length_kind)] = record.length_m  # as calibrated
    belief, about = None, None
    if record.interval_of in list(LengthDefinition):
        about = LengthDefinition(record.interval_of)
        measured, low, high = lengths[about], record.interval_low_m, record.interval_high_m
        if measured and low and high:
            belief = LengthBelief.from_interval(measured, low, high)
    traits = GradingTraits(
        lengths[LengthDefinition.THREAD],
        lengths[LengthDefinition.CENTRELINE],
        lengths[LengthDefinition.CHORD],
        belief,
        about if belief else None,
        arc,
        record.diameter_max_m,
        record.volume_m3,
    )
    return grade(traits, profile)


def fruit_states(store: Store, round_key: str, profile: CropProfile) -> list[FruitState]:
    """Give a round's measured fruit as the forecast takes them; picked ones are marked."""
    day = find_round(store, round_key).record.started_s / DAY_S
    states = []
    for line in fruit_table(store, round_key):
        view = line.view
        if view.record.length_m is None or not view.record.length_m > 0:
            continue
        length, sd = _belief(view)
        states.append(
            FruitState(
                view.key,
                view.row or "",
                view.along_m or 0.0,
                length,
                sd,
                day,
                view.side or "",
                grade_of(view.record, profile).best_class,
                view.picked_s is not None,
            )
        )
    return states


def _belief(view: DetectionView) -> tuple[float, float]:
    record = view.record
    length = record.length_m or 0.0
    low, high = record.interval_low_m, record.interval_high_m
    if low and high:
        believed = LengthBelief.from_interval(length, low, high)
        return believed.median_m, max(believed.sd_m, 1e-3)
    return length, max(record.length_sd_m or 0.0, UNKNOWN_SD * length)


def growth_links(store: Store, round_key: str, least: float | None = None) -> list[Link]:
    """Give what is known of growth up to a round: its fruit followed back through earlier ones.

    Parameters
    ----------
    store : Store
        Where the rounds are.
    round_key : str
        The last round.
    least : float, optional
        Probability from which a link counts; those by hand always do.
    """
    limit = LinkSettings().least if least is None else least
    rounds = {one.key: one.record.started_s / DAY_S for one in store.rounds()}
    newest = round_key
    todo = store.detections(round_key)
    names = {view.key: view.group for view in todo}
    found: list[Link] = []
    seen_rounds = {newest}
    level = {newest: {view.key: view for view in todo}}
    queue = [newest]
    while queue:
        later = queue.pop(0)
        for link in store.links(later, LinkKind.GROWTH):
            if link.second not in level[later] or link.second not in names:
                continue
            if not link.by_hand and (link.score or 0.0) < limit:
                continue
            view = level[later][link.second]
            for key in rounds:
                if rounds[key] < rounds[later] and key not in level:
                    level[key] = {one.key: one for one in store.detections(key)}
            home = next((k for k, views in level.items() if link.first in views), None)
            if home is None:
                continue
            before = level[home][link.first]
            standing = level[later].get(view.group, view), level[home].get(before.group, before)
            name = names[link.second]
            for one in level[home].values():
                if one.group == before.group:
                    names.setdefault(one.key, name)
            made = _link(name, standing[1], rounds[home], standing[0], rounds[later])
            if made is not None:
                found.append(made)
            if home not in seen_rounds:
                seen_rounds.add(home)
                queue.append(home)
    return found


def _link(
    name: str, before: DetectionView, day0: float, after: DetectionView, day1: float
) -> Link | None:
    if before.record.length_m is None or after.record.length_m is None or day1 <= day0:
        return None
    (length0, sd0), (length1, sd1) = _belief(before), _belief(after)
    return Link(name, after.row or "", day0, length0, sd0, day1, length1, sd1)


def forecast_for(store: Store, round_key: str, profile: CropProfile, days: int = 7) -> Forecast:
    """Forecast a round: growth from its links to earlier rounds, classes from a profile.

    Raises
    ------
    ForecastError
        If nothing can be forecast.
    """
    growth = fit_growth(growth_links(store, round_key), GrowthPrior.of(profile))
    return forecast(fruit_states(store, round_key, profile), growth, profile, days)


def round_pick_list(store: Store, round_key: str, profile: CropProfile) -> tuple[Pick, ...]:
    """Give the fruit of a round that are ready today, in walking order."""
    return pick_list(forecast_for(store, round_key, profile, days=0))
