"""Links between detections, and the groups and representative views that follow from them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


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


@dataclass(frozen=True)
class Position:
    """A position along a row, and its standard deviation; metres."""

    at_m: float
    sd_m: float | None = None


def group_detections(keys: Iterable[str], links: Iterable[LinkRecord]) -> dict[str, frozenset[str]]:
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
    dict
        For each detection all that are the same fruit, itself among them.

    Examples
    --------
    >>> same, apart = LinkKind.SAME, LinkKind.APART
    >>> links = [LinkRecord(same, "a", "b", 0.9), LinkRecord(same, "b", "c", 0.5)]
    >>> sorted(group_detections("abcd", links)["a"])
    ['a', 'b', 'c']
    >>> sorted(group_detections("abcd", [*links, LinkRecord(apart, "a", "c", by_hand=True)])["a"])
    ['a', 'b']
    """
    groups = {key: {key} for key in keys}
    shared: dict[int, frozenset[str]] = {}
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
    return {key: shared.setdefault(id(group), frozenset(group)) for key, group in groups.items()}


class Candidate(NamedTuple):
    """How well a view can represent its fruit: higher is better, the first field counts first."""

    not_rejected: bool
    measured: bool
    complete: bool
    view_score: float


class FruitGroup(NamedTuple):
    """The views of one fruit: the representative one, their number, when it was first picked."""

    best: str
    views: int
    picked_s: float | None


def representative_views(
    candidates: Mapping[str, Candidate], picked_s: Mapping[str, float], links: Iterable[LinkRecord]
) -> dict[str, FruitGroup]:
    """Return the group of each detection, with its representative view.

    That is a view that was not rejected, before one with a length, before one of the whole fruit,
    before one with a higher view score, before the first.

    Parameters
    ----------
    candidates : mapping of str to Candidate
        The detections in the order of their stops.
    picked_s : mapping of str to float
        When those that were marked so were picked.
    links : iterable of LinkRecord
        Their links.

    Examples
    --------
    >>> views = {"a": Candidate(True, True, True, 0.4), "b": Candidate(True, True, True, 0.7)}
    >>> representative_views(views, {"a": 9.0}, [LinkRecord(LinkKind.SAME, "a", "b")])["a"]
    FruitGroup(best='b', views=2, picked_s=9.0)
    """
    place = {key: -number for number, key in enumerate(candidates)}
    group_of: dict[str, FruitGroup] = {}
    for key, group in group_detections(candidates, links).items():
        if key not in group_of:
            best = max(group, key=lambda view: (*candidates[view], place[view]))
            times = [picked_s[view] for view in group if view in picked_s]
            one_fruit = FruitGroup(best, len(group), min(times, default=None))
            group_of.update(dict.fromkeys(group, one_fruit))
    return group_of
