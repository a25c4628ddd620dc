"""A gamepad, read from the kernel's input events (Linux); no library is needed.

Codes are those of the kernel's Documentation/input/gamepad.rst, which makes drivers report the same
ones for every pad. The events tell changes only, so a pad that is silent is a pad that is held.
"""

from __future__ import annotations

import contextlib
import errno
import os
import struct
import sys
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Self

from acsar_gym.errors import CommandError

EVENT = struct.Struct("@llHHi")
"""The kernel's struct input_event: seconds, microseconds, type, code, value."""
EV_SYN, EV_KEY, EV_ABS = 0, 1, 3
SYN_REPORT, SYN_DROPPED = 0, 3
BTN_EAST, BTN_TL, BTN_TL2, BTN_TR2, BTN_SELECT, BTN_START = 0x131, 0x136, 0x138, 0x139, 0x13A, 0x13B
ABS_X, ABS_Z, ABS_RX, ABS_RZ, ABS_GAS, ABS_BRAKE = 0x00, 0x02, 0x03, 0x05, 0x09, 0x0A
ABS_HAT2X, ABS_HAT2Y = 0x14, 0x15
EVIOCGABS = 0x80184540
"""The ioctl that reads axis 0; later axes follow. It answers with struct input_absinfo."""
ABS_INFO = struct.Struct("@6i")
XPAD = {ABS_X: (0, -32768, 32767), ABS_Z: (0, 0, 255), ABS_RZ: (0, 0, 255)}
"""Value at rest, minimum and maximum of axes by the kernel's driver xpad; taken where a device
can't be asked: a pseudo-terminal that carries the events of a pad."""
STICK_DEAD_ZONE = 0.1
"""Share of the stick's way on either side within which it is at rest: worn sticks don't centre."""
TRIGGER_DEAD_ZONE = 0.05
"""Share of a trigger's way within which it is at rest."""
REOPEN_EVERY = 50
"""Calls of `poll` between two attempts to open a pad that was lost; 0.5 s at 100 Hz."""
SYSFS = Path("/sys")


class PadEvent(Enum):
    """What the driving loop has to act on, beyond the twist."""

    STOP = "emergency stop"
    RELEASE = "release"
    QUIT = "quit"
    LOST = "lost"
    BACK = "back"


BUTTONS = {BTN_EAST: PadEvent.STOP, BTN_START: PadEvent.RELEASE, BTN_SELECT: PadEvent.QUIT}


@dataclass
class Axis:
    """An axis and its range; a button that stands in for a trigger is one from 0 to 1."""

    value: int
    low: int
    high: int

    def share(self) -> float:
        """How far it is from its minimum to its maximum, 0 to 1."""
        return min(max((self.value - self.low) / max(self.high - self.low, 1), 0.0), 1.0)


class Controls:
    """What the events of one pad ask for.

    The robot drives while LB is held. LB counts from when it is pressed, not where it is held
    already as the pad is opened or after events were lost; and stick and triggers count once all
    were at rest since then: no start but from neutral.
    """

    def __init__(self, axes: dict[int, Axis], backward: int, forward: int) -> None:
        self.axes = axes
        self.dropped = False
        """Whether events were lost: the axes' values are to be read anew."""
        self._stick, self._backward, self._forward = axes[ABS_X], axes[backward], axes[forward]
        self._held = self._neutral = self._skipping = False
        self._partial = b""

    def feed(self, data: bytes) -> list[PadEvent]:
        """Take bytes of the device, which may end within an event; returns the buttons pressed."""
        pressed = []
        data = self._partial + data
        whole = len(data) - len(data) % EVENT.size
        self._partial = data[whole:]
        for _, _, kind, code, value in EVENT.iter_unpack(data[:whole]):
            if kind == EV_SYN:
                if code == SYN_DROPPED:
                    self.disarm()
                    self.dropped = True
                self._skipping = code == SYN_DROPPED or (self._skipping and code != SYN_REPORT)
            elif self._skipping:
                continue
            elif kind == EV_KEY and code == BTN_TL and value < 2:  # 2 repeats a key that is held
                self._held, self._neutral = bool(value), False
            elif kind == EV_KEY and code in BUTTONS and value == 1:
                pressed.append(BUTTONS[code])
            elif kind in (EV_KEY, EV_ABS) and code in self.axes:
                self.axes[code].value = value
            self._neutral = self._neutral or not any((self._turn(), *self._triggers()))
        return pressed

    def disarm(self) -> None:
        """Ask for zero until LB is pressed again."""
        self._held = False

    def twist(self) -> tuple[float, float]:
        """Return shares of the full linear and angular speed, -1 to 1; left is positive."""
        if not (self._held and self._neutral):
            return 0.0, 0.0
        backward, forward = self._triggers()
        return forward - backward, self._turn()

    def _turn(self) -> float:
        """How far the stick is to the left, -1 to 1."""
        offset = 1.0 - 2.0 * self._stick.share()
        turn = max(abs(offset) - STICK_DEAD_ZONE, 0.0) / (1.0 - STICK_DEAD_ZONE)
        return turn if offset > 0.0 else -turn

    def _triggers(self) -> tuple[float, float]:
        """How far the left and the right trigger are pulled, 0 to 1."""
        left, right = (
            max(axis.share() - TRIGGER_DEAD_ZONE, 0.0) / (1.0 - TRIGGER_DEAD_ZONE)
            for axis in (self._backward, self._forward)
        )
        return left, right


class Gamepad:
    """A gamepad that may come and go. Its twist is zero while it is away."""

    def __init__(self, device: str = "") -> None:
        if sys.platform != "linux":
            raise CommandError("--gamepad reads Linux's input events: drive with the keyboard here")
        found = [device] if device else find_gamepads()
        if not found:
            raise CommandError(
                "no gamepad: plug one in, or name its device (ls /dev/input/by-id/*-event-joystick)"
            )
        self._given, self._wait = device, 0
        self._file: int | None = None
        try:
            self._open(found[0])
        except PermissionError as error:
            raise CommandError(
                f"{found[0]}: not readable for you: sudo usermod -aG input $USER, then log in again"
            ) from error
        except OSError as error:
            raise CommandError(f"{found[0]}: {error.strerror or error}") from error

    def _open(self, device: str) -> None:
        """Open the device. CommandError where it is no gamepad."""
        file = os.open(device, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY)
        try:
            self.name, triggers = _identify(file, device)
            axes = {code: _read_axis(file, code) for code in (ABS_X, *triggers)}
        except BaseException:
            os.close(file)
            raise
        self._controls, self._file = Controls(axes, *triggers), file

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the device; idempotent."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def poll(self) -> list[PadEvent]:
        """Read what has arrived, without waiting; returns what happened, in order."""
        if self._file is None:
            self._wait -= 1
            return [PadEvent.BACK] if self._wait <= 0 and self._reopen() else []
        try:
            data = os.read(self._file, 1 << 16)
            events = self._controls.feed(data)
            if self._controls.dropped:
                self._controls.dropped = False
                for code, axis in self._controls.axes.items():
                    axis.value = _read_axis(self._file, code).value
        except BlockingIOError:
            return []
        except OSError:  # ENODEV: its cable was pulled
            data = b""
        if data:
            return events
        self.close()
        self._wait = REOPEN_EVERY
        return [PadEvent.LOST]

    def _reopen(self) -> bool:
        """Whether the pad is there again; else the next attempt is in a while."""
        self._wait = REOPEN_EVERY
        for device in [self._given] if self._given else find_gamepads(self.name):
            try:
                self._open(device)
            except (OSError, CommandError):  # udev may not have given it to us yet
                continue
            return True
        return False

    def disarm(self) -> None:
        """Ask for zero until LB is pressed again."""
        self._controls.disarm()

    def twist(self) -> tuple[float, float]:
        """Return shares of the full linear and angular speed, -1 to 1; left is positive."""
        return (0.0, 0.0) if self._file is None else self._controls.twist()


def find_gamepads(name: str = "") -> list[str]:
    """Return the event devices of the gamepads plugged in, or of those of that name."""
    found = []
    inputs = (SYSFS / "class/input").glob("event*")
    for node in sorted(inputs, key=lambda path: int(path.name.removeprefix("event"))):
        with contextlib.suppress(OSError):  # unplugged just now
            if find_triggers(node / "device") and name in ("", _read_name(node / "device")):
                found.append(f"/dev/input/{node.name}")
    return found


def find_triggers(about: Path) -> tuple[int, int] | None:
    """Tell the left and right trigger from what a device of sysfs can report.

    The specification has them as ABS_HAT2Y and ABS_HAT2X or as buttons. Drivers of pads of today
    have them elsewhere: xpad and hid-playstation as ABS_Z and ABS_RZ, beside a right stick on
    ABS_RX; Xbox pads by Bluetooth as ABS_BRAKE and ABS_GAS, with a right stick on ABS_Z.
    """
    keys, axes = (_parse_bits(about / "capabilities" / kind) for kind in ("key", "abs"))
    if not {BTN_TL, BTN_EAST, BTN_START, BTN_SELECT} <= keys or ABS_X not in axes:
        return None
    choices = {
        (ABS_HAT2Y, ABS_HAT2X): {ABS_HAT2Y, ABS_HAT2X} <= axes,
        (ABS_BRAKE, ABS_GAS): {ABS_BRAKE, ABS_GAS} <= axes,
        (ABS_Z, ABS_RZ): {ABS_Z, ABS_RZ, ABS_RX} <= axes,
        (BTN_TL2, BTN_TR2): {BTN_TL2, BTN_TR2} <= keys,
    }
    return next((pair for pair, there in choices.items() if there), None)


def _identify(file: int, device: str) -> tuple[str, tuple[int, int]]:
    """Name and triggers of an open device. CommandError where it is no gamepad."""
    number = os.fstat(file).st_rdev
    about = SYSFS / f"dev/char/{os.major(number)}:{os.minor(number)}/device"
    if not about.exists() and os.isatty(file):
        return device, (ABS_Z, ABS_RZ)
    if (about / "capabilities").is_dir() and (triggers := find_triggers(about)):
        return _read_name(about), triggers
    raise CommandError(f"{device}: not a gamepad, or one without triggers")


def _read_name(about: Path) -> str:
    return (about / "name").read_text(encoding="utf-8", errors="replace").strip()


def _parse_bits(file: Path) -> set[int]:
    """The numbers of the bits set in a bitmap of sysfs: hexadecimal longs, the highest first."""
    words = file.read_text(encoding="ascii").split()[::-1]
    size = 8 * struct.calcsize("@l")
    bits = sum(int(word, 16) << size * index for index, word in enumerate(words))
    return {bit for bit in range(bits.bit_length()) if bits >> bit & 1}


def _read_axis(file: int, code: int) -> Axis:
    """An axis as it stands now, by the device; at rest where it can't be asked."""
    import fcntl  # noqa: PLC0415 - not on Windows

    if code >= BTN_EAST:
        return Axis(0, 0, 1)
    try:
        answer = fcntl.ioctl(file, EVIOCGABS + code, bytes(ABS_INFO.size))
    except OSError as error:
        if error.errno != errno.ENOTTY:
            raise
        return Axis(*XPAD[code])
    return Axis(*ABS_INFO.unpack(answer)[:3])
