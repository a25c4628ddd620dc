"""Exports torch modules as ONNX policies. Imports torch and onnx."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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
        self.mean: torch.Tensor
        self.std: torch.Tensor
        self.clip = clip
        try:
            numbers = [
                np.atleast_1d(np.array(values, np.float32)) for values in (mean, std, clip or 1)
            ]
        except (TypeError, ValueError):
            numbers = [np.full(1, np.nan)] * 3

        is_finite = all(np.isfinite(array).all() and array.ndim == 1 for array in numbers)
        if not is_finite or numbers[1].min() <= 0.0 or numbers[2].min() <= 0.0 or clip == 0:
            raise PolicyError(
                "normalizer: mean, std and clip must be finite numbers, std and clip positive"
            )
        self.register_buffer("mean", torch.from_numpy(numbers[0]))
        self.register_buffer("std", torch.from_numpy(numbers[1]))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Normalize observations, shape (batch, n)."""
        scaled = (observation - self.mean) / self.std
        return scaled if self.clip is None else torch.clamp(scaled, -self.clip, self.clip)


class Actor(torch.nn.Module):
    """Calls a network of another library in its own way; see `policies.actor`."""

    def __init__(self, network: torch.nn.Module, call: Callable[[Any, Any], Any]) -> None:
        super().__init__()
        self.network = network
        self.call = call

    def forward(self, observation: torch.Tensor) -> Any:
        """Map observations (batch, n) to actions (batch, 2)."""
        return self.call(self.network, observation)


class _PolicyModule(torch.nn.Module):
    """The exported module: normalizer, then network, then clipping to [-1, 1]."""

    def __init__(self, network: torch.nn.Module, normalizer: torch.nn.Module | None) -> None:
        super().__init__()
        self.normalizer = normalizer or torch.nn.Identity()
        self.network = network

    def forward(self, observation: torch.Tensor) -> Any:
        return torch.clamp(self.network(self.normalizer(observation)), -1.0, 1.0)


class _RecurrentModule(_PolicyModule):
    """The same for a recurrent network, which also maps each state to the next one."""

    def forward(self, observation: torch.Tensor, *states: torch.Tensor) -> Any:
        action, *next_states = self.network(self.normalizer(observation), *states)
        return torch.clamp(action, -1.0, 1.0), *next_states


def make_normalizer(source: Any) -> torch.nn.Module | None:
    """Convert the `normalizer` argument of `save` to a module."""
    if source is None or isinstance(source, torch.nn.Module):
        return source
    if not isinstance(source, tuple | list) or len(source) not in (2, 3):
        raise PolicyError("normalizer: must be (mean, std), (mean, std, clip) or a torch module")
    return Normalizer(*source)


def export_network(
    network: torch.nn.Module,
    document: PolicyDocument,
    normalizer: torch.nn.Module | None = None,
    states: Sequence[Shape] = (),
) -> bytes:
    """Return a network as the content of an ONNX file that `OnnxPolicy` reads.

    Args:
        network: Maps observations (batch, n) to actions (batch, 2); with states, an observation and
            states to an action and the next states, with a batch of one.
        document: What the file contains besides it.
        normalizer: Applied to observations first.
        states: Shapes of the states.

    Raises:
        PolicyError: The network doesn't fit the document, or is too large.
    """
    weight = next(network.parameters(), torch.zeros(0))
    module = (_RecurrentModule if states else _PolicyModule)(network, normalizer).to(weight.device)
    shapes = [(1, document.width), *states]
    example = tuple(torch.zeros(*shape, device=weight.device) for shape in shapes)
    names = [f"state_{number}" for number in range(len(states))]
    with _evaluation_mode(module), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # deprecations inside torch's own exporter
        _check_module(module, example)
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # torchvision isn't needed
        program: Any = torch.onnx.export(
            module,
            example,
            input_names=["observation", *names],
            output_names=["action", *(f"next_{name}" for name in names)],
            dynamic_shapes=None if states else ({0: "batch"},),
            dynamo=True,
            verbose=False,
        )

    model: Any = program.model_proto  # each access makes a new one
    _remove_traces(model)
    onnx.helper.set_model_props(model, {DOCUMENT_KEY: document.as_json()})
    content: bytes = model.SerializeToString()
    if len(content) > MAX_POLICY_BYTES:
        size = f"{len(content) / 1e6:,.0f} MB"
        raise PolicyError(f"the policy has {size}: must be {MAX_POLICY_BYTES / 1e6:g} MB at most")
    return content


@contextmanager
def _evaluation_mode(module: torch.nn.Module) -> Iterator[None]:
    """Switch dropout off, and set every part back to its mode."""
    modes = [(layer, layer.training) for layer in module.modules()]
    module.eval()
    try:
        yield
    finally:
        for layer, is_training in modes:
            layer.training = is_training


def _remove_traces(model: Any) -> None:
    """Remove torch's stack traces, which contain paths of this machine."""
    graph = model.graph
    values = (*graph.input, *graph.output, *graph.value_info, *graph.initializer)
    for place in (model, graph, *graph.node, *values):
        del place.metadata_props[:]


def _check_module(module: torch.nn.Module, example: tuple[torch.Tensor, ...]) -> None:
    """Run the module once; PolicyError unless weights, action and states are as they must be."""
    for name, weight in module.named_parameters():
        if not torch.isfinite(weight).all():
            raise PolicyError(
                f"the module's weights {name} contain NaN or infinity, because its training "
                "diverged: train again with a lower learning rate, or save an earlier state"
            )
    try:
        with torch.no_grad():
            returned = module(*example)
    except Exception as error:
        shape = f"(batch, {example[0].shape[1]})"
        raise PolicyError(
            f"the module doesn't take observations of shape {shape}: {format_error(error)}"
        ) from error

    action, *states = returned if isinstance(returned, tuple) else (returned,)
    if action.shape != (1, 2):
        raise PolicyError(f"the module gives shape {tuple(action.shape)}: must be (batch, 2)")
    if not torch.isfinite(action).all():
        raise PolicyError(f"the module gives {action[0].tolist()} for an observation of zeros")
    if [state.shape for state in states] != [state.shape for state in example[1:]]:
        shapes = [tuple(state.shape) for state in states]
        raise PolicyError(f"the module gives states of shape {shapes}: must be those that it takes")
