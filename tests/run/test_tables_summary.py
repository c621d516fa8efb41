from __future__ import annotations

from typing import Any

import pytest

from cucumbervision.run.tables import Summary


def row(m6_cm: float, reason: str = "mask-points-ge-100", flags: str = "") -> dict[str, Any]:
    length = None if reason.startswith("implausible") else m6_cm
    cells = {"length_cm": length, "method": None, "mask_source": None, "simulated": False}
    others = {f"m{k}_cm": None for k in range(1, 6)}
    return {**cells, **others, "m6_cm": m6_cm, "reason": reason, "flags": flags}


SOUND = row(18.0)
STEM = row(30.0, "implausible-diameter", "ends-unsure")
SHORT = row(4.0, "implausible-length")
THICK = row(74.0, "implausible-diameter", "ends-unsure depth-unit")
DOUBTED = row(37.0, flags="depth-unit")


@pytest.mark.parametrize(
    ("rows", "hint"),
    [
        ([SOUND, THICK, SOUND], None),
        ([STEM, SHORT, SOUND], None),
        ([STEM], None),
        ([SHORT], "no fruit has a possible size (median 4 cm): is one step of depth really 1 mm? "
         "--depth-unit 0.01 would explain it"),
        ([THICK, THICK, DOUBTED], "2 of 3 fruit are too large (median 74 cm): is one step of depth "
         "really 1 mm? --depth-unit 0.0001, 0.0002 or 0.00025 would explain it"),
    ],
)  # fmt: skip
def test_a_unit_is_suggested_where_half_of_the_fruit_are_too_large(
    rows: list[dict[str, Any]], hint: str | None
) -> None:
    summary = Summary()
    summary.add(rows)
    assert summary.unit_hints() == ([] if hint is None else [hint])


def test_several_classes_and_what_was_left_out_are_told() -> None:
    summary = Summary()
    summary.add([SOUND | {"label": "cucumber"}, SOUND | {"label": "leaf"}], left_out={"stem": 2})
    told = summary.doubts()
    assert told[0].startswith("measured as fruit: 1 of class cucumber, 1 of class leaf; --classes")
    assert told[1] == "left out: 2 of class stem"


def test_doubts_of_the_data_are_told_once_with_the_remedy() -> None:
    summary = Summary()
    for flags in ("principal-point", "ends-unsure principal-point", ""):
        summary.add([row(18.0, flags=flags)])
    (line,) = summary.doubts()
    assert line.startswith("2 of 3 fruit: the intrinsics' principal point lies off the middle")
    assert "check that" in line


def test_bounds_and_unknown_lengths_are_left_out_of_the_statistics() -> None:
    """Of 18, 20, 9 (in part), 40 and 60 cm (of which nothing is known) the mean is 19 cm."""
    summary = Summary()
    flags = ("end-hidden", "depth-sparse", "end-covered interval-too-wide")
    bound, sparse, wide = (
        row(length_cm, flags=codes)
        for length_cm, codes in zip((9.0, 40.0, 60.0), flags, strict=True)
    )
    summary.add([SOUND, row(20.0), bound, sparse, wide])
    provenance = dict.fromkeys(("software", "licence", "source", "started", "config_sha256"), "")
    lines = dict(summary.lines(0, provenance | {"calibration": None}))
    assert lines["Fruit measured"] == 5
    assert lines["of these only in part (lower bounds)"] == 1
    assert lines["of these uncertain (left out of the statistics)"] == 2
    assert (lines["Mean length [cm]"], lines["Longest [cm]"]) == (19.0, 20.0)
