"""Which detections of a round are one fruit, and which of them stands."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from cucumbervision.store.views import FruitView, LinkKind, LinkRecord, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

__all__ = ["group_fruit", "grouped"]


def group_fruit(keys: Iterable[str], links: Iterable[LinkRecord]) -> dict[str, frozenset[str]]:
    """Join detections that links say are the same fruit.

    What was linked by hand joins first, then the surest. A link that would bring two detections
    together that somebody called two fruit joins nothing.

    Parameters
    ----------
    keys : iterable of str
        The detections.
    links : iterable of LinkRecord
        Of any kind; those of growth say nothing here.

    Returns
    -------
    dict
        For each detection all that are the same fruit, itself among them.

    Examples
    --------
    >>> same, apart = LinkKind.SAME, LinkKind.APART
    >>> links = [LinkRecord(same, "a", "b", 0.9), LinkRecord(same, "b", "c", 0.5)]
    >>> sorted(group_fruit("abcd", links)["a"])
    ['a', 'b', 'c']
    >>> sorted(group_fruit("abcd", [*links, LinkRecord(apart, "a", "c", by_hand=True)])["a"])
    ['a', 'b']
    """
    groups = {key: {key} for key in keys}
    foes: dict[str, set[str]] = {}
    same = []
    for link in links:
        if link.first not in groups or link.second not in groups:
            continue
        if link.kind is LinkKind.SAME:
            same.append(link)
        elif link.kind is LinkKind.APART:
            foes.setdefault(link.first, set()).add(link.second)
            foes.setdefault(link.second, set()).add(link.first)
    for link in sorted(same, key=lambda one: (not one.by_hand, -(one.score or 0.0))):
        a, b = groups[link.first], groups[link.second]
        if a is b or any(not b.isdisjoint(foes[key]) for key in a if key in foes):
            continue
        small, large = sorted((a, b), key=len)
        large |= small
        for key in small:
            groups[key] = large
    return {key: frozenset(group) for key, group in groups.items()}


def grouped(fruit: Sequence[FruitView], links: Iterable[LinkRecord]) -> list[FruitView]:
    """Give each detection its group, named by the view that stands, and when it was picked.

    A rejected view stands only where all are rejected, one without a length only where none
    has one; then the highest view score counts, then the earlier stop.
    """
    members = group_fruit((one.key for one in fruit), links)
    place = {one.key: at for at, one in enumerate(fruit)}
    done: dict[frozenset[str], tuple[str, float | None]] = {}
    views = []
    for one in fruit:
        group = members[one.key]
        if group not in done:
            # Sorted, for a set has no order that could be relied on.
            all_views = [fruit[at] for at in sorted(place[key] for key in group)]
            picked = [view.picked_s for view in all_views if view.picked_s is not None]
            done[group] = max(all_views, key=_standing).key, min(picked, default=None)
        best, picked_s = done[group]
        views.append(replace(one, group=best, views=len(group), picked_s=picked_s))
    return views


def _standing(view: FruitView) -> tuple[bool, bool, float]:
    record = view.record
    return view.verdict is not Verdict.REJECTED, record.length_m is not None, record.view_score
