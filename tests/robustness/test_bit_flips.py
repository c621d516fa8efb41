"""A flipped bit of a store is noticed, or changes nothing; the script's own parts."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from tests.robustness.bit_flips import flip, lines_in, make_store, outcome_of, pages_of, try_flips

from cucumbervision_greenhouse.store.repository import open_store
from cucumbervision_greenhouse.store.schema import Base


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("store") / "house.db"
    make_store(made)
    return made


def test_every_table_has_lines_to_damage(file: Path) -> None:
    lines = lines_in(file)
    assert lines is not None
    assert all(lines[name] for name in Base.metadata.tables)
    assert set(Base.metadata.tables) <= set(pages_of(file))


@pytest.mark.parametrize("name", sorted({*Base.metadata.tables} - {"stops", "actions"}))
def test_a_changed_value_of_each_table_is_noticed(name: str, file: Path, tmp_path: Path) -> None:
    shutil.copytree(file.parent, tmp_path / "store")
    copy = tmp_path / "store" / file.name
    with closing(sqlite3.connect(copy)) as connection:
        [*_, column] = [row[1] for row in connection.execute(f"PRAGMA table_info({name})")]
        connection.execute(f"UPDATE {name} SET {column} = 'x' || {column}")
        connection.commit()
    whole = lines_in(file)
    assert whole is not None
    with open_store(copy, images=copy.parent / "pictures") as store:
        assert outcome_of(store, copy, whole) in ("noticed", "refused")


def test_flipping_misses_nothing() -> None:
    counts = try_flips(20, seed=3)
    total = {word: sum(one[word] for one in counts.values()) for word in ("missed", "noticed")}
    assert total["missed"] == 0
    assert total["noticed"] > 0


def test_one_bit_is_flipped() -> None:
    from random import Random

    data = bytes(8192)
    changed = [a ^ b for a, b in zip(data, flip(data, 1, 4096, Random(1)), strict=True)]
    assert [bin(one).count("1") for one in changed if one] == [1]
    assert not any(changed[:4096])
