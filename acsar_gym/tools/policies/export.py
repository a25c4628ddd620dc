"""Exports torch modules as ONNX policies. Imports torch and onnx."""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from acsar_gym.errors import PolicyError, format_error, require_extra
from acsar_gym.tools.policies.document import DOCUMENT_KEY, PolicyDocument
from acsar_gym.tools.policies.onnx import MAX_POLICY_BYTES

with require_extra("writing an ONNX policy (torch, onnx, onnxscript)", "train"):
    import onnx
    import onnxscript  # noqa: F401 - torch.onnx needs it
    import torch

Shape = tuple[int, ...]


class Normalizer(torch.nn.Module):
    """Normalizes observations: (observation - mean) / std, clipped to [-clip, clip]."""

    def __init__(self, mean: ArrayLike, std: ArrayLike, clip: float | None = None) -> None:
        super().__init__()
        self.mean = torch.nn.Buffer(torch.tensor(np.atleast_1d(mean), dtype=torch.float32))
        self.std = torch.nn.Buffer(torch.tensor(np.atleast_1d(std), dtype=torch.float32))
        self.clip = math.inf if clip is None else clip
        is_finite = torch.isfinite(self.mean).all() and torch.isfinite(self.std).all()
        if not (is_finite and self.std.min() > 0.0 and self.clip > 0.0):
            raise PolicyError(
                "normalizer: mean and std must be finite, std and clip must be positive"
            )

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Normalize observations, shape (batch, n)."""
        return torch.clamp((observation - self.mean) / self.std, -self.clip, self.clip)


class Actor(torch.nn.Module):
    """Calls a network of another library in its own way. See `policies.actor`."""

    def __init__(self, network: torch.nn.Module, call: Callable[..., Any]) -> None:
        super().__init__()
        self.network = network
        self.call = call

    def forward(self, observation: torch.Tensor, *states: torch.Tensor) -> Any:
        """Map observations (batch, n), and states if there are any, to actions (batch, 2)."""
        return self.call(self.network, observation, *states)


class _PolicyModule(torch.nn.Module):
    """The exported module: normalizer, then network, then clipping to [-1, 1].

    A recurrent network also maps each state to the next state.
    """

    def __init__(self, network: torch.nn.Module, normalizer: torch.nn.Module | None) -> None:
        super().__init__()
        self.normalizer = normalizer or torch.nn.Identity()
        self.network = network

    def forward(self, observation: torch.Tensor, *states: torch.Tensor) -> Any:
        returned = self.network(self.normalizer(observation), *states)
        action, *next_states = returned if states else (returned,)
        return torch.clamp(action, -1.0, 1.0), *next_states


def make_normalizer(source: Any) -> torch.nn.Module | None:
    """Convert the `normalizer` argument of `save` to a module."""
    if source is None or isinstance(source, torch.nn.Module):
        return source
    try:
        return Normalizer(*source)
    except (TypeError, ValueError) as error:
        reason = "must be (mean, std), (mean, std, clip) or a torch module"
        raise PolicyError(f"normalizer: {reason}") from error


def export_network(
    network: torch.nn.Module,
    document: PolicyDocument,
    normalizer: torch.nn.Module | None = None,
    states: Sequence[Shape] = (),
) -> bytes:
    """Return a network as the content of an ONNX file that `OnnxPolicy` reads.

    Args:
        network: Maps observations (batch, n) to actions (batch, 2). With states, it maps an
            observation and states to an action and the next states, with a batch of one.
        document: What the file contains besides it.
        normalizer: Applied to observations first.
        states: Shapes of the states.

    Raises:
        PolicyError: The network doesn't fit the document, or is too large.
    """
    # The example must be on the device of the weights.
    weight = next(network.parameters(), torch.zeros(0))
    module = _PolicyModule(network, normalizer).to(weight.device)
    shapes = [(1, document.width), *states]
    example = tuple(torch.zeros(*shape, device=weight.device) for shape in shapes)
    names = [f"state_{number}" for number in range(len(states))]

    # Users may save in the middle of a training: every layer gets its mode back.
    modes = [(layer, layer.training) for layer in module.modules()]
    module.eval()  # without dropout
    try:
        _check_module(module, example)
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # torchvision isn't needed
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # deprecations inside torch's own exporter
            program: Any = torch.onnx.export(
                module,
                example,
                input_names=["observation", *names],
                output_names=["action", *(f"next_{name}" for name in names)],
                dynamic_shapes=None if states else ({0: "batch"},),
                dynamo=True,
                verbose=False,
            )
    finally:
        for layer, is_training in modes:
            layer.training = is_training

    model: Any = program.model_proto  # each access makes a new one
    _remove_traces(model)
    onnx.helper.set_model_props(model, {DOCUMENT_KEY: document.as_json()})
    content: bytes = model.SerializeToString()
    if len(content) > MAX_POLICY_BYTES:
        size = f"{len(content) / 1e6:,.0f} MB"
        raise PolicyError(f"the policy has {size}: must be {MAX_POLICY_BYTES / 1e6:g} MB at most")
    return content


def _remove_traces(model: Any) -> None:
    """Remove torch's stack traces, which contain paths of this machine."""
    graph = model.graph
    values = (*graph.input, *graph.output, *graph.value_info, *graph.initializer)
    for place in (model, graph, *graph.node, *values):
        del place.metadata_props[:]


def _check_module(module: torch.nn.Module, example: tuple[torch.Tensor, ...]) -> None:
    """Run the module once. PolicyError unless action and states are as they must be."""
    # A wrong module is refused here, as errors of the exporter take a page.
    try:
        with torch.no_grad():
            results = module(*example)
    except Exception as error:
        shape = f"(batch, {example[0].shape[1]})"
        raise PolicyError(
            f"the module doesn't take observations of shape {shape}: {format_error(error)}"
        ) from error

    shapes = [tuple(result.shape) for result in results]
    expected = [(1, 2), *(tuple(state.shape) for state in example[1:])]
    if shapes != expected:
        raise PolicyError(f"the module gives shapes {shapes}: must be {expected}")
    weights = (*module.parameters(), results[0])
    if not all(torch.isfinite(weight).all() for weight in weights):
        raise PolicyError(
            "the module's weights contain NaN or infinity, because its training diverged: train "
            "again with a lower learning rate, or save an earlier state"
        )
