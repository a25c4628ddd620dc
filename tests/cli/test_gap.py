"""The commands gap and compare, on recordings in files."""

from __future__ import annotations

import json
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import yaml
from cli_tools import Call, assert_one_line
from rollout_tools import HIDDEN, random_steps

from acsar_gym import Robot, RobotConfig
from acsar_gym.links import open_link
from acsar_gym.recording import Recorder

ACSAR = RobotConfig.preset("acsar")
ROBOT = ACSAR.with_(**HIDDEN)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with recordings of the hidden robot, its file, and both sides of a task."""
    folder = tmp_path_factory.mktemp("files")
    for seed in range(2):
        with Robot(
            open_link("planar", ROBOT), ACSAR, recorder=Recorder(folder / f"log{seed}.mcap")
        ) as robot:
            for speeds in random_steps(seed, 4.0, ACSAR):
                robot.tick(speeds)
    fitted = {**yaml.safe_load(ACSAR.model_dump_json()), **HIDDEN}
    (folder / "robot.yaml").write_text(yaml.safe_dump(fitted), encoding="utf-8")
    for name, config, seeds in (
        ("sim", ACSAR, range(3)),
        ("real", ROBOT, range(1, 4)),
        ("late", ACSAR, range(9, 10)),
    ):
        env = gymnasium.make(
            "acsar_gym/PointGoal-v0",
            link=open_link("planar", config),
            robot=ACSAR,
            record=folder / f"{name}.mcap",
        )
        for seed in seeds:
            observation, _ = env.reset(seed=seed)
            done = False
            while not done:
                action = np.array([0.8 * max(observation[1], 0.0), observation[2]], np.float32)
                observation, _, terminated, truncated, _ = env.step(action)
                done = terminated or truncated
        env.close()
    return folder


@pytest.fixture
def inside(files: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(files)
    return files


def test_the_right_robot_has_nearly_no_gap(inside: Path, call: Call) -> None:
    logs = ("log0.mcap", "log1.mcap", "--robot", "robot.yaml")
    code, out, error = call("gap", *logs, "--json", "gap.json", "--html", "gap.html")
    assert (code, error) == (0, "")
    assert "2 held-out episodes, 8 s: wheel speeds from" in out
    told = json.loads((inside / "gap.json").read_text())
    before, after = (told[side]["figures"] for side in ("before", "after"))
    assert after["wheel_speed_rms"] < 0.1 * before["wheel_speed_rms"]
    assert after["end_pose"] < 0.1 * before["end_pose"]
    assert "<title>Gap of robot.yaml</title>" in (inside / "gap.html").read_text()
    assert call("gap", *logs, "--fail-over", "wheel_speed_rms=0.1", "end_pose=0.001")[0] == 0


def test_a_limit_that_isnt_kept_is_exit_code_1(inside: Path, call: Call) -> None:
    limit = ("--fail-over", "wheel_speed_rms=0.1")
    code, _, error = call("gap", "--robot", "acsar", "log0.mcap", *limit)
    assert code == 1
    assert_one_line(error, "wheel_speed_rms = ")
    assert "over the limit of 0.1" in error


def test_the_unfitted_robot_can_be_that_of_the_recording(inside: Path, call: Call) -> None:
    code, out, _ = call("gap", "log0.mcap", "--robot", "robot.yaml", "--before", "recorded")
    assert code == 0
    assert "(before: recorded)" in out


def test_two_sides_of_a_task(inside: Path, call: Call) -> None:
    outputs = ("--json", "compare.json", "--html", "compare.html")
    code, out, error = call("compare", "sim.mcap", "real.mcap", "--sim", "late.mcap", *outputs)
    assert (code, error) == (0, "")
    assert "sim: 2 of 4 episodes have no partner" in out
    told = json.loads((inside / "compare.json").read_text())
    assert [pair["seed"] for pair in told["pairs"]] == [1, 2]
    assert told["metrics"]["success_rate"]["values"] == [1.0, 1.0]
    assert told["metrics"]["odometry_error"]["pairs"] == 2
    html = (inside / "compare.html").read_text(encoding="utf-8")
    assert '"text":"goal_distance, D = ' in html
    limit = ("--fail-over", "success_rate=0.0", "time_to_goal=0.0")
    code, _, error = call("compare", "sim.mcap", "real.mcap", *limit)
    assert code == 1
    assert_one_line(error, "time_to_goal = ")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("gap", "--robot", "acsar"), "no recording is named"),
        (("gap", "missing.mcap", "--robot", "acsar"), "missing.mcap: there is no such file"),
        (("gap", "robot.yaml", "--robot", "acsar"), "robot.yaml:"),
        (("gap", "cut.mcap", "--robot", "acsar"), "cut.mcap:"),
        (("gap", "log0.mcap", "--robot", "acsr"), "did you mean 'acsar'?"),
        (("gap", "log0.mcap", "log0.mcap", "--robot", "acsar"), "is the same recording as"),
        (("gap", "log0.mcap", "--robot", "acsar", "--body", "balloon"), "unknown body 'balloon'"),
        (("gap", "log0.mcap", "--robot", "acsar", "--fail-over", "end=1"), "unknown metric 'end'"),
        (("gap", "log0.mcap", "--robot", "acsar", "--html", "no/x.html"), "can't be written"),
        (("compare", "sim.mcap", "late.mcap"), "no episode in common: sim has seeds 0 to 2"),
        (("compare", "sim.mcap", "log0.mcap"), "log0.mcap: is of no task, but sim.mcap of"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_bad_input_is_one_line(
    arguments: tuple[str, ...], said: str, inside: Path, call: Call
) -> None:
    (inside / "cut.mcap").write_bytes((inside / "log0.mcap").read_bytes()[:100])
    code, _, error = call(*arguments)
    assert code == 2, error
    assert_one_line(error, said)


def test_a_cut_recording_is_used_as_far_as_it_goes(inside: Path, call: Call) -> None:
    whole = (inside / "log0.mcap").read_bytes()
    (inside / "half.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    code, out, error = call("gap", "half.mcap", "--robot", "robot.yaml")
    assert code == 0, error
    assert "half.mcap: its end is missing" in out


def test_a_preset_before_fitting_has_the_recorded_wiring(inside: Path, call: Call) -> None:
    wires = ("a", "b"), ("b", "a")
    wheels = {one: {"motor": other, "encoder": other} for one, other in wires}
    wired = ROBOT.with_(wheels={**ACSAR.wheels.model_dump(), **wheels})
    recorder = Recorder(inside / "wired.mcap")
    with Robot(open_link("planar", wired), ACSAR.with_(wheels=wired.wheels), (), recorder) as robot:
        for speeds in random_steps(3, 3.0, ACSAR):
            robot.tick(speeds)
    wired.save(inside / "wired.yaml")
    found = {}
    for before in ("acsar", "recorded"):
        logs = ("gap", "wired.mcap", "--robot", "wired.yaml", "--json", "gap.json")
        assert call(*logs, "--before", before)[0] == 0
        found[before] = json.loads((inside / "gap.json").read_text())["before"]["figures"]
    assert found["acsar"] == found["recorded"]


def test_a_cut_copy_is_the_same_recording(inside: Path, call: Call) -> None:
    whole = (inside / "log0.mcap").read_bytes()
    (inside / "part.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    code, _, error = call("gap", "log0.mcap", "part.mcap", "--robot", "robot.yaml")
    assert code == 2
    assert_one_line(error, "part.mcap: is the same recording as log0.mcap")
