"""What holds for every registered environment, in PyBullet, planar and over a tty."""

from __future__ import annotations

import copy
import inspect
import math
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordVideo

from acsar_gym import Robot, RobotConfig, World
from acsar_gym.envs.base import RobotEnv
from acsar_gym.envs.options import EnvOptions
from acsar_gym.errors import (
    AcsarError,
    ConfigError,
    LidarError,
    LinkError,
    MissingExtraError,
    OffScreenWarning,
    WorldError,
)
from acsar_gym.lidars.base import Scan
from acsar_gym.links import open_link
from acsar_gym.links.faults import Faults
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.worlds import Region, Scene

IDS = {
    "acsar_gym/PointGoal-v0": {},
    "acsar_gym/ObstacleGoal-v1": {"worlds": "clutter:5"},
    "acsar_gym/Barn-v1": {"worlds": "barn:5"},
    "acsar_gym/PathFollow-v0": {"worlds": "waypoint_path:5"},
}
SEEING = ["acsar_gym/ObstacleGoal-v1", "acsar_gym/Barn-v1"]
LINKS = ["bullet", "planar"]
BARN = Path(__file__).parents[3] / "shared" / "barn"
WALL = World(
    segments=np.array([[1.0, -9.0, 1.0, 9.0]]),
    goal=Region(3.0, 0.0),
    start=Region(0.0, 0.0, 0.0, 0.0),
    path=np.array([[0.0, 0.0], [3.0, 0.0]]),
)


def make(env_id: str, link: Any = "planar", **options: Any) -> gymnasium.Env[Any, Any]:
    return gymnasium.make(env_id, link=link, **{**IDS[env_id], **options})


def inner(env: gymnasium.Env[Any, Any]) -> RobotEnv:
    assert isinstance(env.unwrapped, RobotEnv)
    return env.unwrapped


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
    assert [warning.category for warning in said] == [OffScreenWarning]
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


@pytest.mark.parametrize("link", LINKS)
def test_a_wall_is_seen_and_a_collision_ends_the_episode(link: str) -> None:
    env = make("acsar_gym/ObstacleGoal-v1", link, worlds=WALL, robot=quiet())
    observation, _ = env.reset(seed=0)
    config, terminated = inner(env).robot.config, False
    info: dict[str, Any] = {}
    reward: Any = 0.0
    ahead = config.lidar.rays // 2 - config.lidar.rays
    assert observation[ahead] * config.lidar.max_range == pytest.approx(1.15, abs=1e-6)
    while not terminated:
        observation, reward, terminated, _, info = env.step(np.array([1.0, 0.0], np.float32))
    assert reward < -4.0
    assert info["true_contact"] == 1.0
    assert info["is_success"] == 0.0
    assert info["true_x"] == pytest.approx(1.0 - config.body.length / 2.0, abs=0.06)
    env.close()


def quiet(**lidar: Any) -> RobotConfig:
    """The robot with a LiDAR without noise."""
    return RobotConfig.preset("acsar").with_(lidar={"noise": 0.0, **lidar})


@pytest.mark.parametrize("env_id", SEEING)
def test_hardware_without_a_lidar_says_so_in_one_line(env_id: str) -> None:
    with pytest.raises(ConfigError, match=r"pass lidar='rplidar:///dev/ttyUSB1'") as caught:
        make(env_id, "/dev/ttyUSB0")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("env_id", "options", "message"),
    [
        (SEEING[0], {"worlds": "clutte"}, "did you mean 'clutter'"),
        (SEEING[0], {"worlds": "no/such.world"}, "no/such.world"),
        (SEEING[0], {"worlds": 7}, "worlds = 7"),
        (SEEING[0], {"difficulty": 2.0}, "from 0 to 1"),
        (SEEING[0], {"lidar": "lidar"}, "rplidar:///dev/ttyUSB1"),
        (SEEING[0], {"goal_tolerance": -1.0}, "goal_tolerance"),
        (SEEING[0], {"view": "side"}, "top or camera"),
        ("acsar_gym/PathFollow-v0", {"worlds": "clutter:1", "max_cross_track": 0}, "max_cross"),
    ],
)
def test_bad_options_are_one_clear_error(
    env_id: str, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(AcsarError, match=message) as caught:
        make(env_id, **options).reset(seed=0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("world", "message"),
    [
        (World(np.array([[0.1, 0.0, 0.3]]), goal=Region(3.0, 0.0)), "the start .* obstacle"),
        (World(np.array([[3.0, 0.0, 0.1]]), goal=Region(3.0, 0.0)), "the goal .* obstacle"),
        (
            World(
                segments=np.array([[1, -1, 1, 1], [-1, -1, -1, 1], [-1, -1, 1, -1], [-1, 1, 1, 1]]),
                goal=Region(3.0, 0.0),
            ),
            "no way from start to goal",
        ),
    ],
)
def test_worlds_that_cannot_be_driven_are_refused(world: World, message: str) -> None:
    with pytest.raises(AcsarError, match=message):
        make(SEEING[0], worlds=world).reset(seed=0)


def test_options_of_a_reset_choose_world_goal_and_path() -> None:
    env = make(SEEING[0])
    _, info = env.reset(options={"world": 3, "goal": (1.0, 0.5)})
    assert info["world"] == 3.0
    assert info["goal_distance"] == pytest.approx(math.hypot(1.0, 0.5))
    env.close()
    env = make("acsar_gym/PathFollow-v0")
    _, info = env.reset(options={"path": [(0.0, 0.1), (1.0, 0.1)]})
    assert info["cross_track_error"] == pytest.approx(-0.1)
    with pytest.raises(ConfigError, match="did you mean 'path'"):
        env.reset(options={"paths": 1})
    env.close()


class FailingLidar:
    """A LiDAR that falls silent after some scans."""

    def __init__(self, scans: int) -> None:
        self.left = scans
        self.closed = False

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Nothing to begin."""

    def scan(self) -> Scan:
        self.left -= 1
        if self.left < 0:
            raise LidarError("the LiDAR is silent", "check its cable")
        return Scan(np.full(64, 5.0), 0.0)

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


def test_a_stale_scan_is_marked() -> None:
    env = make(SEEING[0], lidar=FailingLidar(1000))
    env.reset(seed=0)
    ages = [env.step(np.zeros(2, np.float32))[4] for _ in range(4)]
    assert [info["scan_stale"] for info in ages] == [0.0, 1.0, 1.0, 1.0]
    assert ages[-1]["scan_age"] > ages[0]["scan_age"] > 0.0
    env.close()


def test_scans_come_at_the_lidars_own_rate() -> None:
    env = make(SEEING[0], robot=quiet(rate=4.0))
    env.reset(seed=0)
    infos = [env.step(np.zeros(2, np.float32))[4] for _ in range(10)]
    ages = [info["scan_age"] for info in infos]
    assert ages == pytest.approx([0.1, 0.2, 0.05, 0.15, 0.0] * 2, abs=1e-9)
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
        for _ in range(10):
            recorder.step(np.array([1.0, 0.5], np.float32))
        env.close()
        recorder.close()  # type: ignore[no-untyped-call]
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 1000


def test_barns_rules() -> None:
    env = make("acsar_gym/Barn-v1")
    assert env.spec is not None
    assert env.spec.max_episode_steps == 1000
    _, info = env.reset(seed=0)
    assert info["goal_distance"] == pytest.approx(10.0)
    assert inner(env).task.goal_tolerance == 1.0
    assert info["barn_score"] == 0.0
    env.close()


@pytest.mark.skipif(not BARN.is_dir(), reason="no published worlds here")
def test_barn_takes_a_folder_of_published_worlds() -> None:
    env = make("acsar_gym/Barn-v1", worlds=BARN)
    names, lengths = set(), []
    for number in range(5):
        env.reset(options={"world": number})
        assignment = inner(env).episode.assignment
        assert assignment.world is not None
        names.add(assignment.world.name)
        lengths.append(assignment.length)
    assert names == {"world_1", "world_77", "world_101", "world_201", "world_299"}
    assert sorted(lengths) == pytest.approx([10.029, 10.738, 10.758, 12.312, 13.446], abs=0.01)
    env.close()


def test_the_robot_drives_the_same_in_a_world_as_on_an_open_floor() -> None:
    """Far obstacles change nothing of what odometry says, in PyBullet."""
    rows = []
    for world in (None, WALL):
        link = open_link("bullet")
        robot = Robot(link)
        robot.reset(Scene(world=world))
        for _ in range(100):
            robot.drive(0.3, 0.5)
        rows.append(robot.odometry.pose)
        robot.deactivate()
    assert rows[0] == rows[1]


@pytest.mark.parametrize("link", LINKS)
def test_without_a_display_human_draws_off_screen(
    link: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    env = make("acsar_gym/PointGoal-v0", link, render_mode="human")
    with pytest.warns(OffScreenWarning, match="needs a display.*off-screen"):
        env.reset(seed=0)
    env.step(np.array([1.0, 0.0], np.float32))
    assert env.render() is None
    assert inner(env).robot.active
    env.close()


def test_a_picture_that_cannot_be_drawn_leaves_no_robot_driving(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "PIL", None)
    monkeypatch.delitem(sys.modules, "acsar_gym.render.top_view", raising=False)
    monkeypatch.delitem(sys.modules, "acsar_gym.render.canvas", raising=False)
    env = make("acsar_gym/PointGoal-v0", render_mode="human")
    with pytest.raises(MissingExtraError, match="pictures"):
        env.reset(seed=0)
    assert not inner(env).robot.active
    env.close()


FAULTS: list[tuple[dict[str, Any], float]] = [
    ({"unplug_at": 1.0, "replug_time": 0.5}, 3.0),
    ({"board_reset_at": 1.0}, 1.0),
]


@pytest.mark.parametrize(("faults", "code"), FAULTS)
@pytest.mark.parametrize("link", LINKS)
def test_a_fault_truncates_the_episode_and_the_next_reset_recovers(
    link: str, faults: dict[str, Any], code: float
) -> None:
    env = make("acsar_gym/PointGoal-v0", link, faults=faults)
    for _ in range(2):
        _, info = env.reset(seed=0)
        assert info["fault"] == 0.0
        truncated, steps = False, 0
        while not truncated:
            *_, terminated, truncated, info = env.step(np.array([0.0, 0.2], np.float32))
            assert not terminated
            steps += 1
        assert info["fault"] == code
        assert steps < 20
        assert not inner(env).robot.active
    env.close()


def test_what_a_caller_changes_is_not_told_again() -> None:
    env = make(
        "acsar_gym/PointGoal-v0",
        faults={"unplug_at": 0.3},
        randomization={"motor_gain": (0.9, 1.1)},
    )
    told: Any = env.reset(seed=0)
    truncated = False
    while not truncated:
        last, info = told[0].copy(), copy.deepcopy(told[-1])
        told[0][:] = told[-1]["drawn_motor_gain"][:] = -7.0
        told[-1]["goal_distance"] = -7.0
        told = env.step(np.array([0.5, 0.0], np.float32))
        truncated = told[3]
    assert (told[0] == last).all()
    assert told[-1]["goal_distance"] == info["goal_distance"]
    assert (told[-1]["drawn_motor_gain"] == info["drawn_motor_gain"]).all()
    assert told[-1]["fault"] == 3.0
    env.close()


def test_faults_can_be_raised_instead() -> None:
    env = make("acsar_gym/PointGoal-v0", faults={"unplug_at": 0.3}, on_fault="raise")
    env.reset(seed=0)
    with pytest.raises(LinkError):
        for _ in range(20):
            env.step(np.array([0.5, 0.0], np.float32))  # a fault's clock starts as wheels turn
    env.close()


def test_faulty_episodes_repeat_with_the_seed() -> None:
    seen = []
    for _ in range(2):
        env = make(SEEING[0], faults={"dropped_lines": 0.4, "corrupted_lines": 0.2})
        rows = [env.reset(seed=3)[0]]
        rows += [env.step(np.array([0.5, 0.3], np.float32))[0] for _ in range(30)]
        seen.append(np.array(rows))
        env.close()
    plain = make(SEEING[0])
    plain.reset(seed=3)
    clean = [plain.step(np.array([0.5, 0.3], np.float32))[0] for _ in range(30)]
    assert (seen[0] == seen[1]).all()
    assert (seen[0][1:] != np.array(clean)).any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"faults": {"droped_lines": 0.1}}, "did you mean 'dropped_lines'"),
        ({"on_fault": "ignore"}, "raise or truncate"),
    ],
)
def test_bad_faults_are_one_clear_error(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make(SEEING[0], **options)


# Worlds to train in and to test in, and their numbers


WORLDS = [env_id for env_id in IDS if env_id != "acsar_gym/PointGoal-v0"]


@pytest.mark.parametrize("env_id", WORLDS)
def test_ids_train_in_the_training_split(env_id: str) -> None:
    env = gymnasium.make(env_id, link="planar")
    pool = inner(env).pool
    assert pool is not None
    assert (pool.split, pool.numbers) == ("train", range(1000, 1400))
    _, info = env.reset(seed=0)
    assert 1000 <= info["world"] < 1400
    env.close()
    batch = gymnasium.make_vec(env_id, 1, vectorization_mode="vector_entry_point")
    pool = cast("RobotVectorEnv", batch.unwrapped).pool
    assert pool is not None
    assert pool.numbers == range(1000, 1400)


def test_a_world_is_known_by_its_generators_number() -> None:
    env = make(SEEING[0], worlds="clutter:1000-1399")
    _, info = env.reset(options={"world": 1254})
    world = inner(env).episode.assignment.world
    assert info["world"] == 1254.0
    assert world is not None
    assert world.name == "clutter 1254"
    for number in (254, 999, 1400):
        with pytest.raises(WorldError, match=f"world {number}: must be 1000 to 1399"):
            env.reset(options={"world": number})
    env.close()


def test_a_batch_tells_the_same_numbers() -> None:
    many: Any = gymnasium.make_vec(
        SEEING[0], 8, vectorization_mode="vector_entry_point", worlds="open:1250-1254"
    )
    one = make(SEEING[0], worlds="open:1250-1254")
    told = many.reset(seed=0)[1]["world"].tolist()
    assert told == [one.reset(seed=seed)[1]["world"] for seed in range(8)]
    assert set(told) <= set(range(1250, 1255))
    many.close()
    one.close()


# Specs


@pytest.mark.parametrize("env_id", IDS)
def test_a_spec_with_a_robot_goes_through_json(env_id: str) -> None:
    robot = RobotConfig.preset("acsar").with_(max_linear=0.7, lidar={"rays": 33})
    env = make(env_id, robot=robot, faults=Faults(dropped_lines=0.01))
    assert env.spec is not None
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.spec == env.spec
    assert inner(again).robot.config == inner(env).robot.config == robot
    assert again.observation_space == env.observation_space
    assert (again.reset(seed=5)[0] == env.reset(seed=5)[0]).all()
    for one in (again, env):
        one.close()


def test_a_spec_with_arrays_goes_through_json() -> None:
    distance, tolerance = np.array([0.5, 2.0]), np.float32(0.25)
    env = make("acsar_gym/PointGoal-v0", goal_distance=distance, goal_tolerance=tolerance)
    assert env.spec is not None
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.spec == env.spec
    assert inner(again).task == inner(env).task
    for one in (again, env):
        one.close()


def test_a_batchs_spec_goes_through_json() -> None:
    robot = RobotConfig.preset("acsar").with_(max_linear=0.7)
    many: Any = gymnasium.make_vec(
        "acsar_gym/PointGoal-v0", 2, vectorization_mode="vector_entry_point", robot=robot
    )
    assert EnvSpec.from_json(many.spec.to_json()).kwargs["robot"] == robot.model_dump(mode="json")
    many.close()


@pytest.mark.parametrize("env_id", IDS)
def test_every_id_has_a_reward_threshold(env_id: str) -> None:
    """Below what the policy that comes along reaches; a straight drive doesn't."""
    threshold = gymnasium.spec(env_id).reward_threshold
    assert threshold is not None
    manual = inspect.getdoc(type(make(env_id).unwrapped)) or ""
    assert f"`reward_threshold` {threshold:g}" in manual
