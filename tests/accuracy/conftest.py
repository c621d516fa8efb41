from __future__ import annotations

import json
from pathlib import Path

import pytest

from cucumbervision.capture.source import example_captures
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import measure_inputs


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundled captures through the real run."""
    out = tmp_path_factory.mktemp("run")
    measure_inputs([example_captures()], out, MeasureOptions())
    return out


@pytest.fixture(scope="session")
def table(run: Path) -> Path:
    """Their truth, centreline and chord, as a European spreadsheet writes it."""
    lines = ["capture;fruit;length_cm;kind"]
    for folder in sorted(example_captures().iterdir()):
        for k, true in enumerate(json.loads((folder / "truth.json").read_text()), 1):
            for kind in ("centreline", "chord"):
                text = f"{100 * true[kind + '_m']:.3f}".replace(".", ",")
                lines.append(f"{folder.name};{k};{text};{kind}")
    path = run / "truth.csv"
    path.write_text("\r\n".join(lines), encoding="utf-8-sig")
    return path


HEAD = "capture,fruit,length_cm,kind"


def write(folder: Path, *lines: str) -> Path:
    """Write a table of manual lengths."""
    path = folder / "truth.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path
