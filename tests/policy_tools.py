"""Policies to save, load and drive with."""

from __future__ import annotations

import base64
import json
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium

from acsar_gym.envs.ids import full_id
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.resources import AGENTS
from acsar_gym.tools.policies import OnnxPolicy
from acsar_gym.tools.policies.document import DOCUMENT_KEY, PolicyDocument, describe_policy
from acsar_gym.tools.training.options import TrainingOptions

GOOD = AGENTS / "policies" / "point_goal.onnx"
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


def network(
    nodes: str,
    width: int = 7,
    inputs: str = "",
    outputs: str = "float[batch,2] action",
    document: str = "",
) -> Any:
    """A network in ONNX's own text format, with the document of GOOD or another."""
    import onnx

    model = onnx.parser.parse_model(
        '<ir_version: 10, opset_import: ["" : 20]>'
        f"g (float[batch,{width}] observation{inputs}) => ({outputs}) {{ {nodes} }}"
    )
    document = document or json.dumps(changed(width=width))
    onnx.helper.set_model_props(model, {DOCUMENT_KEY: document})
    return model


def dense(result: str, rows: int = 7, columns: int = 2, source: str = "observation") -> str:
    """The text of a layer of small weights."""
    return (
        f"shape = Constant <value_ints = [{rows}, {columns}]> ()"
        "weights = ConstantOfShape <value = float[1] {0.01}> (shape)"
        f"{result} = MatMul ({source}, weights)"
    )


def counting(path: Path, state: str = "float[1,2]", outputs: int = 1) -> Path:
    """A recurrent policy for PointGoal whose action is how often it decided before, times 0.1."""
    nodes = (
        f"{dense('turn')} action = Add (turn, count)"
        "step = Constant <value = float[1,2] {0.1, 0.1}> () next = Add (count, step)"
    )
    results = "float[batch,2] action" + f", {state} next" * outputs
    model = network(nodes, inputs=f", {state} count", outputs=results)
    path.write_bytes(model.SerializeToString())
    return path


def fitting(path: Path, env_id: str, width: int | None = None, **options: Any) -> Path:
    """A policy with small weights for an environment, with the env's document.

    It takes the first `width` numbers of an observation, or all.
    """
    env: Any = gymnasium.make(full_id(env_id), link="planar", **options)
    document = describe_policy(
        env.unwrapped, env_id, randomization={"friction": (0.7, 1.2)}, width=width
    )
    env.close()
    layer = dense("action", document.width)
    model = network(layer, document.width, document=document.as_json())
    path.write_bytes(model.SerializeToString())
    return path


def lies_about_its_output() -> Any:
    return network(dense("action", columns=3), outputs="float[batch,n] action")


def not_finite() -> Any:
    return network("logs = Log (observation)" + dense("action", source="logs"))


def external_data() -> Any:
    import onnx

    weights = onnx.helper.make_tensor("weights", 1, [7, 2], bytes(56), raw=True)
    onnx.external_data_helper.set_external_data(weights, "weights.bin", 0, 56)
    weights.ClearField("raw_data")
    model = network("action = MatMul (observation, weights)")
    model.graph.initializer.append(weights)
    return model


def random() -> Any:
    return network(dense("turn") + "action = RandomNormalLike (turn)")


def without_inputs() -> Any:
    model = network("action = Constant <value = float[1,2] {0.0, 0.0}> ()")
    del model.graph.input[:]
    return model


def list_of_actions() -> Any:
    nodes = dense("turn") + "action = SequenceConstruct (turn)"
    return network(nodes, outputs="seq(float[batch,2]) action")


HOSTILE: tuple[Callable[[], Any], ...] = (
    *(lies_about_its_output, not_finite, external_data, random),
    *(without_inputs, list_of_actions),
)
"""What makes such networks."""


NAMES = ("PPO", "A2C", "SAC", "TD3", "DDPG")
PLACES = ("data", "policy.pth", "pytorch_variables.pth", "policy.optimizer.pth")
"""What stable-baselines3 unpickles, or gives to torch to unpickle."""


def algorithms() -> dict[str, Any]:
    """stable-baselines3's classes by their names. Importing them takes seconds."""
    import stable_baselines3

    return {name: getattr(stable_baselines3, name) for name in NAMES}


def save(
    path: Path,
    algorithm: str = "PPO",
    env_id: str = ENV_ID,
    *,
    label: bool = True,
    **options: Any,
) -> Path:
    """A small model with random weights: untrained ones have actions that are all about zero."""
    from acsar_gym.tools.policies import sb3_export

    env = gymnasium.make(env_id, link="planar")
    model = algorithms()[algorithm](
        "MlpPolicy", env, device="cpu", seed=0, policy_kwargs={"net_arch": [8]}, **options
    )
    for weight in model.policy.parameters():
        weight.data.normal_(0.0, 0.4)
    inner = env.unwrapped
    assert isinstance(inner, RobotEnv)
    if label:
        sb3_export.label(model, describe_policy(inner, inner.task.id))
    model.save(path)
    env.close()
    return path


class _Payload:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {self.marker}",)


def poison(good: Path, place: str, marker: Path, path: Path) -> Path:
    """A copy of a zip that touches `marker` when that place in it is unpickled."""
    payload = pickle.dumps(_Payload(marker))
    with zipfile.ZipFile(good) as source, zipfile.ZipFile(path, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name == place:
                content = _data(content, payload) if name == "data" else payload
            target.writestr(name, content)
    return path


def _data(content: bytes, payload: bytes) -> bytes:
    data = json.loads(content)
    for item in data.values():
        if isinstance(item, dict) and ":serialized:" in item:
            item[":serialized:"] = base64.b64encode(payload).decode()
    return json.dumps(data).encode()


def tiny(out: Path, **options: Any) -> TrainingOptions:
    """Options of a training of one thread and few robots."""
    defaults = {"robots": 8, "progress": False, "threads": 1, "seed": 3, "out": out}
    return TrainingOptions(**defaults | options)
