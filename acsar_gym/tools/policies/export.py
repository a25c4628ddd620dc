"""Exports torch modules to ONNX. Imports torch and onnx."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from acsar_gym import reading
from acsar_gym.errors import PolicyError, format_error, require_extra
from acsar_gym.tools.policies.bundle import BUNDLE_KEY, Bundle, NormalizerSummary
from acsar_gym.tools.policies.policy import MAX_POLICY_BYTES

with require_extra("writing an ONNX policy (torch, onnx, onnxscript)", "train"):
    import onnx
    import onnxscript  # noqa: F401 - torch.onnx needs it
    import torch


class Normalizer(torch.nn.Module):
    """Normalizes observations: (observation - mean) / std, clipped to [-clip, clip]."""

    def __init__(self, mean: ArrayLike, std: ArrayLike, clip: float | None = None) -> None:
        super().__init__()
        self.mean: torch.Tensor
        self.std: torch.Tensor
        try:
            numbers = [np.asarray(given, np.float32) for given in (mean, std)]
            self.clip = None if clip is None else float(clip)
        except (TypeError, ValueError):
            numbers, self.clip = [np.full(2, np.nan, np.float32)] * 2, None
        finite = all(array.ndim < 2 and np.isfinite(array).all() for array in numbers)
        if not (finite and (numbers[1] > 0.0).all() and (self.clip is None or self.clip > 0.0)):
            raise PolicyError(
                "normalizer: mean, std and clip must be finite numbers, std and clip positive"
            )
        for name, array in zip(("mean", "std"), numbers, strict=True):
            self.register_buffer(name, torch.from_numpy(np.atleast_1d(array).copy()))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Normalize observations, shape (batch, n)."""
        scaled = (observation - self.mean) / self.std
        return scaled if self.clip is None else torch.clamp(scaled, -self.clip, self.clip)


class Actor(torch.nn.Module):
    """Calls a network of another library in its own way; see `policies.actor`."""

    def __init__(self, network: torch.nn.Module, call: Callable[[Any, Any], Any]) -> None:
        super().__init__()
        self.network, self.call = network, call

    def forward(self, observation: torch.Tensor) -> Any:
        """Map observations (batch, n) to actions (batch, 2)."""
        return self.call(self.network, observation)


class _PolicyModule(torch.nn.Module):
    """The exported module: normalizer, then network, then clipping to [-1, 1]."""

    def __init__(self, network: torch.nn.Module, normalizer: torch.nn.Module | None) -> None:
        super().__init__()
        self.normalizer, self.network = normalizer, network

    def forward(self, observation: torch.Tensor) -> Any:
        if self.normalizer is not None:
            observation = self.normalizer(observation)
        return torch.clamp(self.network(observation), -1.0, 1.0)


class _RecurrentModule(_PolicyModule):
    """The same for a recurrent network, which maps each state to the next one, too."""

    def forward(self, observation: torch.Tensor, *states: torch.Tensor) -> Any:
        if self.normalizer is not None:
            observation = self.normalizer(observation)
        action, *after = self.network(observation, *states)
        return torch.clamp(action, -1.0, 1.0), *after


def make_normalizer(given: Any) -> torch.nn.Module | None:
    """Convert the `normalizer` argument of `save` to a module."""
    if given is None or isinstance(given, torch.nn.Module):
        return given
    if not isinstance(given, tuple | list) or len(given) not in (2, 3):
        raise PolicyError("normalizer: must be (mean, std), (mean, std, clip) or a torch module")
    return Normalizer(*given)


def describe_normalizer(bundle: Bundle, normalizer: torch.nn.Module) -> Bundle:
    """Return a bundle that says with what its network normalizes observations."""
    summary = NormalizerSummary(kind=type(normalizer).__name__)
    if isinstance(normalizer, Normalizer):
        ends = [(float(v.min()), float(v.max())) for v in (normalizer.mean, normalizer.std)]
        summary = NormalizerSummary(kind="running", clip=normalizer.clip, mean=ends[0], std=ends[1])
    seen = bundle.observation.model_copy(update={"normalizer": summary})
    return bundle.model_copy(update={"observation": seen})


def write_network(
    network: torch.nn.Module, path: Path, bundle: Bundle, normalizer: torch.nn.Module | None
) -> None:
    """Write a network as an ONNX file that `OnnxPolicy` reads, with its bundle as metadata.

    The file maps `observation` (batch, n) to `action` (batch, 2) in float32. A recurrent one, with
    a batch of one, also maps each state of the bundle to the next one.
    """
    weight = next(network.parameters(), torch.zeros(0))
    if normalizer is not None:
        normalizer.to(weight.device)
        bundle = describe_normalizer(bundle, normalizer)
    module = (_RecurrentModule if bundle.state else _PolicyModule)(network, normalizer)
    shapes = [(1, bundle.observation.width), *(state.shape for state in bundle.state)]
    example = tuple(torch.zeros(*shape, device=weight.device) for shape in shapes)
    modes = [(part, part.training) for part in module.modules()]
    module.eval()  # no dropout
    try:
        _check_module(module, example)
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # torchvision isn't needed
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # deprecations inside torch's own exporter
            program: Any = torch.onnx.export(
                module,
                example,
                input_names=["observation", *(state.input for state in bundle.state)],
                output_names=["action", *(state.output for state in bundle.state)],
                dynamic_shapes=None if bundle.state else ({0: "batch"},),
                dynamo=True,
                verbose=False,
            )
    finally:
        for part, training in modes:
            part.training = training
    model: Any = program.model_proto  # made anew by each access
    graph = model.graph
    # torch's stack traces contain paths of the training machine
    for part in (
        *(model, graph, *graph.node, *graph.input, *graph.output, *graph.value_info),
        *graph.initializer,
    ):
        del part.metadata_props[:]
    onnx.helper.set_model_props(model, {BUNDLE_KEY: bundle.as_json()})
    data = model.SerializeToString()
    if len(data) > MAX_POLICY_BYTES:
        most = f"must be {MAX_POLICY_BYTES / 1e6:g} MB at most"
        raise PolicyError(f"{path}: {len(data) / 1e6:,.0f} MB: {most}")
    path.parent.mkdir(parents=True, exist_ok=True)
    reading.write_atomically(path, data, PolicyError)


def _check_module(module: torch.nn.Module, example: tuple[torch.Tensor, ...]) -> None:
    """Run the module once; PolicyError unless weights, action and states are as they must be."""
    for name, weight in module.named_parameters():
        if not torch.isfinite(weight).all():
            raise PolicyError(
                f"the module's weights {name} hold NaN or infinity: its training diverged: train "
                "anew, for instance with a lower learning rate, or save an earlier state"
            )
    try:
        with torch.no_grad():
            given = module(*example)
    except Exception as error:
        said = f"observations of shape (batch, {example[0].shape[1]}): {format_error(error)}"
        raise PolicyError(f"the module doesn't take {said}") from error
    action, *after = given if isinstance(given, tuple) else (given,)
    if action.shape != (1, 2):
        raise PolicyError(f"the module gives shape {tuple(action.shape)}: must be (batch, 2)")
    if not torch.isfinite(action).all():
        raise PolicyError(f"the module gives {action[0].tolist()} for an observation of zeros")
    if [one.shape for one in after] != [one.shape for one in example[1:]]:
        shapes = [tuple(one.shape) for one in after]
        raise PolicyError(f"the module gives states of shape {shapes}: must be as they came in")
