"""Batches against Gymnasium's SyncVectorEnv of single planar envs: the same numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from acsar_gym.envs.ids import full_id, make_vec
from acsar_gym.registration import snake_case

Compare = Callable[..., int]
OBSERVED = 1e-6
"""Tolerance of observations, which are float32."""


class WithOptions(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Gives every reset the options that a robot of a batch keeps."""

    def __init__(self, env: Any, options: dict[str, Any]) -> None:
        super().__init__(env)
        self._options = options

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return self.env.reset(seed=seed, options=self._options)


def row_of(value: Any, robot: int, count: int) -> Any:
    """An option's value for one of the robots."""
    rows = np.asarray(value)
    is_for_each = rows.ndim == 2 or (rows.ndim == 1 and len(rows) == count)
    row = rows[robot] if is_for_each else rows
    return int(row) if row.ndim == 0 else tuple(row.tolist())


@pytest.fixture
def compare() -> Compare:
    """`compare("PointGoal", arguments, steps)` returns how many episodes have ended."""

    def compare_robots(
        kind: str,
        arguments: dict[str, Any],
        steps: int,
        robots: Sequence[int] = (1,),
        count: int = 3,
        *,
        seed: int = 40,
        options: dict[str, Any] | None = None,
        mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        speed: float = 1.0,
    ) -> int:
        env_id = full_id(snake_case(kind))
        arguments = {"max_episode_steps": 60, **arguments}
        fleet = arguments.get("robot")

        def make_single(i: int) -> Any:
            robot = {"robot": fleet[i % len(fleet)]} if isinstance(fleet, list) else {}
            chosen = {name: row_of(value, i, count) for name, value in (options or {}).items()}
            env = gymnasium.make(
                env_id, link="planar", disable_env_checker=True, **arguments | robot
            )
            return WithOptions(env, chosen)

        batch: Any = make_vec(env_id, count, threads=1, autoreset_mode=mode, **arguments)
        singles = SyncVectorEnv(
            [lambda i=i: make_single(i) for i in robots],  # type: ignore[misc]
            autoreset_mode=mode,
        )
        places = list(robots)
        observations, info = batch.reset(seed=seed, options=options)
        expected, expected_info = singles.reset(seed=[seed + i for i in robots])
        rng = np.random.default_rng(0)
        ends = 0
        for step in range(steps):
            assert observations[places] == pytest.approx(expected, abs=OBSERVED)
            compare_infos(info, expected_info, places)

            actions = rng.uniform((-speed, -1.0), (speed, 1.0), (count, 2)).astype(np.float32)
            if step % 100 < 70 and speed == 1.0:
                actions[:, 0] = abs(actions[:, 0])
            actions *= step % 17 != 0  # a stop is immediate
            observations, rewards, *batch_ends, info = batch.step(actions)
            expected, expected_rewards, *single_ends, expected_info = singles.step(actions[places])
            assert rewards[places] == pytest.approx(expected_rewards, abs=1e-9)
            assert (np.array(batch_ends)[:, places] == single_ends).all()
            ends += int(np.sum(single_ends))
        batch.close()
        singles.close()
        return ends

    return compare_robots


def compare_infos(info: dict[str, Any], expected: dict[str, Any], places: list[int]) -> None:
    """The robots' info is what Gymnasium reports, if its mask is set."""
    for key, values in expected.items():
        if key.startswith("_"):
            continue
        mask = expected[f"_{key}"]
        if not key.startswith("drawn_"):  # not all robots of a fleet draw the same
            assert (info[f"_{key}"][places] == mask).all()
        if isinstance(values, dict):
            compare_infos(info[key], values, places)
            continue
        tolerance = OBSERVED if key == "final_obs" else 1e-9
        for value, single_value in zip(info[key][places][mask], values[mask], strict=True):
            assert value == pytest.approx(single_value, abs=tolerance, nan_ok=True), key
