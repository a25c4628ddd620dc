"""Robots of others by their URDFs: radius, track and wheelbase by hand, or one line.

The files are of the kinds that public robots have: wheels as cylinders, spheres and meshes, on
links that are turned or hang on rockers, with and without ros2_control, with casters, rollers,
steering and arms.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from urdf_tools import (
    CORNERS,
    FOUR,
    PLATE,
    QUARTER,
    box,
    control,
    four_wheels,
    joint,
    link,
    mesh,
    plugin,
    robot,
    shape,
    tyre,
    wheel,
    xyz,
)

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError

Load = Callable[[str], RobotConfig]


BASE = link("base_link")
MECANUM = "package://cart_description/meshes/mecanum_a.dae"
FOOTPRINT = link("base_footprint")

RIGHT = {
    # As a ROSbot: a body link on the base link, wheels with meshes that collide as cylinders.
    "body link": (
        robot(
            BASE,
            link("body_link", box(0.2, 0.15, 0.08), mass=2.0),
            joint("base_to_body", "base_link", "body_link", "0 0 0.0425"),
            four_wheels("body_link", 0.053, 0.096, 0.0, mesh(), tyre(0.0425, 0.036)),
            control(*FOUR, connection_timeout_ms=120000),
        ),
        (0.0425, 0.192, 0.106),
    ),
    # As a Husky: its driver says the diameter, its block names other joints than there are.
    "diameter": (
        robot(
            PLATE,
            FOOTPRINT,
            joint("base_footprint_joint", "base_link", "base_footprint", "0 0 -0.13"),
            four_wheels("base_link", 0.256, 0.2854, 0.033, mesh(), tyre(0.16)),
            control("fl_joint", "fr_joint", wheel_diameter=0.3302, max_speed=1.0),
        ),
        (0.1651, 0.5708, 0.512),
    ),
    # As a Jackal: one motor on each side, so its block has the front wheels alone.
    "two of four in the block": (
        robot(
            BASE,
            link("chassis_link", box(0.42, 0.31, 0.184, at="0 0 0.092"), mass=16.523),
            joint("base_link_joint", "base_link", "chassis_link"),
            four_wheels("chassis_link", 0.131, 0.187795, 0.0345, mesh(), tyre(0.098)),
            control("front_left_wheel_joint", "front_right_wheel_joint"),
        ),
        (0.098, 0.37559, 0.262),
    ),
    # As a Leo: the left rocker is turned about, tyres of two cylinders lie inside of their hubs.
    "turned rocker": (
        robot(
            FOOTPRINT,
            link("base_link", mesh("package://leo/Chassis.dae"), mass=1.6),
            joint("base_joint", "base_footprint", "base_link", "0 0 0.198"),
            *(
                link(f"rocker_{side}")
                + joint(f"rocker_{side}_joint", "base_link", f"rocker_{side}", at, rpy)
                + "".join(
                    wheel(
                        f"{end}{side}",
                        f"rocker_{side}",
                        xyz(x, -0.08, -0.09),
                        tyre(0.057, 0.07, at="0 0.045 0"),
                        tyre(0.0625, 0.04, at="0 0.045 0"),
                        axis=axis,
                    )
                    for end, x in (("a", 0.15), ("b", -0.15))
                )
                for side, at, rpy, axis in (
                    ("L", "0.003 0.14 -0.05", f"0 0 {math.pi}", "0 -1 0"),
                    ("R", "0.003 -0.14 -0.05", "0 0 0", "0 1 0"),
                )
            ),
            plugin(
                "libgz-sim-diff-drive-system.so",
                left_joint="aL_wheel_joint",
                right_joint="aR_wheel_joint",
                wheel_separation=0.35,
                wheel_radius=0.0625,
            ),
        ),
        (0.0625, 0.35, 0.3),
    ),
    # Meshes alone: radius by the height of the axles above base_footprint.
    "meshes above a footprint": (
        robot(
            FOOTPRINT,
            PLATE,
            joint("base_joint", "base_footprint", "base_link", "0 0 0.14"),
            four_wheels("base_link", 0.25, 0.3, -0.02, mesh()),
            control(*FOUR),
        ),
        (0.12, 0.6, 0.5),
    ),
    "Gazebo's plugin alone": (
        robot(
            PLATE,
            four_wheels("base_link", 0.2, 0.25, 0.0, tyre(0.09)),
            plugin("libgazebo_ros_diff_drive.so", wheel_separation=0.5, wheel_diameter=0.18),
        ),
        (0.09, 0.5, 0.4),
    ),
    # The wheels' middle isn't the base link, which a world carries, and prefixes are on all names.
    "off centre": (
        robot(
            link("world"),
            link("r1/base_link", box(0.6, 0.3, 0.1, at="0.1 0 0.1")),
            joint("fix", "world", "r1/base_link", "3 4 0", f"0 0 {QUARTER}"),
            "".join(
                wheel(f"r1/{name}", "r1/base_link", xyz(0.05 + 0.2 * x, 0.2 * y, 0.1), tyre(0.1))
                for name, (x, y) in CORNERS.items()
            ),
        ),
        (0.1, 0.4, 0.4),
    ),
    # Wheels on springs, a chassis above its empty base link, and a world in which that moves.
    "springs in a world": (
        robot(
            link("world"),
            link("cart"),
            joint("yaw", "world", "cart", kind="continuous", axis="0 0 1"),
            link("chassis", box(0.8, 0.4, 0.2)),
            joint("planar", "cart", "chassis", "1 2 0", kind="planar", axis="0 0 1"),
            BASE,
            joint("centre", "chassis", "base_link", "0.1 0 0"),
            "".join(
                link(f"{name}_spring")
                + joint(
                    f"{name}_slide",
                    "chassis",
                    f"{name}_spring",
                    xyz(0.1 + 0.2 * x, 0.25 * y, 0.0),
                    kind="prismatic",
                    axis="0 0 1",
                )
                + wheel(name, f"{name}_spring", "0 0 -0.05", tyre(0.1))
                for name, (x, y) in CORNERS.items()
            ),
        ),
        (0.1, 0.5, 0.4),
    ),
    # The arm's last joint turns without end about y, too; its block has more parameters.
    "base and arm": (
        robot(
            PLATE,
            four_wheels("base_link", 0.2, 0.25, 0.0, tyre(0.09)),
            link("shoulder", mesh()),
            link("hand", mesh()),
            joint("lift", "base_link", "shoulder", "0.2 0 0.5", kind="revolute"),
            joint("wrist", "shoulder", "hand", "0 0 0.4", kind="continuous"),
            control("lift", "wrist", serial_port="/dev/arm", baud_rate=9600, wheelbase=9),
            control(*FOUR, serial_port="/dev/base"),
        ),
        (0.09, 0.5, 0.4),
    ),
}


@pytest.fixture
def load(tmp_path: Path) -> Load:
    def read(text: str) -> RobotConfig:
        path = tmp_path / "robot.urdf"
        path.write_text(text, encoding="utf-8")
        return RobotConfig.load(path)

    return read


@pytest.mark.parametrize("name", RIGHT)
def test_radius_track_and_wheelbase_are_those_of_links_and_joints(name: str, load: Load) -> None:
    text, expected = RIGHT[name]
    config = load(text)
    found = config.wheel_radius, config.wheel_separation, config.wheelbase
    assert found == pytest.approx(expected, abs=1e-6)
    assert (config.baud_rate, config.control_rate) == (115200, 100.0)
    skids = 1.0 + (config.wheelbase / config.wheel_separation) ** 2
    assert config.wheel_separation_multiplier == pytest.approx(skids, abs=1e-4)


def test_wheels_are_named_in_the_order_of_the_wire(load: Load) -> None:
    config = load(RIGHT["body link"][0])
    assert config.wheel_joints == (
        "front_right_wheel_joint",
        "front_left_wheel_joint",
        "rear_left_wheel_joint",
        "rear_right_wheel_joint",
    )


def test_mass_footprint_and_height_are_those_of_all_links(load: Load) -> None:
    body = load(RIGHT["diameter"][0]).body
    assert body.mass == pytest.approx(42.0)
    assert (body.length, body.width) == pytest.approx((0.9, 0.5708 + 0.04))
    assert body.height == pytest.approx(0.2 - 0.033 + 0.16)


def test_a_footprint_is_seen_from_the_middle_between_the_wheels(load: Load) -> None:
    config = load(RIGHT["off centre"][0])
    assert config.footprint is not None
    corners = np.array(config.footprint)
    assert corners.min(axis=0) == pytest.approx((-0.3, -0.22))
    assert corners.max(axis=0) == pytest.approx((0.35, 0.22))


def test_a_lidars_place_is_that_of_its_frame(load: Load) -> None:
    cart = [PLATE, four_wheels("base_link", 0.2, 0.25, 0.0, tyre(0.1))]
    plain = load(robot(*cart))
    assert (plain.lidar_x_offset, plain.lidar_y_offset) == (0.0, 0.0)
    mast = link("mast") + joint("mast_joint", "base_link", "mast", "0.1 0 0.2")
    laser = link("laser") + joint("laser_joint", "mast", "laser", "0.02 0.01 0.1")
    config = load(robot(*cart, mast, laser))
    place = config.lidar_x_offset, config.lidar_y_offset, config.lidar_z_offset
    assert place == pytest.approx((0.12, 0.01, 0.4))
    assert config.lidar_frame == "laser"


def test_parameters_count_more_than_links(load: Load) -> None:
    cart = PLATE, four_wheels("base_link", 0.2, 0.25, 0.0, tyre(0.1))
    said: dict[str, Any] = {"wheel_radius": 0.11, "wheel_separation": 0.49}
    said["wheel_separation_multiplier"] = 1.6
    config = load(robot(*cart, control(*FOUR, **said)))
    assert config.model_dump(include=set(said)) == said
    assert config.wheelbase == 0.4


def test_a_robot_of_the_own_driver_is_measured_too_where_its_parameters_are_silent(
    load: Load,
) -> None:
    own = control(*FOUR, plugin="acsar_hardware/ACSARInterface", wheel_radius=0.05)
    config = load(robot(PLATE, four_wheels("base_link", 0.2, 0.25, 0.0, tyre(0.1)), own))
    found = config.wheel_radius, config.wheel_separation, config.wheelbase
    assert found == (0.05, 0.5, 0.4)
    assert config.wheel_separation_multiplier == 1.0
    assert (config.baud_rate, config.control_rate) == (9600, 20.0)


TWO = "".join(
    wheel(side, "base_link", xyz(0.0, y, 0.03), tyre(0.03))
    for side, y in (("left", 0.07), ("right", -0.07))
)
CASTER = link("caster_link", shape("sphere radius='0.01'")) + joint(
    "caster_joint", "base_link", "caster_link", "-0.1 0 0.01"
)
STEERED = "".join(
    link(f"{side}_knuckle")
    + joint(f"{side}_hinge", "base_link", f"{side}_knuckle", at, kind="revolute", axis="0 0 1")
    + wheel(f"front_{side}", f"{side}_knuckle", "0 0 0", tyre(0.05))
    + wheel(f"rear_{side}", "base_link", behind, tyre(0.05))
    for side, at, behind in (
        ("left", "0.2 0.1 0.05", "-0.2 0.1 0.05"),
        ("right", "0.2 -0.1 0.05", "-0.2 -0.1 0.05"),
    )
)
SLANTED = "".join(
    f"<gazebo reference='{name}_wheel_link'><fdir1>1 {-x * y} 0</fdir1></gazebo>"
    for name, (x, y) in CORNERS.items()
)
TWO_DRIVEN, MECANUM_WHEELS, STEERED_AXLE = (
    "two driven wheels",
    "mecanum or omni wheels",
    "a steered axle",
)
WHEELS = four_wheels("base_link", 0.2, 0.25, 0.0, tyre(0.1))

REFUSED = {
    "a caster": (
        robot(BASE, TWO, CASTER, control("left_wheel_joint", "right_wheel_joint")),
        TWO_DRIVEN,
    ),
    "mecanum meshes": (
        robot(PLATE, four_wheels("base_link", 0.2, 0.25, 0.0, mesh(MECANUM), tyre(0.1))),
        MECANUM_WHEELS,
    ),
    "slanted friction": (robot(PLATE, WHEELS, SLANTED), MECANUM_WHEELS),
    "a steered axle": (robot(BASE, STEERED), STEERED_AXLE),
    "six wheels": (
        robot(
            PLATE,
            WHEELS,
            wheel("mid_left", "base_link", "0 0.25 0", tyre(0.1)),
            wheel("mid_right", "base_link", "0 -0.25 0", tyre(0.1)),
        ),
        "6 wheels",
    ),
    "meshes without a size": (
        robot(PLATE, four_wheels("base_link", 0.2, 0.25, 0.0, mesh()), control(*FOUR)),
        "doesn't say wheel_radius: its wheels have no cylinder",
    ),
    "no wheels": (
        robot(BASE, link("lid"), joint("lid_joint", "base_link", "lid"), control()),
        "doesn't say wheel_radius, wheel_separation and wheelbase: it has no continuous joint",
    ),
    "a LiDAR that turns": (
        robot(
            PLATE,
            link("head", tyre(0.04)),
            joint("spin", "base_link", "head", kind="continuous", axis="0 0 1"),
        ),
        "the axes of its turning joints (spin) aren't along y of base_link",
    ),
    "a trapezoid": (
        robot(
            PLATE,
            wheel("fl", "base_link", "0.2 0.3 0", tyre(0.1)),
            wheel("fr", "base_link", "0.2 -0.3 0", tyre(0.1)),
            wheel("rl", "base_link", "-0.2 0.2 0", tyre(0.1)),
            wheel("rr", "base_link", "-0.2 -0.2 0", tyre(0.1)),
        ),
        "corners of a rectangle",
    ),
    "expressions": (
        robot(PLATE, four_wheels("base_link", 0.2, 0.25, 0.0, tyre(0.1)).replace("0.25", "${b}")),
        "run 'xacro",
    ),
    "a world": ("<sdf version='1.9'><world name='w'/></sdf>", "file of Gazebo (SDF)"),
    "a circle": (
        robot(link("a"), link("b"), joint("i", "a", "b"), joint("j", "b", "a")),
        "form a circle",
    ),
    "words for numbers": (
        robot(PLATE, WHEELS.replace("'0.2 0.25 0.0'", "'0.2 wide 0.0'")),
        "origin xyz = '0.2 wide 0.0': must be 3 numbers",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_other_robots_are_said_to_be_what_they_are_in_one_line(name: str, load: Load) -> None:
    text, expected = REFUSED[name]
    with pytest.raises(ConfigError) as caught:
        load(text)
    message = str(caught.value)
    assert expected in message
    assert "robot.urdf: " in message
    assert "\n" not in message
    assert len(message) < 400


@pytest.mark.parametrize("body", ["planar", "bullet"])
def test_a_robot_of_somebody_else_drives(body: str, tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(RIGHT["off centre"][0], encoding="utf-8")
    env = gymnasium.make("acsar_gym/PointGoal-v0", link=body, robot=str(path))
    env.reset(seed=0, options={"goal": (3.0, 0.0)})
    for _ in range(20):
        _, _, _, _, info = env.step(np.array([1.0, 0.0], np.float32))
    assert info["true_x"] > 0.5
    assert info["true_y"] == pytest.approx(0.0, abs=0.02)
    env.close()
