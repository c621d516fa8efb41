"""What changed in a house between two rounds: fruit that grew, were picked, are new or are gone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from itertools import groupby
from statistics import median

from cucumbervision.methods.result import LengthDefinition
from cucumbervision_greenhouse.forecast.forecast import natural_key
from cucumbervision_greenhouse.rounds.fruit_table import RoundContent, read_round
from cucumbervision_greenhouse.store.records import FruitRow, LinkKind, StopRecord
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
    """

    change: Change
    before: FruitRow | None
    after: FruitRow | None
    days: float

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


@dataclass(frozen=True, eq=False)
class DayComparison:
    """Two rounds of a house or of one row, fruit by fruit.

    Parameters
    ----------
    changes : tuple of FruitChange
        Every fruit of either round, by row and position.
    """

    changes: tuple[FruitChange, ...]

    def of(self, change: Change) -> tuple[FruitChange, ...]:
        """Return the fruit with a change."""
        return tuple(fruit for fruit in self.changes if fruit.change is change)

    def number(self, *changes: Change) -> int:
        """Return how many fruit have one of these changes."""
        return sum(fruit.change in changes for fruit in self.changes)

    @property
    def before(self) -> int:
        """Fruit on the plant at the earlier round, where both rounds went."""
        return self.number(Change.PICKED, Change.GONE, Change.STAYED)

    @property
    def after(self) -> int:
        """Fruit on the plant at the later round, where both rounds went."""
        return self.number(Change.STAYED, Change.NEW)

    @property
    def growth_m_per_day(self) -> float | None:
        """Median growth of the fruit that stayed, metres a day."""
        growths = [fruit.growth_m_per_day for fruit in self.changes]
        known_growths = [growth for growth in growths if growth is not None]
        return median(known_growths) if known_growths else None

    def by_row(self) -> dict[str, DayComparison]:
        """Return the fruit of each row, in the natural order of their names."""
        rows = groupby(self.changes, key=lambda fruit: fruit.row)  # they are sorted by row
        return {row: DayComparison(tuple(of_row)) for row, of_row in rows}


def compare_rounds(
    earlier: Sequence[FruitRow],
    later: Sequence[FruitRow],
    same: Mapping[str, str],
    stops: tuple[Sequence[StopRecord], Sequence[StopRecord]],
    days: float,
) -> DayComparison:
    """Compare two rounds of a house.

    Parameters
    ----------
    earlier, later : sequence of FruitRow
        Their fruit (`fruit_table`); doubtful ones are left out.
    same : mapping of str to str
        Fruit of the earlier round by those of the later one (`same_fruit`).
    stops : pair of sequences of StopRecord
        The stops of both, which say where each of them went.
    days : float
        Time between them, days; above 0.
    """
    before = {line.key: line for line in earlier if not line.doubtful}
    after = {line.key: line for line in later if not line.doubtful}
    walked_before, walked_after = map(_walked, stops)
    changes = []
    for key, view in after.items():
        first = before.pop(same.get(key, ""), None)
        if first is not None:
            changes.append(FruitChange(Change.STAYED, first, view, days))
        else:
            change = Change.NEW if _is_walked(view, walked_before) else Change.NOT_WALKED
            changes.append(FruitChange(change, None, view, days))
    for view in before.values():
        if view.picked_s is not None:
            change = Change.PICKED
        else:
            change = Change.GONE if _is_walked(view, walked_after) else Change.NOT_WALKED
        changes.append(FruitChange(change, view, None, days))
    return DayComparison(tuple(sorted(changes, key=_place)))


def _place(fruit: FruitChange) -> tuple[object, ...]:
    view = fruit.after or fruit.before
    along_m = None if view is None else view.along_m
    return (natural_key(fruit.row), fruit.row, along_m is None, along_m or 0.0)


_Walked = dict[tuple[str, str], list[float | None]]


def _walked(stops: Iterable[StopRecord]) -> _Walked:
    """Return where each side of each row was walked, metres; None where that is not known."""
    positions_m: _Walked = {}
    for stop in stops:
        positions_m.setdefault((stop.row or "", stop.side or ""), []).append(stop.at_m)
    return positions_m


def _is_walked(view: FruitRow, walked: _Walked) -> bool:
    """Return whether a round that walked there went where a fruit hangs."""
    positions_m = walked.get((view.row or "", view.side or ""), [])
    known_m = [at_m for at_m in positions_m if at_m is not None]
    if view.along_m is None or len(known_m) < len(positions_m) or not known_m:
        return bool(positions_m)
    return bool(min(known_m) - _REACH_M <= view.along_m <= max(known_m) + _REACH_M)


def linked_rounds(store: Store, content: RoundContent) -> tuple[list[RoundContent], dict[str, str]]:
    """Return a round with those that its sure links lead to, and their fruit's keys in it by group.

    A fruit that several rounds show is followed from each to the next; deleted rounds are left out.
    """
    walk_of = cache(store.round)  # None for a deleted round
    contents, name_of = [content], {view.group: view.group for view in content.views}
    for current in contents:
        links = [link for link in store.links(current.key, LinkKind.GROWTH) if link.sure]
        for link in sorted(links, key=lambda link: not link.by_hand):
            for end, far_end in ((link.first, link.second), (link.second, link.first)):
                name = name_of.get(current.group_of.get(end, ""))
                if name is None:
                    continue
                home = next((x for x in contents if far_end in x.group_of), None)
                if home is None and walk_of(key := store.detection(far_end).view.round_key):
                    contents.append(home := read_round(store, key))
                if home is not None:
                    name_of.setdefault(home.group_of[far_end], name)
    return contents, name_of


def same_fruit(store: Store, earlier: RoundContent, later: RoundContent) -> dict[str, str]:
    """Return the fruit of an earlier round by those of a later one (`linked_rounds`)."""
    _, name_of = linked_rounds(store, later)
    return {name_of[view.group]: view.group for view in earlier.views if view.group in name_of}


def offered_pairs(
    store: Store, comparison: DayComparison, contents: Sequence[RoundContent]
) -> list[tuple[FruitRow, FruitRow]]:
    """Return fruit not seen again and new ones that may be the same, the likeliest first.

    Parameters
    ----------
    store : Store
        Where the rounds are.
    comparison : DayComparison
        Of two rounds.
    contents : sequence of RoundContent
        These two, the earlier one first.
    """
    group_of = {view.key: view.group for content in contents for view in content.views}
    gone = {x.before.key: x.before for x in comparison.of(Change.GONE) if x.before}
    new = {x.after.key: x.after for x in comparison.of(Change.NEW) if x.after}
    links = [x for x in store.links(contents[-1].key, LinkKind.GROWTH) if not x.sure]
    links.sort(key=lambda link: -(link.score or 0.0))
    ends = [(group_of.get(link.first, ""), group_of.get(link.second, "")) for link in links]
    return [(gone[first], new[last]) for first, last in ends if first in gone and last in new]


def fruit_days(store: Store, content: RoundContent, key: str) -> list[FruitRow]:
    """Return a fruit by any of its views on every day on which it was seen, the earliest first."""
    contents, name_of = linked_rounds(store, content)
    fruit = [view for x in contents for view in x.views if view.best]
    same = [view for view in fruit if name_of.get(view.group) == content.group_of[key]]
    return sorted(same, key=lambda view: view.taken_s)
