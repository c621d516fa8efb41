from __future__ import annotations

from pathlib import Path

import pytest

from cucumbervision.errors import InstancesError
from cucumbervision.fruit.label_files import read_labels


@pytest.mark.parametrize(
    ("name", "content", "fault"),
    [
        ("a.json", "{", "is not JSON"),
        ("a.json", "{}", "no annotations"),
        ("a.json", '[{"bbox": [0, 0, 1, 1]}]', "names no picture"),
        ("a.csv", "1,2", "unknown kind"),
        ("a.txt", None, "no such file"),
        ("folder", None, "no such file"),
    ],
)
def test_other_files_are_refused(
    tmp_path: Path, name: str, content: str | None, fault: str
) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_text(content, encoding="utf-8")
    with pytest.raises(InstancesError, match=fault):
        read_labels(path)
