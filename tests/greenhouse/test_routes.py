from __future__ import annotations

import errno
import html
import io
import re
import shutil
import zipfile

import pytest

pytest.importorskip("streamlit")
pytest.importorskip("httpx2")

from starlette.testclient import TestClient
from tests.greenhouse.camera.test_page import WALK, wait_for_jobs

from cucumbervision.methods.result import Length
from cucumbervision_greenhouse import language, resources
from cucumbervision_greenhouse.store.records import FruitRow, key_of
from cucumbervision_greenhouse.store.repository import Store


def test_a_round_is_loaded_as_files(asked: TestClient) -> None:
    answer = asked.get(f"/api/files/{WALK}", params={"formats": ["xlsx", "csv", "html"]})
    assert answer.headers["content-disposition"] == "attachment; filename*=UTF-8''morning.zip"
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        names = set(archive.namelist())
        lines = archive.read("fruit.csv").decode("utf-8-sig").splitlines()
    assert {"round.xlsx", "fruit.csv", "round.html"} < names
    assert len(lines) == 9  # eight fruit and the head
    assert asked.get(f"/api/files/{key_of('gone')}?formats=csv").status_code == 404
    assert asked.get(f"/api/files/{WALK}?formats=exe").status_code == 404


@pytest.mark.parametrize(
    ("fault", "status", "text"),
    [
        (
            OSError(errno.ENOSPC, "No space left on device"),
            507,
            "cannot store more (No space left on device): free some space",
        ),
        (
            PermissionError(errno.EACCES, "Permission denied", "/tmp/files"),
            500,
            "/tmp/files: Permission denied; check who may read and write it",
        ),
    ],
)
def test_a_fault_of_the_disk_is_named_where_files_are_packed(
    asked: TestClient, monkeypatch: pytest.MonkeyPatch, fault: OSError, status: int, text: str
) -> None:
    def failing(*_: object) -> None:
        raise fault

    monkeypatch.setattr(shutil, "make_archive", failing)
    answer = asked.get(f"/api/files/{WALK}?formats=csv")
    assert answer.status_code == status
    assert text in answer.json()["error"]


def test_a_round_is_printed_with_its_pick_list(asked: TestClient) -> None:
    answer = asked.get(f"/api/print/{WALK}")
    assert answer.headers["content-type"].startswith("text/html")
    assert "All fruit: 8" in answer.text
    assert asked.get(f"/api/print/{key_of('gone')}").status_code == 404


@pytest.mark.parametrize("code", sorted(language.LANGUAGES.keys() - {"en"}))
def test_the_printed_page_is_in_the_viewer_s_language_and_columns_are_in_english(
    asked: TestClient, code: str
) -> None:
    def texts(wanted: str) -> set[str]:
        page = asked.get(f"/api/print/{WALK}", headers={"accept-language": wanted}).text
        assert f'<html lang="{wanted}">' in page
        pieces = re.findall(r">([^<>]+)<", page.partition("<body>")[2])
        return {html.unescape(piece).strip() for piece in pieces} - {""}

    translated = language.catalogue(code).gettext
    english, shown = texts("en"), texts(code)
    # Nothing that the catalogue has stays English, unless the language has the same word.
    assert not {text for text in english & shown if translated(text) != text}
    assert {translated("Work"), translated("Remarks")} <= shown
    assert any(re.fullmatch(r"\d+,\d", text) for text in shown)
    assert not any(re.fullmatch(r"\d+\.\d", text) for text in shown)
    answer = asked.get(f"/api/files/{WALK}?formats=csv", headers={"accept-language": code})
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        head, line, *_ = archive.read("fruit.csv").decode("utf-8-sig").splitlines()
    assert "length_cm,at_least" in head
    assert "class " in line or "too " in line


def test_an_upload_is_kept_in_parts_and_measured_when_it_is_whole(asked: TestClient) -> None:
    resources.change_settings(upload_limit_mb=1)
    files = [{"name": "odd.png", "size": 13, "changed": 1.5}]
    begun = asked.post("/api/uploads", json={"round": WALK, "files": files}).json()
    assert begun["received"] == [0]
    place = f"/api/uploads/{begun['upload']}/0"
    assert asked.post(f"{place}?offset=0", content=b"MZ no").json() == {"received": 5}
    assert asked.post("/api/uploads", json={"round": WALK, "files": files}).json() == {
        **begun,
        "received": [5],
    }
    assert asked.post(f"{place}?offset=5", content=b" picture").json() == {"received": 13}
    wait_for_jobs()
    (upload,) = resources.uploads().all(WALK)
    assert upload.done
    assert [(one.name, one.saved) for one in upload.outcomes] == [("odd.png", False)]
    files[0]["size"] = 1_000_001
    refused = asked.post("/api/uploads", json={"round": WALK, "files": files})
    assert refused.status_code == 409
    assert "more than the 1 MB" in refused.json()["error"]
    for path in ("/api/uploads/..%2F..%2Fhouse/0?offset=0", f"{place}?offset=-1"):
        assert asked.post(path, content=b"x").status_code in (400, 404)


def test_the_printed_page_is_in_inches_where_they_are_chosen(
    asked: TestClient, store: Store
) -> None:
    store.correct(
        store.detections(WALK)[0].key,
        FruitRow(1, length=Length(0.241), flags="end-hidden", offset_m=0.0),
    )
    in_cm = asked.get(f"/api/print/{WALK}").text
    resources.change_settings(unit="in")
    page = asked.get(f"/api/print/{WALK}").text
    assert "at least 24.1 cm" in in_cm
    assert "at least 9.49 in" in page
    assert not re.findall(r"\bcm\b|\[m\]", re.sub(r"(?s)<style>.*</style>", "", page))
    figures = [re.findall(r"<b>([\d.]+) (?:cm|in)</b>", text) for text in (in_cm, page)]
    for length_cm, length_in in zip(*figures, strict=True):
        assert float(length_in) == pytest.approx(float(length_cm) / 2.54, abs=0.026)
    assert len(figures[0]) == 4  # mean, spread, shortest, longest
