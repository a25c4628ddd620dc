"""What a gamepad's events ask for, and how one is found, opened, lost and opened again."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from gamepad_tools import EmulatedPad, event

from acsar_gym.errors import CommandError
from acsar_gym.tools import gamepad
from acsar_gym.tools.gamepad import (
    ABS_BRAKE,
    ABS_GAS,
    ABS_HAT2X,
    ABS_HAT2Y,
    ABS_INFO,
    ABS_RZ,
    ABS_X,
    ABS_Z,
    BTN_EAST,
    BTN_SELECT,
    BTN_START,
    BTN_TL,
    BTN_TL2,
    BTN_TR2,
    EV_ABS,
    EV_KEY,
    EV_SYN,
    EVENT,
    EVIOCGABS,
    SYN_DROPPED,
    SYN_REPORT,
    XPAD,
    Axis,
    Controls,
    Gamepad,
    PadEvent,
    find_gamepads,
    find_triggers,
)

LB, LET_GO = event(EV_KEY, BTN_TL, 1), event(EV_KEY, BTN_TL, 0)
FULL, HALF, REST = (event(EV_ABS, ABS_RZ, value) for value in (255, 128, 0))
BACK_UP = event(EV_ABS, ABS_Z, 255)
LEFT, RIGHT, CENTRE = (event(EV_ABS, ABS_X, value) for value in (-32768, 32767, 900))
OVERFLOW = EVENT.pack(0, 0, EV_SYN, SYN_DROPPED, 0)
REPORT = EVENT.pack(0, 0, EV_SYN, SYN_REPORT, 0)


def controls() -> Controls:
    return Controls({code: Axis(*XPAD[code]) for code in XPAD}, ABS_Z, ABS_RZ)


@pytest.mark.parametrize(
    ("events", "linear", "angular"),
    [
        ([], 0.0, 0.0),
        ([FULL, LEFT], 0.0, 0.0),  # without LB nothing moves
        ([LB], 0.0, 0.0),
        ([LB, FULL], 1.0, 0.0),
        ([LB, HALF], 0.476, 0.0),
        ([LB, BACK_UP], -1.0, 0.0),
        ([LB, BACK_UP, FULL], 0.0, 0.0),
        ([LB, FULL, REST], 0.0, 0.0),
        ([LB, LEFT], 0.0, 1.0),
        ([LB, RIGHT], 0.0, -1.0),
        ([LB, CENTRE], 0.0, 0.0),  # a worn stick
        ([LB, FULL, RIGHT], 1.0, -1.0),
        ([LB, FULL, LEFT, LET_GO], 0.0, 0.0),
        ([LB, FULL, LET_GO, LB], 0.0, 0.0),  # the trigger is still pulled
        ([LB, FULL, LET_GO, LB, REST, HALF], 0.476, 0.0),
        ([FULL, LB], 0.0, 0.0),
        ([LEFT, LB], 0.0, 0.0),
        ([LEFT, LB, FULL, CENTRE], 0.0, 0.0),  # never all at rest
        ([LEFT, LB, CENTRE, HALF, RIGHT], 0.476, -1.0),
        ([LB, FULL, event(EV_KEY, BTN_TL, 2)], 1.0, 0.0),  # the kernel repeats keys that are held
        ([LB, FULL, OVERFLOW], 0.0, 0.0),
        ([LB, FULL, OVERFLOW, LB, REPORT], 0.0, 0.0),  # what is left of the packet is void
        ([LB, OVERFLOW, REPORT, LB, HALF], 0.476, 0.0),
    ],
)
def test_twist(events: list[bytes], linear: float, angular: float) -> None:
    asked = controls()
    assert asked.feed(b"".join(events)) == []
    assert asked.twist() == pytest.approx((linear, angular), abs=1e-3)
    assert asked.dropped == (OVERFLOW in events)


def test_buttons_act_when_pressed_and_in_their_order() -> None:
    asked = controls()
    codes = (BTN_EAST, BTN_START, BTN_SELECT)
    data = b"".join(event(EV_KEY, code, value) for code in codes for value in (1, 2, 0))
    assert asked.feed(data) == [PadEvent.STOP, PadEvent.RELEASE, PadEvent.QUIT]


def test_an_emergency_stop_is_heard_without_the_deadman() -> None:
    assert controls().feed(event(EV_KEY, BTN_EAST, 1)) == [PadEvent.STOP]


def test_after_a_release_of_the_emergency_stop_the_deadman_is_pressed_anew() -> None:
    asked = controls()
    asked.feed(LB + FULL)
    asked.disarm()
    assert asked.twist() == (0.0, 0.0)
    asked.feed(HALF)
    assert asked.twist() == (0.0, 0.0)
    asked.feed(LET_GO + REST + LB + FULL)
    assert asked.twist() == (1.0, 0.0)


# Pads as the kernel's drivers tell them, in words of 64 bits, the highest first.
KEYS = "7cdb000000000000 0 0 0 0"
KEYS_WITH_TRIGGERS = "7fdb000000000000 0 0 0 0"


@pytest.mark.parametrize(
    ("keys", "axes", "triggers"),
    [
        pytest.param(KEYS, "3003f", (ABS_Z, ABS_RZ), id="xpad"),
        pytest.param(KEYS_WITH_TRIGGERS, "3003f", (ABS_Z, ABS_RZ), id="hid-playstation"),
        pytest.param(KEYS, "30627", (ABS_BRAKE, ABS_GAS), id="Xbox by Bluetooth"),
        pytest.param(KEYS_WITH_TRIGGERS, "3001b", (BTN_TL2, BTN_TR2), id="hid-nintendo"),
        pytest.param(KEYS_WITH_TRIGGERS, "30027", (BTN_TL2, BTN_TR2), id="right stick on Z and RZ"),
        pytest.param(KEYS, "30001b", (ABS_HAT2Y, ABS_HAT2X), id="the specification's"),
        pytest.param(KEYS, "30027", None, id="a right stick is no trigger"),
        pytest.param(KEYS, "0", None, id="no stick"),
        pytest.param("10000 0 0 0 0", "3", None, id="a joystick's buttons"),
        pytest.param("402000000 3803078f800d001 feffffdfffefffff fffffffffffffffe", "0", None,
                     id="a keyboard"),
    ],
)  # fmt: skip
def test_triggers_are_found_where_drivers_have_them(
    keys: str, axes: str, triggers: tuple[int, int] | None, tmp_path: Path
) -> None:
    make_input(tmp_path, keys, axes)
    assert find_triggers(tmp_path) == triggers


def make_input(about: Path, keys: str, axes: str, name: str = "A Pad") -> None:
    """What sysfs tells about an input device."""
    (about / "capabilities").mkdir(parents=True)
    for file, text in (("capabilities/key", keys), ("capabilities/abs", axes), ("name", name)):
        (about / file).write_text(f"{text}\n", encoding="utf-8")


def test_pads_are_found_among_all_inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gamepad, "SYSFS", tmp_path)
    assert find_gamepads() == []
    for number, name in ((10, "Second"), (2, "First")):
        make_input(tmp_path / f"class/input/event{number}/device", KEYS, "3003f", name)
    make_input(tmp_path / "class/input/event1/device", "0", "0", "Mouse")
    (tmp_path / "class/input/event3").mkdir()  # as it goes away
    assert find_gamepads() == ["/dev/input/event2", "/dev/input/event10"]
    assert find_gamepads("Second") == ["/dev/input/event10"]


@pytest.fixture
def pad(tmp_path: Path) -> Iterator[EmulatedPad]:
    emulated = EmulatedPad(tmp_path / "pad")
    yield emulated
    emulated.pull()


def test_a_pad_is_lost_and_comes_back(pad: EmulatedPad, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gamepad, "REOPEN_EVERY", 3)
    with Gamepad(str(pad.path)) as opened:
        assert opened.poll() == []
        pad.deliver(LB + FULL)
        assert (opened.poll(), opened.twist()) == ([], (1.0, 0.0))
        pad.deliver(OVERFLOW + REPORT)
        assert (opened.poll(), opened.twist()) == ([], (0.0, 0.0))
        pad.deliver(LET_GO + LB + FULL)
        assert (opened.poll(), opened.twist()) == ([], (1.0, 0.0))
        for _ in range(2):
            pad.pull()
            assert (opened.poll(), opened.twist()) == ([PadEvent.LOST], (0.0, 0.0))
            assert [opened.poll() for _ in range(10)] == [[]] * 10
            pad.plug()
            assert [event for _ in range(3) for event in opened.poll()] == [PadEvent.BACK]
            pad.deliver(FULL)  # nobody has pressed LB since
            assert (opened.poll(), opened.twist()) == ([], (0.0, 0.0))
            pad.deliver(REST + LB + HALF)
            assert opened.poll() == []
            assert opened.twist() == pytest.approx((0.476, 0.0), abs=1e-3)


def test_no_pad_and_no_gamepad_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gamepad, "SYSFS", tmp_path)
    for device, said in (
        ("", "by-id"),
        ("/dev/null", "not a gamepad"),
        (str(tmp_path), "not a gamepad"),
        (str(tmp_path / "none"), "No such file"),
    ):
        with pytest.raises(CommandError, match=said) as raised:
            Gamepad(device)
        assert "\n" not in str(raised.value)
    monkeypatch.setattr(sys, "platform", "darwin")
    with pytest.raises(CommandError, match="Linux"):
        Gamepad()


def test_a_tty_that_the_kernel_knows_is_a_serial_port(
    pad: EmulatedPad, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So --gamepad /dev/ttyUSB0 is a mistake, and not a silent pad."""
    monkeypatch.setattr(gamepad, "SYSFS", tmp_path)
    number = pad.path.stat().st_rdev
    (tmp_path / f"dev/char/{os.major(number)}:{os.minor(number)}/device").mkdir(parents=True)
    with pytest.raises(CommandError, match="not a gamepad"):
        Gamepad(str(pad.path))


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
@pytest.mark.skipif(not Path("/usr/include/linux/input.h").exists(), reason="needs Linux's headers")
def test_numbers_are_the_kernels(tmp_path: Path) -> None:
    names = [name for name in vars(gamepad) if name.startswith(("EV_", "SYN_", "BTN_", "ABS_"))]
    names = [name for name in names if isinstance(getattr(gamepad, name), int)]
    assert len(names) > 15
    terms = ["sizeof(struct input_event)", "sizeof(struct input_absinfo)", "EVIOCGABS(0)", *names]
    lines = "".join(f'printf("%ld\\n", (long)({term}));' for term in terms)
    source = f"#include <stdio.h>\n#include <linux/input.h>\nint main(void) {{{lines} return 0;}}"
    (tmp_path / "numbers.c").write_text(source, encoding="ascii")
    subprocess.run(["cc", "-o", tmp_path / "numbers", tmp_path / "numbers.c"], check=True)
    printed = subprocess.run([tmp_path / "numbers"], check=True, capture_output=True, text=True)
    ours = [EVENT.size, ABS_INFO.size, EVIOCGABS, *(getattr(gamepad, name) for name in names)]
    assert list(map(int, printed.stdout.split())) == ours
