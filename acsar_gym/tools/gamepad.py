"""A gamepad, read by evdev from the kernel's input events (Linux).

Drivers report the codes of the kernel's Documentation/input/gamepad.rst for every pad. Events
report changes only, so a pad that is silent is a pad that is held.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Self

from evdev import InputDevice, InputEvent, ecodes, list_devices

from acsar_gym.errors import CommandError

STICK_DEAD_ZONE = 0.1
"""Share of the stick's way on either side within which it is at rest: worn sticks don't centre."""
TRIGGER_DEAD_ZONE = 0.05
"""Share of a trigger's way within which it is at rest."""
REOPEN_EVERY = 50
"""Calls of `poll` between two attempts to open a pad that was lost; 0.5 s at 100 Hz."""


class PadEvent(Enum):
    """What the driving loop has to act on, apart from the twist."""

    STOP = "emergency stop"
    RELEASE = "release"
    QUIT = "quit"
    LOST = "lost"
    BACK = "back"


BUTTONS = {
    ecodes.BTN_EAST: PadEvent.STOP,
    ecodes.BTN_START: PadEvent.RELEASE,
    ecodes.BTN_SELECT: PadEvent.QUIT,
}


@dataclass
class Axis:
    """An axis and its range; a button that replaces a trigger is an axis from 0 to 1."""

    value: int
    low: int
    high: int

    @classmethod
    def of(cls, device: InputDevice[str], code: int) -> Self:
        """Return an axis of a device with its value now."""
        if code >= ecodes.BTN_MISC:
            return cls(0, 0, 1)
        about = device.absinfo(code)
        return cls(about.value, about.min, about.max)

    @property
    def share(self) -> float:
        """Position between the minimum and the maximum, 0 to 1."""
        return min(max((self.value - self.low) / max(self.high - self.low, 1), 0.0), 1.0)


class Controls:
    """The twist and the buttons that a pad's events request.

    The robot drives while LB is held. LB counts from when it is pressed, not if it is held already
    as the pad is opened or after events were lost. Stick and triggers count once all were at rest
    since then, so the robot only starts from neutral.

    Attributes:
        axes: Stick and triggers by their codes.
        dropped: Whether the kernel dropped events, so that the axes must be read again.
    """

    def __init__(self, axes: dict[int, Axis], backward: int, forward: int) -> None:
        self.axes = axes
        self.dropped = False
        self._backward = axes[backward]
        self._forward = axes[forward]
        self._held = False
        self._neutral = False
        self._skipping = False

    def take(self, events: Iterable[InputEvent]) -> list[PadEvent]:
        """Take events, and return the buttons that were pressed."""
        pressed = []
        for event in events:
            if event.type == ecodes.EV_SYN:
                self._take_end_of_packet(event.code)
            elif self._skipping:
                continue
            elif event.type == ecodes.EV_KEY and event.code == ecodes.BTN_TL:
                if event.value != 2:  # the kernel repeats keys that are held
                    self._held = bool(event.value)
                    self._neutral = False
            elif event.type == ecodes.EV_KEY and event.code in BUTTONS:
                if event.value == 1:
                    pressed.append(BUTTONS[event.code])
            elif event.type in (ecodes.EV_KEY, ecodes.EV_ABS) and event.code in self.axes:
                self.axes[event.code].value = event.value

            at_rest = not (self._turn() or _pull(self._backward) or _pull(self._forward))
            self._neutral = self._neutral or at_rest
        return pressed

    def _take_end_of_packet(self, code: int) -> None:
        """Skip the rest of a packet of which the kernel dropped events."""
        if code == ecodes.SYN_DROPPED:
            self.disarm()
            self.dropped = self._skipping = True
        elif code == ecodes.SYN_REPORT:
            self._skipping = False

    def disarm(self) -> None:
        """Request zero until LB is pressed again."""
        self._held = False

    def twist(self) -> tuple[float, float]:
        """Return shares of the full linear and angular speed, -1 to 1; left is positive."""
        if not (self._held and self._neutral):
            return 0.0, 0.0
        return _pull(self._forward) - _pull(self._backward), self._turn()

    def _turn(self) -> float:
        """How far the stick is to the left, -1 to 1."""
        offset = 1.0 - 2.0 * self.axes[ecodes.ABS_X].share
        turn = max(abs(offset) - STICK_DEAD_ZONE, 0.0) / (1.0 - STICK_DEAD_ZONE)
        return turn if offset > 0.0 else -turn


def _pull(trigger: Axis) -> float:
    """How far a trigger is pulled, 0 to 1."""
    return max(trigger.share - TRIGGER_DEAD_ZONE, 0.0) / (1.0 - TRIGGER_DEAD_ZONE)


class Gamepad:
    """A gamepad that may be lost and come back. Its twist is zero while it is lost.

    Args:
        path: Its event device; by default the first gamepad that is found.
    """

    def __init__(self, path: str = "") -> None:
        paths = [path] if path else find_gamepads()
        if not paths:
            raise CommandError(
                "no gamepad: plug one in, name its device (ls /dev/input/by-id/*-event-joystick), "
                "or, if it is there, sudo usermod -aG input $USER and log in again"
            )

        self._path = path
        self._wait = 0
        self._device: InputDevice[str] | None = None
        try:
            self._open(paths[0])
        except PermissionError as error:
            raise CommandError(
                f"{paths[0]}: not readable for you: sudo usermod -aG input $USER, then log in again"
            ) from error
        except FileNotFoundError as error:
            raise CommandError(f"{paths[0]}: {error.strerror}") from error
        except OSError as error:
            raise CommandError(f"{paths[0]}: not a gamepad") from error

    def _open(self, path: str) -> None:
        """Open the device; CommandError if it isn't a gamepad."""
        device = InputDevice(path, readonly=True)
        triggers = find_triggers(device)
        if triggers is None:
            device.close()
            raise CommandError(f"{path}: not a gamepad, or one without triggers")

        axes = {code: Axis.of(device, code) for code in (ecodes.ABS_X, *triggers)}
        self._controls = Controls(axes, *triggers)
        self._device = device
        self.name = device.name

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the device. Idempotent."""
        if self._device is not None:
            self._device.close()
            self._device = None

    def poll(self) -> list[PadEvent]:
        """Read all events that have arrived, and return what happened, in order."""
        if self._device is None:
            self._wait -= 1
            return [PadEvent.BACK] if self._wait <= 0 and self._reopen() else []

        happened = []
        try:
            with contextlib.suppress(BlockingIOError):
                while True:
                    happened += self._controls.take(self._device.read())
            if self._controls.dropped:
                self._controls.dropped = False
                for code, axis in self._controls.axes.items():
                    axis.value = Axis.of(self._device, code).value
        except OSError:  # ENODEV: the cable was pulled
            self.close()
            self._wait = REOPEN_EVERY
            happened.append(PadEvent.LOST)
        return happened

    def _reopen(self) -> bool:
        """Whether the pad is back; otherwise the next attempt follows after `REOPEN_EVERY`."""
        self._wait = REOPEN_EVERY
        for path in [self._path] if self._path else find_gamepads(self.name):
            with contextlib.suppress(OSError, CommandError):  # udev may not have set its rights yet
                self._open(path)
                return True
        return False

    def disarm(self) -> None:
        """Request zero until LB is pressed again."""
        self._controls.disarm()

    def twist(self) -> tuple[float, float]:
        """Return shares of the full linear and angular speed, -1 to 1; left is positive."""
        return (0.0, 0.0) if self._device is None else self._controls.twist()


def find_gamepads(name: str = "") -> list[str]:
    """Return the paths of the gamepads that are plugged in, or of those with a name."""
    gamepads = []
    for path in sorted(list_devices(writable=False), key=lambda path: (len(path), path)):
        with contextlib.suppress(OSError):  # unplugged just now
            device = InputDevice(path, readonly=True)
            if find_triggers(device) is not None and name in ("", device.name):
                gamepads.append(path)
            device.close()
    return gamepads


def find_triggers(device: InputDevice[str]) -> tuple[int, int] | None:
    """Return the codes of the left and right trigger; None if a device isn't a gamepad.

    The specification has them as ABS_HAT2Y and ABS_HAT2X or as buttons. Drivers of today's pads
    have them elsewhere: xpad and hid-playstation as ABS_Z and ABS_RZ, next to a right stick on
    ABS_RX; Xbox pads by Bluetooth as ABS_BRAKE and ABS_GAS, with a right stick on ABS_Z.
    """
    capabilities = device.capabilities(absinfo=False)
    keys = set(capabilities.get(ecodes.EV_KEY, ()))
    axes = set(capabilities.get(ecodes.EV_ABS, ()))
    if not {ecodes.BTN_TL, *BUTTONS} <= keys or ecodes.ABS_X not in axes:
        return None

    if {ecodes.ABS_HAT2Y, ecodes.ABS_HAT2X} <= axes:
        return ecodes.ABS_HAT2Y, ecodes.ABS_HAT2X
    if {ecodes.ABS_BRAKE, ecodes.ABS_GAS} <= axes:
        return ecodes.ABS_BRAKE, ecodes.ABS_GAS
    if {ecodes.ABS_Z, ecodes.ABS_RZ, ecodes.ABS_RX} <= axes:
        return ecodes.ABS_Z, ecodes.ABS_RZ
    if {ecodes.BTN_TL2, ecodes.BTN_TR2} <= keys:
        return ecodes.BTN_TL2, ecodes.BTN_TR2
    return None
