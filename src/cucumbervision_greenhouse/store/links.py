"""Links between detections, and the groups that follow from them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable


class LinkKind(StrEnum):
    """How two detections are related."""

    SAME = "same"  # one fruit, seen twice in a round
    GROWTH = "growth"  # one fruit on an earlier and a later round
    APART = "apart"  # two fruit, decided by hand: no algorithm may link them


@dataclass(frozen=True)
class LinkRecord:
    """Two detections and their relation; for growth the earlier one is first."""

    kind: LinkKind
    first: str
    second: str
    score: float | None = None
    by_hand: bool = False


def group_detections(keys: Iterable[str], links: Iterable[LinkRecord]) -> list[set[str]]:
    """Group the detections that links identify as the same fruit.

    What was linked by hand joins first, then the surest. A link that would bring two detections
    together that were parted by hand joins nothing.

    Parameters
    ----------
    keys : iterable of str
        The detections.
    links : iterable of LinkRecord
        Links of any kind; links of growth are ignored.

    Returns
    -------
    list of set
        The detections of each fruit.

    Examples
    --------
    >>> same, apart = LinkKind.SAME, LinkKind.APART
    >>> links = [LinkRecord(same, "a", "b", 0.9), LinkRecord(same, "b", "c", 0.5)]
    >>> [sorted(group) for group in group_detections("abcd", links)]
    [['a', 'b', 'c'], ['d']]
    >>> parted = [*links, LinkRecord(apart, "a", "c", by_hand=True)]
    >>> [sorted(group) for group in group_detections("abcd", parted)]
    [['a', 'b'], ['c'], ['d']]
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
    for link in sorted(same, key=lambda link: (not link.by_hand, -(link.score or 0.0))):
        a, b = groups[link.first], groups[link.second]
        if a is b or any(not b.isdisjoint(foes[key]) for key in a if key in foes):
            continue
        small, large = sorted((a, b), key=len)
        large |= small
        for key in small:
            groups[key] = large
    return list({id(group): group for group in groups.values()}.values())
