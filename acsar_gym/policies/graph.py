"""What stands in an ONNX file, read without onnx or onnxruntime, and what is refused in it.

The numbers are those of https://github.com/onnx/onnx/blob/main/onnx/onnx.proto.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from acsar_gym.errors import PolicyError
from acsar_gym.policies.protobuf import Message, ProtobufError

FLOAT32 = 1
MAX_WIDTH = 100_000
"""Numbers of an observation, at most."""
Dims = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Node:
    """One operation; `transposed` says which operands of a Gemm are."""

    op: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    transposed: tuple[bool, bool]


@dataclass(frozen=True, slots=True)
class Graph:
    """A network: its nodes in order, its weights' shapes, and its one input's width."""

    nodes: tuple[Node, ...]
    weights: dict[str, Dims]
    width: int
    metadata: dict[str, str]


def read(data: bytes) -> Graph:
    """The network of an ONNX file.

    Raises PolicyError, whose message doesn't name the file, for what isn't one, doesn't map
    `observation` (batch, n) to `action` (batch, 2) in float32, or has anything in it that a policy
    doesn't need: data in other files, functions, other packages' operations, subgraphs.
    """
    try:
        model = Message(data)
        graph = model.message(7)
        _refuse(model, graph)
        weights = {t.text(8): _dims(t, len(data)) for t in graph.messages(5)}
        nodes = tuple(_node(node, len(data)) for node in graph.messages(1))
        width = _width(graph, weights)
        metadata = {entry.text(1): entry.text(2) for entry in model.messages(14)}
    except ProtobufError as error:
        raise PolicyError(f"not an ONNX policy: {error}") from None
    return Graph(nodes, weights, width, metadata)


def _refuse(model: Message, graph: Message) -> None:
    if 7 not in model or 1 not in graph:
        raise PolicyError("not an ONNX policy: holds no network")
    if 25 in model or 20 in model or 15 in graph:
        raise PolicyError("not an ONNX policy: functions, training and sparse weights aren't read")


def _dims(tensor: Message, size: int) -> Dims:
    """The shape of a tensor whose numbers are all in the file, which has `size` bytes."""
    if 13 in tensor or 14 in tensor:
        raise PolicyError("keeps weights in other files: save it as a single file")
    dims = tuple(tensor.integers(1))
    if min(dims, default=0) < 0 or math.prod(dims) > 2 * size:
        raise PolicyError(f"not an ONNX policy: weights of shape {dims[:8]} aren't all in the file")
    return dims


def _node(node: Message, size: int) -> Node:
    if node.text(7) not in ("", "ai.onnx"):
        raise PolicyError(f"not an ONNX policy: an operation of {node.text(7)[:40]!r}")
    attributes = {part.text(1): part for part in node.messages(5)}
    for part in attributes.values():
        if any(number in part for number in (6, 10, 11, 22, 23)):
            raise PolicyError(
                f"uses {node.text(4)[:40]!r}: a policy has neither loops nor branches"
            )
        _dims(part.message(5), size)
    transposed = [n in attributes and attributes[n].integer(3) != 0 for n in ("transA", "transB")]
    inputs, outputs = tuple(node.texts(1)), tuple(node.texts(2))
    return Node(node.text(4), inputs, outputs, (transposed[0], transposed[1]))


def _width(graph: Message, weights: dict[str, Dims]) -> int:
    """How many numbers the observation has."""
    inputs = [put for put in graph.messages(11) if put.text(1) not in weights]
    outputs = graph.messages(12)
    names = [[put.text(1)[:40] for put in puts[:5]] for puts in (inputs, outputs)]
    if names != [["observation"], ["action"]]:
        raise PolicyError(f"must map 'observation' to 'action', maps {names[0]} to {names[1]}")
    width, given = _columns(inputs[0]), _columns(outputs[0])
    if width is None or not 0 < width <= MAX_WIDTH or given not in (None, 2):
        raise PolicyError(
            f"must map (batch, n) to (batch, 2), maps n = {width or '?'} to {given or '?'}"
        )
    return width


def _columns(put: Message) -> int | None:
    """The second size of a (batch, n) of float32; None where it's left open."""
    tensor = put.message(2).message(1)
    dims = tensor.message(2).messages(1)
    if tensor.integer(1) != FLOAT32:
        raise PolicyError(f"{put.text(1)} must be float32")
    if 2 not in tensor:
        return None
    if len(dims) != 2 or (1 in dims[0] and dims[0].integer(1) != 1):
        raise PolicyError(f"{put.text(1)} must be of shape (batch, n)")
    return dims[1].integer(1) if 1 in dims[1] else None
