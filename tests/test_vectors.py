"""Batches of every id against the single planar env: the same numbers from the same seeds."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym import RobotConfig, World
from acsar_gym.errors import WorldError
from acsar_gym.vectors import BarnVectorEnv, ObstacleGoalVectorEnv
from acsar_gym.worlds import Region

ACSAR = RobotConfig.preset("acsar")
REGIONS = World(
    np.array([[0.0, 2.0, 0.3], [1.0, -2.0, 0.4]]),
    np.array([[-6.0, -6.0, 6.0, -6.0]]),
    Region(-3.0, 0.0, 1.0),
    Region(3.0, 0.0, 1.0),
    np.array([[-3.0, 0.0], [3.0, 0.0]]),
)
LIMITED = ACSAR.with_(
    linear_limits={"max_velocity": 0.4, "max_acceleration": 1.0},
    angular_limits={"max_acceleration": 3.0, "max_jerk": 60.0},
)
FENCED = ACSAR.with_(geofence={"max_x": 0.6, "min_y": -0.3, "max_y": 0.3})
LATE = ACSAR.with_(
    baud_rate=38400, firmware={"processing_time": 0.02}, linear_limits={"max_jerk": 20.0}
)
CASES: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    "obstacles": ("ObstacleGoal", {"worlds": "clutter:6"}, {}),
    "rooms": ("ObstacleGoal", {"worlds": "rooms:4"}, {"noise": 0.0}),
    "regions": ("ObstacleGoal", {"worlds": REGIONS}, {"dropouts": 0.1, "rays": 33}),
    "slow LiDAR": ("ObstacleGoal", {"worlds": "open:4"}, {"rate": 7.0, "field_of_view": 4.7}),
    "BARN": ("Barn", {"worlds": "barn:4"}, {"noise": 0.02, "min_range": 0.3}),
    "smooth path": ("PathFollow", {"worlds": "smooth_path:6"}, {}),
    "waypoints": ("PathFollow", {"worlds": "waypoint_path:6"}, {}),
    "limits": ("PointGoal", {"robot": LIMITED}, {}),
    "geofence": ("ObstacleGoal", {"robot": FENCED, "worlds": "open:4"}, {}),
    "limits on a slow wire": ("PathFollow", {"robot": LATE}, {}),
}


@pytest.mark.parametrize("name", CASES)
def test_a_robot_of_the_batch_is_the_single_planar_env(name: str) -> None:
    kind, options, lidar = CASES[name]
    env_id = f"acsar_gym/{kind}-v0"
    options = {**options, "robot": options.get("robot", ACSAR).with_(lidar=lidar)}
    many: Any = gymnasium.make_vec(env_id, 3, vectorization_mode="vector_entry_point", **options)
    one = gymnasium.make(env_id, link="planar", **options)
    expected, _ = one.reset(seed=41)
    seen, _ = many.reset(seed=40)
    assert seen[1] == pytest.approx(expected, abs=1e-6)
    rng, over, ends = np.random.default_rng(0), False, 0
    for step in range(500):
        acts = rng.uniform(-1.0, 1.0, (3, 2)).astype(np.float32)
        acts[:, 0] = abs(acts[:, 0]) if step % 100 < 70 else acts[:, 0]
        seen, rewards, terminated, truncated, infos = many.step(acts)
        if over:
            expected, info = one.reset()
            reward, over = 0.0, False
            assert [terminated[1], truncated[1]] == [False, False]
        else:
            expected, value, *end, info = one.step(acts[1])
            reward, over = float(value), any(end)
            assert [terminated[1], truncated[1]] == end
        ends += over
        assert seen[1] == pytest.approx(expected, abs=1e-6)
        assert rewards[1] == pytest.approx(reward, abs=1e-9)
        assert {k: infos[k][1] for k in info} == pytest.approx(info, abs=1e-9)
    many.close()
    one.close()
    assert ends >= 1


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    seen = []
    for threads in (1, 2):
        env = ObstacleGoalVectorEnv(40, worlds="clutter:5", threads=threads, max_episode_steps=9)
        rows = [env.reset(seed=3)[0]]
        rng = np.random.default_rng(0)
        rows += [env.step(rng.uniform(-1, 1, (40, 2)))[0] for _ in range(30)]
        seen.append(np.array(rows))
        env.close()
    assert (seen[0] == seen[1]).all()


def test_robots_of_a_batch_are_in_different_worlds() -> None:
    env = BarnVectorEnv(30, worlds="barn:4")
    _, infos = env.reset(seed=0)
    assert set(infos["world"].tolist()) == {0.0, 1.0, 2.0, 3.0}
    env.close()


def test_a_world_that_cannot_be_driven_is_one_clear_error() -> None:
    with pytest.raises(WorldError, match="the start"):
        ObstacleGoalVectorEnv(2, worlds=World(np.array([[0.0, 0.0, 1.0]]), goal=Region(5.0, 0.0)))
