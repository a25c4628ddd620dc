"""Compute the numbers that all robots of a batch share, and the sizes of its ring buffers.

`setup_of` takes `ticks`, the control periods in an env step; `max_steps`, the time limit of an
episode in env steps; `numbers`, how many numbers of the observation are the task's own;
`sees`, whether the robots have a LiDAR; and `varied`, what every robot draws for every episode.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from acsar_gym.config import LINE_BYTES, RobotConfig, whole_ratio
from acsar_gym.dynamics.randomization import Randomization, Ranges, longest_delay
from acsar_gym.dynamics.timing import line_time, substep, wire_loops, wire_time
from acsar_gym.errors import ConfigError
from acsar_gym.lidars.base import stale_after
from acsar_gym.lidars.simulated import draws
from acsar_gym.links.faults import Faults
from acsar_gym.links.faulty_wire import BUFFER
from acsar_gym.safety import limiter, rules
from acsar_gym.vector.kernel import layout
from acsar_gym.vector.kernel.layout import LineFaults
from acsar_gym.wire import STANDSTILL_TIMEOUT

BATCH_FAULTS = ("dropped_lines", "late_lines", "lateness", "episodes", "direction")
"""Faults that a batch can simulate: lines that are lost or late."""


def setup_of(
    config: RobotConfig,
    ticks: int,
    max_steps: int | None,
    numbers: int,
    faults: Faults,
    *,
    sees: bool,
    varied: Randomization,
) -> layout.Setup:
    """Compute the numbers that all robots of a batch share; see the module for the arguments."""
    dt = substep(config)
    limited = config.geofence is not None or not limiter.free(config)
    left_radius, right_radius = config.wheel_radii
    delay = command_loops(config, varied.ranges(config, ticks * config.period))
    late = delay * dt > ticks * config.period - dt / 2.0
    return layout.Setup(
        dt=dt,
        period=config.period,
        wire_time=wire_time(config),
        isotropic=config.body.turn_factor is None and varied.turn_factor is None,
        ticks=ticks,
        left_radius=left_radius,
        right_radius=right_radius,
        separation=config.effective_separation,
        max_wheel_speed=config.max_wheel_speed,
        max_linear=config.max_linear,
        max_angular=config.max_angular,
        max_steps=math.inf if max_steps is None else float(max_steps),
        guarded=limited or late or faults.possible,
        rules=rules.of(config),
        faults=line_faults(faults, config),
        falls_silent=faults.possible and faults.direction != "commands",
        numbers=numbers,
        **_board(config, dt),
        **_lidar(config, sees=sees),
    )


def _board(config: RobotConfig, dt: float) -> dict[str, Any]:
    """The fields of a setup that are about motors, encoders and firmware."""
    encoder, rate = config.encoder, config.firmware.loop_rate
    window = round(encoder.window * rate)
    per_radian = encoder.counts_per_revolution / (2.0 * math.pi)
    return {
        "ramps": tuple(config.motor.of_wheel(wheel).acceleration * dt for wheel in range(4)),
        "top": config.motor.max_speed,
        "counts_per_radian": per_radian,
        "speed_per_count": 1.0 / (per_radian * window * dt),
        "quantum": encoder.quantum or 0.0,
        "window": window,
        "loops": whole_ratio("firmware.loop_rate", rate, "", config.control_rate),
    }


def _lidar(config: RobotConfig, *, sees: bool) -> dict[str, Any]:
    """The fields of a setup that are about the LiDAR."""
    lidar = config.lidar
    return {
        "lidar_rate": lidar.rate if sees else 0.0,
        "stale": stale_after(config),
        "noise": lidar.noise,
        "dropouts": lidar.dropouts,
        "min_range": lidar.min_range,
        "draws": draws(lidar),
    }


def lines_kept(setup: layout.Setup, ranges: Ranges, config: RobotConfig) -> int:
    """Size of the ring of command lines [ticks]: the longest time that one can be on its way."""
    late = 2 * math.ceil(setup.faults.lateness / setup.period) if setup.faults.possible else 0
    return 2 + late + math.ceil(command_loops(config, ranges) / setup.loops)


def counts_kept(setup: layout.Setup, ranges: Ranges, config: RobotConfig) -> int:
    """Size of the ring of encoder counts [firmware loops].

    The oldest feedback line that may still be on its way, and the encoders' window before it.

    Args:
        setup: of the batch.
        ranges: of the randomized parameters.
        config: of the robots.

    Raises:
        ConfigError: where feedback is on its way for as long as `feedback_timeout`.
    """
    delay = wire_loops(config) + round(ranges.high.latency / setup.dt)
    if delay * setup.dt >= config.feedback_timeout:
        raise ConfigError(
            f"feedback_timeout = {config.feedback_timeout:g} s: feedback takes "
            f"{delay * setup.dt:g} s on this wire (baud_rate, firmware.processing_time): must be "
            "longer"
        )
    rare = ranges.low.feedback_rate
    rate = config.feedback_rate if math.isnan(rare) else rare
    slowest = math.ceil(1.0 / (rate * setup.dt))
    late = math.ceil(setup.faults.lateness / setup.dt) if setup.faults.possible else 0
    return int(setup.window + delay + late + slowest + setup.loops + 1)


def command_loops(config: RobotConfig, ranges: Ranges) -> int:
    """The longest time until a command has effect, without faults [firmware loops]."""
    latency = ranges.high.latency / substep(config)
    return round(wire_loops(config, longest_delay(ranges, config)) + latency)


def check_faults(faults: Mapping[str, Any] | Faults | None, config: RobotConfig) -> Faults:
    """Check the faults of a batch.

    Args:
        faults: as users pass `faults=`; see `Faults.of`.
        config: of the robots.

    Raises:
        ConfigError: for a fault that a batch can't simulate, or a value out of range.
    """
    asked, sound = Faults.of(faults), Faults()
    for field in fields(asked):
        if field.name not in BATCH_FAULTS and getattr(asked, field.name) != getattr(
            sound, field.name
        ):
            raise ConfigError(
                f"faults: {field.name}: a batch knows {', '.join(BATCH_FAULTS)}; for others "
                "make_vec with vectorization_mode='sync'"
            )
    most = BUFFER / (max(config.control_rate, config.feedback_rate) * (LINE_BYTES + 1))
    if asked.late_lines > 0.0 and asked.lateness > most:
        raise ConfigError(
            f"faults: lateness = {asked.lateness:g}: must be at most {most:.3g} s in a batch, so "
            "that no lines are lost behind a late one"
        )
    return asked


def line_faults(faults: Faults, config: RobotConfig) -> LineFaults:
    """Convert faults to the numbers that compiled loops need."""
    firmware = config.firmware
    return LineFaults(
        possible=faults.possible,
        episodes=float(faults.episodes),
        feedback=faults.direction != "commands",
        commands=faults.direction != "feedback",
        dropped=float(faults.dropped_lines),
        late=float(faults.late_lines),
        lateness=float(faults.lateness),
        patience=math.ceil(STANDSTILL_TIMEOUT / config.period),
        line_time=line_time(config),
        processing_time=firmware.processing_time,
        command_timeout=firmware.command_timeout or math.inf,
    )
