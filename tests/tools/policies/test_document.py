"""The document of a policy file: read whatever it contains, and compared with task and robot."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from policy_tools import ENV_ID, GOOD, changed, document_of, fitting, relabelled

from acsar_gym import RobotConfig
from acsar_gym.errors import AcsarWarning, PolicyError
from acsar_gym.sensors.map.sensor import MAP_NAMES
from acsar_gym.tools import cli
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.policies import OnnxPolicy
from acsar_gym.tools.policies.document import (
    DOCUMENT_KEY,
    MAX_DOCUMENT_BYTES,
    PolicyDocument,
    parse_document,
    robot_ranges,
)

ACSAR = RobotConfig.preset("acsar")
WHOLE = json.dumps(changed())
MAP_WIDTH = 7 + len(MAP_NAMES)
ALONE: dict[str, Any] = robot_ranges([ACSAR], {"friction": (0.7, 1.2), "latency": (0.0, 0.02)})
"""The robot of a training with a single robot."""
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=9), inner),
    max_leaves=20,
)


def parse(text: str) -> PolicyDocument:
    return parse_document({DOCUMENT_KEY: text})


@given(st.sampled_from(sorted(changed())), JSON)
def test_parse_document_accepts_or_refuses_in_one_line(name: str, value: Any) -> None:
    try:
        document = parse(json.dumps(changed(**{name: value})))
    except PolicyError as error:
        assert "\n" not in str(error)  # noqa: PT017 - some changes are harmless
    else:
        assert parse(document.as_json()) == document
        assert list(document.rows())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (WHOLE[:-9], "JSON"),
        (json.dumps(changed(version=3)), "policy.version = 3"),
        (json.dumps(changed(extra=1)), "'policy.extra'"),
        ("[" * 100_000, "JSON"),
        (WHOLE + " " * MAX_DOCUMENT_BYTES, "500,000"),
    ],
    ids=range(5),
)
def test_parse_document_names_each_kind_of_damage(text: str, message: str) -> None:
    with pytest.raises(PolicyError) as raised:
        parse(text)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_parse_document_explains_a_missing_document(tmp_path: Path) -> None:
    import onnx

    model = onnx.load(GOOD)
    path = tmp_path / "foreign.onnx"
    del model.metadata_props[:]
    onnx.save(model, path)
    with pytest.raises(
        PolicyError, match=r"foreign\.onnx: contains no document .* export it again"
    ):
        OnnxPolicy(path)


def refused(path: Path, **env: Any) -> str:
    with pytest.raises(PolicyError) as raised:
        runs.make_env(OnnxPolicy(path), "planar", env.pop("robot", None), env)
    return str(raised.value)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"observation": ["heading_cos -1 to 1"]}, "observation[0] is heading_cos -1 to 1 in the"),
        (
            {"observation": ["goal_distance 0 to 1", *document_of().observation[1:]]},
            "observation[0] is goal_distance 0 to 1 in the file and goal_distance 0 to 2 in acsar",
        ),
        ({"scale": 9.0}, "scale is 9 in the file and 3"),
        ({"rate": 20.0}, "rate is 20 in the file and 10"),
    ],
    ids=["name", "bounds", "scale", "rate"],
)
def test_check_observation_names_the_line_that_differs(
    values: dict[str, Any], message: str, tmp_path: Path
) -> None:
    path = relabelled(tmp_path / "policy.onnx", **values)
    assert refused(path).startswith(f"{path}: {message}")


@pytest.mark.parametrize("lidar", [{"field_of_view": 4.71}, {"max_range": 8.0}], ids=str)
def test_check_observation_refuses_another_lidar_unless_the_policy_takes_no_rays(
    lidar: dict[str, Any], tmp_path: Path
) -> None:
    robot = ACSAR.with_(lidar=lidar)
    path = fitting(tmp_path / "rays.onnx", "obstacle_goal", worlds="open:2")
    assert "64 ranges over 6.283 rad to 5 m in the file and" in refused(
        path, robot=robot, worlds="open:2"
    )
    policy = OnnxPolicy(fitting(tmp_path / "p.onnx", "obstacle_goal", MAP_WIDTH, worlds="open:2"))
    assert not any(name.startswith("lidar") for name in policy.document.robot)
    env = runs.make_env(policy, "planar", robot, {"worlds": "open:2"})
    observation, _ = env.reset(seed=0)
    env.close()
    assert len(observation) > policy.width == MAP_WIDTH
    assert policy(observation).shape == (2,)


def test_take_sensors_wants_whole_sensors_and_at_least_one(tmp_path: Path) -> None:
    sizes = f"the observation has 7 or {MAP_WIDTH} or {MAP_WIDTH + 64}"
    with pytest.raises(PolicyError, match=f"takes 6 numbers, {sizes}"):
        fitting(tmp_path / "p.onnx", "obstacle_goal", 6, worlds="open:2")
    path = fitting(tmp_path / "p.onnx", "obstacle_goal", 7, worlds="open:2")
    assert "observation[7] is nothing in the file and map[90]" in refused(path, worlds="open:2")


@pytest.mark.parametrize(
    ("changes", "message", "is_refused"),
    [
        ({}, "", False),
        ({"body": {"friction": 0.65}, "firmware": {"command_delay": 0.025}}, "", False),
        ({"body": {"friction": 0.3}}, "body.friction is 0.3, was 0.7 to 1.2", False),
        ({"motor": {"time_constant": (0.08, 0.3, 0.08, 0.08)}}, "is 0.08, 0.3, 0.08", False),
        ({"max_linear": 1.0}, "max_linear is 1, was 0.5", True),
        ({"body": {"length": 0.6}}, "footprint.length is 0.6, was 0.34", True),
        ({"max_linear": 0.51}, "", True),
    ],
)
def test_policies_for_other_robots_warn_and_refuse_real_ones_of_another_size_or_speed(
    changes: dict[str, Any], message: str, is_refused: bool, tmp_path: Path
) -> None:
    """Before its port is opened, unless the user drives it anyway."""
    policy = OnnxPolicy(relabelled(tmp_path / "p.onnx", robot=ALONE))
    robot = ACSAR.with_(**changes)
    runs.make_env(policy, "planar", robot, {}).close()
    warning = "".join(policy.differences)
    assert message in warning
    assert bool(warning) == bool(message)

    if is_refused:
        with pytest.raises(PolicyError, match=r"in the training: .*--anyway") as raised:
            runs.make_env(policy, "/dev/ttyUSB7", robot, {})
        assert message in str(raised.value)
        assert "\n" not in str(raised.value)
        policy.anyway = True
    runs.make_env(policy, "/dev/ttyUSB7", robot, {}).close()


def test_robot_ranges_cover_the_robots_and_the_randomization() -> None:
    varied = {
        "latency": (0.0, 0.02),
        "deadband": (0.1, 0.3),
        "deadband_offset": (-0.2, 0.2),
        "feedback_rate": (20.0, 50.0),
        "motor_lag": (0.5, 2.0),
        "track_width": (0.9, 1.0),
    }
    fast = ACSAR.with_(max_linear=2.0, motor={"time_constant": (0.1, 0.1, 0.2, 0.1)})

    ranges = robot_ranges([ACSAR, fast], varied)
    for name, ends in (
        ("max_linear", (0.5, 2.0)),
        ("motor.deadband", (0.0, 0.5)),
        ("motor.time_constant", (0.04, 0.4)),
        ("firmware.command_delay", (0.0, 0.02)),
        ("firmware.feedback_rate", (20.0, 50.0)),
        ("wheel_separation", (0.27, 0.3)),
        ("footprint.length", (0.34, 0.34)),
    ):
        assert ranges[name] == pytest.approx(ends), name


def test_evaluate_policy_warns_of_differences_and_records_them(tmp_path: Path) -> None:
    options = {"goal_tolerance": 0.05, "goal_distance": [0.5, 3.0], "gone": 1}
    path = relabelled(tmp_path / "p.onnx", robot=ALONE, options=options)
    policy = OnnxPolicy(path)
    robot = ACSAR.with_(body={"mass": 9.0}, max_angular=1.0)
    with pytest.warns(AcsarWarning) as caught:
        done = runs.evaluate_policy(policy, "planar", robot, range(1))
    messages = [str(item.message) for item in caught]
    assert messages == [f"{path}: {line}" for line in policy.differences]
    option, _ = policy.differences
    assert option == "goal_tolerance was 0.05 in the training and is 0.15 in this task"
    assert done.header["policy"]["differences"] == list(policy.differences)


def test_policies_for_a_fleet_drive_each_of_its_robots(tmp_path: Path) -> None:
    policy = OnnxPolicy(relabelled(tmp_path / "p.onnx", robot={"max_linear": [0.3, 2.0]}))
    runs.make_env(policy, "/dev/ttyUSB7", ACSAR.with_(max_linear=2.0), {}).close()


def test_policy_command_shows_the_document_without_control_characters(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    out = tmp_path / "document.json"
    path = relabelled(tmp_path / "p.onnx", worlds="\x1b[2J[red]a\nb")
    monkeypatch.setattr("sys.argv", ["acsar-gym", "policy", str(path), "--json", str(out)])
    with pytest.raises(SystemExit, match="0"):
        cli.main()
    shown = capsys.readouterr().out
    for text in (ENV_ID, "goal_distance 0 to 2", "0.7 to 1.2", "[red]a"):
        assert text in shown
    assert "\x1b" not in shown
    written = json.loads(out.read_text())
    assert written.pop("origin") == "written by acsar-gym policy"
    assert parse(json.dumps(written)) == document_of(path)
