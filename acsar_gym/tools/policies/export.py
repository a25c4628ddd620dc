"""Exports torch modules as ONNX policies. Imports torch and onnx."""

from __future__ import annotations

import contextlib
import logging
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acsar_gym import reading
from acsar_gym.errors import MissingExtraError, PolicyError
from acsar_gym.tools.policies import bundle as bundles
from acsar_gym.tools.policies.base import format_error
from acsar_gym.tools.policies.bundle import Bundle
from acsar_gym.tools.policies.onnx import inspect_network

try:
    import onnx
    import onnxscript  # noqa: F401 - torch.onnx needs it
    import torch
except ImportError:
    raise MissingExtraError("writing an ONNX policy (torch, onnx, onnxscript)", "train") from None


class Normalizer(torch.nn.Module):
    """Normalizes observations: (observation - mean) / std, clipped to [-clip, clip].

    Args:
        mean: a number, or shape (n,).
        std: positive; a number, or shape (n,).
        clip: positive; None for no clipping.

    Raises:
        PolicyError: for other values.
    """

    def __init__(self, mean: ArrayLike, std: ArrayLike, clip: float | None = None) -> None:
        super().__init__()
        self.mean: torch.Tensor
        self.std: torch.Tensor
        for name, values in (("mean", mean), ("std", std)):
            numbers = _numbers(values)
            if numbers.ndim > 1 or not np.isfinite(numbers).all():
                raise PolicyError(f"normalizer: {name} must be finite numbers, one each")
            self.register_buffer(name, torch.from_numpy(np.atleast_1d(numbers).copy()))
        limit = np.ones(()) if clip is None else _numbers(clip)
        if not bool((self.std > 0.0).all()) or limit.ndim or not limit > 0.0:
            raise PolicyError("normalizer: std and clip must be positive")
        self.clip = None if clip is None else float(limit)

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


def make_normalizer(given: Any) -> torch.nn.Module | None:
    """Convert the `normalizer` argument of `save` to a module.

    Args:
        given: None, a module, (mean, std) or (mean, std, clip).

    Raises:
        PolicyError: for anything else.
    """
    if given is None or isinstance(given, torch.nn.Module):
        return given
    if not isinstance(given, tuple | list) or len(given) not in (2, 3):
        raise PolicyError("normalizer: must be (mean, std), (mean, std, clip) or a torch module")
    return Normalizer(*given)


def _numbers(values: ArrayLike) -> NDArray[np.float32]:
    """Convert to a float32 array; a single NaN if the values aren't numbers."""
    try:
        return np.asarray(values, np.float32)
    except (TypeError, ValueError):
        return np.full((), np.nan, np.float32)


def _summary(module: torch.nn.Module) -> bundles.NormalizerSummary:
    """Describe a normalizer, which becomes part of the graph."""
    if not isinstance(module, Normalizer):
        return bundles.NormalizerSummary(kind=type(module).__name__)
    mean, std = ((float(v.min()), float(v.max())) for v in (module.mean, module.std))
    return bundles.NormalizerSummary(kind="running", clip=module.clip, mean=mean, std=std)


class _Whole(torch.nn.Module):
    """The exported module: normalizer, then network, then clipping to [-1, 1]."""

    def __init__(self, network: torch.nn.Module, normalizer: torch.nn.Module | None) -> None:
        super().__init__()
        self.normalizer, self.network = normalizer, network

    def forward(self, observation: torch.Tensor) -> Any:
        if self.normalizer is not None:
            observation = self.normalizer(observation)
        return torch.clamp(self.network(observation), -1.0, 1.0)


class _Recurrent(_Whole):
    """The same for a recurrent network, which maps each state to the next one, too."""

    def forward(self, observation: torch.Tensor, *states: torch.Tensor) -> Any:
        if self.normalizer is not None:
            observation = self.normalizer(observation)
        action, *after = self.network(observation, *states)
        return torch.clamp(action, -1.0, 1.0), *after


def write_network(
    network: torch.nn.Module, path: Path, bundle: Bundle, normalizer: torch.nn.Module | None
) -> None:
    """Write a network as an ONNX file that `OnnxPolicy` reads.

    The file maps `observation` (batch, n) to `action` (batch, 2) in float32. A recurrent one, with
    a batch of one, also maps each state of the bundle to the next one.

    Args:
        network: maps normalized observations (batch, n) to actions (batch, 2); a recurrent one
            (observation, state, ...) to (action, next state, ...).
        path: file to write; its folder is created.
        bundle: what the policy was trained for and how; the normalizer is added to it.
        normalizer: module that is applied to observations (batch, n) first; None for none.

    Raises:
        PolicyError: the network doesn't fit the env, or has operations that OnnxPolicy rejects.
    """
    whole = (_Recurrent if bundle.state else _Whole)(network, normalizer)
    with _evaluating(whole):
        _check_weights(whole)
        shapes = [(1, bundle.observation.width), *(state.shape for state in bundle.state)]
        example = tuple(torch.zeros(*shape, device=_device(whole)) for shape in shapes)
        _check(whole, example)
        model: Any = _exported(whole, example, bundle)
    _forget_sources(model)
    if normalizer is not None:
        seen = bundle.observation.model_copy(update={"normalizer": _summary(normalizer)})
        bundle = bundle.model_copy(update={"observation": seen})
    onnx.helper.set_model_props(model, {bundles.BUNDLE_KEY: bundle.as_json()})
    data = model.SerializeToString()
    try:
        inspect_network(data)
    except PolicyError as error:
        raise PolicyError(f"{path}: can't be written: it {error}") from None
    path.parent.mkdir(parents=True, exist_ok=True)
    reading.write_atomically(path, data, PolicyError)


def _exported(whole: torch.nn.Module, example: tuple[torch.Tensor, ...], bundle: Bundle) -> Any:
    """Export the module to an ONNX model, with a free batch size unless it is recurrent."""
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # torchvision isn't needed
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # deprecations inside torch's own exporter
        program: Any = torch.onnx.export(
            whole,
            example,
            input_names=["observation", *(state.input for state in bundle.state)],
            output_names=["action", *(state.output for state in bundle.state)],
            dynamic_shapes=None if bundle.state else ({0: "batch"},),
            dynamo=True,
            verbose=False,
        )
    return program.model_proto


def _check_weights(whole: torch.nn.Module) -> None:
    """Raise PolicyError for weights that are NaN or infinite, as after a training that diverged."""
    for name, weight in whole.named_parameters():
        if not torch.isfinite(weight).all():
            raise PolicyError(
                f"the module's weights {name} hold NaN or infinity: its training diverged: train "
                "anew, for instance with a lower learning rate, or save an earlier state"
            )


def _check(whole: torch.nn.Module, example: tuple[torch.Tensor, ...]) -> None:
    """Run the module once; PolicyError unless it gives an action (1, 2) and the same states."""
    try:
        with torch.no_grad():
            given = whole(*example)
    except Exception as error:  # noqa: BLE001 - whatever a user's module raises
        said = f"observations of shape (batch, {example[0].shape[1]}): {format_error(error)}"
        raise PolicyError(f"the module doesn't take {said}") from None
    action, *after = given if isinstance(given, tuple) else (given,)
    if action.shape != (1, 2):
        raise PolicyError(f"the module gives shape {tuple(action.shape)}: must be (batch, 2)")
    if not torch.isfinite(action).all():
        raise PolicyError(f"the module gives {action[0].tolist()} for an observation of zeros")
    if [one.shape for one in after] != [one.shape for one in example[1:]]:
        shapes = [tuple(one.shape) for one in after]
        raise PolicyError(f"the module gives states of shape {shapes}: must be as they came in")


@contextlib.contextmanager
def _evaluating(module: torch.nn.Module) -> Iterator[None]:
    """Switch all parts to evaluation mode (no dropout), and restore each one's mode at the end."""
    modes = [(part, part.training) for part in module.modules()]
    module.eval()
    try:
        yield
    finally:
        for part, training in modes:
            part.training = training


def _device(module: _Whole) -> torch.device:
    """Return the device of the network's weights, and move the normalizer to it."""
    weight = next(module.network.parameters(), torch.zeros(0))
    if module.normalizer is not None:
        module.normalizer.to(weight.device)
    return weight.device


def _forget_sources(model: Any) -> None:
    """Remove torch's stack traces from the model; they contain paths of the training machine."""
    graph = model.graph
    for part in (model, graph, *graph.node, *graph.input, *graph.output, *graph.value_info):
        del part.metadata_props[:]
    for weight in graph.initializer:
        del weight.metadata_props[:]
