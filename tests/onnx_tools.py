"""ONNX policies made by hand: good ones, and those that an attacker would send."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from acsar_gym.envs.ids import full_id
from acsar_gym.resources import AGENTS
from acsar_gym.tools.policies import OnnxPolicy
from acsar_gym.tools.policies.document import DOCUMENT_KEY, PolicyDocument, describe_policy

GOOD = AGENTS / "policies" / "point_goal.onnx"
VARIED: dict[str, Any] = {"friction": (0.7, 1.2), "motor_lag": (0.6, 1.5)}
ENV_ID = "acsar_gym/PointGoal-v0"


def document_of(path: Path = GOOD) -> PolicyDocument:
    """The document of a policy file."""
    return OnnxPolicy(path).document


def changed(**values: Any) -> dict[str, Any]:
    """The document of GOOD as JSON has it, with other values."""
    return {**document_of().model_dump(mode="json"), **values}


def relabelled(path: Path, **values: Any) -> Path:
    """A copy of a packaged policy, whose document has other values."""
    import onnx

    model = onnx.load(GOOD)
    onnx.helper.set_model_props(model, {DOCUMENT_KEY: json.dumps(changed(**values))})
    onnx.save(model, path)
    return path


class Maker:
    """A network in the making: `add("Tanh", "observation")` names its results by itself."""

    def __init__(self, width: int = 7, shape: tuple[str | int, ...] = ("batch", 2)) -> None:
        import onnx

        self._onnx, self._width, self._shape = onnx, width, shape
        self._inputs = [self._value("observation", ("batch", width))]
        self._nodes: list[Any] = []
        self._weights: list[Any] = []
        self.domains = [("", 20)]

    def _value(self, name: str, shape: tuple[str | int, ...]) -> Any:
        return self._onnx.helper.make_tensor_value_info(name, 1, shape)

    def weight(self, value: Any, dtype: Any = np.float32) -> str:
        """A constant of the file."""
        name = f"w{len(self._weights)}"
        array = np.asarray(value, dtype)
        self._weights.append(self._onnx.numpy_helper.from_array(array, name))
        return name

    def add(self, op: str, *inputs: str, out: str = "", domain: str = "", **attributes: Any) -> str:
        """One operation; returns the name of its result."""
        out = out or f"v{len(self._nodes)}"
        node = self._onnx.helper.make_node(op, list(inputs), [out], domain=domain, **attributes)
        self._nodes.append(node)
        return out

    def dense(self, value: str, rows: int, columns: int = 2, out: str = "action") -> str:
        """A layer of small weights."""
        weights = self.weight(np.full((rows, columns), 0.01))
        return self.add("MatMul", value, weights, out=out)

    def model(self) -> Any:
        """The finished onnx.ModelProto."""
        helper = self._onnx.helper
        output = self._value("action", self._shape)
        graph = helper.make_graph(self._nodes, "g", self._inputs, [output], self._weights)
        opsets = [helper.make_opsetid(domain, version) for domain, version in self.domains]
        model = helper.make_model(graph, opset_imports=opsets, ir_version=10)
        data = changed(width=self._width)
        helper.set_model_props(model, {DOCUMENT_KEY: json.dumps(data)})
        return model

    def bytes(self) -> bytes:
        """The finished file."""
        data: bytes = self.model().SerializeToString()
        return data


def counting(path: Path, shape: tuple[Any, ...] = (1, 2), dtype: int = 1, outputs: int = 1) -> Path:
    """A recurrent policy for PointGoal whose action is how often it decided before, times 0.1."""
    import onnx

    make, value = Maker(), onnx.helper.make_tensor_value_info
    make.add("Add", make.dense("observation", 7, out="d"), "count", out="action")
    if outputs:
        make.add("Add", "count", make.weight(np.full((1, 2), 0.1)), out="next")
    model = make.model()
    model.graph.input.append(value("count", dtype, shape))
    model.graph.output.extend([value("next", dtype, shape)] * outputs)
    path.write_bytes(model.SerializeToString())
    return path


def fitting(path: Path, env_id: str, width: int | None = None, **options: Any) -> Path:
    """A policy with small weights for an environment, with what `described` says of it.

    It takes the first `width` numbers of an observation, or all.
    """
    import gymnasium

    env: Any = gymnasium.make(full_id(env_id), link="planar", **options)
    document = describe_policy(env.unwrapped, env_id, randomization=VARIED, width=width)
    env.close()
    make = Maker(document.width)
    make.dense("observation", document.width)
    model = make.model()
    del model.metadata_props[:]
    model.metadata_props.add(key=DOCUMENT_KEY, value=document.as_json())
    path.write_bytes(model.SerializeToString())
    return path


def other_width() -> bytes:
    make = Maker()
    make.dense("observation", 9)
    return make.bytes()


def lies_about_its_output() -> bytes:
    make = Maker(shape=("batch", "n"))
    make.dense("observation", 7, 3)
    return make.bytes()


def not_finite() -> bytes:
    make = Maker()
    make.dense(make.add("Log", "observation"), 7)
    return make.bytes()


def external_data() -> bytes:
    import onnx

    make = Maker()
    make.dense("observation", 7)
    model = make.model()
    weights = model.graph.initializer[0]
    onnx.external_data_helper.set_external_data(weights, "weights.bin", 0, 56)
    weights.ClearField("raw_data")
    data: bytes = model.SerializeToString()
    return data


def random() -> bytes:
    make = Maker()
    make.add("RandomNormalLike", make.dense("observation", 7, out="d"), out="action")
    return make.bytes()


def weights_that_are_not_there() -> bytes:
    make = Maker()
    make.dense("observation", 7)
    model = make.model()
    del model.graph.initializer[0].dims[:]
    model.graph.initializer[0].dims.extend([7, 2_000_000_000])
    data: bytes = model.SerializeToString()
    return data


def in_other_format() -> bytes:
    """What onnxruntime would read as its own format."""
    return b"\x18\x00\x00\x00ORTM" + bytes(100)


HOSTILE: tuple[Callable[[], bytes], ...] = (
    other_width,
    lies_about_its_output,
    not_finite,
    external_data,
    random,
    weights_that_are_not_there,
    in_other_format,
)
"""What makes such files."""
