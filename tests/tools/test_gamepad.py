"""What a gamepad's events request, and how a pad is found, opened, lost and opened again."""

from __future__ import annotations

import contextlib
import itertools
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gamepad_tools
import pytest
from evdev import InputEvent, ecodes
from gamepad_tools import (
    FULL,
    HALF,
    LB,
    LEFT,
    LET_GO,
    QUIT,
    REST,
    START,
    STOP,
    XPAD,
    EmulatedPad,
    event,
)

from acsar_gym import Robot, open_link
from acsar_gym.errors import CommandError, MissingExtraError
from acsar_gym.tools import gamepad, teleop
from acsar_gym.tools.gamepad import Controls, Gamepad, PadEvent, find_gamepads, find_triggers

BACK_UP = event(ecodes.EV_ABS, ecodes.ABS_Z, 255)
RIGHT = event(ecodes.EV_ABS, ecodes.ABS_X, 32767)
CENTRE = event(ecodes.EV_ABS, ecodes.ABS_X, 900)
DROPPED = [InputEvent(0, 0, ecodes.EV_SYN, ecodes.SYN_DROPPED, 0)]
REPEAT = event(ecodes.EV_KEY, ecodes.BTN_TL, 2)


def make_controls() -> Controls:
    return Controls(XPAD, ecodes.ABS_Z, ecodes.ABS_RZ)


@pytest.mark.parametrize(
    ("packets", "linear", "angular"),
    [
        ([FULL, LEFT], 0.0, 0.0),  # without LB nothing moves
        ([LB, FULL], 1.0, 0.0),
        ([LB, BACK_UP], -1.0, 0.0),
        ([LB, CENTRE], 0.0, 0.0),  # a worn stick
        ([LB, FULL, RIGHT], 1.0, -1.0),
        ([LB, FULL, LET_GO, LB], 0.0, 0.0),  # the trigger is still pulled
        ([LB, FULL, LET_GO, LB, REST, HALF], 0.476, 0.0),
        ([LEFT, LB, FULL, CENTRE], 0.0, 0.0),  # never all at rest
        ([LEFT, LB, CENTRE, HALF, RIGHT], 0.476, -1.0),
        ([LB, FULL, REPEAT], 1.0, 0.0),  # the kernel repeats keys that are held
    ],
)
def test_controls_twist(packets: list[list[InputEvent]], linear: float, angular: float) -> None:
    controls = make_controls()
    for packet in packets:
        assert controls.take(packet) == []
    assert controls.twist() == pytest.approx((linear, angular), abs=1e-3)


def test_controls_take_returns_buttons_in_their_order_without_lb() -> None:
    codes = (ecodes.BTN_EAST, ecodes.BTN_START, ecodes.BTN_SELECT)
    packets = [event(ecodes.EV_KEY, code, value) for code in codes for value in (1, 2, 0)]
    pressed = make_controls().take(itertools.chain(*packets))
    assert pressed == [PadEvent.STOP, PadEvent.RELEASE, PadEvent.QUIT]


def test_controls_disarm_needs_lb_again() -> None:
    controls = make_controls()
    controls.take(LB + FULL)
    controls.disarm()
    assert controls.twist() == (0.0, 0.0)
    controls.take(HALF)
    assert controls.twist() == (0.0, 0.0)
    controls.take(LET_GO + REST + LB + FULL)
    assert controls.twist() == (1.0, 0.0)


def describe(keys: str, axes: str, name: str = "") -> Any:
    """An input device of which only name and capabilities are known."""
    codes = {
        ecodes.EV_KEY: [ecodes.ecodes[f"BTN_{key}"] for key in keys.split()],
        ecodes.EV_ABS: [ecodes.ecodes[f"ABS_{axis}"] for axis in axes.split()],
    }
    return SimpleNamespace(name=name, capabilities=lambda absinfo: codes, close=lambda: None)


KEYS = "SOUTH EAST NORTH WEST TL TR SELECT START MODE THUMBL THUMBR"


@pytest.mark.parametrize(
    ("keys", "axes", "triggers"),
    [
        pytest.param(KEYS, "X Y Z RX RY RZ HAT0X HAT0Y", "Z RZ", id="xpad"),
        pytest.param(KEYS, "X Y Z RZ GAS BRAKE", "BRAKE GAS", id="Xbox by Bluetooth"),
        pytest.param(KEYS + " TL2 TR2", "X Y RX RY", "TL2 TR2", id="hid-nintendo"),
        pytest.param(KEYS, "X Y RX RY HAT2X HAT2Y", "HAT2Y HAT2X", id="the specification's"),
        pytest.param(KEYS, "X Y Z RZ", "", id="a right stick is no trigger"),
        pytest.param("TRIGGER THUMB", "X Y", "", id="a joystick"),
    ],
)
def test_find_triggers_where_drivers_have_them(keys: str, axes: str, triggers: str) -> None:
    prefix = "BTN_" if "TL2" in triggers else "ABS_"
    codes = tuple(ecodes.ecodes[prefix + name] for name in triggers.split())
    assert find_triggers(describe(keys, axes)) == (codes or None)


def test_find_gamepads_among_all_inputs(monkeypatch: pytest.MonkeyPatch) -> None:
    axes = "X Y Z RX RY RZ"
    devices = {
        "/dev/input/event10": describe(KEYS, axes, "Second"),
        "/dev/input/event2": describe(KEYS, axes, "First"),
        "/dev/input/event1": describe("", "", "Mouse"),
    }
    monkeypatch.setattr(gamepad, "list_devices", lambda **_: list(devices))
    monkeypatch.setattr(gamepad, "InputDevice", lambda path, **_: devices[path])
    assert find_gamepads() == ["/dev/input/event2", "/dev/input/event10"]
    assert find_gamepads("Second") == ["/dev/input/event10"]


@pytest.fixture
def pad(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[EmulatedPad]:
    monkeypatch.setattr(gamepad, "InputDevice", gamepad_tools.PadDevice)
    emulated = EmulatedPad(tmp_path / "pad")
    yield emulated
    emulated.pull()


def test_gamepad_is_lost_and_comes_back(pad: EmulatedPad, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gamepad, "REOPEN_EVERY", 3)
    with contextlib.closing(Gamepad(str(pad.path))) as opened:
        pad.deliver(STOP + DROPPED)  # as if the pad was lost for a moment
        assert opened.poll() == [PadEvent.STOP, PadEvent.LOST]
        assert [opened.poll() for _ in range(3)] == [[], [], [PadEvent.BACK]]

        for _ in range(2):
            pad.deliver(LB + FULL)
            assert (opened.poll(), opened.controls.twist()) == ([], (1.0, 0.0))
            pad.pull()
            assert (opened.poll(), opened.controls.twist()) == ([PadEvent.LOST], (0.0, 0.0))
            assert [opened.poll() for _ in range(10)] == [[]] * 10
            pad.plug()
            assert [happened for _ in range(3) for happened in opened.poll()] == [PadEvent.BACK]
            assert opened.controls.twist() == (0.0, 0.0)

        pad.deliver(STOP + START + QUIT)
        assert opened.poll() == [PadEvent.STOP, PadEvent.RELEASE, PadEvent.QUIT]


@pytest.mark.parametrize(
    ("device", "message"),
    [("", "by-id"), ("/dev/null", "not a gamepad"), ("/dev/acsar-missing", "No such file")],
)
def test_gamepad_that_isnt_there_is_one_line(
    device: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gamepad, "list_devices", lambda **_: [])
    with pytest.raises(CommandError, match=message) as caught:
        Gamepad(device)
    assert "\n" not in str(caught.value)


def test_drive_gamepad_without_evdev_or_linux_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Robot(open_link("planar"))
    with monkeypatch.context() as patch:
        patch.delitem(sys.modules, "acsar_gym.tools.gamepad")
        patch.setitem(sys.modules, "evdev", None)
        with pytest.raises(MissingExtraError, match=r"'\.\[gamepad\]'"):
            teleop.drive_gamepad(robot)
    monkeypatch.setattr(sys, "platform", "darwin")
    with pytest.raises(CommandError, match="Linux"):
        teleop.drive_gamepad(robot)
