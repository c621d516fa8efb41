"""Damage to a file that Hypothesis draws: its bytes, its words, or the values of its JSON tree."""

from __future__ import annotations

import json
import re
import zlib
from typing import Any

from hypothesis import strategies as st

_PNG = b"\x89PNG\r\n\x1a\n"
_NUMBERS = st.one_of(
    st.sampled_from([0, -1, 5e-324, 1e-300, 1e300, 2**31, 2**63, 10**399, -(10**399)]),
    st.floats(),
    st.integers(),
)
_VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), _NUMBERS, st.text()),
    lambda inner: st.one_of(st.lists(inner), st.dictionaries(st.text(), inner)),
    max_leaves=8,
)
_WORDS = st.one_of(st.text(), _NUMBERS.map(repr), st.integers(0, 400).map("9".__mul__))


def damaged(data: bytes, ending: str, draw: Any) -> bytes:
    """Return a file's bytes with one to three changes; `ending` is its name's, without the dot."""
    for _ in range(draw(st.integers(1, 3))):
        if draw(st.integers(0, 3)) == 0:
            data = _bytes(data, draw)
        elif ending == "json":
            data = _tree(data, draw)
        elif data.startswith(_PNG):
            data = _chunk(data, draw)
        elif ending in ("csv", "txt", "toml", "yaml"):
            data = _word(data, draw)
        else:
            data = _bytes(data, draw)
    return data


def _bytes(data: bytes, draw: Any) -> bytes:
    start = draw(st.integers(0, len(data)))
    stop = draw(st.one_of(st.just(len(data)), st.integers(start, min(len(data), start + 16))))
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
    spans = [match.span() for match in re.finditer(rb"[^\s,;:=\[\]{}\"'<>]+", data)]
    if not spans:
        return _bytes(data, draw)
    start, stop = draw(st.sampled_from(spans))
    word: str = draw(_WORDS)
    return data[:start] + word.encode(errors="surrogatepass") + data[stop:]


def _chunk(data: bytes, draw: Any) -> bytes:
    """Change a chunk of a PNG, with the checksum that fits."""
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
