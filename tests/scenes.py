"""Worlds, movers and robots that vary."""

from __future__ import annotations

from acsar_gym.worlds import Region, World
from acsar_gym.worlds.movers import walk
from acsar_gym.worlds.world import make_rectangle

HALL = World(
    segments=make_rectangle(-1.0, -2.0, 5.0, 2.0),
    start=Region(0.2, -0.1, 0.0, 0.3),
    goal=Region(4.0, 0.0, 0.25),
    movers=(
        walk([[1.6, -1.5], [1.6, 1.5]], 0.8, spread=4.0, name="across"),
        walk([[4.5, 0.6], [-0.5, 0.9]], 1.3, radius=0.3, reacts=True, name="towards"),
        walk([[3.0, -1.2], [3.0, -1.2]], name="waiting"),
    ),
    name="hall",
)
"""One walks across, one comes towards the robot and keeps a distance, one stands."""


RANGES: dict[str, tuple[float, ...]] = {
    "mass": (0.5, 2.0),
    "friction": (0.4, 1.2),
    "motor_gain": (0.9, 1.1),
    "motor_lag": (0.5, 2.0),
    "deadband": (0.1, 0.5),
    "wheel_radius": (0.95, 1.05),
    "latency": (0.01, 0.04),
    "feedback_rate": (15.0, 60.0),
    "track_width": (0.9, 1.1),
    "left_wheel_radius": (0.97, 1.03),
    "right_wheel_radius": (0.97, 1.03),
    "turn_factor": (0.8, 1.3),
    "command_delay": (0.001, 0.012),
    "delay_samples": (0.001, 0.002, 0.007, 0.012),
    "deadband_offset": (0.01, 0.2),
    "lidar_rate": (1.0, 12.0),
    "lidar_noise": (0.005, 0.03),
    "lidar_bias": (-0.03, 0.03),
    "lidar_dropouts": (0.01, 0.1),
    "lidar_outliers": (0.1, 0.9),
}
