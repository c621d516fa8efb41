from __future__ import annotations

import pytest

from cucumbervision.capture.frames import Stop
from cucumbervision.errors import NameRefusedError
from cucumbervision.names import LONGEST_NAME, checked_name, house_key, same_house


@pytest.mark.parametrize(
    "bad",
    [
        *("3\0", "3\x1b[2J", "3\t4", "3\n4", "3\r4", "3\x85", "3\u2028", "3\u2029"),
        *("3\ud800", "\udc80", "\u202e3", "3\u200f", "\u061c", "\u2066a\u2069"),
    ],
)
def test_what_is_no_letter_is_refused_by_its_number_and_never_shown(bad: str) -> None:
    with pytest.raises(NameRefusedError, match=r"the row '.*' contains U\+[0-9A-F]{4}") as found:
        checked_name(f"a{bad}b", "row")
    assert str(found.value).isprintable()
    with pytest.raises(NameRefusedError):
        Stop(row=f"a{bad}b")
    with pytest.raises(NameRefusedError):
        Stop(side=f"a{bad}b")


@pytest.mark.parametrize(
    "name",
    [
        *(
            "3",
            "=1+1",
            "x;=cmd|'/c calc'!A0",
            "![x](http://a)",
            "<b>",
            "Süd",
            "温室 3",
            "צפון",
            "شمال",
        ),
        *("उत्तर", "می\u200cروم", "👩\u200d🌾", ""),
    ],
)
def test_names_of_every_script_and_with_any_sign_stay_as_they_are(name: str) -> None:
    assert checked_name(f" {name} ") == name
    assert Stop(row=name).row == name


def test_a_name_that_fits_on_no_page_is_refused_with_its_length() -> None:
    longest = "ü" * LONGEST_NAME
    assert checked_name(f" {longest} ") == longest
    with pytest.raises(NameRefusedError, match=r"the row 'ü{40}' has 201 characters, and 200 are"):
        checked_name(longest + "ü", "row")
    with pytest.raises(NameRefusedError):
        Stop(row=longest + "ü")


def test_houses_are_one_by_case_spaces_and_the_leading_word_only() -> None:
    same = ["7", "House 7", "house 7", " HOUSE\u00a07", "house7", "House-7", "\uff17"]
    assert {house_key(name) for name in same} == {"7"}
    other = ["", "House", "17", "House 7a", "Houses 7", "Green house 7"]
    assert len({house_key(name) for name in (*other, "7")}) == len(other) + 1
    assert same_house("house 7", ["Nord", "7", "House 7"]) == "7"
    assert same_house("House 7", ["7", "House 7"]) == "House 7"  # its own name comes first
    assert same_house("", ["", "7"]) == ""
