"""The example notebooks run from the first cell to the last."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")

EXAMPLES = Path(__file__).parents[2] / "examples"


def executed(name: str, folder: Path) -> list[Any]:
    """Return the cells of a notebook after it was run in an empty folder."""
    notebook = nbformat.read(EXAMPLES / name, as_version=4)
    nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()
    return list(notebook.cells)


def shown(cells: list[Any]) -> str:
    """Return the text of all outputs."""
    outputs = [one for cell in cells for one in cell.get("outputs", [])]
    return "\n".join(
        output.get("text") or output.get("data", {}).get("text/plain", "") for output in outputs
    )


def test_a_researcher_gets_a_table_a_plot_and_the_methods_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Where a library loaded by another test has set it, the notebook would show no plot.
    monkeypatch.delenv("MPLBACKEND", raising=False)
    cells = executed("researcher.ipynb", tmp_path)
    text = shown(cells)
    assert "16.192" in text  # the bench's first fruit by M6
    assert "of 8 intervals hold the true length" in text
    pictures = [
        one for c in cells for one in c.get("outputs", []) if "image/png" in one.get("data", {})
    ]
    assert len(pictures) == 1


def test_a_robot_gets_places_to_cut_and_reasons_to_wait(tmp_path: Path) -> None:
    text = shown(executed("robot.ipynb", tmp_path))
    assert "cut at" in text
    assert "perhaps not ripe" in text
    assert "unsure which end is the stem's" in text  # one lies on the bench


def test_notebooks_are_kept_without_outputs() -> None:
    for path in EXAMPLES.glob("*.ipynb"):
        for cell in nbformat.read(path, as_version=4).cells:
            assert not cell.get("outputs")
            assert cell.get("execution_count") is None
