"""A gamepad, read by evdev from the kernel's input events (Linux).

Drivers report the codes of the kernel's Documentation/input/gamepad.rst for every pad. Events
report changes only, so a silent pad is a pad that is held.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Mapping
from enum import Enum

from evdev import AbsInfo, InputDevice, InputEvent, ecodes, list_devices

from acsar_gym.errors import CommandError

STICK_DEAD_ZONE = 0.1
"""Share of the stick's way on either side within which it is at rest: worn sticks don't centre."""
TRIGGER_DEAD_ZONE = 0.05
"""Share of a trigger's way within which it is at rest."""
REOPEN_EVERY = 50
"""Calls of `poll` between two attempts to open a pad that was lost. 0.5 s at 100 Hz."""
BUTTON_AXIS = AbsInfo(value=0, min=0, max=1, fuzz=0, flat=0, resolution=0)
"""A button that replaces a trigger."""


class PadEvent(Enum):
    """What the driving loop has to act on, apart from the twist."""

    STOP = "emergency stop"
    RELEASE = "release"
    QUIT = "quit"
    LOST = "lost; the robot is held until it is plugged in again"
    BACK = "back; press LB to drive on"


BUTTONS = {
    ecodes.BTN_EAST: PadEvent.STOP,
    ecodes.BTN_START: PadEvent.RELEASE,
    ecodes.BTN_SELECT: PadEvent.QUIT,
}


class Controls:
    """The twist and the buttons that a pad's events request.

    The robot drives while LB is held. LB counts from when it is pressed, not if it is held already
    as the pad is opened. Stick and triggers count once all were at rest since then, so the robot
    only starts from neutral.

    Args:
        axes: Stick and triggers by their codes.
        backward: Code of the left trigger.
        forward: Code of the right trigger.

    Attributes:
        has_lost_events: Whether events were lost, so that the pad has to be opened again.
    """

    def __init__(self, axes: Mapping[int, AbsInfo], backward: int, forward: int) -> None:
        self._axes = axes
        self._backward = backward
        self._forward = forward
        codes = (ecodes.ABS_X, backward, forward)
        self._levels = {code: self._measure(code, axes[code].value) for code in codes}
        self._held = False
        self._neutral = False
        self.has_lost_events = False

    def take(self, events: Iterable[InputEvent]) -> list[PadEvent]:
        """Take events, and return the buttons that were pressed before events were dropped."""
        pressed = []
        for event in events:
            if event.type == ecodes.EV_SYN and event.code == ecodes.SYN_DROPPED:
                self.has_lost_events = True
                break
            if event.type not in (ecodes.EV_KEY, ecodes.EV_ABS):
                continue

            # Letting go of LB stops. The kernel repeats keys that are held with the value 2.
            if event.code == ecodes.BTN_TL and event.value != 2:
                self._held = bool(event.value)
                self._neutral = False
            elif event.code in BUTTONS and event.value == 1:
                pressed.append(BUTTONS[event.code])
            elif event.code in self._levels:
                self._levels[event.code] = self._measure(event.code, event.value)
            self._neutral = self._neutral or not any(self._levels.values())
        return pressed

    def disarm(self) -> None:
        """Request zero until LB is pressed again."""
        self._held = False

    def twist(self) -> tuple[float, float]:
        """Return shares of the full linear and angular speed, -1 to 1. Left is positive."""
        if not (self._held and self._neutral):
            return 0.0, 0.0
        linear = self._levels[self._forward] - self._levels[self._backward]
        return linear, self._levels[ecodes.ABS_X]

    def _measure(self, code: int, value: int) -> float:
        """How far the stick is to the left, -1 to 1, or a trigger is pulled, 0 to 1."""
        axis = self._axes[code]
        level = min(max((value - axis.min) / max(axis.max - axis.min, 1), 0.0), 1.0)
        dead_zone = TRIGGER_DEAD_ZONE
        # Left is the minimum of the stick's axis, and a positive turn.
        if code == ecodes.ABS_X:
            level = 1.0 - 2.0 * level
            dead_zone = STICK_DEAD_ZONE
        return math.copysign(max(abs(level) - dead_zone, 0.0) / (1.0 - dead_zone), level)


class Gamepad:
    """A gamepad that may be lost and come back. Its twist is zero while it is lost.

    Args:
        path: Its event device. By default the first gamepad that is found.

    Attributes:
        name: Name of the pad.
        controls: The twist that it requests.
    """

    def __init__(self, path: str = "") -> None:
        self.name = ""
        self._path = path
        self._wait = 0
        self._device: InputDevice[str] | None = None

        paths = [path] if path else find_gamepads()
        if not paths:
            raise CommandError(
                "no gamepad: plug one in, name its device (ls /dev/input/by-id/*-event-joystick), "
                "or, if it is there, sudo usermod -aG input $USER and log in again"
            )
        try:
            self._open(paths[0])
        except OSError as error:
            reason = error.strerror or "not an input device"
            raise CommandError(
                f"{paths[0]}: not a gamepad that you may read: {reason}; is your user in the group "
                "input?"
            ) from error

    def _open(self, path: str) -> None:
        """Open the device. CommandError if it isn't a gamepad."""
        device = InputDevice(path, readonly=True)
        # A device that was unplugged may come back as another device.
        triggers = find_triggers(device)
        if triggers is None:
            device.close()
            raise CommandError(f"{path}: not a gamepad, or a gamepad without triggers")

        # A button that replaces a trigger has no range of its own.
        axes = {
            code: BUTTON_AXIS if code >= ecodes.BTN_MISC else device.absinfo(code)
            for code in (ecodes.ABS_X, *triggers)
        }
        self.controls = Controls(axes, *triggers)
        self._device = device
        self.name = device.name

    def close(self) -> None:
        """Close the device. Idempotent."""
        if self._device is not None:
            self._device.close()
            self._device = None

    def poll(self) -> list[PadEvent]:
        """Read all events that have arrived, and return what happened, in order."""
        if self._device is None:
            return self._reopen()
        happened = []
        try:
            with contextlib.suppress(BlockingIOError):
                while not self.controls.has_lost_events:
                    happened += self.controls.take(self._device.read())
        except OSError:  # the cable was pulled
            self.controls.has_lost_events = True

        # The robot is at rest until the pad is opened again, and LB pressed.
        if self.controls.has_lost_events:
            self.close()
            self.controls.disarm()
            self._wait = REOPEN_EVERY
            happened.append(PadEvent.LOST)
        return happened

    def _reopen(self) -> list[PadEvent]:
        """Try to open a lost pad, once in `REOPEN_EVERY` calls."""
        self._wait -= 1
        if self._wait > 0:
            return []
        self._wait = REOPEN_EVERY
        for path in [self._path] if self._path else find_gamepads(self.name):
            with contextlib.suppress(OSError, CommandError):  # udev may not have set its rights yet
                self._open(path)
                return [PadEvent.BACK]
        return []


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


TRIGGERS = (
    (ecodes.ABS_HAT2Y, ecodes.ABS_HAT2X),
    (ecodes.ABS_BRAKE, ecodes.ABS_GAS),
    (ecodes.ABS_Z, ecodes.ABS_RZ, ecodes.ABS_RX),
    (ecodes.BTN_TL2, ecodes.BTN_TR2),
)
"""Left and right trigger, and what else a pad must have for these to be triggers. The specification
has triggers as ABS_HAT2Y and ABS_HAT2X or as buttons. Xpad and hid-playstation have them as ABS_Z
and ABS_RZ, next to a right stick on ABS_RX. Xbox pads by Bluetooth as ABS_BRAKE and ABS_GAS."""


def find_triggers(device: InputDevice[str]) -> tuple[int, ...] | None:
    """Return the codes of the left and right trigger. None if a device isn't a gamepad."""
    capabilities = device.capabilities(absinfo=False)
    codes = {*capabilities.get(ecodes.EV_KEY, ()), *capabilities.get(ecodes.EV_ABS, ())}
    if not {ecodes.ABS_X, ecodes.BTN_TL, *BUTTONS} <= codes:
        return None
    # Without ABS_RX, ABS_Z and ABS_RZ are a right stick.
    return next((row[:2] for row in TRIGGERS if codes.issuperset(row)), None)
