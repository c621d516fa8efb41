"""Read and write the protocol buffer of ONNX files: external files, loops, small networks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

_Kind: TypeAlias = Literal[
    "model", "training", "graph", "node", "attribute", "tensor", "sparse", "function", "entry"
]
# Nested messages by field number (onnx.proto, IR version 13) on the path to a tensor.
_PARTS: dict[_Kind, dict[int, _Kind]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "function": {7: "node", 11: "attribute"},
    "sparse": {1: "tensor", 2: "tensor"},
    "tensor": {13: "entry"},
    "entry": {},
}
_VARINT, _EIGHT_BYTES, _LENGTH, _FOUR_BYTES = 0, 1, 2, 5
_DEEPEST = 64


def external_files(network: bytes) -> list[str]:
    r"""Return the files that an ONNX network's tensors are stored in, beside itself.

    The runtimes would read each of these files, at any location.

    Parameters
    ----------
    network : bytes
        The ONNX file.

    Returns
    -------
    list of str
        `TensorProto.external_data`, key 'location'; an empty name where a tensor is stored
        elsewhere and does not say where.

    Raises
    ------
    ValueError
        If it is no protocol buffer.

    Examples
    --------
    >>> location = b"\x0a\x08location\x12\x05w.bin"
    >>> tensor = b"\x6a" + bytes([len(location)]) + location
    >>> graph = b"\x2a" + bytes([len(tensor)]) + tensor
    >>> external_files(b"\x3a" + bytes([len(graph)]) + graph)
    ['w.bin']
    """
    return list(_locations(memoryview(network), "model", 0))


def has_loop(network: bytes) -> bool:
    """Return whether an ONNX network has a node `Loop`, which may run without end.

    Raises
    ------
    ValueError
        If it is no protocol buffer.
    """
    return "Loop" in _operators(memoryview(network), "model", 0)


def _operators(message: memoryview, kind: _Kind, depth: int) -> Iterator[str]:
    if depth > _DEEPEST:
        raise ValueError("its graphs are nested too deeply")
    for number, value in _fields(message):
        if isinstance(value, int):
            continue
        if kind == "node" and number == 4:  # op_type
            yield bytes(value).decode("utf-8", "replace")
        elif (part := _PARTS[kind].get(number)) and part not in ("tensor", "sparse"):
            yield from _operators(value, part, depth + 1)


def _locations(message: memoryview, kind: _Kind, depth: int) -> Iterator[str]:
    if depth > _DEEPEST:
        raise ValueError("its graphs are nested too deeply")
    parts = _PARTS[kind]
    for number, value in _fields(message):
        if isinstance(value, int):
            if kind == "tensor" and number == 14 and value == 1:  # data_location EXTERNAL
                yield ""
        elif part := parts.get(number):
            if part == "entry":
                yield from _location(value)
            else:
                yield from _locations(value, part, depth + 1)


def _location(entry: memoryview) -> Iterator[str]:
    words = {
        number: bytes(value).decode("utf-8", "replace")
        for number, value in _fields(entry)
        if not isinstance(value, int)
    }
    if words.get(1) == "location":
        yield words.get(2, "")


def _fields(message: memoryview) -> Iterator[tuple[int, memoryview | int]]:
    """Return a message's fields: number, and bytes or number; fixed-size numbers as bytes."""
    position = 0
    while position < len(message):
        key, position = _varint(message, position)
        number, wire = key >> 3, key & 7
        if wire == _VARINT:
            value, position = _varint(message, position)
            yield number, value
            continue
        if wire == _LENGTH:
            size, position = _varint(message, position)
        elif wire in (_EIGHT_BYTES, _FOUR_BYTES):
            size = 8 if wire == _EIGHT_BYTES else 4
        else:
            raise ValueError("is no protocol buffer")
        if position + size > len(message):
            raise ValueError("is cut short")
        yield number, message[position : position + size]
        position += size


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if position >= len(message):
            raise ValueError("is cut short")
        byte = message[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
    raise ValueError("is no protocol buffer")


_TYPES = {"float32": 1, "uint8": 2, "int64": 7}
_OPSET, _IR_VERSION = 13, 8


@dataclass(frozen=True)
class Node:
    """A node of a small network.

    Parameters
    ----------
    operator : str
        Operator of ONNX, opset 13.
    inputs : tuple of str
        Names of its inputs.
    output : str
        Name of its output.
    attributes : mapping of str to int, tuple of int or str
        Its attributes.
    """

    operator: str
    inputs: tuple[str, ...]
    output: str
    attributes: Mapping[str, int | tuple[int, ...] | str] = field(default_factory=dict)


def small_network(
    nodes: Sequence[Node],
    inputs: Mapping[str, tuple[str, int]],
    outputs: Mapping[str, tuple[str, int]],
) -> bytes:
    """Return the content of an ONNX file without weights.

    The package onnx, which could write it, is not needed for measuring.

    Parameters
    ----------
    nodes : sequence of Node
        In the order of computing.
    inputs, outputs : mapping of str to (str, int)
        Type ('float32', 'uint8' or 'int64') and number of axes of each; their sizes are free.

    Examples
    --------
    >>> double = small_network(
    ...     [Node("Add", ("x", "x"), "y")], {"x": ("float32", 1)}, {"y": ("float32", 1)}
    ... )
    >>> external_files(double), has_loop(double)
    ([], False)
    """
    graph = b"".join(_part(1, _node(node)) for node in nodes) + _part(2, b"graph")
    for number, tensors in ((11, inputs), (12, outputs)):
        for name, (kind, axes) in tensors.items():
            sizes = b"".join(_part(1, _part(2, f"{name}{axis}".encode())) for axis in range(axes))
            tensor = _number(1, _TYPES[kind]) + _part(2, sizes)
            graph += _part(number, _part(1, name.encode()) + _part(2, _part(1, tensor)))
    return _number(1, _IR_VERSION) + _part(7, graph) + _part(8, _number(2, _OPSET))


def _node(node: Node) -> bytes:
    content = b"".join(_part(1, name.encode()) for name in node.inputs)
    content += _part(2, node.output.encode()) + _part(4, node.operator.encode())
    for name, value in node.attributes.items():
        attribute = _part(1, name.encode())
        if isinstance(value, str):
            attribute += _part(4, value.encode()) + _number(20, 3)
        elif isinstance(value, int):
            attribute += _number(3, value) + _number(20, 2)
        else:
            attribute += b"".join(_number(8, part) for part in value) + _number(20, 7)
        content += _part(5, attribute)
    return content


def _part(number: int, content: bytes) -> bytes:
    return _varint_bytes(number << 3 | _LENGTH) + _varint_bytes(len(content)) + content


def _number(number: int, value: int) -> bytes:
    return _varint_bytes(number << 3 | _VARINT) + _varint_bytes(value)


def _varint_bytes(value: int) -> bytes:
    digits = []
    while value > 0x7F:
        digits.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*digits, value])
