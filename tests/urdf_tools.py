"""URDFs of robots, made of links, wheels, ros2_control blocks and plugins of Gazebo."""

from __future__ import annotations

import math
from typing import Any

QUARTER = math.pi / 2.0
CORNERS = {
    "front_left": (1, 1),
    "front_right": (1, -1),
    "rear_left": (-1, 1),
    "rear_right": (-1, -1),
}


def xyz(*numbers: float) -> str:
    return " ".join(map(str, numbers))


def link(name: str, *content: str, mass: float = 0.0) -> str:
    inertial = f"<inertial><mass value='{mass}'/></inertial>" if mass else ""
    return f"<link name='{name}'>{inertial}{''.join(content)}</link>"


def shape(kind: str, tag: str = "collision", at: str = "0 0 0", rpy: str = "0 0 0") -> str:
    return f"<{tag}><origin xyz='{at}' rpy='{rpy}'/><geometry><{kind}/></geometry></{tag}>"


def tyre(radius: float, width: float = 0.04, at: str = "0 0 0", rpy: str = f"{QUARTER} 0 0") -> str:
    return shape(f"cylinder radius='{radius}' length='{width}'", at=at, rpy=rpy)


def box(length: float, width: float, height: float, at: str = "0 0 0") -> str:
    return shape(f"box size='{length} {width} {height}'", at=at)


def mesh(name: str = "package://cart_description/meshes/wheel.dae", tag: str = "visual") -> str:
    return shape(f"mesh filename='{name}'", tag)


def joint(
    name: str,
    parent: str,
    child: str,
    at: str = "0 0 0",
    rpy: str = "0 0 0",
    kind: str = "fixed",
    axis: str = "0 1 0",
) -> str:
    limit = "<limit lower='-0.5' upper='0.5' effort='9' velocity='1'/>" * (kind == "revolute")
    return (
        f"<joint name='{name}' type='{kind}'><parent link='{parent}'/><child link='{child}'/>"
        f"<origin xyz='{at}' rpy='{rpy}'/><axis xyz='{axis}'/>{limit}</joint>"
    )


def wheel(
    name: str,
    parent: str,
    at: str,
    *content: str,
    axis: str = "0 1 0",
    rpy: str = "0 0 0",
    mass: float = 0.5,
) -> str:
    return link(f"{name}_wheel_link", *content, mass=mass) + joint(
        f"{name}_wheel_joint", parent, f"{name}_wheel_link", at, rpy, "continuous", axis
    )


def four_wheels(
    parent: str, a: float, b: float, z: float, *content: str, axis: str = "0 1 0"
) -> str:
    return "".join(
        wheel(name, parent, xyz(a * x, b * y, z), *content, axis=axis)
        for name, (x, y) in CORNERS.items()
    )


def control(*joints: str, plugin: str = "cart_base/CartHardware", **params: Any) -> str:
    given = "".join(f"<param name='{name}'>{value}</param>" for name, value in params.items())
    commanded = "".join(
        f"<joint name='{each}'><command_interface name='velocity'/></joint>" for each in joints
    )
    return (
        f"<ros2_control name='hardware' type='system'><hardware><plugin>{plugin}</plugin>{given}"
        f"</hardware>{commanded}</ros2_control>"
    )


def plugin(name: str, **values: object) -> str:
    content = "".join(f"<{tag}>{value}</{tag}>" for tag, value in values.items())
    return f"<gazebo><plugin filename='{name}' name='{name}'>{content}</plugin></gazebo>"


def robot(*content: str, name: str = "cart") -> str:
    return f"<?xml version='1.0'?><robot name='{name}'>{''.join(content)}</robot>"


FOUR = tuple(f"{name}_wheel_joint" for name in CORNERS)
PLATE = link("base_link", box(0.9, 0.5, 0.2, at="0 0 0.1"), mass=40.0)
