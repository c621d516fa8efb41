"""What changed in a house between two rounds: fruit that grew, were picked, are new or are gone."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from statistics import median
from typing import TYPE_CHECKING

from cucumbervision.methods.result import LengthDefinition
from cucumbervision_greenhouse.forecast.forecast import natural_key
from cucumbervision_greenhouse.rounds.day_linking import SURE
from cucumbervision_greenhouse.store.records import LinkKind

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from cucumbervision_greenhouse.rounds.fruit_table import RoundContent
    from cucumbervision_greenhouse.store.records import FruitRow, LinkRecord, StopRecord
    from cucumbervision_greenhouse.store.repository import Store

_REACH_M = 0.5  # along the row: a camera shows the fruit this far from its stop


class Change(StrEnum):
    """What became of a fruit between two rounds."""

    STAYED = "seen on both days"
    PICKED = "picked"  # ticked off as picked, and not seen again
    GONE = "not seen again"  # picked without a tick, fallen, or missed by the later round
    NEW = "new"  # seen for the first time: set since then, or missed by the earlier round
    NOT_WALKED = "not walked"  # the other round did not go there


@dataclass(frozen=True, eq=False)
class FruitChange:
    """One fruit in two rounds.

    Parameters
    ----------
    change : Change
        What became of it.
    before, after : FruitRow, optional
        The fruit in the earlier and in the later round; None where that round does not have it.
    days : float
        Time between the two rounds, days.
    probability : float
        That both are one fruit; 1 where only one round has it.
    """

    change: Change
    before: FruitRow | None
    after: FruitRow | None
    days: float
    probability: float = 1.0

    @property
    def row(self) -> str:
        """The row in which it hangs; empty without a name."""
        view = self.after or self.before
        return (view.row or "") if view is not None else ""

    @property
    def is_back(self) -> bool:
        """Whether it was ticked off as picked, and was seen again all the same."""
        ticked = self.before is not None and self.before.picked_s is not None
        return ticked and self.after is not None

    @property
    def growth_m_per_day(self) -> float | None:
        """Growth of the centreline, thread or chord in a day, metres.

        None where one of the two lengths is missing or unknown, is a lower bound, or has another
        definition.
        """
        if self.before is None or self.after is None:
            return None
        first, last = self.before.whole_length, self.after.whole_length
        if first is None or last is None:
            return None
        if first.kind != last.kind or first.kind not in set(LengthDefinition):
            return None
        return (last.value_m - first.value_m) / self.days


@dataclass(frozen=True)
class ChangeCounts:
    """How many fruit changed and how, in a row or a house.

    `before` = `picked` + `gone` + `stayed`, and `after` = `stayed` + `new`: fruit where one of the
    two rounds did not go are in none of them.

    Parameters
    ----------
    before, after : int
        Fruit on the plant at the earlier and at the later round.
    picked, gone, stayed, new : int
        As `Change` names them.
    unsure : int
        Fruit among `stayed` that may be two: a link less sure than `day_linking.SURE`.
    returned : int
        Fruit among `stayed` that were ticked off as picked.
    not_walked : int
        Fruit of either round where the other one did not go.
    growth_m_per_day : float, optional
        Median growth of the fruit that stayed.
    """

    before: int
    picked: int
    gone: int
    stayed: int
    new: int
    after: int
    unsure: int
    returned: int
    not_walked: int
    growth_m_per_day: float | None


@dataclass(frozen=True, eq=False)
class DayComparison:
    """Two rounds of a house, fruit by fruit.

    Parameters
    ----------
    days : float
        Time between them, days.
    changes : tuple of FruitChange
        Every fruit of either round, by row and position.
    """

    days: float
    changes: tuple[FruitChange, ...]

    def of(self, change: Change) -> tuple[FruitChange, ...]:
        """Return the fruit with a change."""
        return tuple(fruit for fruit in self.changes if fruit.change is change)

    def counts(self) -> ChangeCounts:
        """Return the numbers of the house."""
        return _counts(self.changes)

    def by_row(self) -> dict[str, ChangeCounts]:
        """Return the numbers of each row, in the natural order of their names."""
        rows: dict[str, list[FruitChange]] = {}
        for fruit in self.changes:
            rows.setdefault(fruit.row, []).append(fruit)
        return {row: _counts(rows[row]) for row in sorted(rows, key=natural_key)}


def _counts(changes: Sequence[FruitChange]) -> ChangeCounts:
    number = Counter(fruit.change for fruit in changes)
    picked, gone, stayed = (number[c] for c in (Change.PICKED, Change.GONE, Change.STAYED))
    growths = [fruit.growth_m_per_day for fruit in changes]
    known_growths = [growth for growth in growths if growth is not None]
    return ChangeCounts(
        before=picked + gone + stayed,
        picked=picked,
        gone=gone,
        stayed=stayed,
        new=number[Change.NEW],
        after=stayed + number[Change.NEW],
        unsure=sum(fruit.probability < SURE for fruit in changes),
        returned=sum(fruit.is_back for fruit in changes),
        not_walked=number[Change.NOT_WALKED],
        growth_m_per_day=median(known_growths) if known_growths else None,
    )


def compare_rounds(
    earlier: Sequence[FruitRow],
    later: Sequence[FruitRow],
    same: Mapping[str, tuple[str, float]],
    stops: tuple[Sequence[StopRecord], Sequence[StopRecord]],
    days: float,
) -> DayComparison:
    """Compare two rounds of a house.

    Parameters
    ----------
    earlier, later : sequence of FruitRow
        Their fruit (`fruit_table`); doubtful ones are left out.
    same : mapping of str to (str, float)
        Fruit of the earlier round by those of the later one, with probabilities (`same_fruit`).
    stops : pair of sequences of StopRecord
        The stops of both, which say where each of them went.
    days : float
        Time between them, days; above 0.
    """
    before = {line.key: line for line in earlier if not line.doubtful}
    after = {line.key: line for line in later if not line.doubtful}
    walked_before, walked_after = (_walked_spans(stops_of_round) for stops_of_round in stops)
    changes = []
    for key, view in after.items():
        first_key, probability = same.get(key, ("", 1.0))
        first = before.pop(first_key, None)
        if first is not None:
            changes.append(FruitChange(Change.STAYED, first, view, days, probability))
        else:
            change = Change.NEW if _is_walked(view, walked_before) else Change.NOT_WALKED
            changes.append(FruitChange(change, None, view, days))
    for view in before.values():
        if view.picked_s is not None:
            change = Change.PICKED
        else:
            change = Change.GONE if _is_walked(view, walked_after) else Change.NOT_WALKED
        changes.append(FruitChange(change, view, None, days))
    return DayComparison(days, tuple(sorted(changes, key=_place)))


def _place(fruit: FruitChange) -> tuple[object, ...]:
    view = fruit.after or fruit.before
    along_m = None if view is None else view.along_m
    return (natural_key(fruit.row), along_m is None, along_m or 0.0)


_Spans = dict[tuple[str, str], tuple[float, float] | None]


def _walked_spans(stops: Iterable[StopRecord]) -> _Spans:
    """Return from where to where each side of each row was walked, metres; None if not known."""
    spans: _Spans = {}
    for stop in stops:
        side = stop.row or "", stop.side or ""
        at_m = stop.position_m if stop.fitted_m is None else stop.fitted_m
        span = spans.get(side, (at_m, at_m) if at_m is not None else None)
        if at_m is None or span is None:
            spans[side] = None
        else:
            spans[side] = min(span[0], at_m), max(span[1], at_m)
    return spans


def _is_walked(view: FruitRow, spans: _Spans) -> bool:
    """Return whether a round with these spans went where a fruit hangs."""
    side = view.row or "", view.side or ""
    if side not in spans:
        return False
    span = spans[side]
    if span is None or view.along_m is None:
        return True
    return bool(span[0] - _REACH_M <= view.along_m <= span[1] + _REACH_M)


def same_fruit(store: Store, contents: Sequence[RoundContent]) -> dict[str, tuple[str, float]]:
    """Return which fruit of the last round is which of the first, by the links between rounds.

    All links count, unlike for growth: each is likelier than not, and a fruit without one would be
    counted as gone and as new.

    Parameters
    ----------
    store : Store
        Where the rounds are.
    contents : sequence of RoundContent
        Two or more rounds of a house, the earliest first: a fruit that the days between show, too,
        is followed through them.

    Returns
    -------
    dict
        Keys of the first round's fruit by those of the last one's, and the probability of each.
    """
    group_of = {view.key: view.group for content in contents for view in content.views}
    # A fruit has one name in all rounds: its key in the last of them.
    names = {view.group: (view.group, 1.0) for view in contents[-1].views}
    for content in reversed(contents[1:]):
        for link in sorted(store.links(content.key, LinkKind.GROWTH), key=_probability)[::-1]:
            named = names.get(group_of.get(link.second, ""))
            if named is not None and link.first in group_of:
                name, probability = named
                names.setdefault(group_of[link.first], (name, probability * _probability(link)))
    first = {view.group for view in contents[0].views}
    return {
        name: (group, probability) for group, (name, probability) in names.items() if group in first
    }


def _probability(link: LinkRecord) -> float:
    """Return how likely a link is right; one made by hand is."""
    return 1.0 if link.by_hand else link.score or 0.0


def fruit_days(store: Store, round_key: str, key: str) -> list[FruitRow]:
    """Return a fruit on every day on which it was seen, the earliest first.

    Parameters
    ----------
    store : Store
        Where it is.
    round_key, key : str
        A round that has it, and any of its views there.
    """
    fruit_of_day = {round_key: _fruit_of(store, round_key, {key})}
    queue = [round_key]
    for current in queue:
        view, keys = fruit_of_day[current]
        if view is None:
            continue
        for link in store.links(current, LinkKind.GROWTH):
            for end, far_end in ((link.first, link.second), (link.second, link.first)):
                if end in keys:
                    day = store.detection(far_end).view.round_key
                    if day not in fruit_of_day:
                        fruit_of_day[day] = _fruit_of(store, day, {far_end})
                        queue.append(day)
    views = [view for view, _ in fruit_of_day.values() if view is not None]
    return sorted(views, key=lambda view: view.taken_s)


def _fruit_of(store: Store, round_key: str, keys: set[str]) -> tuple[FruitRow | None, set[str]]:
    """Return a fruit of a round by any of its views, and the keys of all of them."""
    views = store.detections(round_key)
    groups = {view.group for view in views if view.key in keys}
    members = [view for view in views if view.group in groups]
    return next((view for view in members if view.best), None), {view.key for view in members}
