"""What a network may cost, told from its structure, before anything of it runs.

The shapes of all its values follow from the observation's shape alone, so one decision costs what
every other one does: without loops, branches, random numbers, or sizes that depend on what is seen.
"""

from __future__ import annotations

import math

from acsar_gym.errors import PolicyError
from acsar_gym.policies.graph import Dims, Graph, Node

MAX_WORK = 50_000_000
"""Multiplications that a plain network may take without being tried out first."""


def _names(text: str) -> frozenset[str]:
    return frozenset(text.split())


_SIMPLE = _names(
    "Abs Celu Elu Erf Exp Gelu HardSigmoid HardSwish Identity LeakyRelu Log Mish Neg Relu Selu "
    "Sigmoid Softplus Softsign Sqrt Swish Tanh ThresholdedRelu"
)
"""Of one operand, element by element."""
_ELEMENTWISE = _names("Add Clip Div Max Min Mul PRelu Pow Sub")
_SIZED = _names(
    "CumSum Expand Pad ReduceL1 ReduceL2 ReduceLogSum ReduceLogSumExp ReduceMax ReduceMean "
    "ReduceMin ReduceProd ReduceSum ReduceSumSquare Reshape Slice Split Squeeze Tile TopK Trilu "
    "Unsqueeze"
)
"""All operands but the first decide about sizes, or may."""
_MAKING = _names("ConstantOfShape Range")
"""All operands decide about sizes."""
_OTHERS = _names(
    "And ArgMax ArgMin Atan Attention AveragePool BatchNormalization Cast CastLike Ceil Concat "
    "Constant Conv Cos DequantizeLinear DynamicQuantizeLinear Einsum Equal Flatten Floor GRU "
    "Gather GatherElements GatherND Gemm GlobalAveragePool GlobalMaxPool Greater GreaterOrEqual "
    "GroupNormalization InstanceNormalization IsInf IsNaN LSTM LayerNormalization Less "
    "LessOrEqual LogSoftmax LpNormalization MatMul MatMulInteger MaxPool Mean Mod Not Or "
    "QuantizeLinear RMSNormalization RNN Reciprocal Round ScatterElements ScatterND Shape Sign "
    "Sin Size Softmax Sum Transpose Where Xor"
)
OPERATIONS = _SIMPLE | _ELEMENTWISE | _SIZED | _MAKING | _OTHERS


def check(graph: Graph) -> None:
    """PolicyError for operations that a feed-forward network doesn't need."""
    static = set(graph.weights)
    for node in graph.nodes:
        if node.op not in OPERATIONS:
            raise PolicyError(f"uses {node.op[:40]!r}, which a feed-forward policy doesn't need")
        if any(name and name not in static for name in _sizes(node)):
            raise PolicyError(f"uses {node.op!r} with sizes that depend on what is seen")
        if node.op in ("Constant", "Shape", "Size") or static.issuperset(filter(None, node.inputs)):
            static.update(node.outputs)


def _sizes(node: Node) -> tuple[str, ...]:
    """The operands that decide about the size of a node's result."""
    if node.op in _MAKING:
        return node.inputs
    return node.inputs[1:] if node.op in _SIZED else ()


def plain(graph: Graph) -> bool:
    """Whether it's a small chain of dense layers, safe to run as its structure alone tells.

    Every value in it is one row: as wide as the observation, or as a layer of weights.
    """
    widths, work = {"observation": graph.width}, 0
    for node in graph.nodes:
        width = _row(node, widths, graph.weights)
        if width is None or len(node.outputs) != 1:
            return False
        work += width
        if node.op in ("Gemm", "MatMul"):
            work += math.prod(graph.weights[node.inputs[1]])
        widths[node.outputs[0]] = width
    return work <= MAX_WORK and widths.get("action") == 2


def _row(node: Node, widths: dict[str, int], weights: dict[str, Dims]) -> int | None:
    """The width of a node's result; None where it isn't plainly one row."""
    inputs = [name for name in node.inputs if name]
    if node.op in _SIMPLE and len(inputs) == 1:
        return widths.get(inputs[0])
    if node.op in ("Gemm", "MatMul") and len(inputs) >= 2:
        return _layer(node, inputs, widths, weights)
    if node.op in _ELEMENTWISE:
        found = {widths[name] for name in inputs if name in widths}
        if len(found) == 1:
            (width,) = found
            rest = [name for name in inputs if name not in widths]
            return width if all(_fits(weights.get(name), width) for name in rest) else None
    return None


def _layer(
    node: Node, inputs: list[str], widths: dict[str, int], weights: dict[str, Dims]
) -> int | None:
    shape = weights.get(inputs[1], ())
    if len(shape) != 2 or inputs[0] not in widths or node.transposed[0]:
        return None
    rows, columns = reversed(shape) if node.transposed[1] else shape
    fits = all(_fits(weights.get(name), columns) for name in inputs[2:])
    return columns if rows == widths[inputs[0]] and fits else None


def _fits(shape: Dims | None, width: int) -> bool:
    """Whether adding weights of this shape to one row of `width` gives such a row."""
    return shape in ((), (1,), (width,), (1, 1), (1, width))
