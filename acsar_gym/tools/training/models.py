"""Makes and loads the models of a training, and decides with them. Imports torch."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm

from acsar_gym.errors import AcsarError, ConfigError, PolicyError, format_error
from acsar_gym.tools.policies import ZipPolicy, sb3
from acsar_gym.tools.training import checkpoints
from acsar_gym.tools.training.checkpoints import TrainingState
from acsar_gym.tools.training.held_out import FIRST_HELD_OUT_SEED, Decide
from acsar_gym.tools.training.plan import TrainingPlan
from acsar_gym.vector.env import RobotVectorEnv

MAX_TORCH_THREADS = 2
"""Default limit of torch's threads; more don't help with networks this small."""


def prepare_torch(plan: TrainingPlan) -> None:
    """Set the number of torch's threads, and check the device."""
    torch.set_num_threads(min(plan.threads, plan.options.threads or MAX_TORCH_THREADS))
    if plan.options.device == "cuda" and not torch.cuda.is_available():
        why = (
            "has no CUDA device that it can use" if torch.version.cuda else "is built without CUDA"
        )
        raise ConfigError(f"--device cuda: torch {torch.__version__} {why}: leave --device away")


def make_model(plan: TrainingPlan, env: RobotVectorEnv) -> BaseAlgorithm:
    """Make a new model by the recipe."""
    recipe = plan.recipe
    arguments = recipe.build_arguments()
    steps, size = (arguments.get(name) for name in ("n_steps", "batch_size"))
    if isinstance(steps, int) and isinstance(size, int):
        arguments["batch_size"] = min(size, steps * env.num_envs)
    given: dict[str, Any] = (
        {"stats_window_size": env.num_envs} | arguments | _common_arguments(plan)
    )
    try:
        return plan.algorithm.load()(env=recipe.wrap_batch(sb3.BatchVecEnv(env)), **given)
    except AcsarError:
        raise
    except Exception as error:
        raise ConfigError(f"{recipe.file}: {recipe.key}: {format_error(error)}") from error


def load_model(
    plan: TrainingPlan, env: RobotVectorEnv, saved: ZipPolicy, state: TrainingState | None
) -> BaseAlgorithm:
    """Load a model, with the hyperparameters that it was saved with."""
    saved.check(env.task, env.sensors)
    if saved.algorithm != plan.algorithm.kind:
        raise PolicyError(
            f"{saved.path}: is of {saved.algorithm}, but with --algo {plan.algorithm.name} only "
            f"{plan.algorithm.kind}'s models can be trained on"
        )
    batch = plan.recipe.wrap_batch(sb3.BatchVecEnv(env))
    arguments = _common_arguments(plan)
    if state is not None:
        arguments["seed"] = (plan.options.seed + state.steps) % FIRST_HELD_OUT_SEED
    model = plan.algorithm.load().load(saved.path, batch, **arguments)
    if state is not None:
        checkpoints.load_beside(saved.path.parent, model)
    return model


def _common_arguments(plan: TrainingPlan) -> dict[str, Any]:
    """Return the arguments of a model that don't come from recipes."""
    logs = str(plan.out / "tensorboard")
    return {"device": plan.options.device, "seed": plan.options.seed, "tensorboard_log": logs}


def make_decider(model: BaseAlgorithm) -> Decide:
    """Return a function from observations (n, m) to deterministic actions (n, 2).

    A recurrent policy's state begins at the first call, and is kept for all robots from then on.
    """
    policy: Any = model.policy
    device, state, width = policy.device, None, policy.observation_space.shape[0]

    def decide(seen: NDArray[np.float32]) -> NDArray[np.float32]:
        """As the policy's `predict`, in half the time."""
        seen = np.ascontiguousarray(seen[:, :width])
        with torch.no_grad():
            action = policy._predict(torch.from_numpy(seen).to(device), deterministic=True)  # noqa: SLF001
        clipped: NDArray[np.float32] = np.clip(action.cpu().numpy(), -1.0, 1.0)
        return clipped

    def decide_with_state(seen: NDArray[np.float32]) -> NDArray[np.float32]:
        nonlocal state
        begun = np.full(len(seen), state is None)
        action, state = policy.predict(seen[:, :width], state, begun, deterministic=True)
        return np.asarray(action, np.float32)

    return decide_with_state if hasattr(policy, "lstm_actor") else decide
