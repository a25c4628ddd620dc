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
from env_tools import IDS, LINKS, POINT_GOAL, SEEING, Make, inner
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordVideo

from acsar_gym import RobotEnv
from acsar_gym.envs.ids import full_id
from acsar_gym.envs.robot_env import EnvOptions
from acsar_gym.errors import AcsarError, AcsarWarning, MissingExtraError

ARC = np.array([0.3, 0.1], np.float32)


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("env_id", IDS)
def test_gymnasium_finds_nothing_to_complain_about(
    env_id: str, link: str, monkeypatch: pytest.MonkeyPatch, make: Make
) -> None:
    """In every render mode, without a display: one warning states that "human" shows nothing."""
    monkeypatch.delenv("DISPLAY", raising=False)
    env = make(env_id, link)
    with pytest.warns() as caught:
        check_env(env.unwrapped)
    assert [warning.category for warning in caught] == [AcsarWarning]
    assert "needs a display" in str(caught[0].message)


@pytest.mark.parametrize("env_id", IDS)
def test_stable_baselines3_finds_nothing_to_complain_about(env_id: str, make: Make) -> None:
    from stable_baselines3.common.env_checker import check_env as sb3_check_env

    sb3_check_env(make(env_id).unwrapped)


def manual_of(env_id: str, make: Make) -> str:
    """The manual of an id, and those that it refers to."""
    manual = inspect.getdoc(type(make(env_id).unwrapped)) or ""
    others = [other for other in IDS if other != env_id and f"`{other}`" in manual]
    return "\n".join([manual, *(manual_of(other, make) for other in others)])


@pytest.mark.parametrize("env_id", IDS)
def test_the_class_is_the_manual(env_id: str, make: Make) -> None:
    """With observation, reward, end, the task's options and the weights of its reward."""
    env = inner(make(env_id))
    manual = inspect.getdoc(type(env)) or ""
    for part in ("Observation space", "Reward", "Start and end", "Arguments"):
        assert f"## {part}" in manual
    shared = inspect.getdoc(RobotEnv) or ""
    names = {"link", "robot", "weights", *EnvOptions.names()}
    assert [name for name in names if f"- `{name}`:" not in shared] == []
    options = inspect.signature(type(env.task)).parameters
    assert [name for name in options if f"- `{name}`:" not in manual] == []
    whole = manual_of(env_id, make)
    for name, weight in env.task.weights._asdict().items():
        assert f"| `{name}` | {weight:g} |" in whole


@pytest.mark.parametrize(
    ("name", "env_id"),
    [
        ("barn", "acsar_gym/Barn-v1"),
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
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    outputs = [process.communicate(timeout=240)[0].splitlines() for process in processes]
    assert outputs[0] == outputs[1]
    assert len({line.split(" ")[-1] for line in outputs[0]}) == len(names)


@pytest.mark.parametrize("env_id", IDS)
def test_info_holds_the_same_floats_at_every_step(env_id: str, make: Make) -> None:
    env = make(env_id)
    _, first = env.reset(seed=0)
    for _ in range(20):
        *_, info = env.step(ARC)
        assert info.keys() == first.keys()
        assert all(type(value) is float for value in info.values())
        assert not any(math.isnan(value) for value in info.values())


PORT = "/dev/ttyUSB0"
VARIED = {"mass": (0.5, 2.0)}


@pytest.mark.parametrize(
    ("env_id", "options", "message"),
    [
        (POINT_GOAL, {"link": "bulet"}, "'bullet'"),
        (POINT_GOAL, {"robot": "acsra"}, "'acsar'"),
        (POINT_GOAL, {"policy_rate": 30.0}, "policy_rate"),
        (POINT_GOAL, {"goal_distance": 3}, "goal_distance"),
        (POINT_GOAL, {"faults": {"droped_lines": 0.1}}, "'dropped_lines'"),
        (POINT_GOAL, {"render_mode": "rgb_array", "view": "camera"}, "bullet"),
        (POINT_GOAL, {"randomization": {"frictoin": (0.5, 1.0)}}, "'friction'"),
        (POINT_GOAL, {"randomization": {"feedback_rate": (1.0, 20.0)}}, "feedback_timeout"),
        (POINT_GOAL, {"randomization": VARIED, "link": PORT}, "simulated"),
        (POINT_GOAL, {"randomization": VARIED, "link": "replay:tape.mcap"}, "simulated"),
        (SEEING[0], {"link": PORT}, "like rplidar:///dev/ttyUSB1"),
        (SEEING[0], {"difficulty": 2.0}, "difficulty"),
        (SEEING[0], {"lidar": "lidar"}, "lidar"),
        (SEEING[0], {"view": "side"}, "view"),
    ],
)
def test_bad_options_are_one_clear_error(
    env_id: str, options: dict[str, Any], message: str, make: Make
) -> None:
    with pytest.raises(AcsarError, match=message) as caught:
        make(env_id, **options).reset(seed=0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize(("view", "shape"), [("top", (480, 480, 3)), ("camera", (480, 640, 3))])
def test_every_id_has_pictures(env_id: str, view: str, shape: tuple[int, ...], make: Make) -> None:
    env = make(env_id, "bullet", render_mode="rgb_array", view=view)
    env.reset(seed=0)
    first: Any = env.render()
    for _ in range(3):
        env.step(np.array([1.0, 0.5], np.float32))
    last: Any = env.render()
    assert first.dtype == np.uint8
    assert first.shape == last.shape == shape
    assert (first != last).any()


def test_videos_can_be_recorded(tmp_path: Path, make: Make) -> None:
    with warnings.catch_warnings():  # moviepy's own, of imageio's ffmpeg
        warnings.simplefilter("ignore")
        recorder = RecordVideo(
            make(SEEING[0], render_mode="rgb_array"), str(tmp_path), disable_logger=True
        )
        recorder.reset(seed=0)
        assert recorder.frames_per_sec == 10.0
        for _ in range(10):
            recorder.step(ARC)
        recorder.close()  # type: ignore[no-untyped-call]
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 1000


def test_a_picture_that_cannot_be_drawn_leaves_no_robot_driving(
    monkeypatch: pytest.MonkeyPatch, make: Make
) -> None:
    env = make(render_mode="human")
    monkeypatch.setitem(sys.modules, "PIL", None)  # it is there, and can't be imported
    monkeypatch.delitem(sys.modules, "acsar_gym.render.top_view", raising=False)
    monkeypatch.delitem(sys.modules, "acsar_gym.render.canvas", raising=False)
    with pytest.raises(MissingExtraError, match="pictures"):
        env.reset(seed=0)
    assert not inner(env).robot.active
