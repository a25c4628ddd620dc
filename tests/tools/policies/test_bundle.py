"""What a policy file says about itself: read whatever it holds, and compared with an env."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from onnx_tools import ENV_ID, GOOD, bundle_of, changed, counting, fitting, relabelled

from acsar_gym import RobotConfig
from acsar_gym.errors import AcsarWarning, PolicyError
from acsar_gym.sensors.map.sensor import MAP_NAMES
from acsar_gym.tools import cli
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.policies import OnnxPolicy
from acsar_gym.tools.policies.bundle import (
    MAX_BUNDLE_BYTES,
    ROBOT_FIELDS,
    bundle_rows,
    parse_bundle,
    trained_range,
)

ACSAR = RobotConfig.preset("acsar")
WHOLE = json.dumps(changed())
HEADING = ["heading_cos", *bundle_of().observation.names[1:]]
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=9), inner),
    max_leaves=20,
)


def paths(data: Any, prefix: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """All places of a JSON document."""
    inner = data.items() if isinstance(data, dict) else enumerate(data)
    nested = [((*prefix, key), value) for key, value in inner]
    found = [path for path, _ in nested]
    for path, value in nested:
        found += paths(value, path) if isinstance(value, dict | list) else []
    return found


PLACES = paths(changed())


@given(st.sampled_from(PLACES), JSON)
@example(("metrics", "held_out"), {"\n": ""})
def test_a_changed_bundle_is_a_bundle_or_one_line(path: tuple[Any, ...], value: Any) -> None:
    data = changed()
    place = data
    for part in path[:-1]:
        place = place[part]
    place[path[-1]] = value
    try:
        found = parse_bundle(json.dumps(data))
    except PolicyError as error:
        assert "\n" not in str(error)  # noqa: PT017 - some changes are harmless
    else:
        assert parse_bundle(found.as_json()) == found
        assert list(bundle_rows(found))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (WHOLE[:-9], "JSON"),
        ("[]", "bundle = []"),
        (json.dumps(changed(version=2)), "bundle.version = 2"),
        (json.dumps(changed(rates__policy=-1.0)), "rates.policy = -1.0"),
        (json.dumps(changed(extra=1)), "'bundle.extra'"),
        (json.dumps(changed(observation__names=[])), "names, low and high"),
        (WHOLE.replace('"scale": 3.0', '"scale": 1e999'), "1e999"),
        (
            WHOLE.replace('"options": {', '"options": {"a": ' + "[" * 900 + "]" * 900 + ", "),
            "env.options.a.list.0",
        ),
        ("[" * 100_000, "JSON"),
        (WHOLE + " " * MAX_BUNDLE_BYTES, "500,000"),
    ],
    ids=range(10),
)
def test_each_kind_of_damage_is_named(text: str, said: str) -> None:
    with pytest.raises(PolicyError) as raised:
        parse_bundle(text)
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_network_of_another_tool_says_how_to_make_it_a_policy(tmp_path: Path) -> None:
    import onnx

    model, path = onnx.load(GOOD), tmp_path / "foreign.onnx"
    del model.metadata_props[:]
    onnx.save(model, path)
    with pytest.raises(PolicyError, match=r"foreign\.onnx: .*bundle.*export"):
        OnnxPolicy(path)


def test_a_bundle_must_describe_its_own_network(tmp_path: Path) -> None:
    seven = bundle_of().observation.names
    wide: dict[str, Any] = dict.fromkeys(("observation__low", "observation__high"), [0.0] * 8)
    path = relabelled(tmp_path / "p.onnx", observation__names=[*seven, "x"], **wide)
    with pytest.raises(PolicyError, match=r"7 numbers.* 8"):
        OnnxPolicy(path)
    state = [{"input": "h", "output": "h2", "shape": [1, 1, 4]}]
    with pytest.raises(PolicyError, match="0 states"):
        OnnxPolicy(relabelled(path, state=state))


def refused(path: Path, **env: Any) -> str:
    with pytest.raises(PolicyError) as raised:
        runs.make_env(OnnxPolicy(path), "planar", env.pop("robot", None), env)
    return str(raised.value)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"observation__names": HEADING}, "observation[0] is heading_cos"),
        ({"observation__scale": 9.0}, "observation.scale is 9 in the file and 3"),
        ({"rates__policy": 20.0}, "rates.policy is 20 in the file and 10"),
        ({"action__high": [1.0, 0.5]}, "action is linear -1 to 1 max_linear, angular -1 to 0.5"),
        ({"action__units": ["m/s", "rad/s"]}, "action is linear -1 to 1 m/s, angular"),
        ({"observation__high": [1.0] * 7}, "observation.goal_distance is 0 to 1 in the file and 0"),
    ],
    ids=["names", "scale", "rate", "action", "units", "bounds"],
)
def test_what_does_not_fit_is_named(values: dict[str, Any], said: str, tmp_path: Path) -> None:
    path = relabelled(tmp_path / "policy.onnx", **values)
    assert refused(path).startswith(f"{path}: {said}")


@pytest.mark.parametrize(
    ("lidar", "said"),
    [
        ({"field_of_view": 4.71}, "lidar.field_of_view is 6.283 in the file and 4.71"),
        ({"rays": 32}, "lidar.rays is 64 in the file and 32"),
        ({"max_range": 8.0}, "lidar.max_range is 5 in the file and 8"),
    ],
    ids=["field of view", "rays", "range"],
)
def test_another_lidar_is_named(lidar: dict[str, Any], said: str, tmp_path: Path) -> None:
    path = fitting(tmp_path / "p.onnx", "obstacle_goal", worlds="open:2")
    assert said in refused(path, robot=ACSAR.with_(lidar=lidar), worlds="open:2")


def differences(file: Path, /, **changes: Any) -> tuple[str, ...]:
    """What is told of a robot that drives with a policy."""
    policy = OnnxPolicy(file)
    runs.make_env(policy, "planar", ACSAR.with_(**changes), {"worlds": "open:2"}).close()
    return policy.differences


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy file of a training with a single robot."""
    return relabelled(tmp_path_factory.mktemp("alone") / "alone.onnx", robots={})


def test_a_robot_like_those_of_the_training_is_not_told(alone: Path) -> None:
    within = {"motor": {"time_constant": (0.05, 0.08, 0.1, 0.119)}, "body": {"friction": 0.8}}
    silent = {"wheel_radius": 0.06, "name": "other", "serial_port": "/dev/ttyUSB7"}
    assert differences(alone) == differences(alone, **within) == ()
    assert differences(alone, **silent) == ()
    assert differences(alone, firmware={"command_delay": 0.015}) == ()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"max_linear": 1.0}, "max_linear was 0.5 in the training and is 1 on this robot"),
        ({"body": {"mass": 9.0}}, "body.mass was 4 in the training and is 9 on"),
        ({"body": {"friction": 0.3}}, "body.friction was 0.7 to 1.2 in the training and is 0.3 on"),
        (
            {"motor": {"time_constant": (0.08, 0.3, 0.08, 0.08)}},
            "was 0.048 to 0.12 in the training",
        ),
        ({"body": {"turn_factor": 2.0}}, "turn_factor was 1.384 to 1.692 in the training and is 2"),
        ({"wheel_separation_multiplier": 2.0}, "multiplier was 1.398 to 1.709 in the training and"),
        ({"firmware": {"command_delay": 0.05}}, "command_delay was 0 to 0.02 in the training and"),
        ({"firmware": {"feedback_rate": 20.0}}, "feedback_rate was 100 in the training and is 20"),
        ({"linear_limits": {"max_acceleration": 1.0}}, "linear_limits.max_acceleration was 2 in"),
        ({"control_rate": 50.0, "firmware": {"feedback_rate": 100.0}}, "rates.control was 100 in"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_robot_outside_of_the_training_is_one_line_a_field(
    alone: Path, changes: dict[str, Any], said: str
) -> None:
    (line,) = differences(alone, **changes)
    assert said in line
    assert line.endswith("it may drive worse than it was measured to")


def test_where_a_lidar_looks_from_is_told_of_policies_that_use_one(
    alone: Path, tmp_path: Path
) -> None:
    assert differences(alone, lidar_x_offset=0.1) == ()
    path = fitting(tmp_path / "p.onnx", "obstacle_goal", worlds="open:2")
    footprint, line = differences(path, lidar_x_offset=0.1, body={"length": 0.6})
    assert "lidar_x_offset was -0.15 in the training and is 0.1" in line
    assert "footprint.radius was 0.2404" in footprint


def test_ranges_of_a_training_follow_from_the_randomization() -> None:
    ranges: dict[str, tuple[float, ...]] = {
        "latency": (0.0, 0.02),
        "deadband": (0.1, 0.3),
        "deadband_offset": (-0.1, 0.2),
    }
    ranges |= {"delay_samples": (0.004, 0.03, 0.01), "feedback_rate": (20.0, 50.0)}
    assert trained_range(ROBOT_FIELDS["motor.deadband"], (0.0,), ranges) == pytest.approx(
        (0.0, 0.5)
    )
    delay = trained_range(ROBOT_FIELDS["firmware.command_delay"], (0.01,), ranges)
    assert delay == pytest.approx((0.014, 0.06))
    assert trained_range(ROBOT_FIELDS["feedback_rate"], (100.0,), ranges) == (20.0, 50.0)


def test_driving_warns_once_a_field_and_the_header_says_it(alone: Path) -> None:
    robot: Any = ACSAR.with_(body={"mass": 9.0}, max_angular=1.0)
    policy = OnnxPolicy(alone)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        done = runs.evaluate_policy(policy, "planar", robot, range(1))
    told = [str(one.message) for one in caught if one.category is AcsarWarning]
    assert told == [f"{policy.path}: {line}" for line in policy.differences]
    assert len(told) == 2
    assert done.header["policy"]["differences"] == list(policy.differences)


def test_a_policy_is_shown_and_its_text_cannot_steer_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    out = tmp_path / "bundle.json"
    path = relabelled(tmp_path / "p.onnx", env__worlds="\x1b[2J[red]a\nb")
    monkeypatch.setattr("sys.argv", ["acsar-gym", "policy", "show", str(path), "--json", str(out)])
    with pytest.raises(SystemExit, match="0"):
        cli.main()
    shown = capsys.readouterr().out
    for said in (ENV_ID, "goal_distance 0 to 2", "friction 0.7 to", "[red]a"):
        assert said in shown
    assert "\x1b" not in shown
    written = json.loads(out.read_text())
    assert written.pop("origin") == "written by acsar-gym policy show"
    assert parse_bundle(json.dumps(written)) == bundle_of(path)


OF_THE_MAP = 7 + len(MAP_NAMES)


@pytest.mark.parametrize(
    "lidar",
    [{"field_of_view": 4.71}, {"rays": 32}, {"max_range": 8.0}],
    ids=lambda lidar: next(iter(lidar)),
)
def test_a_policy_that_takes_no_rays_drives_with_any_lidar(
    lidar: dict[str, Any], tmp_path: Path
) -> None:
    path = fitting(tmp_path / "p.onnx", "obstacle_goal", OF_THE_MAP, worlds="open:2")
    policy = OnnxPolicy(path)
    assert [sensor.name for sensor in policy.bundle.observation.sensors] == ["map"]
    env = runs.make_env(policy, "planar", ACSAR.with_(lidar=lidar), {"worlds": "open:2"})
    seen, _ = env.reset(seed=0)
    assert len(seen) > policy.width == OF_THE_MAP
    assert policy(seen).shape == (2,)
    env.close()


@pytest.mark.parametrize("width", [6, OF_THE_MAP + 1])
def test_a_policy_takes_whole_sensors(width: int, tmp_path: Path) -> None:
    said = f"takes {width} numbers, the observation has 7 or {OF_THE_MAP} or {OF_THE_MAP + 64}"
    with pytest.raises(PolicyError, match=said):
        fitting(tmp_path / "p.onnx", "obstacle_goal", width, worlds="open:2")


def test_a_recurrent_policy_keeps_its_state_until_the_reset(tmp_path: Path) -> None:
    policy, seen = OnnxPolicy(counting(tmp_path / "p.onnx")), np.zeros(7, np.float32)
    for _ in range(2):
        policy.reset()
        decided = [float(policy(seen)[1]) for _ in range(3)]
        assert decided == pytest.approx([0.0, 0.1, 0.2])
    done = runs.evaluate_policy(policy, "planar", None, range(2))
    assert [one.length > 0 for one in done.results] == [True, True]


@pytest.mark.parametrize(
    "options",
    [
        {"shape": ("n", 2)},
        {"shape": (50_000, 50_000)},
        {"dtype": 7},
        {"outputs": 0},
        {"outputs": 2},
    ],
    ids=["free", "huge", "integers", "lost", "too many"],
)
def test_a_state_that_cannot_be_kept_is_one_line(options: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match=r"p\.onnx: "):
        OnnxPolicy(counting(tmp_path / "p.onnx", **options))


ROBOTS = {
    "max_linear": [0.3, 2.0],
    "footprint_length": [0.25, 0.9],
    "footprint_width": [0.25, 0.7],
    "footprint_radius": [0.2, 0.6],
    "motor.time_constant": [0.05, 0.2],
    "body.mass": [1.0, 60.0],
}


def outside(tmp_path: Path, robot: RobotConfig, robots: dict[str, list[float]]) -> tuple[str, ...]:
    """What is told of a robot by a policy for these robots."""
    policy = OnnxPolicy(relabelled(tmp_path / "p.onnx", robots=robots))
    runs.make_env(policy, "planar", robot, {}).close()
    return policy.outside


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, ""),
        ({"max_linear": 2.0, "body": {"mass": 60.0}}, ""),
        ({"max_linear": 2.1}, "max_linear of this robot is 2.1, the policy is for 0.3 to 2"),
        ({"body": {"length": 1.0}}, "footprint_length of this robot is 1, the policy is for 0.25"),
        (
            {"footprint": [(0.65, 0.0), (-0.2, 0.3), (-0.2, -0.3)]},
            "footprint_radius of this robot is 0.65, the policy is for 0.2 to 0.6",
        ),
        (
            {"motor": {"time_constant": (0.1, 0.1, 0.3, 0.1)}},
            "motor.time_constant of this robot is 0.1, 0.1, 0.3, 0.1, the policy is for 0.05",
        ),
    ],
)
def test_a_policy_says_which_robots_it_is_for(
    changes: dict[str, Any], said: str, tmp_path: Path
) -> None:
    lines = outside(tmp_path, ACSAR.with_(**changes), ROBOTS)
    assert [line[: len(said)] for line in lines] == ([said] if said else [])


@pytest.mark.parametrize("name", ["tail.length", "__class__", "name"])
def test_numbers_that_no_robot_has_are_one_line(name: str, tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match=f"robots {name}: this acsar_gym compares no such number"):
        outside(tmp_path, ACSAR, {name: [0.0, 1.0]})


def test_run_refuses_another_robot_and_evaluate_warns(tmp_path: Path) -> None:
    policy = OnnxPolicy(relabelled(tmp_path / "p.onnx", robots={"max_linear": [0.3, 2.0]}))
    ACSAR.with_(max_linear=2.5).save(tmp_path / "fast.yaml")
    robot, said = str(tmp_path / "fast.yaml"), "max_linear of this robot is 2.5, the policy is for"
    with pytest.warns(AcsarWarning, match=said):
        done = runs.evaluate_policy(policy, "planar", robot, range(1))
    assert done.header["policy"]["differences"][0].startswith(said)
    with pytest.raises(PolicyError, match=f"{said} 0.3 to 2: train it again") as raised:
        runs.drive_to_goal(policy, "planar", robot, (0.5, 0.0))
    assert "\n" not in str(raised.value)


def test_a_real_robot_that_a_policy_is_not_for_is_refused(tmp_path: Path) -> None:
    """Before its port is opened."""
    policy = OnnxPolicy(relabelled(tmp_path / "p.onnx", robots={"max_linear": [1.0, 2.0]}))
    with pytest.raises(PolicyError, match=r"max_linear of this robot is 0\.5"):
        runs.make_env(policy, "/dev/ttyUSB7", None, {})
