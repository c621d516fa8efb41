from __future__ import annotations

from itertools import permutations

from cucumbervision_greenhouse.store.records import LinkKind, LinkRecord
from cucumbervision_greenhouse.store.repository import group_detections


def same(pair: str, score: float | None = None, *, by_hand: bool = False) -> LinkRecord:
    return LinkRecord(LinkKind.SAME, pair[0], pair[1], score, by_hand)


def apart(pair: str) -> LinkRecord:
    return LinkRecord(LinkKind.APART, pair[0], pair[1], by_hand=True)


def shape(keys: str, links: list[LinkRecord]) -> set[str]:
    return {"".join(sorted(group)) for group in group_detections(keys, links)}


def test_links_join_whatever_their_order() -> None:
    links = [same("ab"), same("dc"), same("bc")]
    for order in permutations(links):
        assert shape("abcde", list(order)) == {"abcd", "e"}


def test_the_surest_link_wins_where_two_must_not_meet() -> None:
    links = [same("ab", 0.6), same("bc", 0.7), apart("ac")]
    for order in permutations(links):
        assert shape("abc", list(order)) == {"a", "bc"}


def test_a_link_by_hand_goes_before_the_surest() -> None:
    assert shape("abc", [same("ab", by_hand=True), same("bc", 1.0), apart("ca")]) == {"ab", "c"}


def test_two_that_must_not_meet_do_not_meet_through_others() -> None:
    links = [same("ab", 0.9), same("cd", 0.8), same("bc", 0.7), apart("ad")]
    assert shape("abcd", links) == {"ab", "cd"}


def test_growth_and_other_rounds_fruit_join_nothing() -> None:
    growth = LinkRecord(LinkKind.GROWTH, "a", "b")
    assert shape("ab", [growth, same("az"), same("zb")]) == {"a", "b"}
