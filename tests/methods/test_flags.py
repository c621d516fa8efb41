"""The table of flags, and what is said by it."""

from __future__ import annotations

import pytest

from cucumbervision.methods.flags import (
    FLAGS,
    LOWER_BOUND,
    NO_DEPTH,
    Flag,
    data_doubts,
    flag_remarks,
    is_lower_bound,
)


def test_a_fruit_without_a_distance_is_no_lower_bound_whatever_else_it_has() -> None:
    for bound in LOWER_BOUND:
        assert is_lower_bound([bound, Flag.POOR_FIT])
        for fault in NO_DEPTH:
            assert not is_lower_bound([bound, fault])


def test_what_has_no_depth_is_said_of_the_batch_with_a_remedy() -> None:
    for flag in NO_DEPTH:
        assert FLAGS[flag].data_fault
        assert FLAGS[flag].remedy
        [line] = data_doubts({flag: 2}, 5)
        assert line.startswith("2 of 5 fruit: ")
    assert data_doubts({Flag.POOR_FIT: 2, Flag.END_HIDDEN: 1}, 5) == []


@pytest.mark.parametrize("flag", [f for f, line in FLAGS.items() if line.remedy])
def test_a_remedy_comes_with_a_fault_and_a_remark(flag: Flag) -> None:
    assert FLAGS[flag].data_fault
    assert FLAGS[flag].remark


def test_equal_remarks_are_said_once() -> None:
    assert flag_remarks("cut-by-frame box-clipped") == "cut by the picture's edge"
    assert flag_remarks("sam-mask-empty") == ""
    assert flag_remarks("no-such-flag") == ""
