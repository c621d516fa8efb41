from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cucumbervision.errors import RoundError
from cucumbervision_greenhouse.rounds.walking import pose_matrix, read_poses


def test_csv_and_json_say_the_same(tmp_path: Path) -> None:
    table, data = tmp_path / "a.csv", tmp_path / "b.json"
    table.write_text("capture,position_m,row,position_sd_m\na,1.5,3,\nb,1.9,3,0.01\n")
    data.write_text(
        '[{"capture": "a", "position_m": 1.5, "row": "3"},'
        ' {"capture": "b", "position_m": 1.9, "row": "3", "position_sd_m": 0.01}]'
    )
    assert read_poses(table) == read_poses(data)
    assert read_poses(table)["a"].position_sd_m == 0.03


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("capture,position_m\na,here\n", "line 1"),
        ("capture,position_m\na,nan\n", "line 1"),
        ("capture,position_m,positon_sd_m\na,1,2\n", "positon_sd_m"),
        ("capture,position_m\na,1\na,2\n", "two lines for capture 'a'"),
        ("capture,position_m,height_m\na,1,1.2\nb,2,\n", "only some lines give height_m"),
        ("capture,position_m,position_sd_m\na,1,0\n", "position_sd_m"),
    ],
)
def test_bad_lines_are_named(tmp_path: Path, text: str, fault: str) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(text)
    with pytest.raises(RoundError, match=fault) as error:
        read_poses(path)
    assert "poses.csv" in str(error.value)


def test_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(RoundError, match="cannot be read"):
        read_poses(tmp_path / "none.csv")
    broken = tmp_path / "broken.json"
    broken.write_text("[{")
    with pytest.raises(RoundError, match="is not JSON"):
        read_poses(broken)


def test_matrices_turn_as_they_say() -> None:
    ahead, right = np.array([0, 0, 1.0, 1]), np.array([1.0, 0, 0, 1])
    level = pose_matrix(2.0, height_m=1.2)
    assert (level @ ahead)[:3] == pytest.approx([2.0, 1.2, 1.0])
    assert (pose_matrix(2.0, -1) @ right)[:3] == pytest.approx([1.0, 0.0, 0.0])
    # Looking up by 30 degrees, what is straight ahead lies higher.
    assert (pose_matrix(0.0, pitch_deg=30) @ ahead)[:3] == pytest.approx([0, 0.5, np.sqrt(0.75)])
    # Rolled clockwise, the picture's right is down.
    assert (pose_matrix(0.0, roll_deg=90) @ right)[:3] == pytest.approx([0, -1, 0], abs=1e-12)
