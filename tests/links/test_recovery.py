"""A cable that is pulled at any moment: links, robots and environments on this side of it."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
import yaml
from processes import first_line, program
from serial_tools import DRIVER, TIMEOUT, Emulated, no_leak, start, wait_until

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import LinkError, LinkLostError
from acsar_gym.protocol import ZERO, Decoder

pytestmark = pytest.mark.usefixtures("deadline")


CURVE = np.array([0.1, 0.1], np.float32)


def name(emulator: Emulated) -> str:
    return str(emulator.log.with_name("usb-acsar"))


def make_env(emulator: Emulated, config: RobotConfig) -> Any:
    """An environment in the middle of an episode."""
    device = name(emulator)
    env = gymnasium.make(
        "acsar_gym/PointGoal-v0", link=device, robot=config, max_episode_steps=10**6
    )
    env.reset(seed=0)
    env.step(CURVE)
    return env


def step_until_fault(env: Any) -> Any:
    """The step that a fault ends."""
    return next(result for _ in range(200) if (result := env.step(CURVE))[3])


def spoken(emulator: Emulated) -> set[Any]:
    """The commands since the cable was plugged in."""
    return {reading.speeds for reading in Decoder().feed(emulator.since_plugged())}


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulated]:
    """It stops soon without commands, so that the next test needn't wait for it."""
    folder = tmp_path_factory.mktemp("board")
    hasty = RobotConfig.preset("acsar").with_(firmware={"command_timeout": 0.1})
    robot = folder / "robot.yaml"
    robot.write_text(yaml.safe_dump(hasty.model_dump()), encoding="utf-8")
    options = "--name", str(folder / "usb-acsar"), "--robot", str(robot)

    emulated = start(folder / "emulator.jsonl", *options)
    yield emulated
    emulated.end()


@pytest.fixture
def emulator(board: Emulated) -> Emulated:
    """A robot at rest that is plugged in, with a lasting name and an empty log."""
    board.plug()
    board.forget()
    return board


@pytest.fixture
def config(config: RobotConfig) -> RobotConfig:
    return config.with_(reconnect_timeout=TIMEOUT)


def test_interrupt_ends_a_program_that_waits_for_its_cable(emulator: Emulated) -> None:
    code = """
import time
robot.activate()
try:
    drive(10**9)
except Exception:
    print('lost', flush=True)
robot.activate()
"""

    with program(DRIVER + code, name(emulator)) as process:
        wait_until(emulator.is_driven, "a command that turns the wheels")
        emulator.pull()
        assert first_line(process) == "lost"
        time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=TIMEOUT)
    assert "KeyboardInterrupt" in error


def test_cable_the_same_robot_drives_on_once_the_cable_is_back(
    emulator: Emulated, config: RobotConfig
) -> None:
    robot = Robot(open_link(name(emulator), config), config)
    with no_leak():
        robot.activate()
        robot.drive(0.2, 0.0)
        emulator.pull()
        with pytest.raises(LinkLostError) as caught:
            for _ in range(int(TIMEOUT / robot.config.period)):
                robot.drive(0.2, 0.0)
        assert name(emulator) in caught.value.found
        assert "\n" not in str(caught.value)
        assert not robot.active

        wait_until(lambda: emulator.stands(loops=20), "wheels that stand")
        emulator.plug()
        emulator.forget()
        assert spoken(emulator) <= {ZERO}
        robot.activate()
        assert spoken(emulator) <= {ZERO}
        assert robot.odometry.pose == (0.0, 0.0, 0.0)
        while robot.odometry.pose[0] < 0.01:
            robot.drive(0.2, 0.0)
        robot.close()
    wait_until(lambda: emulator.commands()[-1] == ZERO, "zero as the last command")


LOST = 3.0


def test_cable_fault_ends_the_episode_with_the_reason_and_the_next_one_starts(
    emulator: Emulated, config: RobotConfig
) -> None:
    env = make_env(emulator, config)
    emulator.pull()
    observation, reward, terminated, truncated, info = step_until_fault(env)
    assert env.observation_space.contains(observation)
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert (info["fault"], info["is_success"]) == (LOST, 0.0)
    assert "lost while in use" in info["fault_reason"]
    with pytest.raises(LinkError, match=r"call activate\(\) or env.reset\(\) first"):
        env.step(CURVE)

    emulator.plug()
    observation, info = env.reset()
    assert env.observation_space.contains(observation)
    assert info["fault"] == 0.0
    assert "fault_reason" not in info
    assert spoken(emulator) <= {ZERO}
    assert env.step(CURVE)[-1]["fault"] == 0.0
    emulator.pull()  # between two episodes
    emulator.plug()
    env.reset()
    assert env.step(CURVE)[-1]["fault"] == 0.0
    env.close()


def test_cable_that_stays_out_is_reported_in_time(emulator: Emulated, config: RobotConfig) -> None:
    with no_leak():
        env = make_env(emulator, config.with_(reconnect_timeout=0.4))
        emulator.pull()
        step_until_fault(env)

        start = time.monotonic()
        with pytest.raises(LinkError, match="no such device"):
            env.reset()
        assert time.monotonic() - start >= 0.3
        env.close()
