"""Damage to a file: to its bytes, its lines, its cells, its numbers or its JSON values."""

from __future__ import annotations

import io
import json
import re
import sqlite3
import struct
import warnings
import zipfile
import zlib
from contextlib import closing
from copy import deepcopy
from typing import TYPE_CHECKING, Any

from tests.robustness.binary_numbers import changed_number

if TYPE_CHECKING:
    from collections.abc import Callable
    from random import Random

_PNG = b"\x89PNG\r\n\x1a\n"
_TEXTS = frozenset({"json", "jsonl", "csv", "txt", "toml", "yaml", "xml"})
_HUGE_CELL = 200_000  # beyond what Python's csv reads in one cell
_BOUNDARIES = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)

# What stands in JSON for values that Python's own writer would refuse to write.
_RAW = {
    "@digits": "9" * 6000,
    "@deep list": "[" * 50_000 + "]" * 50_000,
    "@deep object": '{"a":' * 5000 + "1" + "}" * 5000,
    "@huge": "1e400",
    "@half a letter": '"\\ud800"',
    "@hundreds of digits": "9" * 400,
    "@minus hundreds of digits": "-" + "9" * 400,
}
_NUMBERS = (
    *("@huge", "@digits", "@hundreds of digits", "@minus hundreds of digits", 0, -1, 2**31, 2**63),
    *(5e-324, 1e-300, 1e-30, 1e30, 1e300, 1.7e308, -1e-300, -1e300, float("nan"), float("-inf")),
)
"""Numbers at the ends of what a float, an integer and JSON hold."""
_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2, 0.5, -0.5, 1e-300, 1e308, -1e308, 2**31, 2**63, 2**64),
    *(
        10**30,
        10**400,
        1e300,
        float("nan"),
        float("inf"),
        "",
        "x",
        "0",
        "-1",
        "1e9",
        "\0",
        "Gürkchen 黄瓜 🥒",
    ),
    *("x" * 400, "../" * 20 + "etc/passwd", "a/b\\c", "=1+1", [], {}, [[]], [{}], [None], {"": 0}),
    *([0] * 3, [1e308] * 6, ["a", 1], *_RAW),
)
_CELLS = (None, 0, -1, 1e308, 2**62, "", "x" * 400, b"\xff\0", "2999-99-99", "nan")
_NO_TEXTS = ("ff", "c3", "eda080", "00", "efbfbf")  # hexadecimal; no UTF-8, or none to be written
_WORDS = (
    *("", "0", "-1", "1e400", "nan", "inf", "9" * 6000, "1,5", "1.234,5", "'", '"', '"""', "=1"),
    *("9" * 400, "-" + "9" * 400, "1e-300", "1e300", "-1e300", "5e-324"),
    *("x" * 400, "true", "[]", "{}", "#", ";", "\t", "\0", "é", "²", "१", "0x10", "1_000", "None"),
)


def damaged(data: bytes, ending: str, random: Random) -> bytes:
    """Return a file's bytes with one to three kinds of damage.

    Parameters
    ----------
    data : bytes
        The whole file.
    ending : str
        Its name's ending without the dot, which says what damage reaches deep.
    random : Random
        Chooses; the same state gives the same damage.

    Examples
    --------
    >>> from random import Random
    >>> damaged(b'{"a": 1}', "json", Random(2)) == damaged(b'{"a": 1}', "json", Random(2))
    True
    """
    for _ in range(random.choice((1, 1, 1, 2, 2, 3))):
        data = random.choice(_kinds(ending, data))(data, random)
    return data


def _kinds(ending: str, data: bytes) -> tuple[Callable[[bytes, Random], bytes], ...]:
    raw = (_flip, _cut, _boundary, _copy_piece, _zeros)
    if ending == "json":
        return (*[_json] * 8, *[_number] * 4, _word, _encoding, _flip, _cut)
    if ending == "jsonl":
        return (*[_json_line] * 6, _word, _lines, _encoding, _flip, _cut)
    if ending == "yaml" and b"&a" not in data:
        return (*[_word] * 5, _lines, _cells, _aliases, _encoding, _flip, _cut)
    if ending in _TEXTS:
        return (*[_word] * 5, _lines, _cells, _cells, _encoding, _flip, _cut, _copy_piece)
    if ending == "db":
        return (*[_row] * 6, *[_no_text] * 2, *raw)
    if ending == "onnx":
        return (*[_network_number] * 6, *raw)
    if ending == "db3":
        return (*[_recording_number] * 6, _row, *raw)
    if data.startswith(_PNG):
        return (*[_png] * 4, *raw)
    if data.startswith(b"\xff\xd8"):
        return (*[_jpeg_head] * 2, *raw)
    if data.startswith((b"II*\0", b"MM\0*")):
        return (*[_tiff_head] * 3, *raw)
    if ending == "npz":
        return (*[_numpy_head] * 3, *[_members] * 3, *raw, _word)
    if data.startswith((b"\x93NUMPY", b"PK")):
        return (*[_numpy_head] * 3, *raw, _word, _member)
    return raw


def _place(data: bytes, random: Random, size: int = 1) -> int:
    # Heads say sizes and kinds: half of all damage goes there.
    reach = min(len(data), 256) if random.random() < 0.5 else len(data)
    return random.randrange(max(1, reach - size + 1))


def _flip(data: bytes, random: Random) -> bytes:
    broken = bytearray(data)
    for _ in range(random.choice((1, 1, 2, 8)) if broken else 0):
        broken[_place(data, random)] ^= 1 << random.randrange(8)
    return bytes(broken)


def _cut(data: bytes, random: Random) -> bytes:
    return data[: random.choice((0, 1, len(data) - 1, random.randrange(len(data) + 1)))]


def _boundary(data: bytes, random: Random) -> bytes:
    value, size = random.choice(_BOUNDARIES), random.choice((1, 2, 4, 4, 8))
    number = int(value & ((1 << 8 * size) - 1)).to_bytes(size, random.choice(("big", "little")))
    at = _place(data, random, size)
    return data[:at] + number + data[at + size :]


def _copy_piece(data: bytes, random: Random) -> bytes:
    start = _place(data, random)
    piece = data[start : start + random.choice((1, 4, 16, 64, 1024))]
    at = _place(data, random)
    return data[:at] + piece * random.choice((1, 1, 2, 50)) + data[at:]


def _zeros(data: bytes, random: Random) -> bytes:
    at, size = _place(data, random), random.choice((1, 4, 16, 256))
    return data[:at] + bytes(min(size, len(data) - at)) + data[at + size :]


def _png(data: bytes, random: Random) -> bytes:
    """Damage one chunk and make its checksum right again, so that a decoder goes on to read it."""
    chunks, at = [], len(_PNG)
    while at + 12 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    if not chunks:
        return _flip(data, random)
    k = 0 if random.random() < 0.6 else random.randrange(len(chunks))
    name, body = chunks[k]
    if name == b"IHDR" and len(body) == 13:
        sides = (0, 1, 2, 1000, 20_000, 65_535, 2**20, 2**31 - 1, 2**32 - 1)
        head = list(struct.unpack(">IIBBBBB", body))
        which = random.randrange(7)
        head[which] = random.choice(sides if which < 2 else (0, 1, 2, 3, 4, 6, 8, 16, 255))
        body = struct.pack(">IIBBBBB", *head)
    else:
        body = random.choice((_flip, _cut, _zeros))(body, random)
    chunks[k] = name, body
    written = (
        len(body).to_bytes(4, "big") + name + body + zlib.crc32(name + body).to_bytes(4, "big")
        for name, body in chunks
    )
    return _PNG + b"".join(written)


def _jpeg_head(data: bytes, random: Random) -> bytes:
    """Change the height or the width that a JPEG's head says."""
    head = re.search(rb"\xff[\xc0-\xc2]..\x08", data, re.DOTALL)
    if head is None:
        return _flip(data, random)
    at = head.end() + random.choice((0, 2))
    side = random.choice((0, 1, 2, 1000, 20_000, 65_535))
    return data[:at] + side.to_bytes(2, "big") + data[at + 2 :]


def _tiff_head(data: bytes, random: Random) -> bytes:
    """Change, double or remove one tag of a TIFF's first directory."""
    order: Any = "little" if data.startswith(b"II") else "big"
    start = int.from_bytes(data[4:8], order)
    count = int.from_bytes(data[start : start + 2], order)
    if not 0 < count < 200:
        return _flip(data, random)
    at = start + 2 + 12 * random.randrange(count)
    tag = bytearray(data[at : at + 12])
    what = random.randrange(4)
    if what == 0:  # its value: a size, a place or a kind
        value = random.choice((0, 1, 65_535, 2**20, 2**31 - 1, 2**32 - 1))
        tag[8:12] = value.to_bytes(4, order)
    elif what == 1:  # how many values it has
        tag[4:8] = random.choice((0, 2, 2**31, 2**32 - 1)).to_bytes(4, order)
    elif what == 2:  # its type
        tag[2:4] = random.choice((0, 1, 2, 3, 4, 5, 11, 12, 13, 999)).to_bytes(2, order)
    else:  # said twice
        tag = bytearray(data[start + 2 : start + 14])
    return data[:at] + bytes(tag) + data[at + 12 :]


def _members(data: bytes, random: Random) -> bytes:
    """Rename, double or drop a member of an archive of arrays, or put one in that is none."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [(one.filename, archive.read(one)) for one in archive.infolist()]
    except (zipfile.BadZipFile, OSError, EOFError, ValueError, NotImplementedError, zlib.error):
        return _flip(data, random)
    if not members:
        return _flip(data, random)
    k = random.randrange(len(members))
    name, body = members[k]
    names = (name.removesuffix(".npy"), f"{name}.txt", "a/", "../x.npy", "depth.NPY", "²" * 80)
    what = random.randrange(5)
    if what == 0:
        members[k] = random.choice(names), body
    elif what == 1:
        members.append((name, body))
    elif what == 2:
        members.append((random.choice(names), random.choice((b"", b"no array", body[:40]))))
    elif what == 3:
        del members[k]
    else:
        members[k] = name, _numpy_head(body, random)
    out = io.BytesIO()
    with warnings.catch_warnings(action="ignore"), zipfile.ZipFile(out, "w") as archive:
        for one, content in members:
            archive.writestr(one, content)
    return out.getvalue()


def _numpy_head(data: bytes, random: Random) -> bytes:
    """Change what an array's head says, at the same length."""
    heads = list(re.finditer(rb"\{'descr': .*?\}[ ]*\n", data))
    if not heads:
        return _flip(data, random)
    head = random.choice(heads)
    text = head.group().decode("latin-1").rstrip()
    shapes = ("(9999999, 9999999)", "(-4, 2)", "(4,)", "()", "(0, 5)", "(2**40,)", "(3, 3, 3, 3)")
    kinds = ("'<f8'", "'|O'", "'<U4'", "'<M8[s]'", "'|V8'", "'>u2'", "'|b1'", "'<c16'", "[]", "1")
    if random.random() < 0.5:
        text = re.sub(r"\([^)]*\)", random.choice(shapes), text, count=1)
    else:
        text = re.sub(r"'descr': [^,]*,", f"'descr': {random.choice(kinds)},", text, count=1)
    room = len(head.group())
    put = text.encode("latin-1")[: room - 1].ljust(room - 1) + b"\n"
    return data[: head.start()] + put + data[head.end() :]


def _member(data: bytes, random: Random) -> bytes:
    """Call the members of a zip something else."""
    return data.replace(b".npy", random.choice((b".txt", b".NPY", b"/npy", b".pkl")))


def _word(data: bytes, random: Random) -> bytes:
    words = list(re.finditer(rb"[^\s,;:=\[\]{}\"']+", data))
    if not words:
        return _flip(data, random)
    one = random.choice(words)
    put = random.choice(_WORDS).encode()
    if random.random() < 0.2:
        put = random.choice(words).group()
    return data[: one.start()] + put + data[one.end() :]


def _lines(data: bytes, random: Random) -> bytes:
    lines = data.split(b"\n")
    k = random.randrange(len(lines))
    what = random.randrange(5)
    if what == 0:
        del lines[k]
    elif what == 1:
        lines.insert(k, random.choice(lines))
    elif what == 2:
        random.shuffle(lines)
    elif what == 3:
        lines[k] = b""
    else:
        lines[k] = lines[k] * random.choice((2, 100))
    return b"\n".join(lines)


def _cells(data: bytes, random: Random) -> bytes:
    what = random.randrange(6)
    if what == 0:
        return data.replace(b"\r\n", b"\n").replace(b"\n", b"\r")  # as old Macs end lines
    if what == 1:
        at = _place(data, random)
        return data[:at] + b"x" * _HUGE_CELL + data[at:]
    separator = random.choice((b",", b";", b"\t", b" "))
    if what == 2:
        return data.replace(b",", separator)
    places = [m.start() for m in re.finditer(re.escape(separator), data)] or [0]
    at = random.choice(places)
    if what == 3:
        return data[:at] + separator * random.choice((1, 2, 200)) + data[at:]
    if what == 4:
        return data[:at] + data[at + 1 :]
    return data[: at + 1] + b'"' + data[at + 1 :]


def _encoding(data: bytes, random: Random) -> bytes:
    text = data.decode("utf-8", errors="replace")
    what = random.randrange(5)
    if what == 0:
        return text.encode("utf-16")
    if what == 1:
        return b"\xef\xbb\xbf" + data
    if what == 2:  # what an editor set to "ANSI" saves
        return re.sub(r"[a-z](?=[a-z])", "ü", text, count=3).encode("cp1252", errors="replace")
    if what == 3:
        return data.replace(b"\n", b"\r\n")
    at = _place(data, random)
    return data[:at] + random.choice((b"\xff", b"\xc3", b"\0", "\u2028".encode())) + data[at:]


def _aliases(data: bytes, random: Random) -> bytes:
    """Put in lists of lists of lists that are small in the file and large when written out."""
    lists = ["&a [x, x, x, x, x, x, x, x, x]"]
    lists += [f"&{chr(98 + k)} [{', '.join([f'*{chr(97 + k)}'] * 9)}]" for k in range(8)]
    key = random.choice(("x", "names", "train", "kpt_shape", "path"))
    return data + f"\nbomb: [{', '.join(lists)}]\n{key}: *i\n".encode()


def _row(data: bytes, random: Random) -> bytes:
    """Change one value of an SQLite file to another that its column allows or not."""

    def change(connection: sqlite3.Connection, table: str, columns: list[tuple[str, str]]) -> None:
        column, _ = random.choice(columns)
        if random.random() < 0.05:
            connection.execute(f'ALTER TABLE "{table}" DROP COLUMN "{column}"')
        value = random.choice((*_CELLS, *(json.dumps(v) for v in _VALUES if v == v)))
        if isinstance(value, str):
            value = _RAW.get(value.strip('"'), value)
        connection.execute(f'UPDATE "{table}" SET "{column}" = ?', (value,))

    return _in_table(data, random, change)


def _no_text(data: bytes, random: Random) -> bytes:
    """Put bytes that are no text into a text column of an SQLite file."""

    def change(connection: sqlite3.Connection, table: str, columns: list[tuple[str, str]]) -> None:
        texts = [name for name, kind in columns if "CHAR" in kind or "TEXT" in kind]
        column, put = random.choice(texts), random.choice(_NO_TEXTS)
        connection.execute(f'UPDATE "{table}" SET "{column}" = CAST(x\'{put}\' AS TEXT)')

    return _in_table(data, random, change)


def _in_table(
    data: bytes,
    random: Random,
    change: Callable[[sqlite3.Connection, str, list[tuple[str, str]]], None],
) -> bytes:
    """Change a table of an SQLite file, drawn at random; given names and types of its columns."""
    head = bytearray(data)
    if len(head) > 20:
        head[18:20] = b"\1\1"  # in memory there is no write-ahead log
    try:
        with closing(sqlite3.connect(":memory:")) as connection:
            connection.deserialize(bytes(head))
            connection.execute("PRAGMA ignore_check_constraints = ON")
            tables = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
            table = random.choice([name for (name,) in tables.fetchall()])
            columns = connection.execute(f'PRAGMA table_info("{table}")').fetchall()
            change(connection, table, [(name, kind) for _, name, kind, *_ in columns])
            connection.commit()
            return bytes(connection.serialize())
    # SQLite calls damage a lack of memory too, and quotes damaged names, which are no text.
    except (sqlite3.Error, IndexError, OverflowError, MemoryError, UnicodeError):
        return _flip(data, random)


def _number(data: bytes, random: Random) -> bytes:
    """Change one number, in a list of numbers or alone, to one at the ends of its kind."""
    try:
        tree = [json.loads(data)]
    except (ValueError, RecursionError):
        return _flip(data, random)
    places: list[tuple[Any, Any]] = []
    waiting: list[Any] = [tree]
    while waiting:
        node = waiting.pop()
        for key, value in list(node.items() if isinstance(node, dict) else enumerate(node))[:400]:
            if isinstance(value, dict | list):
                waiting.append(value)
            elif isinstance(value, int | float) and not isinstance(value, bool):
                places.append((node, key))
    if not places:
        return _flip(data, random)
    node, key = random.choice(places)
    node[key] = random.choice(_NUMBERS)
    return _written(tree[0]).encode("utf-8", errors="replace")


def _network_number(data: bytes, random: Random) -> bytes:
    return _binary_number(data, "onnx", random)


def _recording_number(data: bytes, random: Random) -> bytes:
    return _binary_number(data, "db3", random)


def _binary_number(data: bytes, ending: str, random: Random) -> bytes:
    """Change one number where the rest of a binary file stays valid."""
    integer = random.choice((*_BOUNDARIES, -1, -(2**63), 2**63 - 1, 3, 16))
    real = random.choice((0.0, -1.0, 1e-38, 3e38, -3e38, 1e300, float("nan"), float("inf")))
    word = random.choice(_WORDS)
    return changed_number(data, ending, random.randrange, integer, real, word) or _flip(
        data, random
    )


def _json(data: bytes, random: Random) -> bytes:
    """Change values or keys somewhere in the tree."""
    try:
        tree = [json.loads(data)]
    except (ValueError, RecursionError):
        return _flip(data, random)
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        _change(tree, random)
    return _written(tree[0]).encode("utf-8", errors="replace")


def _json_line(data: bytes, random: Random) -> bytes:
    lines = data.split(b"\n")
    k = random.randrange(len(lines))
    lines[k] = _json(lines[k], random) if lines[k] else b"{}"
    return b"\n".join(lines)


def _change(tree: list[Any], random: Random) -> None:
    places: list[tuple[Any, Any]] = []
    waiting: list[Any] = [tree]
    while waiting:
        node = waiting.pop()
        found = list(node.items()) if isinstance(node, dict) else list(enumerate(node))
        places += [(node, key) for key, _ in found]
        # A list of a thousand numbers is one place more, not a thousand.
        waiting += [value for _, value in found[:40] if isinstance(value, dict | list) and value]
    node, key = random.choice(places)
    what = random.random()
    if what < 0.6 or node is tree:
        # What is changed again must not be shared.
        node[key] = deepcopy(random.choice(_VALUES))
    elif what < 0.75:
        del node[key]
    elif what < 0.85:
        other, at = random.choice(places)
        node[key] = json.loads(_written(other[at])) if _is_plain(other[at]) else None
    elif isinstance(node, dict):
        node[random.choice(("", "x" * 400, "unknown", "@digits"))] = deepcopy(node[key])
    else:
        node[key:key] = [deepcopy(node[key])] * random.choice((1, 2, 1000))


def _is_plain(value: Any) -> bool:
    return not any(name in str(value) for name in ("@", "nan", "inf"))


def _written(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    for name, raw in _RAW.items():
        text = text.replace(f'"{name}"', raw) if f'"{name}":' not in text else text
    return text
