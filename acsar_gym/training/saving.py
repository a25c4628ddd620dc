"""Writes the results of a training: the model to continue from, and the policy to run."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acsar_gym.evaluation import provenance
from acsar_gym.policies.bundle import Bundle, Training
from acsar_gym.reading import bounded
from acsar_gym.recording.header import plain
from acsar_gym.training import record

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm


FILES = ("policy.onnx", "model.zip")
"""What a training leaves: the policy to drive with, and the model to train on."""


def save(model: BaseAlgorithm, bundle: Bundle, out: Path) -> tuple[Path, Path]:
    """Write policy.onnx and model.zip into a folder.

    Args:
        model: the trained model.
        bundle: what it was trained for and how.
        out: an existing folder.

    Returns:
        Paths of policy.onnx and model.zip.

    Raises:
        PolicyError: the policy can't be exported.
    """
    from acsar_gym.policies import sb3, sb3_export  # noqa: PLC0415 - imports torch

    sb3.label(model, bundle)
    policy, zipped = (out / name for name in FILES)
    with bounded.replacing(zipped) as new:
        model.save(new)
    sb3_export.export(model.policy, policy, bundle)
    return policy, zipped


def told(
    model: BaseAlgorithm,
    commands: Sequence[Sequence[str]],
    hyperparameters: Mapping[str, Any],
    seconds: float,
) -> Training:
    """Describe a training that has just ended, for the bundle of its policy.

    Args:
        model: the trained model.
        commands: that began the training and went on with it.
        hyperparameters: of the algorithm, by name.
        seconds: how long it took [s].
    """
    return Training(
        algorithm=type(model).__name__,
        hyperparameters=plain(dict(hyperparameters)),
        steps=model.num_timesteps,
        seed=model.seed,
        command="; ".join(map(shlex.join, commands))[:2_000],
        versions=provenance.versions(*record.LIBRARIES),
        revision=record.revision() or "",
        seconds=seconds,
        finished=datetime.now(UTC).isoformat(timespec="seconds"),
    )
