"""What holds for every registered environment, in PyBullet, planar and over a tty."""

from __future__ import annotations

import inspect
import math
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from env_tools import IDS, LINKS, SEEING, inner, make
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordVideo

from acsar_gym import RobotConfig
from acsar_gym.envs.ids import full_id
from acsar_gym.envs.robot_env import EnvOptions
from acsar_gym.errors import AcsarError, AcsarWarning, LidarError, LinkError, MissingExtraError
from acsar_gym.lidar.scan import Revolution
from acsar_gym.worlds import Scene


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("env_id", IDS)
def test_gymnasium_finds_nothing_to_complain_about(
    env_id: str, link: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In every render mode, without a display: one warning says that "human" shows nothing."""
    monkeypatch.delenv("DISPLAY", raising=False)
    env = make(env_id, link)
    with pytest.warns() as said:
        check_env(env.unwrapped)
    assert [warning.category for warning in said] == [AcsarWarning]
    assert "needs a display" in str(said[0].message)
    env.close()


@pytest.mark.parametrize("env_id", IDS)
def test_stable_baselines3_finds_nothing_to_complain_about(env_id: str) -> None:
    from stable_baselines3.common.env_checker import check_env as sb3_check_env

    env = make(env_id)
    sb3_check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize("env_id", IDS)
def test_the_class_is_the_manual(env_id: str) -> None:
    env = make(env_id)
    manual = inspect.getdoc(type(env.unwrapped)) or ""
    for part in ("Action space", "Observation space", "Reward", "Start and end", "Arguments"):
        assert f"## {part}" in manual
    task = inner(env).task
    names = {"link", "robot", *EnvOptions.names(), *inspect.signature(type(task)).parameters}
    names -= set() if task.worlds else {"worlds", "difficulty"}
    names -= set() if task.sensors else {"lidar"}
    assert [name for name in names if f"`{name}`" not in manual] == []
    env.close()


@pytest.mark.parametrize(
    ("name", "env_id"),
    [
        ("barn", "acsar_gym/Barn-v1"),
        ("point_goal", "acsar_gym/PointGoal-v0"),
        ("dyna_barn", "acsar_gym/DynaBarn-v0"),
        ("dynabarn", "acsar_gym/DynaBarn-v0"),
        ("mine/Task-v0", "mine/Task-v0"),
        ("no_such", "acsar_gym/NoSuch"),
    ],
)
def test_short_names_are_those_of_the_newest_versions(name: str, env_id: str) -> None:
    assert full_id(name) == env_id


ROLLOUT = """
import hashlib, sys, gymnasium, numpy as np
for name in sys.argv[1:]:
    env_id, link = name.split(" ")
    env = gymnasium.make("acsar_gym:" + env_id, link=link)
    digest, rng = hashlib.sha256(), np.random.default_rng(5)
    for seed in (7, None, None):
        observation, info = env.reset(seed=seed)
        digest.update(observation.tobytes())
        for _ in range(60):
            step = env.step(rng.uniform(-1, 1, 2).astype(np.float32))
            digest.update(step[0].tobytes() + repr(step[1:]).encode())
            if step[2]:
                break
    print(name, digest.hexdigest())
"""


def test_two_processes_with_one_seed_see_the_same_bits() -> None:
    names = [f"{env_id} {link}" for env_id in IDS for link in LINKS]
    command = [sys.executable, "-c", ROLLOUT, *names]
    both = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    one, other = (process.communicate(timeout=240)[0].splitlines() for process in both)
    assert one == other
    assert len({line.split(" ")[-1] for line in one}) == len(names)


@pytest.mark.parametrize("env_id", IDS)
def test_info_holds_the_same_floats_at_every_step(env_id: str) -> None:
    env = make(env_id)
    _, first = env.reset(seed=0)
    for _ in range(20):
        *_, info = env.step(np.array([0.3, 0.1], np.float32))
        assert info.keys() == first.keys()
        assert all(type(value) is float for value in info.values())
        assert not any(math.isnan(value) for value in info.values())
    env.close()


def quiet(**lidar: Any) -> RobotConfig:
    """The robot with a LiDAR without noise."""
    return RobotConfig.preset("acsar").with_(lidar={"noise": 0.0, **lidar})


PORT = "/dev/ttyUSB0"
VARIED = {"mass": (0.5, 2.0)}


@pytest.mark.parametrize(
    ("env_id", "options", "named"),
    [
        ("PointGoal-v0", {"link": "bulet"}, "'bullet'"),
        ("PointGoal-v0", {"robot": "acsra"}, "'acsar'"),
        ("PointGoal-v0", {"policy_rate": 30.0}, "policy_rate"),
        ("PointGoal-v0", {"goal_distance": 3}, "goal_distance"),
        ("PointGoal-v0", {"faults": {"droped_lines": 0.1}}, "'dropped_lines'"),
        ("PointGoal-v0", {"render_mode": "rgb_array", "view": "camera"}, "bullet"),
        ("PointGoal-v0", {"randomization": {"frictoin": (0.5, 1.0)}}, "'friction'"),
        ("PointGoal-v0", {"randomization": {"feedback_rate": (1.0, 20.0)}}, "feedback_timeout"),
        ("PointGoal-v0", {"randomization": VARIED, "link": PORT}, "simulated"),
        ("PointGoal-v0", {"randomization": VARIED, "link": "replay:tape.mcap"}, "simulated"),
        ("ObstacleGoal-v1", {"link": PORT}, "like rplidar:///dev/ttyUSB1"),
        ("ObstacleGoal-v1", {"difficulty": 2.0}, "difficulty"),
        ("ObstacleGoal-v1", {"lidar": "lidar"}, "lidar"),
        ("ObstacleGoal-v1", {"view": "side"}, "view"),
    ],
)
def test_bad_options_are_one_clear_error(env_id: str, options: dict[str, Any], named: str) -> None:
    with pytest.raises(AcsarError, match=named) as caught:
        make(f"acsar_gym/{env_id}", **options).reset(seed=0)
    assert "\n" not in str(caught.value)


class FailingLidar:
    """A LiDAR that falls silent after some scans."""

    def __init__(self, scans: int) -> None:
        self.left = scans
        self.closed = False

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Nothing to begin."""

    def scan(self) -> Revolution:
        self.left -= 1
        if self.left < 0:
            raise LidarError("the LiDAR is silent", "check its cable")
        return Revolution(np.zeros(1), np.ones(1), np.zeros(1), 0.0)

    def close(self) -> None:
        self.closed = True


def test_a_silent_lidar_stops_the_robot() -> None:
    lidar = FailingLidar(15)
    env = make(SEEING[0], lidar=lidar)
    env.reset(seed=0)
    env.step(np.array([1.0, 0.0], np.float32))
    _, reward, terminated, truncated, info = env.step(np.array([1.0, 0.0], np.float32))
    assert (reward, terminated, truncated, info["fault"]) == (0.0, False, True, 4.0)
    assert "LiDAR" in info["fault_reason"]
    assert not inner(env).robot.active
    with pytest.raises(LinkError, match="reset"):
        env.step(np.array([1.0, 0.0], np.float32))
    env.close()
    assert lidar.closed


def test_scans_come_at_the_lidars_own_rate_and_stale_ones_are_marked() -> None:
    env = make(SEEING[0], robot=quiet(rate=4.0))
    env.reset(seed=0)
    infos = [env.step(np.zeros(2, np.float32))[4] for _ in range(10)]
    ages = np.array([info["scan_age"] for info in infos])
    assert ages[0] not in (0.0, 0.1)  # the phase is drawn
    assert ages == pytest.approx((ages[0] + 0.1 * np.arange(10)) % 0.25, abs=1e-9)
    env.close()
    env = make(SEEING[0], lidar=FailingLidar(1000))  # its scans are all of time 0
    env.reset(seed=0)
    stale = [env.step(np.zeros(2, np.float32))[4]["scan_stale"] for _ in range(4)]
    assert stale == [0.0, 1.0, 1.0, 1.0]
    env.close()


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("view", ["top", "camera"])
def test_every_id_has_pictures(env_id: str, view: str) -> None:
    env = make(env_id, "bullet", render_mode="rgb_array", view=view)
    env.reset(seed=0)
    before: Any = env.render()
    for _ in range(3):
        env.step(np.array([1.0, 0.5], np.float32))
    after: Any = env.render()
    env.close()
    assert before.dtype == np.uint8
    assert before.shape == after.shape == ((480, 480, 3) if view == "top" else (480, 640, 3))
    assert (before != after).any()


def test_videos_can_be_recorded(tmp_path: Path) -> None:
    env = make(SEEING[0], render_mode="rgb_array")
    with warnings.catch_warnings():  # moviepy's own, of imageio's ffmpeg
        warnings.simplefilter("ignore")
        recorder = RecordVideo(env, str(tmp_path), disable_logger=True)
        recorder.reset(seed=0)
        assert recorder.frames_per_sec == 10.0
        for _ in range(10):
            recorder.step(np.array([1.0, 0.5], np.float32))
        env.close()
        recorder.close()  # type: ignore[no-untyped-call]
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 1000


def test_a_picture_that_cannot_be_drawn_leaves_no_robot_driving(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    env = make("acsar_gym/PointGoal-v0", render_mode="human")
    monkeypatch.setitem(sys.modules, "PIL", None)  # it is there, and can't be imported
    monkeypatch.delitem(sys.modules, "acsar_gym.render.top_view", raising=False)
    monkeypatch.delitem(sys.modules, "acsar_gym.render.canvas", raising=False)
    with pytest.raises(MissingExtraError, match="pictures"):
        env.reset(seed=0)
    assert not inner(env).robot.active
    env.close()
