"""Export of stable-baselines3's models as ONNX policies. Imports torch."""

from __future__ import annotations

import io
import pickle
import warnings
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Space

from acsar_gym import reading
from acsar_gym.envs.ids import full_id, strip_module
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import PolicyError, escape_unprintable, format_error, require_extra
from acsar_gym.tasks.factory import task_name
from acsar_gym.tools.policies.document import (
    DOCUMENT_KEY,
    PolicyDocument,
    describe_policy,
    parse_document,
)
from acsar_gym.tools.policies.export import Actor, Normalizer, Shape, export_network
from acsar_gym.tools.policies.saving import planar_env

with require_extra("stable-baselines3", "train"):
    import torch
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
    from stable_baselines3.common.running_mean_std import RunningMeanStd
    from stable_baselines3.common.save_util import load_from_zip_file
    from stable_baselines3.common.vec_env import VecNormalize

MAX_STATISTICS_BYTES = 100_000_000
"""Largest accepted VecNormalize file [bytes]. It can contain old observations."""
STATISTICS_PATTERNS = ("*vecnormalize*.pkl", "*/vecnormalize.pkl")
"""Names of VecNormalize files in a model's folder or, as RL Zoo stores them, one folder deeper."""
INFERENCE_OBJECTS = {"learning_rate": 0.0, "lr_schedule": None, "clip_range": 0.0}
"""Replace what only training needs. Other Python versions may not unpickle schedules."""


def _decide(policy: Any, observation: Any) -> Any:
    """Map observations (batch, n) to the deterministic actions of a policy."""
    return policy._predict(observation, deterministic=True)  # noqa: SLF001


def _decide_by_memory(policy: Any, observation: Any, *states: Any) -> Any:
    """The same for a policy of RecurrentPPO, whose states are those of the actor's LSTM."""
    features = policy.extract_features(observation, policy.pi_features_extractor)
    latent, next_states = policy.lstm_actor(features.unsqueeze(0), states)
    action = policy.action_net(policy.mlp_extractor.forward_actor(latent.squeeze(0)))
    if policy.squash_output:  # with use_sde, if the recipe asks for it
        action = torch.tanh(action)
    return action, *next_states


def label(model: BaseAlgorithm, document: PolicyDocument) -> None:
    """Store in a model what it was trained for and how. `model.save` keeps this."""
    setattr(model, DOCUMENT_KEY, document.as_json())


def export_policy(
    policy: BasePolicy, document: PolicyDocument, normalizer: Normalizer | None = None
) -> bytes:
    """Return the deterministic actor of a model as the content of an ONNX file.

    Args:
        policy: The policy of a model of PPO, A2C, SAC, TD3, DDPG, TQC or RecurrentPPO.
        document: What it was trained for.
        normalizer: Applied to observations first.

    Raises:
        PolicyError: The policy doesn't fit the document, or can't be exported.
    """
    # An LSTM has two states, which become inputs and outputs of the network.
    actor = Actor(policy, _decide)
    states: tuple[Shape, ...] = ()
    lstm: Any = getattr(policy, "lstm_actor", None)
    if lstm is not None:
        actor = Actor(policy, _decide_by_memory)
        states = ((lstm.num_layers, 1, lstm.hidden_size),) * 2

    torch.distributions.Distribution.set_default_validate_args(False)  # can't be exported
    try:
        return export_network(actor, document, normalizer, states)
    finally:
        torch.distributions.Distribution.set_default_validate_args(__debug__)


def convert_zip(
    content: bytes,
    path: Path,
    env_id: str = "",
    robot: str | Path | None = None,
    vecnormalize: str | Path | None = None,
) -> bytes:
    """Return the policy of a model's zip as the content of an ONNX file. Can run code of the zip.

    Args:
        content: Content of the zip.
        path: Its path, beside which a VecNormalize may be.
        env_id: Id of the env that it is for. Default: that of its label.
        robot: Preset or file of the robot of the training, if there is no label.
        vecnormalize: File of the VecNormalize of the training, or "none".

    Raises:
        PolicyError: It can't be converted. The message doesn't name the zip.
    """
    data, policy = _load_zip(content)
    document = None
    with suppress(PolicyError):  # of an older version: like no label
        document = parse_document({DOCUMENT_KEY: str(data.get(DOCUMENT_KEY))})
    if document is None or (env_id and document.env != strip_module(full_id(env_id))):
        if not env_id:
            raise PolicyError(
                "doesn't say which environment it is for: add --env point_goal or another"
            )
        with planar_env(env_id, robot=robot) as env:
            document = describe_policy(env, env_id, width=_find_width(policy, env))

    # VecNormalize isn't part of a zip.
    file = _find_statistics(data, path, vecnormalize)
    normalizer = None if file is None else read_normalizer(file, document.width)
    return export_policy(policy, document, normalizer)


def _load_zip(content: bytes) -> tuple[dict[str, Any], BasePolicy]:
    """Load the data of a zip, and make its policy without its algorithm."""
    loading: Any = load_from_zip_file
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about objects that can't be unpickled or are unused
            data, parameters, _ = loading(
                io.BytesIO(content), device="cpu", custom_objects=INFERENCE_OBJECTS
            )
        spaces = (data["observation_space"], data["action_space"])
        arguments = dict(data["policy_kwargs"])
        if issubclass(data["policy_class"], ActorCriticPolicy):
            arguments["use_sde"] = data["use_sde"]
        if all(isinstance(space, Box) for space in spaces):
            policy: BasePolicy = data["policy_class"](*spaces, lambda _: 0.0, **arguments)
            policy.load_state_dict(parameters["policy"])
            return data, policy
    except Exception as error:
        raise PolicyError(f"not a stable-baselines3 model: {format_error(error)}") from error

    raise PolicyError(
        f"made for {_describe(*spaces)}: a policy of this package gets a row of numbers and gives "
        "two"
    )


def _find_width(policy: BasePolicy, env: RobotEnv) -> int:
    """Return how many numbers of an env's observation a policy takes.

    Raises:
        PolicyError: The spaces of the policy aren't those of the env.
    """
    # The last sensors may be left out, so only the first numbers are compared.
    observed: Any = env.observation_space
    space: Any = policy.observation_space
    width = len(space.low)
    ends = [observed.low[:width], observed.high[:width]]
    is_equal = np.array_equal([space.low, space.high], ends)
    if not is_equal or policy.action_space != env.action_space:
        raise PolicyError(
            f"made for {_describe(space, policy.action_space)}, but {task_name(env.task)} has "
            f"{_describe(observed, env.action_space)}: of the wrappers that change observations, "
            "only VecNormalize can be part of a policy"
        )
    return width


def _describe(*spaces: Space[Any]) -> str:
    """Describe the spaces of observations and actions in a few words."""
    return " and ".join(escape_unprintable(" ".join(str(space).split()), 80) for space in spaces)


# VecNormalize


def _find_statistics(data: Mapping[str, Any], path: Path, named: str | Path | None) -> Path | None:
    """Return the VecNormalize file to use.

    Raises:
        PolicyError: The model needs one that isn't there, or it isn't known whether it needs the
            one that is there.
    """
    if named is not None:
        return None if str(named) == "none" else Path(named)
    is_normalized = _is_normalized(data)
    if is_normalized is False:
        return None

    # Next to the model, as its own example and RL Zoo save it.
    files = [file for pattern in STATISTICS_PATTERNS for file in sorted(path.parent.glob(pattern))]
    if is_normalized and len(files) == 1:
        return files[0]
    convert = f"'acsar-gym policy {path} --out policy.onnx --trust --vecnormalize"
    if is_normalized and not files:
        raise PolicyError(
            f"was trained with a VecNormalize, whose file isn't beside it: convert it with "
            f"{convert} FILE', or --vecnormalize none if it changed only rewards"
        )
    # Checkpoints have a file each: the wrong one would give wrong actions.
    if files:
        more = f", and {len(files) - 1} more" if files[1:] else ""
        raise PolicyError(
            f"{files[0]}{more} is beside it: if it was trained with that VecNormalize, convert it "
            f"with {convert} {files[0]}', otherwise name another, or --vecnormalize none"
        )
    return None


def _is_normalized(data: Mapping[str, Any]) -> bool | None:
    """Find out whether a model was trained with a VecNormalize that changes observations.

    A zip contains the last observation as the network got it, and the original one if there was a
    VecNormalize. SAC, TD3, DDPG and TQC always have an original one, so there what the network got
    must have left the observation space.

    Returns:
        None if the zip doesn't show it, as after loading a model and saving it again.
    """
    normalized = data.get("_last_obs")
    original = data.get("_last_original_obs")
    if normalized is None:
        return None
    if original is None or np.array_equal(normalized, original):
        return False
    # Normalized numbers are seldom all within the bounds of the original ones.
    space = data["observation_space"]
    is_outside = bool(((normalized < space.low) | (normalized > space.high)).any())
    return True if is_outside or "replay_buffer_class" not in data else None


def read_normalizer(path: Path, width: int) -> Normalizer | None:
    """Read the normalization of observations from a saved VecNormalize, which can run any code.

    Args:
        path: The pickle file.
        width: Size of an observation.

    Returns:
        The module. None if the VecNormalize doesn't change observations.

    Raises:
        PolicyError: The file can't be read, isn't a VecNormalize, or is for other observations.
    """
    data = reading.read_file(path, MAX_STATISTICS_BYTES, PolicyError)
    try:
        saved: Any = pickle.loads(data)  # noqa: S301 - only with --trust
    except Exception as error:
        raise PolicyError(f"{path}: not a VecNormalize: {format_error(error)}") from error
    if not isinstance(saved, VecNormalize):
        raise PolicyError(f"{path}: contains a {type(saved).__name__}, not a VecNormalize")
    if not saved.norm_obs:
        return None

    statistics: Any = saved.obs_rms
    if not isinstance(statistics, RunningMeanStd) or statistics.mean.shape != (width,):
        raise PolicyError(f"{path}: isn't for observations of {width} numbers")
    # As VecNormalize itself does it.
    deviation = np.sqrt(statistics.var + saved.epsilon)
    return Normalizer(statistics.mean, deviation, saved.clip_obs)
