"""Which detections of a round are one fruit, and which of them stands."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from cucumbervision.store.views import LinkKind, LinkRecord

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

__all__ = ["Candidate", "Standing", "group_fruit", "standings"]


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
    for link in sorted(same, key=lambda one: (not one.by_hand, -(one.score or 0.0))):
        a, b = groups[link.first], groups[link.second]
        if a is b or any(not b.isdisjoint(foes[key]) for key in a if key in foes):
            continue
        small, large = sorted((a, b), key=len)
        large |= small
        for key in small:
            groups[key] = large
    return {key: shared.setdefault(id(group), frozenset(group)) for key, group in groups.items()}


class Candidate(NamedTuple):
    """What decides whether a view of a fruit stands: more is better, the first thing first."""

    not_rejected: bool
    measured: bool
    view_score: float


class Standing(NamedTuple):
    """A group: the view that stands, how many there are, when the fruit was first picked."""

    best: str
    views: int
    picked_s: float | None


def standings(
    candidates: Mapping[str, Candidate], picked_s: Mapping[str, float], links: Iterable[LinkRecord]
) -> dict[str, Standing]:
    """Give each detection its group, named by the view that stands, and when it was picked.

    A rejected view stands only where all are rejected, one without a length only where none
    has one; then the highest view score counts, then the view that comes first.

    Parameters
    ----------
    candidates : mapping of str to Candidate
        The detections in the order of their stops.
    picked_s : mapping of str to float
        When those that were marked so were picked.
    links : iterable of LinkRecord
        What links them.

    Examples
    --------
    >>> views = {"a": Candidate(True, True, 0.4), "b": Candidate(True, True, 0.7)}
    >>> standings(views, {"a": 9.0}, [LinkRecord(LinkKind.SAME, "a", "b")])["a"]
    Standing(best='b', views=2, picked_s=9.0)
    """
    place = {key: -at for at, key in enumerate(candidates)}
    found: dict[str, Standing] = {}
    for key, group in group_fruit(candidates, links).items():
        if key not in found:
            best = max(group, key=lambda one: (*candidates[one], place[one]))
            times = [picked_s[one] for one in group if one in picked_s]
            standing = Standing(best, len(group), min(times, default=None))
            found.update(dict.fromkeys(group, standing))
    return found
