"""What stops the wheels without the host: time-out, watchdog, bad bytes, a blocked wheel."""

from __future__ import annotations

import itertools
import subprocess
from pathlib import Path

import pytest
from firmware_tools import BUILD, Ran, Script

from acsar_gym.protocol import encode
from acsar_gym.resources import ASSETS

FORWARD = (8.0, 8.0, 8.0, 8.0)
RAMP = 8.0 / 60.0
OFF = [0.0] * 4


def first_off(ran: Ran, after: float) -> float:
    """When the motors have no current any more [s]."""
    return next(time for time, duty in ran.states("duty") if time > after and duty == OFF)


def test_timeout_stops_motors_when_commands_stop(script: Script, tmp_path: Path) -> None:
    script.command(0.1, 1.0, FORWARD)
    ran = script.run(2.5, tmp_path)
    assert first_off(ran, 0.9) - 0.993 == pytest.approx(0.5 + RAMP, abs=0.01)
    assert ran.feedback()[-1][1] == (0.0, 0.0, 0.0, 0.0)


def test_zero_command_takes_the_current_away_at_the_end_of_the_ramp(
    script: Script, tmp_path: Path
) -> None:
    script.command(0.1, 1.0, FORWARD)
    script.command(1.0, 1.5, (0.0, 0.0, 0.0, 0.0))
    assert first_off(script.run(1.5, tmp_path), 1.0) - 1.003 == pytest.approx(RAMP, abs=0.01)


def test_watchdog_resets_a_program_that_hangs_with_its_motors_off(
    script: Script, tmp_path: Path
) -> None:
    script.command(0.1, 2.0, FORWARD)
    script.order(1.0, "hang")
    ran = script.run(2.0, tmp_path)
    assert ran.figures["resets"] == 1
    assert first_off(ran, 1.0) < 1.0 + 0.14
    assert min(ran.at(1.9, "speeds")) > 7.5  # and goes on with the next command


def test_parser_skips_bad_parts_which_never_turn_a_wheel(script: Script, tmp_path: Path) -> None:
    garbage = b"ap9.00,bp099.0,cq05.00,dp05.0x\r\n,,,\n\xff\x00ap\r\x80ep05.00\r\nap05.00"
    for tick in range(36):
        script.say(0.1 + tick * 0.03, garbage[tick % 5 :] if tick % 2 else b"A" * 300 + b"\n")
    script.say(1.2, b"\r\n")  # completes the only valid part of all of these
    script.say(1.21, b"ap05.00,bn05.00,cp05.0,dp05.00,\r\n")
    ran = script.run(2.6, tmp_path)
    assert all(duty == OFF for time, duty in ran.states("duty") if time < 1.2)
    a, b, c, d = ran.at(1.6, "speeds")
    assert (a, b, c, d) == pytest.approx((5.0, -5.0, 0.0, 5.0), abs=0.1)
    assert ran.at(2.5, "duty") == OFF


def test_blocked_wheel_gets_limited_current_and_does_not_race_when_free(
    script: Script, tmp_path: Path
) -> None:
    script.command(0.1, 3.0, (4.0, 4.0, 4.0, 4.0))
    script.order(1.0, "turn 2 0")
    script.order(2.0, "free 2")  # a moment before it would be cut as stalled
    ran = script.run(3.0, tmp_path)
    assert 0.4 < ran.at(1.9, "duty")[2] < 4.0 / 36.0 + 0.42
    assert ran.at(1.9, "speeds")[3] == pytest.approx(4.0, abs=0.1)
    assert max(speeds[2] for _, speeds in ran.states("speeds")) < 4.0 + 0.4 * 36.0
    assert ran.at(2.9, "speeds")[2] == pytest.approx(4.0, abs=0.1)


def test_feedback_comes_at_its_rate_whatever_is_received(script: Script, tmp_path: Path) -> None:
    """A full line to the board, its wheels at top speed: it still has time to sleep."""
    for tick in range(150):
        script.say(0.1 + tick / 100, encode((30.0, 30.0, -30.0, -30.0)) * 3)
    ran = script.run(1.6, tmp_path)
    stamps = [time for time, _ in ran.feedback()]
    gaps = [later - earlier for earlier, later in itertools.pairwise(stamps)]
    assert len(stamps) == 159
    assert min(gaps) > 0.0095
    assert max(gaps) < 0.0105
    assert ran.figures["busy"] < 0.7


@pytest.mark.parametrize(("chip", "memory"), [("atmega328p", 2048), ("atmega2560", 8192)])
def test_memory_is_enough_with_a_deep_margin(chip: str, memory: int, tmp_path: Path) -> None:
    script = Script(chip)
    for tick in range(100):
        script.say(0.1 + tick / 100, encode((20.0, -20.0, 20.0, 20.0)) + b"ap\xff\r")
    stack = script.run(1.2, tmp_path).figures["stack"]
    size = ["avr-size", str(BUILD / f"{chip}.elf")]
    output = subprocess.run(size, capture_output=True, text=True, check=True)
    _, data, bss, *_ = output.stdout.splitlines()[1].split()
    assert 0 < stack < 256
    assert int(data) + int(bss) + stack < memory / 2


def test_files_compile_as_in_the_arduino_ide(chip: str, tmp_path: Path) -> None:
    """With its flags: one object a file, linked in the end. The sketch is C++."""
    folder = ASSETS / "firmware" / "acsar"
    flags = [f"-mmcu={chip}", "-Os", "-DF_CPU=16000000L", "-DARDUINO=10819", "-ffunction-sections"]
    objects = []
    for source in sorted(folder.glob("*.c")):
        objects.append(tmp_path / f"{source.stem}.o")
        subprocess.run(
            ["avr-gcc", "-c", "-std=gnu11", "-w", *flags, source, "-o", objects[-1]], check=True
        )

    sketch = tmp_path / "sketch.o"
    subprocess.run(
        ["avr-g++", "-c", "-x", "c++", *flags, folder / "acsar.ino", "-o", sketch], check=True
    )
    program = tmp_path / "acsar.elf"
    subprocess.run(
        ["avr-gcc", f"-mmcu={chip}", "-Wl,--gc-sections", "-o", program, *objects, sketch, "-lm"],
        check=True,
    )
