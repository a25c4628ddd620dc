"""Parses ONNX files without onnx or onnxruntime, and rejects what a policy doesn't need.

Field numbers are those of https://github.com/onnx/onnx/blob/main/onnx/onnx.proto.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from acsar_gym.errors import PolicyError
from acsar_gym.tools.policies.protobuf import Message, ProtobufError

FLOAT32, INT64 = 1, 7
MAX_WIDTH = 100_000
"""Largest accepted size of an observation."""
MAX_STATES = 16
"""Most states of a recurrent network."""
Dims = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Node:
    """One operation.

    `transposed` are of a Gemm (transA, transB), `axis` of a Concat or Gather, `keepdims` of a
    reduction.
    """

    op: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    transposed: tuple[bool, bool]
    axis: int | None
    keepdims: bool


class State(NamedTuple):
    """A state of a recurrent network: names of input and output, and the shape of both."""

    input: str
    output: str
    shape: Dims


@dataclass(frozen=True, slots=True)
class Graph:
    """A network: nodes in order of execution, shapes of its weights, size of its input, states."""

    nodes: tuple[Node, ...]
    weights: dict[str, Dims]
    whole: dict[str, int]
    """The weights that are a single whole number, such as axes."""
    width: int
    states: tuple[State, ...]
    metadata: dict[str, str]


def read(data: bytes) -> Graph:
    """Parse an ONNX file.

    Args:
        data: content of the file.

    Returns:
        The network, which maps `observation` (batch, n) to `action` (batch, 2) in float32. Any
        further inputs are states, and the further outputs what they are next.

    Raises:
        PolicyError: it isn't an ONNX file, has other inputs or outputs, or contains external
            data, functions, operators of other domains, or subgraphs. The message doesn't name
            the file.
    """
    try:
        model = Message(data)
        graph = model.message(7)
        _refuse(model, graph)
        tensors = graph.messages(5)
        weights = {t.text(8): _dims(t, len(data)) for t in tensors}
        whole = {t.text(8): int.from_bytes(t.data(9), "little") for t in tensors if _is_whole(t)}
        nodes = tuple(_node(node, len(data)) for node in graph.messages(1))
        width, states = _width(graph, weights), _states(graph, weights)
        metadata = {entry.text(1): entry.text(2) for entry in model.messages(14)}
    except ProtobufError as error:
        raise PolicyError(f"not an ONNX policy: {error}") from None
    return Graph(nodes, weights, whole, width, states, metadata)


def _refuse(model: Message, graph: Message) -> None:
    """Reject models without a graph, and with functions, training info or sparse weights."""
    if 7 not in model or 1 not in graph:
        raise PolicyError("not an ONNX policy: holds no network")
    if 25 in model or 20 in model or 15 in graph:
        raise PolicyError("not an ONNX policy: functions, training and sparse weights aren't read")


def _dims(tensor: Message, size: int) -> Dims:
    """Return the shape of a tensor; `size` [bytes] of the file bounds its number of elements."""
    if 13 in tensor or 14 in tensor:
        raise PolicyError("keeps weights in other files: save it as a single file")
    dims = tuple(tensor.integers(1))
    if min(dims, default=0) < 0 or math.prod(dims) > 2 * size:
        raise PolicyError(f"not an ONNX policy: weights of shape {dims[:8]} aren't all in the file")
    return dims


def _is_whole(tensor: Message) -> bool:
    """Return whether a tensor is a single number of type int64."""
    return tensor.integer(2) == INT64 and math.prod(tensor.integers(1)) == 1 and tensor.size(9) == 8


def _node(node: Message, size: int) -> Node:
    """Parse one operation; rejects other domains and subgraph attributes."""
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
    axis = attributes["axis"].integer(3) if "axis" in attributes else None
    keepdims = "keepdims" not in attributes or attributes["keepdims"].integer(3) != 0
    return Node(node.text(4), inputs, outputs, (transposed[0], transposed[1]), axis, keepdims)


def _inputs(graph: Message, weights: dict[str, Dims]) -> list[Message]:
    """Return the inputs of a graph that aren't weights."""
    return [put for put in graph.messages(11) if put.text(1) not in weights]


def _width(graph: Message, weights: dict[str, Dims]) -> int:
    """Return the size n of the observation (batch, n); checks the first input and output."""
    inputs, outputs = _inputs(graph, weights), graph.messages(12)
    names = [[put.text(1)[:40] for put in puts[:5]] for puts in (inputs, outputs)]
    if [puts[:1] for puts in names] != [["observation"], ["action"]]:
        raise PolicyError(f"must map 'observation' to 'action', maps {names[0]} to {names[1]}")
    width, given = _columns(inputs[0]), _columns(outputs[0])
    if width is None or not 0 < width <= MAX_WIDTH or given not in (None, 2):
        raise PolicyError(
            f"must map (batch, n) to (batch, 2), maps n = {width or '?'} to {given or '?'}"
        )
    return width


def _states(graph: Message, weights: dict[str, Dims]) -> tuple[State, ...]:
    """Return the states: the inputs and outputs behind the first ones, in pairs."""
    puts = [part[1:] for part in (_inputs(graph, weights), graph.messages(12))]
    if len(puts[0]) != len(puts[1]) or len(puts[0]) > MAX_STATES:
        names = [[put.text(1)[:40] for put in part[:5]] for part in puts]
        raise PolicyError(f"must have an output for every state, maps {names[0]} to {names[1]}")
    return tuple(_state(*pair) for pair in zip(*puts, strict=True))


def _state(before: Message, after: Message) -> State:
    """Return one state; its shape must be constant, and small."""
    shapes = [_shape(put) for put in (before, after)]
    if shapes[0] is None or shapes[1] not in (None, shapes[0]):
        raise PolicyError(f"state {before.text(1)[:40]!r}: must have one constant shape")
    if min(shapes[0]) <= 0 or math.prod(shapes[0]) > MAX_WIDTH:
        raise PolicyError(f"state {before.text(1)[:40]!r}: shape {shapes[0][:8]} can't be used")
    return State(before.text(1), after.text(1), shapes[0])


def _shape(put: Message) -> Dims | None:
    """Return the shape of a float32 input or output; None if the file leaves it open."""
    tensor = put.message(2).message(1)
    dims = tensor.message(2).messages(1)
    if tensor.integer(1) != FLOAT32:
        raise PolicyError(f"{put.text(1)[:40]} must be float32")
    return tuple(dim.integer(1) for dim in dims) if dims and all(1 in d for d in dims) else None


def _columns(put: Message) -> int | None:
    """Return n of a float32 input or output (batch, n); None if the file leaves it open."""
    tensor = put.message(2).message(1)
    dims = tensor.message(2).messages(1)
    if tensor.integer(1) != FLOAT32:
        raise PolicyError(f"{put.text(1)} must be float32")
    if 2 not in tensor:
        return None
    if len(dims) != 2 or (1 in dims[0] and dims[0].integer(1) != 1):
        raise PolicyError(f"{put.text(1)} must be of shape (batch, n)")
    return dims[1].integer(1) if 1 in dims[1] else None
