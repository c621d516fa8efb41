"""A round is written in five formats; each reads back as the same numbers."""

from __future__ import annotations

import csv
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from tests.greenhouse.conftest import whole_stop
from tests.greenhouse.exports.conftest import CONFIG, EVIL, MODEL, SITE, WALK
from typer.testing import CliRunner

from cucumbervision.cli.app import app
from cucumbervision.crop.profiles import load_profile
from cucumbervision.errors import CucumberVisionError, DiskFullError
from cucumbervision.files import cell_value
from cucumbervision.run.fields import Cell, Column
from cucumbervision_greenhouse.exports import ExportFormat
from cucumbervision_greenhouse.exports.build import COLUMNS, RoundTables, round_tables
from cucumbervision_greenhouse.exports.writers import SHEETS, render_sheet, write_exports
from cucumbervision_greenhouse.store.records import Round, key_of
from cucumbervision_greenhouse.store.repository import Store

ROOT = Path(__file__).parents[3]


def test_without_a_profile_there_are_no_grades_and_no_forecast(store: Store) -> None:
    tables = round_tables(store, WALK.key)
    assert tables.note == "no crop profile was named"
    assert not tables["forecast"]
    assert {line["grade"] for line in tables["fruit"]} == {None}
    assert "No forecast" in render_sheet(tables)


def test_an_empty_round_can_be_written_too(store: Store, tmp_path: Path) -> None:
    empty = Round(key_of("empty"), "=1+1", "", 86400.0)
    store.save_round(empty)
    tables = round_tables(store, empty.key, load_profile("long-cucumber"))
    assert tables.summary["fruit"] == 0
    assert len(write_exports(tables, tmp_path / "out")) == 8 + 1 + 8 + 1 + 1


def _read(text: str, column: Column) -> Cell:
    if text == "":
        return None
    if column.type == "text":
        return text[1:] if cell_value(text[1:]) == text else text
    if column.type == "yes/no":
        return text == "true"
    return int(text) if column.type == "whole" else float(text)


def test_csv_reads_back_the_same(tables: RoundTables, tmp_path: Path) -> None:
    write_exports(tables, tmp_path, [ExportFormat.CSV])
    for name, lines in tables.tables.items():
        with (tmp_path / f"{name}.csv").open(encoding="utf-8-sig", newline="") as stream:
            head, *rows = csv.reader(stream)
        assert head == [column.name for column in COLUMNS[name]]
        read = [
            {c.name: _read(cell, c) for cell, c in zip(row, COLUMNS[name], strict=True)}
            for row in rows
        ]
        assert read == lines
        assert not any(cell[:1] in "=+@" for row in rows for cell in row if cell)


def test_json_reads_back_the_same(tables: RoundTables, tmp_path: Path) -> None:
    write_exports(tables, tmp_path, [ExportFormat.JSON])
    read = json.loads((tmp_path / "round.json").read_text(encoding="utf-8"))
    for name, lines in tables.tables.items():
        assert read["tables"][name] == lines
        assert [c["unit"] for c in read["columns"][name]] == [c.unit for c in COLUMNS[name]]
    assert {one["sha256"] for one in read["hashes"]} >= {CONFIG, MODEL, SITE}


def test_parquet_reads_back_the_same(tables: RoundTables, tmp_path: Path) -> None:
    pq = pytest.importorskip("pyarrow.parquet")
    write_exports(tables, tmp_path, [ExportFormat.PARQUET])
    for name, lines in tables.tables.items():
        read = pq.read_table(tmp_path / f"{name}.parquet")
        assert read.to_pylist() == lines
        about = json.loads(read.schema.metadata[b"cucumbervision"])
        assert {one["kind"] for one in about["hashes"]} == {
            *("config", "model", "calibration", "profile")
        }
        for column in COLUMNS[name]:
            assert read.schema.field(column.name).metadata[b"unit"].decode() == column.unit


def test_excel_reads_back_the_same(tables: RoundTables, tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    write_exports(tables, tmp_path, [ExportFormat.XLSX])
    book = openpyxl.load_workbook(tmp_path / "round.xlsx")
    for name, (title, frozen) in SHEETS.items():
        lines, sheet = tables[name], book[title]
        head, *rows = sheet.iter_rows(values_only=True)
        assert list(head) == [column.title for column in COLUMNS[name]]
        for row, cells in zip(rows, lines, strict=True):
            for got, column in zip(row, COLUMNS[name], strict=True):
                cell = cells[column.name]
                assert got == (cell_value(cell) if isinstance(cell, str) else cell)
        assert sheet.freeze_panes == f"{'ABCDEF'[frozen]}2"
        # Printed on A4, as wide as the paper, with its head on every page.
        assert (sheet.page_setup.paperSize, sheet.page_setup.fitToHeight) == (9, 0)
        assert sheet.print_title_rows == "$1:$1"
        # What each column of a sheet says is told on the sheet 'Columns'.
        told = [row[1:] for row in book["Columns"].values if row[0] == name]
        assert told == [(one.name, one.unit or None, one.says) for one in COLUMNS[name]]
    assert "length [cm]" in [cell.value for cell in book["Fruit"][1]]
    lengths = next(cell for cell in book["Fruit"][1] if cell.value == "length [cm]")
    assert book["Fruit"].cell(2, lengths.column).number_format == "0.00"
    assert book["Fruit"].print_area.endswith(f"$A$1:$J${1 + len(tables['fruit'])}")
    values = [str(cell.value) for row in book["Summary"].iter_rows() for cell in row]
    assert {CONFIG, MODEL, SITE} <= {*values}
    # No cell anywhere is a formula.
    kinds = {c.data_type for sheet in book for row in sheet.iter_rows() for c in row}
    assert "f" not in kinds


def test_the_page_names_the_days_of_the_captures_and_of_the_picking(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The round was begun on day 20000 and its captures taken that day; it is printed 3 days later.
    monkeypatch.setattr("time.time", lambda: WALK.started_s + 3 * 86400)
    page = render_sheet(round_tables(store, WALK.key, load_profile("long-cucumber")))
    assert "Walked on Fri 4 Oct" in page
    assert "To pick on Mon 7 Oct" in page
    late = Round(key_of("begun later"), "late", "", WALK.started_s + 86400.0)
    store.save_round(late)
    stop = replace(whole_stop(store, key_of("export", 0)), key=key_of("late"), round_key=late.key)
    store.save_stop(stop)
    assert "Walked on Fri 4 Oct" in render_sheet(round_tables(store, late.key))


def test_the_page_is_escaped_and_loads_nothing(tables: RoundTables) -> None:
    evil = replace(tables, title=EVIL, note=EVIL)
    page = render_sheet(evil)
    assert "<script" not in page
    assert "&lt;script&gt;" in page
    assert not re.findall(r"""(?:src|href|url)\s*[=(]\s*["']?https?:""", page)
    assert "default-src 'none'" in page
    # It begins with numbers and ends with one line of what it rests on.
    first, last = page.index("Ready that day"), page.index("<footer>")
    assert page.index("<h1>") < first < page.index("<p")
    assert page[last:].count("<p>") == 1
    assert all(sha[:8] in page[last:] for sha in (CONFIG, MODEL, SITE))


def test_the_page_prints_on_a4(tables: RoundTables, tmp_path: Path) -> None:
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium is installed")
    (page,) = write_exports(tables, tmp_path, [ExportFormat.HTML])
    pdf = tmp_path / "round.pdf"
    subprocess.run(
        [
            *(chromium, "--headless", "--no-sandbox", "--disable-gpu", "--no-pdf-header-footer"),
            *(f"--user-data-dir={tmp_path / 'profile'}", f"--print-to-pdf={pdf}", page.as_uri()),
        ],
        check=True,
        capture_output=True,
        timeout=120,
    )
    data = pdf.read_bytes()
    assert data.startswith(b"%PDF-")
    boxes = re.findall(rb"/MediaBox\s*\[\s*0 0 ([\d.]+) ([\d.]+)", data)
    assert boxes
    for width, height in boxes:  # A4 in points
        assert (float(width), float(height)) == pytest.approx((595.3, 841.9), abs=1.0)


def test_a_folder_that_cannot_be_written_is_named(tables: RoundTables, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(CucumberVisionError, match="cannot be written"):
        write_exports(tables, tmp_path / "file", [ExportFormat.JSON])


def test_the_command_writes_what_is_asked_for(store: Store, house: Path, tmp_path: Path) -> None:
    arguments = ["export", "morning", "--store", str(house), "-f", "json"]
    done = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    assert done.stdout.split() == [str(tmp_path / "out" / "round.json")]
    read = json.loads((tmp_path / "out" / "round.json").read_text(encoding="utf-8"))
    assert {line["day"] for line in read["tables"]["forecast"]} == set(range(8))


def test_the_page_on_exports_names_every_table() -> None:
    text = (ROOT / "docs" / "exports.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `(\w+)` \| (?!a file|`)", text, re.M)[-len(COLUMNS) :] == list(COLUMNS)


def test_an_export_that_fails_leaves_the_last_one_whole(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tables = round_tables(store, WALK.key)
    paths = write_exports(tables, tmp_path, [ExportFormat.CSV, ExportFormat.JSON])
    before = {path: path.read_bytes() for path in paths}

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("cucumbervision_greenhouse.exports.writers.write_json", full)
    with pytest.raises(DiskFullError, match="free some space on the disk"):
        write_exports(tables, tmp_path, [ExportFormat.CSV, ExportFormat.JSON])
    assert {path: path.read_bytes() for path in paths} == before
    assert not list(tmp_path.glob(".export-*"))
