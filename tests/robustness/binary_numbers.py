"""Change one number inside an ONNX network or a recording; the rest of the file stays valid.

Bytes changed at random mostly break the structure of such a file, which is then refused at once.
What a reader does with a weight that is not finite, a negative size or a time in another century
is only tried where the structure holds.
"""

from __future__ import annotations

import re
import sqlite3
import struct
from contextlib import closing
from typing import TYPE_CHECKING, Any

import numpy as np
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    Pick = Callable[[int], int]

_CDR_HEAD = 4  # bytes before a ROS message, which say its byte order
_STRING = "std_msgs/msg/String"


def changed_number(
    data: bytes, ending: str, pick: Pick, integer: int, real: float, word: str
) -> bytes | None:
    """Return a file with one number changed.

    Parameters
    ----------
    data : bytes
        An ONNX network or a recording (a ROS 2 bag in SQLite).
    ending : str
        'onnx' or 'db3'.
    pick : callable
        Returns an index below its argument.
    integer, real, word : int, float, str
        What is put in place of an integer, a floating-point number or a number in a text.

    Returns
    -------
    bytes or None
        None if the file is already too damaged to find a number in it.
    """
    change = {"onnx": _network, "db3": _recording}[ending]
    return change(data, pick, integer, real, word)


def _network(data: bytes, pick: Pick, integer: int, real: float, word: str) -> bytes | None:
    import onnx

    model = onnx.ModelProto()
    try:
        model.ParseFromString(data)
    except DecodeError:
        return None
    integer = (integer + 2**63) % 2**64 - 2**63
    places = list(_network_places(model, integer, real, word))
    if not places:
        return None
    places[pick(len(places))](pick)
    return bytes(model.SerializeToString())


def _network_places(
    model: Any, integer: int, real: float, word: str
) -> Iterator[Callable[[Pick], None]]:
    """Yield functions, each of which changes one kind of number of one part of a network."""

    def element(numbers: Any, value: Any) -> Callable[[Pick], None]:
        def change(pick: Pick) -> None:
            numbers[pick(len(numbers))] = value

        return change

    def field(message: Any, name: str, value: Any) -> Callable[[Pick], None]:
        return lambda _: setattr(message, name, value)

    def weight(tensor: Any) -> Callable[[Pick], None]:
        def change(pick: Pick) -> None:
            weights = np.frombuffer(tensor.raw_data, np.float32).copy()
            with np.errstate(over="ignore"):
                weights[pick(weights.size)] = real
            tensor.raw_data = weights.tobytes()

        return change

    yield field(model, "ir_version", integer)
    for opset in model.opset_import:
        yield field(opset, "version", integer)
    for entry in model.metadata_props:
        yield field(entry, "value", word)
    for tensor in model.graph.initializer:
        if tensor.dims:
            yield element(tensor.dims, integer)
        if tensor.data_type == 1 and len(tensor.raw_data) >= 4 and len(tensor.raw_data) % 4 == 0:
            yield weight(tensor)
        yield field(tensor, "data_type", integer % 32)
    for value in (*model.graph.input, *model.graph.output):
        for dimension in value.type.tensor_type.shape.dim:
            yield field(dimension, "dim_value", integer)
    for node in model.graph.node:
        for attribute in node.attribute:
            if attribute.ints:
                yield element(attribute.ints, integer)
            if attribute.floats:
                yield element(attribute.floats, real)
            yield field(attribute, "i", integer)
            yield field(attribute, "f", real)


def _recording(data: bytes, pick: Pick, integer: int, real: float, word: str) -> bytes | None:
    head = bytearray(data)
    if len(head) > 20:
        head[18:20] = b"\1\1"  # in memory there is no write-ahead log
    try:
        with closing(sqlite3.connect(":memory:")) as connection:
            connection.deserialize(bytes(head))
            rows = connection.execute(
                "SELECT messages.id, type, timestamp, data FROM messages"
                " JOIN topics ON topics.id = topic_id ORDER BY messages.id"
            ).fetchall()
            key, kind, time_ns, message = rows[pick(len(rows))]
            if pick(6) == 0:
                time_ns = (integer + 2**63) % 2**64 - 2**63
            elif kind == _STRING:
                message = _text(message, pick, word)
            else:
                message = _binary(message, pick, integer, real)
            connection.execute(
                "UPDATE messages SET timestamp = ?, data = ? WHERE id = ?", (time_ns, message, key)
            )
            connection.commit()
            return bytes(connection.serialize())
    except (sqlite3.Error, IndexError, TypeError, ValueError, OverflowError, MemoryError):
        return None


def _text(message: bytes, pick: Pick, word: str) -> bytes:
    """Change a number in a text message, whose length stands before it."""
    text = message[_CDR_HEAD + 4 :].rstrip(b"\0")
    spans = [number.span() for number in re.finditer(rb"-?\d[\d.e+-]*", text)] or [(0, 0)]
    start, stop = spans[pick(len(spans))]
    put = word.encode(errors="surrogatepass").replace(b"\0", b"")
    text = text[:start] + put + text[stop:] + b"\0"
    return message[:_CDR_HEAD] + struct.pack("<I", len(text)) + text


def _binary(message: bytes, pick: Pick, integer: int, real: float) -> bytes:
    """Change an aligned number of a message: a double, or an integer of four bytes."""
    body = bytearray(message[_CDR_HEAD:])
    if pick(2) and len(body) >= 8:
        place = 8 * pick(len(body) // 8)
        body[place : place + 8] = struct.pack("<d", real)
    else:
        place = 4 * pick(len(body) // 4)
        body[place : place + 4] = struct.pack("<I", integer % 2**32)
    return message[:_CDR_HEAD] + bytes(body)
