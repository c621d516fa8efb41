"""The context of one fruit: its views, its neighbours, and itself on the days before and after.

It is what a person needs to correct which views are one fruit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from cucumbervision.rounds.merge_and_link import earlier_round, later_rounds
from cucumbervision.store.links import LinkKind
from cucumbervision.store.views import Verdict

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from cucumbervision.store.links import LinkRecord
    from cucumbervision.store.repository import Store
    from cucumbervision.store.views import DetectionView, RoundView

_NEAR_M, _FAR_M = 0.35, 0.80  # of one round; of another day, since rows are moved
_SHOWN = 4


@dataclass(frozen=True)
class OtherDay:
    """A fruit on another day.

    Parameters
    ----------
    round : RoundView
        The round of that day.
    linked : DetectionView, optional
        The fruit that it is taken to be there.
    near : tuple of DetectionView
        Others that it might be, the nearest first.
    """

    round: RoundView
    linked: DetectionView | None
    near: tuple[DetectionView, ...]


@dataclass(frozen=True)
class FruitContext:
    """A fruit and its context.

    Parameters
    ----------
    fruit : DetectionView
        The representative view.
    views : tuple of DetectionView
        All its views, the representative one first.
    near : tuple of DetectionView
        Other fruit of the same row, the nearest first.
    earlier, later : OtherDay, optional
        The same on the day before and after, where a round of it is there.
    """

    fruit: DetectionView
    views: tuple[DetectionView, ...]
    near: tuple[DetectionView, ...]
    earlier: OtherDay | None = None
    later: OtherDay | None = None


def around(store: Store, round_key: str, key: str) -> FruitContext | None:
    """Return a fruit with its context; None if it is no longer there.

    Parameters
    ----------
    store : Store
        Where it is.
    round_key : str
        Its round.
    key : str
        Any of its views.
    """
    every = store.detections(round_key)
    group = next((view.group for view in every if view.key == key), None)
    if group is None:
        return None
    views = sorted((v for v in every if v.group == group), key=lambda v: not v.best)
    fruit = next(view for view in views if view.best)
    others = [v for v in every if v.best and v.group != group and v.verdict is not Verdict.REJECTED]
    links = store.links(round_key, LinkKind.GROWTH)
    keys = {view.key for view in views}
    before, after = earlier_round(store, round_key), later_rounds(store, round_key)[:1]
    return FruitContext(
        fruit,
        tuple(views),
        nearest(fruit, others, _NEAR_M),
        None if before is None else _other_day(store, before, fruit, _ends(links, keys)),
        _other_day(store, after[0], fruit, _ends(links, keys)) if after else None,
    )


def _ends(links: Iterable[LinkRecord], keys: set[str]) -> set[str]:
    """Return the other ends of the links of some detections."""
    found = set()
    for link in links:
        if link.first in keys:
            found.add(link.second)
        elif link.second in keys:
            found.add(link.first)
    return found


def _other_day(store: Store, one: RoundView, fruit: DetectionView, ends: set[str]) -> OtherDay:
    every = store.detections(one.key)
    group = next((view.group for view in every if view.key in ends), None)
    best = [view for view in every if view.best and view.verdict is not Verdict.REJECTED]
    linked = next((view for view in best if view.group == group), None)
    others = [view for view in best if view.group != group]
    return OtherDay(one, linked, nearest(fruit, others, _FAR_M))


def nearest(
    fruit: DetectionView, others: Sequence[DetectionView], reach_m: float
) -> tuple[DetectionView, ...]:
    """Return the few fruit of the same row that hang nearest along it, within a reach."""
    if fruit.along_m is None:
        return ()
    at_m = fruit.along_m
    placed = [
        (abs(view.along_m - at_m), view.key, view)
        for view in others
        if view.row == fruit.row and view.along_m is not None
    ]
    return tuple(view for gap, _, view in sorted(placed)[:_SHOWN] if gap <= reach_m)


def least_sure_first(fruit: Sequence[DetectionView]) -> list[DetectionView]:
    """Return the fruit that one view alone shows and nobody has judged, the least sure first."""
    once = [view for view in fruit if view.views == 1 and view.verdict is None]
    return sorted(once, key=lambda view: (view.record.score, view.key))
