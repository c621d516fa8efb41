"""Damage to a file that Hypothesis draws: any values in its tree, words, cells or bytes.

A second generator beside `mutations`, which takes nothing from it: values, places and lengths are
Hypothesis's own.
"""

from __future__ import annotations

import io
import json
import re
import sqlite3
import zipfile
import zlib
from contextlib import closing
from typing import Any

from hypothesis import strategies as st
from tests.robustness.binary_numbers import changed_number

_PNG = b"\x89PNG\r\n\x1a\n"
_LEAVES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.integers(-(10**400), 10**400),
    st.floats(),
    st.text(),
)
_VALUES = st.recursive(
    _LEAVES,
    lambda inner: st.one_of(st.lists(inner), st.dictionaries(st.text(), inner)),
    max_leaves=8,
)
_WORDS = st.one_of(
    st.text(), st.floats().map(repr), st.integers().map(str), st.integers(0, 400).map("9".__mul__)
)
_CELLS = st.one_of(st.none(), st.integers(-(2**63), 2**63 - 1), st.floats(), st.text(), st.binary())


def drawn_damage(data: bytes, ending: str, draw: Any) -> bytes:
    """Return a file's bytes with one to three changes that Hypothesis draws.

    Parameters
    ----------
    data : bytes
        The whole file.
    ending : str
        Its name's ending without the dot.
    draw : callable
        Of `hypothesis.strategies.data`: strategy to value.
    """
    for _ in range(draw(st.integers(1, 3))):
        data = _changed(data, ending, draw)
    return data


def _changed(data: bytes, ending: str, draw: Any) -> bytes:
    deep = draw(st.integers(0, 3))
    if deep == 0:
        return _bytes(data, draw)
    if ending == "json":
        return _tree(data, draw)
    if ending == "jsonl":
        lines = data.split(b"\n")
        k = draw(st.integers(0, len(lines) - 1))
        lines[k] = _tree(lines[k], draw)
        return b"\n".join(lines)
    if ending == "db":
        return _cell(data, draw)
    if ending in ("onnx", "db3"):
        return _binary_number(data, ending, draw)
    if data.startswith(_PNG):
        return _chunk(data, draw)
    if ending in ("zip", "npz"):
        return _member(data, draw)
    if ending in ("csv", "txt", "toml", "yaml", "xml"):
        return _word(data, draw)
    return _bytes(data, draw)


def _bytes(data: bytes, draw: Any) -> bytes:
    start = draw(st.integers(0, len(data)))
    stop = draw(st.integers(start, min(len(data), start + 16)))
    put: bytes = draw(st.binary(max_size=16))
    return data[:start] + put + data[stop:]


def _tree(data: bytes, draw: Any) -> bytes:
    """Change, remove or add one value anywhere in a JSON tree."""
    try:
        tree = [json.loads(data)]
    except (ValueError, RecursionError):
        return _bytes(data, draw)
    places: list[tuple[Any, Any]] = []
    waiting: list[Any] = [tree]
    while waiting:
        node = waiting.pop()
        items = list(node.items() if isinstance(node, dict) else enumerate(node))[:100]
        places += [(node, key) for key, _ in items]
        waiting += [value for _, value in items if isinstance(value, dict | list)]
    node, key = places[draw(st.integers(0, len(places) - 1))]
    what = draw(st.sampled_from(("value", "value", "value", "remove", "add")))
    if what == "value" or node is tree:
        node[key] = draw(_VALUES)
    elif what == "remove":
        del node[key]
    elif isinstance(node, dict):
        node[draw(st.text())] = draw(_VALUES)
    else:
        node.insert(key, draw(_VALUES))
    return json.dumps(tree[0], ensure_ascii=draw(st.booleans())).encode(errors="surrogatepass")


def _word(data: bytes, draw: Any) -> bytes:
    spans = [one.span() for one in re.finditer(rb"[^\s,;:=\[\]{}\"'<>]+", data)]
    if not spans:
        return _bytes(data, draw)
    start, stop = spans[draw(st.integers(0, len(spans) - 1))]
    word: str = draw(_WORDS)
    return data[:start] + word.encode(errors="surrogatepass") + data[stop:]


def _chunk(data: bytes, draw: Any) -> bytes:
    """Change one chunk of a PNG, with the checksum that fits."""
    chunks, at = [], len(_PNG)
    while at + 12 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    if not chunks:
        return _bytes(data, draw)
    k = draw(st.integers(0, len(chunks) - 1))
    chunks[k] = chunks[k][0], _bytes(chunks[k][1], draw)
    return _PNG + b"".join(
        len(body).to_bytes(4, "big") + name + body + zlib.crc32(name + body).to_bytes(4, "big")
        for name, body in chunks
    )


def _member(data: bytes, draw: Any) -> bytes:
    """Change one member's name or bytes, in an archive that is whole."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [(one.filename, archive.read(one)) for one in archive.infolist()]
    except (zipfile.BadZipFile, OSError, EOFError, ValueError, NotImplementedError, zlib.error):
        return _bytes(data, draw)
    if not members:
        return _bytes(data, draw)
    k = draw(st.integers(0, len(members) - 1))
    name, body = members[k]
    if draw(st.booleans()):
        members[k] = name, _bytes(body, draw)
    else:
        members[k] = draw(st.text(st.characters(codec="utf-8"), min_size=1, max_size=60)), body
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for one, content in dict(members).items():
            archive.writestr(one, content)
    return out.getvalue()


def _binary_number(data: bytes, ending: str, draw: Any) -> bytes:
    """Change one number where the rest of a binary file stays valid."""

    def pick(count: int) -> int:
        return int(draw(st.integers(0, count - 1)))

    integer, real = draw(st.integers(-(2**63), 2**64 - 1)), draw(st.floats())
    changed = changed_number(data, ending, pick, integer, real, draw(_WORDS))
    return _bytes(data, draw) if changed is None else changed


def _cell(data: bytes, draw: Any) -> bytes:
    """Put a value of any kind into a column of an SQLite file."""
    head = bytearray(data)
    head[18:20] = b"\1\1"  # in memory there is no write-ahead log
    try:
        with closing(sqlite3.connect(":memory:")) as connection:
            connection.deserialize(bytes(head))
            connection.execute("PRAGMA ignore_check_constraints = ON")
            found = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
            tables = sorted(name for (name,) in found)
            table = tables[draw(st.integers(0, len(tables) - 1))]
            columns = connection.execute(f'PRAGMA table_info("{table}")').fetchall()
            column = columns[draw(st.integers(0, len(columns) - 1))][1]
            value = draw(st.one_of(_CELLS, _VALUES.map(json.dumps)))
            connection.execute(f'UPDATE "{table}" SET "{column}" = ?', (value,))
            connection.commit()
            return bytes(connection.serialize())
    except (sqlite3.Error, IndexError, UnicodeError):
        return _bytes(data, draw)
