"""The forecast of a round, its age, and the fruit that are ready today."""

from __future__ import annotations

import datetime
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from enum import StrEnum

from cucumbervision.crop.grades import UNDECIDED, WITHOUT_CLASS, Grade, GradeStatus, class_of, grade
from cucumbervision.crop.profiles import CropProfile
from cucumbervision.errors import Message
from cucumbervision.methods.intervals import SCALE_SD
from cucumbervision.methods.result import UNKNOWN_SD, Length
from cucumbervision_greenhouse.forecast.forecast import Forecast, forecast
from cucumbervision_greenhouse.forecast.growth import FruitState, GrowthPrior, Point, fit_growth
from cucumbervision_greenhouse.rounds.day_comparison import linked_rounds
from cucumbervision_greenhouse.rounds.fruit_table import RoundContent, fruit_table, read_round
from cucumbervision_greenhouse.rounds.merge_and_link import DAY_S
from cucumbervision_greenhouse.store.records import ArtifactRecord, FruitRow, Round
from cucumbervision_greenhouse.store.repository import Store

_UNKNOWN_SD_M = 1e-3  # of a lower bound of 0


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
    table: Sequence[FruitRow],
    day: float,
    profile: CropProfile,
    *,
    earlier: Mapping[str, Sequence[Point]] | None = None,
    picked_before_s: float = math.inf,
) -> list[FruitState]:
    """Return a round's fruit as the forecast takes them; a fruit without a length is one of any.

    Parameters
    ----------
    table : sequence of FruitRow
        The fruit; doubtful ones, and those that were picked before `picked_before_s`, are left out.
    day : float
        Of the round.
    profile : CropProfile
        Its classes.
    earlier : mapping of str to sequence of (day, length_m, sd_m), optional
        Earlier lengths of each (`earlier_lengths`).
    picked_before_s : float
        Fruit that were picked then or later are marked as picked.
    """
    states = []
    for view in table:
        is_picked = view.picked_s is not None
        if view.doubtful or (is_picked and (view.picked_s or 0.0) < picked_before_s):
            continue
        graded, length = grade(view, profile), view.known_length
        length_m, sd_m = _median_and_sd(length) if length else (0.0, _UNKNOWN_SD_M)
        is_whole = view.whole_length is not None
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
                picked=is_picked,
                possible=graded.possible,
                at_least=not is_whole,
                earlier=tuple((earlier or {}).get(view.group, ())) if is_whole else (),
            )
        )
    return states


def grades_today(
    table: Sequence[FruitRow], profile: CropProfile, forecast: Forecast | None
) -> dict[str, Grade]:
    """Return the grade of each fruit by its key: today's, with the growth expected since the round.

    Picked and doubtful fruit, and all without a forecast, keep that of their measurement.
    """
    grades = {line.key: grade(line, profile) for line in table}
    columns = (forecast.fruit, forecast.possible) if forecast else ((), ())
    for state, possible in zip(*columns, strict=True):
        measured = grades[state.fruit_id]
        if possible != measured.possible:
            name = class_of(possible)
            in_class = GradeStatus.NO_CLASS if name in WITHOUT_CLASS else GradeStatus.IN_CLASS
            grades[state.fruit_id] = replace(
                measured,
                verdict=GradeStatus.UNDECIDED if name == UNDECIDED else in_class,
                name=name,
                possible=possible,
                probabilities={},
                reason="",
                rules=(Message("by the growth expected since the round"), *measured.rules),
            )
    return grades


def lengths_today(forecast: Forecast | None) -> dict[str, float]:
    """Return the expected lengths today, by key, of whole fruit that were measured earlier."""
    columns = (forecast.fruit, forecast.length_m.tolist()) if forecast else ((), ())
    return {
        state.fruit_id: length_m
        for state, length_m in zip(*columns, strict=True)
        if forecast and not state.at_least and state.day < forecast.today
    }


def _median_and_sd(length: Length) -> tuple[float, float]:
    """Return the median of a measured length and its standard deviation, metres."""
    if length.sides is None:
        return length.value_m, UNKNOWN_SD * length.value_m
    median_m, *sides = length.sides
    return median_m, max(median_m * math.hypot(*sides) / math.sqrt(2), 1e-3)


def earlier_lengths(store: Store, content: RoundContent) -> dict[str, list[Point]]:
    """Return the lengths of a round's fruit on earlier days, of all their views, in order."""
    contents, name_of = linked_rounds(store, content)
    days = {walk.key: walk.walked_s / DAY_S for walk in store.rounds()}
    points: dict[str, list[Point]] = defaultdict(list)
    before = [x for x in contents if days[x.key] < days[content.key]]
    for earlier in sorted(before, key=lambda x: days[x.key]):
        for fruit in fruit_table(earlier):
            if fruit.group in name_of and fruit.whole_length is not None:
                point = (days[earlier.key], *_median_and_sd(fruit.whole_length))
                points[name_of[fruit.group]].append(point)
    return points


_FRESH_DAYS, _USEFUL_DAYS = 2, 7


class Age(StrEnum):
    """The use of a round by its age."""

    FRESH = "fresh"  # its lengths are still valid
    OLD = "old"  # its lengths are extrapolated by the expected growth
    USELESS = "useless"  # its fruit are picked by now, or far too long


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
) -> Forecast:
    """Forecast a round from today on: growth from its fruit, classes from a profile.

    The error that all lengths share is allowed for (`shared_scale_sd`). For a round that is too old
    for a forecast of today, day 0 is the day of its walk. Fruit that were picked today are in no
    count, so that those left keep their probabilities while they are ticked off.

    Parameters
    ----------
    store : Store
        Where the round is.
    round_summary : Round
        The round.
    profile : CropProfile
        Its classes, and the growth that is expected.
    now_s : float
        Now, seconds since 1970.
    content : RoundContent, optional
        What `fruit_table.read_round` returned for the round, where it was read already.
    days : int
        Days ahead; 0 for today alone.
    """
    content = content or read_round(store, round_summary.key)
    fruit = fruit_states(
        fruit_table(content),
        round_summary.walked_s / DAY_S,
        profile,
        earlier=earlier_lengths(store, content),
        picked_before_s=midnight_s(now_s),
    )
    return forecast(
        fruit,
        fit_growth(fruit, GrowthPrior.of(profile)),
        profile,
        days,
        today=day_0_s(round_summary, now_s) / DAY_S,
        scale_sd=shared_scale_sd(stop.artifacts for stop in content.stops),
    )


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
