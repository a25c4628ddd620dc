"""Bounds the cost of a network from its graph alone, before any of it is run.

Only operations are accepted whose output shapes follow from the shape of the observation: no loops,
branches, random numbers or data-dependent shapes. So every decision costs the same.
"""

from __future__ import annotations

import math

from acsar_gym.errors import PolicyError
from acsar_gym.tools.policies.graph import Dims, Graph, Node

MAX_WORK = 50_000_000
"""Multiplications per decision up to which a plain network runs without a trial (trial.py)."""


def _names(text: str) -> frozenset[str]:
    """Split a list of names separated by spaces."""
    return frozenset(text.split())


_SIMPLE = _names(
    "Abs Cast Celu Elu Erf Exp Gelu HardSigmoid HardSwish Identity LeakyRelu Log Mish Neg Relu "
    "Selu Sigmoid Softplus Softsign Sqrt Swish Tanh ThresholdedRelu"
)
"""Operations on one operand, element by element."""
_ELEMENTWISE = _names("Add Clip Div Max Min Mul PRelu Pow Sub")
_SIZED = _names(
    "CumSum Expand Pad ReduceL1 ReduceL2 ReduceLogSum ReduceLogSumExp ReduceMax ReduceMean "
    "ReduceMin ReduceProd ReduceSum ReduceSumSquare Reshape Slice Split Squeeze Tile TopK Trilu "
    "Unsqueeze"
)
"""Operations whose second and later operands can determine the size of the output."""
_MAKING = _names("ConstantOfShape Range")
"""Operations whose operands all determine the size of the output."""
_OTHERS = _names(
    "And ArgMax ArgMin Atan Attention AveragePool BatchNormalization CastLike Ceil Concat "
    "Constant Conv Cos DequantizeLinear DynamicQuantizeLinear Einsum Equal Flatten Floor GRU "
    "Gather GatherElements GatherND Gemm GlobalAveragePool GlobalMaxPool Greater GreaterOrEqual "
    "GroupNormalization InstanceNormalization IsInf IsNaN LSTM LayerNormalization Less "
    "LessOrEqual LogSoftmax LpNormalization MatMul MatMulInteger MaxPool Mean Mod Not Or "
    "QuantizeLinear RMSNormalization RNN Reciprocal Round ScatterElements ScatterND Shape Sign "
    "Sin Size Softmax Sum Transpose Where Xor"
)
OPERATIONS = _SIMPLE | _ELEMENTWISE | _SIZED | _MAKING | _OTHERS


def check(graph: Graph) -> None:
    """Check that a network consists of operations of feed-forward networks only.

    Raises:
        PolicyError: for other operations, and for output sizes that aren't constants.
    """
    static = set(graph.weights)
    for node in graph.nodes:
        if node.op not in OPERATIONS:
            raise PolicyError(f"uses {node.op[:40]!r}, which a feed-forward policy doesn't need")
        if any(name and name not in static for name in _sizes(node)):
            raise PolicyError(f"uses {node.op!r} with sizes that depend on what is seen")
        if node.op in ("Constant", "Shape", "Size") or static.issuperset(filter(None, node.inputs)):
            static.update(node.outputs)


def _sizes(node: Node) -> tuple[str, ...]:
    """Return the operands of a node that determine the size of its output."""
    if node.op in _MAKING:
        return node.inputs
    return node.inputs[1:] if node.op in _SIZED else ()


def plain(graph: Graph) -> bool:
    """Return whether a network is a small chain of dense layers, safe to run without a trial.

    Every value in it is one row, no wider than follows from the operations. Parts of the
    observation may be cut out, changed number by number, looked up in a table of which the least
    or largest numbers are kept, and put together again.
    """
    widths, found, work = {"observation": graph.width}, dict[str, int](), 0
    for node in graph.nodes:
        columns = _columns(node, widths, graph.weights)
        if columns is not None:
            found[node.outputs[0]] = columns
            work += columns * widths[node.inputs[1]]
            continue
        width = _kept(node, found, graph.whole) or _row(node, widths, graph.weights)
        if width is None or len(node.outputs) != 1:
            return False
        work += width
        if node.op in ("Gemm", "MatMul"):
            work += math.prod(graph.weights[node.inputs[1]])
        widths[node.outputs[0]] = width
    return work <= MAX_WORK and "action" in widths


def _columns(node: Node, widths: dict[str, int], weights: dict[str, Dims]) -> int | None:
    """Return the columns of a table in which a row of indices is looked up; None for others."""
    if node.op != "Gather" or node.axis not in (None, 0) or len(node.outputs) != 1:
        return None
    shape = weights.get(node.inputs[0], ())
    return shape[1] if len(shape) == 2 and node.inputs[1] in widths else None


def _kept(node: Node, found: dict[str, int], whole: dict[str, int]) -> int | None:
    """Return the width of the extremes of each column of what was looked up; None for others.

    That has the shape (1, indices, columns). Other axes, and kept ones, leave more than a row.
    """
    if node.op not in ("ReduceMin", "ReduceMax") or node.keepdims or len(node.inputs) != 2:
        return None
    return found.get(node.inputs[0]) if whole.get(node.inputs[1]) == 1 else None


def _row(node: Node, widths: dict[str, int], weights: dict[str, Dims]) -> int | None:
    """Return the largest width of a node's output; None unless it is certainly a single row."""
    inputs = [name for name in node.inputs if name]
    rows = [widths[name] for name in inputs if name in widths]
    rest = [weights.get(name) for name in inputs if name not in widths]
    if not rows or inputs[0] not in widths:
        return _product(rows, rest) if node.op in _ELEMENTWISE else None
    if node.op in _SIMPLE and len(inputs) == 1:
        return rows[0]
    if node.op == "Slice" and len(rows) == 1:
        return rows[0]  # of its rest, only the numbers count, not the shapes
    if node.op == "Concat" and node.axis in (1, -1) and not rest:
        return sum(rows)
    if node.op in ("Gemm", "MatMul") and len(inputs) >= 2:
        return _layer(node, inputs, weights)
    return _product(rows, rest) if node.op in _ELEMENTWISE else None


def _product(rows: list[int], rest: list[Dims | None]) -> int | None:
    """Return the largest width of an operation on rows and weights, element by element."""
    sizes = [_width(shape) for shape in rest]
    known = [size for size in sizes if size is not None]
    return max((*rows, *known)) if rows and len(known) == len(sizes) else None


def _layer(node: Node, inputs: list[str], weights: dict[str, Dims]) -> int | None:
    """Return the width of the output of a Gemm or MatMul; None if it isn't a dense layer."""
    shape = weights.get(inputs[1], ())
    if len(shape) != 2 or node.transposed[0]:
        return None
    columns = shape[0] if node.transposed[1] else shape[1]
    biases = (_width(weights.get(name)) for name in inputs[2:])
    return columns if all(width is not None and width <= columns for width in biases) else None


def _width(shape: Dims | None) -> int | None:
    """Return the width of weights that are one row, or one number; None for others."""
    if shape is None or math.prod(shape) != max((1, *shape)) or len(shape) > 2:
        return None
    return None if len(shape) == 2 and shape[0] != 1 else max((1, *shape))
