"""The bundle of a policy file in words."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from acsar_gym import reading
from acsar_gym.errors import PolicyError
from acsar_gym.tools.policies import describe
from acsar_gym.tools.policies.base import resolve
from acsar_gym.tools.policies.bundle import Bundle, ObservationLayout
from acsar_gym.tools.policies.onnx import MAX_POLICY_BYTES, inspect_network

Row = tuple[str, str]


def read_bundle(path: str | Path) -> tuple[Path, Bundle]:
    """Read the bundle of a policy file; neither onnxruntime nor the network is run.

    Args:
        path: an ONNX file, or the name of a policy that comes with the package.

    Returns:
        Path of the file, and its bundle.

    Raises:
        PolicyError: the file is missing, or isn't a policy that this package accepts.
    """
    found = resolve(path)
    data = reading.read_file(found, MAX_POLICY_BYTES, PolicyError)
    try:
        return found, inspect_network(data)[1]
    except PolicyError as error:
        raise PolicyError(f"{found}: {error}") from None


def bundle_rows(bundle: Bundle) -> Iterator[Row]:
    """Yield what a bundle says, as names and values."""
    env, robot = bundle.env, bundle.robot
    yield "environment", env.id
    yield "options", _mapping(env.options)
    yield "worlds", env.worlds or "none"
    yield from _observation(bundle.observation)
    yield "action", ", ".join(map(_part, *_action(bundle)))
    yield "state", ", ".join(f"{one.input} {list(one.shape)}" for one in bundle.state) or "none"
    yield "rates", f"policy {bundle.rates.policy:g} Hz, control {bundle.rates.control:g} Hz"
    yield "robot", f"{robot.name or 'unnamed'}, config {robot.sha256[:16]}"
    yield "calibration", (robot.calibration_sha256 or "none")[:16]
    known = {
        name: describe.format_value(value)
        for name, value in robot.values.items()
        if value is not None
    }
    yield "", _mapping(known)
    yield from _trained(bundle)


def _observation(seen: ObservationLayout) -> Iterator[Row]:
    """Yield the layout of an observation."""
    yield "observation", ", ".join(map(_part, seen.names, seen.low, seen.high))
    yield "sensors", ", ".join(sensor.layout for sensor in seen.sensors) or "none"
    yield "distances", "not scaled" if seen.scale is None else f"divided by {seen.scale:g} m"
    normalizer = seen.normalizer
    told = "none"
    if normalizer is not None:
        told = f"{normalizer.kind}, part of the network"
        for name in ("mean", "std"):
            ends = getattr(normalizer, name)
            told += "" if ends is None else f", {name} {ends[0]:.3g} to {ends[1]:.3g}"
        told += "" if normalizer.clip is None else f", clipped to {normalizer.clip:g}"
    yield "normalizer", told


def _trained(bundle: Bundle) -> Iterator[Row]:
    """Yield how the policy was trained, and its figures."""
    ranges = bundle.randomization
    yield (
        "randomization",
        "not known"
        if ranges is None
        else _mapping(
            {
                name: " to ".join(f"{one:.4g}" for one in (min(v), max(v)))
                for name, v in ranges.items()
            }
        ),
    )
    told = {} if bundle.training is None else bundle.training.model_dump(mode="json")
    for name, value in told.items():
        if value not in (None, "", {}):
            yield name, _mapping(value) if isinstance(value, dict) else str(value)
    for name, figures in bundle.metrics.items():
        yield name, _mapping({key: describe.format_value(value) for key, value in figures.items()})


def _action(bundle: Bundle) -> tuple[list[str], tuple[float, ...], tuple[float, ...]]:
    """Return names with units, and the ends of the ranges of an action."""
    action = bundle.action
    names = [f"{name} (x {unit})" for name, unit in zip(action.names, action.units, strict=False)]
    return names, action.low, action.high


def _part(name: str, low: float | None, high: float | None) -> str:
    ends = ("-inf" if low is None else f"{low:g}", "inf" if high is None else f"{high:g}")
    return f"{name} {ends[0]} to {ends[1]}"


def _mapping(values: Mapping[str, Any]) -> str:
    """Format a mapping on one line."""
    parts = [f"{k} {v if isinstance(v, str) else json.dumps(v)}" for k, v in values.items()]
    return ", ".join(parts) or "none"
