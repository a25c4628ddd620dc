"""The fields of a skid-steer robot that a URDF describes.

A wheel is a joint that turns without end about the y axis of the base link, and carries a cylinder,
a sphere or a mesh. A cylinder says its radius and where it touches the ground; the radius of a mesh
is taken from parameters, or from the height of its axle above `base_footprint`.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from acsar_gym.config.parts import GEOMETRY_FIELDS, HINTS, MEASURES, ONLY_FOUR, RobotPart
from acsar_gym.config.urdf import Block, Floats, Joint, Shape, Urdf, parse_urdf
from acsar_gym.errors import ConfigError, show_value

DRIVER_DEFAULTS = {"baud_rate": "9600", "control_rate": "20"}
"""Of the robot's own driver, if the URDF has no baud_rate [bit/s]; with a rate that fits [Hz]."""
DIAMETER = "wheel_diameter"  # parameter of drivers that don't say the radius
PARALLEL = 0.95  # cosine from which two directions count as parallel
ALIKE = 0.1  # wheels are alike if radius and height differ by at most this share of the radius
SQUARE = 0.1  # four wheels are a rectangle if its sides differ from it by at most this share
ROLLERS = 3  # a wheel that carries as many joints has rollers
UNKNOWN_RADIUS = 0.1  # stands for the radius of a mesh where heights are compared [m]
CENTRED = 1e-3
"""A footprint whose middle is nearer to that of the wheels is a rectangle around them [m]."""
_CASTER = re.compile(r"castor|caster", re.IGNORECASE)
_STEERING = re.compile(r"steer", re.IGNORECASE)
_MECANUM = re.compile(r"mecanum|omni.?wheel|roller", re.IGNORECASE)
_MECANUM_DRIVE = re.compile(r"mecanum|omni_?(drive|wheel|base)|planar_move", re.IGNORECASE)
_STEERED_DRIVE = re.compile(r"ackermann|bicycle|tricycle|swerve", re.IGNORECASE)
_LIDAR = re.compile(r"laser|lidar|scan", re.IGNORECASE)


@dataclass(frozen=True)
class _Wheel:
    """A wheel: its joint, the middle of its tyre in the base frame, radius if known, width [m]."""

    joint: Joint
    place: Floats
    radius: float | None
    width: float


def read_urdf(text: str, names: Sequence[str], driven: Sequence[str] = ()) -> RobotPart:
    """Read the fields of a robot from its URDF, which was expanded from xacro.

    `names` are parameters that the block of the robot's own driver may have, `driven` the joints of
    a controller. ConfigError says what a robot is that hasn't four driven wheels.
    """
    urdf = parse_urdf(text)
    joints = {joint.name for joint in urdf.joints}
    for name in driven:
        if name not in joints:
            raise ConfigError(f"has no joint {show_value(name)}, which the controller drives")
    commanded = [name for block in urdf.blocks for name in block.joints]
    wheels = _find_wheels(urdf, {*commanded, *driven})
    chosen = _choose_wheels(wheels, driven or commanded or _joints_of_plugins(urdf))
    base = _choose_blocks(urdf, {wheel.joint.name for wheel in chosen}, names)
    is_own = any(block.is_own(names) for block in base)
    part = RobotPart(skids=not is_own)
    if not is_own:
        part.missing = dict.fromkeys(MEASURES, "no link or parameter does")
    if not (is_own and len(chosen) != 4):
        _check_drive(urdf, base, chosen, wheels)
        _measure_robot(urdf, chosen, part)
    for block in reversed(base):
        _take_params(block, names, part)
    return part


def _choose_blocks(urdf: Urdf, wheels: set[str], names: Sequence[str]) -> list[Block]:
    """The blocks of the base: whose joints are wheels, else one of the own driver, or named so."""
    of_wheels = [block for block in urdf.blocks if wheels & set(block.joints)]
    of_driver = [block for block in urdf.blocks if block.is_own(names)]
    named = [block for block in urdf.blocks if any("wheel" in name for name in block.joints)]
    measured = [block for block in urdf.blocks if {*MEASURES, DIAMETER} & set(block.params)]
    return of_wheels or of_driver[:1] or named[:1] or measured[:1]


def _take_params(block: Block, names: Sequence[str], part: RobotPart) -> None:
    """Take the parameters of a hardware block; ConfigError for near misses of our own ones."""
    if DIAMETER in block.params:
        part.fields["wheel_radius"] = _halve(block.params[DIAMETER])
    if not block.is_own(names):
        shared = (*GEOMETRY_FIELDS, "serial_port")
        part.fields |= {name: block.params[name] for name in shared if name in block.params}
        return
    for name in (param for param in block.params if param not in names):
        near = difflib.get_close_matches(name, names, n=1, cutoff=0.85)
        if near:
            hint = HINTS.get(name, f"did you mean {near[0]!r}?")
            raise ConfigError(f"unknown param {name!r}; {hint}")
    given = {name: value for name, value in block.params.items() if name in names}
    part.fields |= given if "baud_rate" in given else {**DRIVER_DEFAULTS, **given}


def _halve(diameter: str) -> float:
    try:
        return float(diameter) / 2.0
    except ValueError as error:
        raise ConfigError(
            f"a wheel's diameter or radius = {show_value(diameter)}: must be a number"
        ) from error


# Wheels


def _find_wheels(urdf: Urdf, named: set[str]) -> list[_Wheel]:
    """Find what may be a wheel, but for casters; `named` joints need no shape."""
    wheels: list[_Wheel] = []
    for joint in (joint for joint in urdf.joints if joint.is_endless):
        rigid = urdf.find_rigid(joint.child)
        onward = [link_joint for link in rigid for link_joint in urdf.below.get(link, ())]
        if 0 < sum(link_joint.kind != "fixed" for link_joint in onward) < ROLLERS:
            continue
        chain = list(urdf.find_chain(joint))
        problem = next((link_joint.problem for link_joint in chain if link_joint.problem), "")
        if problem and (joint.name in named or "wheel" in joint.name.lower()):
            raise ConfigError(problem)
        sideways = abs(urdf.find_axis(joint)[1]) > PARALLEL
        if (
            problem
            or not sideways
            or any(_is_caster(urdf, link_joint, joint) for link_joint in chain)
        ):
            continue
        wheel = _measure_wheel(urdf, joint, rigid)
        is_mesh = any(urdf.links[link].meshes for link in rigid)
        if wheel.radius or joint.name in named or (is_mesh and not _shapes(urdf, rigid)):
            wheels.append(wheel)
    return wheels


def _is_caster(urdf: Urdf, joint: Joint, wheel: Joint) -> bool:
    """Whether a joint in the chain of a wheel makes it a caster: by name, or as it swivels."""
    name = f"{joint.name} {joint.child}"
    if _CASTER.search(name):
        return True
    if joint is wheel or not joint.is_endless or not _is_vertical(urdf, joint):
        return False
    return not (_STEERING.search(name) or _is_commanded(urdf, joint))


def _is_vertical(urdf: Urdf, joint: Joint) -> bool:
    return bool(abs(urdf.find_axis(joint)[2]) > PARALLEL)


def _is_commanded(urdf: Urdf, joint: Joint) -> bool:
    return any(joint.name in block.joints for block in urdf.blocks)


def _shapes(urdf: Urdf, links: Iterable[str]) -> list[tuple[Floats, Shape]]:
    """The shapes of links, each with its frame in the base frame."""
    return [
        (urdf.frames[link] @ shape.frame, shape)
        for link in links
        for shape in urdf.links[link].shapes
    ]


def _measure_wheel(urdf: Urdf, joint: Joint, rigid: Iterable[str]) -> _Wheel:
    """Find the tyre: the largest round shape about a joint's axis, or several as large."""
    hub, axis = urdf.frames[joint.child][:3, 3], urdf.find_axis(joint)
    tyres = []
    for frame, shape in _shapes(urdf, rigid):
        is_ball = shape.kind == "sphere"
        is_tyre = shape.kind == "cylinder" and abs(frame[:3, 2] @ axis) > PARALLEL
        if shape.half[0] > 0.0 and (is_ball or is_tyre):
            along = float((frame[:3, 3] - hub) @ axis)
            tyres.append((shape.half[0], along, 0.0 if is_ball else shape.half[2]))
    if not tyres:
        return _Wheel(joint, hub, None, 0.0)
    radius = max(tyre[0] for tyre in tyres)
    largest = [tyre for tyre in tyres if tyre[0] > 0.99 * radius]
    low = min(along - half for _, along, half in largest)
    high = max(along + half for _, along, half in largest)
    return _Wheel(joint, hub + (low + high) / 2.0 * axis, radius, high - low)


def _choose_wheels(wheels: Sequence[_Wheel], named: Iterable[str]) -> list[_Wheel]:
    """The driven wheels: as many as are alike among the named ones, and others like them."""
    names = set(named)
    pool = [wheel for wheel in wheels if wheel.joint.name in names] or wheels
    kinds = [[other for other in pool if _are_alike(wheel, other)] for wheel in pool]
    best = max(kinds, key=lambda kind: (len(kind), kind[0].radius or 0.0), default=[])
    return [wheel for wheel in wheels if best and _are_alike(best[0], wheel)]


def _are_alike(first: _Wheel, second: _Wheel) -> bool:
    """Whether two wheels have the same height and, where both are known, radius."""
    radius = first.radius or second.radius or UNKNOWN_RADIUS
    differences = [abs(first.place[2] - second.place[2])]
    if first.radius and second.radius:
        differences.append(abs(first.radius - second.radius))
    return bool(max(differences) <= ALIKE * radius)


def _joints_of_plugins(urdf: Urdf) -> list[str]:
    """The joints that a plugin of Gazebo drives: its leftJoint, front_left_joint, right_rear."""
    joints, side = {joint.name for joint in urdf.joints}, re.compile("left|right", re.IGNORECASE)
    values = [value for plugin in urdf.plugins for value in plugin.values]
    return [text for tag, text in values if text in joints and side.search(tag)]


# Which drive


def _check_drive(
    urdf: Urdf, base: Sequence[Block], chosen: Sequence[_Wheel], wheels: Sequence[_Wheel]
) -> None:
    """Raise ConfigError that says which drive it is, unless it has four wheels that skid."""
    steering = [
        joint.name
        for wheel in wheels
        for joint in list(urdf.find_chain(wheel.joint))[1:]
        if joint.kind in ("revolute", "continuous") and _is_vertical(urdf, joint)
    ]
    steering += [j.name for j in urdf.joints if j.kind == "revolute" and _STEERING.search(j.name)]
    drives = [f"{plugin.name} {plugin.values}" for plugin in urdf.plugins]
    drives += [plugin for block in base for plugin in block.plugins]
    if steering or any(_STEERED_DRIVE.search(drive) for drive in drives):
        names = f" ({_list(dict.fromkeys(steering))})" if steering else ""
        raise ConfigError(f"is a robot with a steered axle{names}: {ONLY_FOUR}")
    if any(_MECANUM_DRIVE.search(drive) for drive in [*drives, urdf.name]) or any(
        _has_rollers(urdf, wheel) for wheel in chosen
    ):
        raise ConfigError(f"is a robot with mecanum or omni wheels: {ONLY_FOUR}")
    names = _list(wheel.joint.name for wheel in chosen)
    if len(chosen) == 2:
        first, second = chosen
        track = abs(first.place[1] - second.place[1])
        raise ConfigError(
            f"is a robot with two driven wheels ({names}), {track:.4g} m apart, and what "
            "carries it besides, a differential drive: only four driven wheels that skid are "
            "simulated; for --link ros2 give the file of its controller alone"
        )
    if chosen and len(chosen) != 4:
        count = f"{len(chosen)} wheel{'s' * (len(chosen) > 1)}"
        raise ConfigError(f"is a robot with {count} about y ({names}): {ONLY_FOUR}")


def _has_rollers(urdf: Urdf, wheel: _Wheel) -> bool:
    """Whether names, rollers or friction tell a mecanum or omni wheel."""
    rigid = urdf.find_rigid(wheel.joint.child)
    onward = [
        roller for link in rigid for roller in urdf.below.get(link, ()) if roller.kind != "fixed"
    ]
    meshes = [mesh for link in rigid for mesh in urdf.links[link].meshes]
    words = " ".join((wheel.joint.name, *rigid, *meshes))
    friction = urdf.friction.get(wheel.joint.child, [])
    slanted = len(friction) == 3 and abs(friction[0] * friction[1]) > 0.1
    return bool(_MECANUM.search(words)) or len(onward) >= ROLLERS or slanted


def _list(names: Iterable[str]) -> str:
    """Name a few things."""
    short = [name[:60] for name in names]
    return ", ".join(short[:4]) + (", ..." if len(short) > 4 else "")


# Measures


def _measure_robot(urdf: Urdf, wheels: Sequence[_Wheel], part: RobotPart) -> None:
    """Set the fields that links and joints say, and why others are missing."""
    if not wheels:
        part.missing |= dict.fromkeys(part.missing, _explain_no_wheels(urdf))
        return
    centre = np.mean([wheel.place for wheel in wheels], axis=0)
    forward = sorted(wheels, key=lambda wheel: -wheel.place[0])
    left = [wheel for wheel in forward if wheel.place[1] > centre[1]]
    right = [wheel for wheel in forward if wheel.place[1] <= centre[1]]
    if len(left) != 2:
        names = _list(wheel.joint.name for wheel in wheels)
        raise ConfigError(f"doesn't have two of its wheels ({names}) on each side")
    corners = [right[0], left[0], left[1], right[1]]
    a, b, c, d = (wheel.place for wheel in corners)
    track = float(b[1] + c[1] - a[1] - d[1]) / 2.0
    wheelbase = float(a[0] + b[0] - c[0] - d[0]) / 2.0
    uneven = max(abs((b[1] - a[1]) - (c[1] - d[1])), abs((a[0] - d[0]) - (b[0] - c[0])))
    if wheelbase <= 0.0 or uneven > SQUARE * min(track, wheelbase):
        names = _list(wheel.joint.name for wheel in corners)
        raise ConfigError(f"has wheels ({names}) that aren't the corners of a rectangle")
    part.centre = (float(centre[0]), float(centre[1]))
    part.fields |= {
        "wheel_separation": _round(track),
        "wheelbase": _round(wheelbase),
        "wheel_joints": [wheel.joint.name for wheel in corners],
        "base_frame": urdf.base,
    }
    radius = _find_radius(urdf, corners, float(centre[2]))
    if radius is not None:
        part.fields["wheel_radius"] = _round(radius)
    elif part.missing:
        part.missing["wheel_radius"] = (
            "its wheels have no cylinder about their axles, and meshes aren't opened; add "
            "<param name='wheel_radius'>0.1</param> to its <ros2_control><hardware>"
        )
    _measure_body(urdf, corners, centre, radius or 0.0, part)
    _place_lidar(urdf, centre, radius or 0.0, part)


def _explain_no_wheels(urdf: Urdf) -> str:
    """Say why no joint is a wheel."""
    turning = [joint for joint in urdf.joints if joint.is_endless]
    names = _list(joint.name for joint in turning)
    if not turning:
        return "it has no continuous joint, and no <ros2_control><hardware> params"
    if all(abs(urdf.find_axis(joint)[1]) < PARALLEL for joint in turning):
        return f"the axes of its turning joints ({names}) aren't along y of {urdf.base}"
    return f"none of its turning joints ({names}) has a cylinder about it, a sphere or a mesh"


def _find_radius(urdf: Urdf, wheels: Sequence[_Wheel], height: float) -> float | None:
    """The wheels' radius by their shapes, Gazebo's plugins, or height above the ground [m]."""
    radii = [wheel.radius for wheel in wheels if wheel.radius]
    if radii:
        return sum(radii) / len(radii)
    for plugin in urdf.plugins:
        for tag, text in plugin.values:
            name = tag.lower().replace("_", "")
            if name in ("wheelradius", "wheeldiameter"):
                value = _halve(text) * (1.0 if name == "wheeldiameter" else 2.0)
                if value > 0.0:
                    return value
    for link, frame in urdf.frames.items():
        if "footprint" in link and height - frame[2, 3] > 0.0:
            return height - float(frame[2, 3])
    return None


def _measure_body(
    urdf: Urdf, wheels: Sequence[_Wheel], centre: Floats, radius: float, part: RobotPart
) -> None:
    """Set mass, footprint and height; the latter is that of the largest shape, which no mast is."""
    carriers = [joint.name for wheel in wheels for joint in list(urdf.find_chain(wheel.joint))[1:]]
    base = _shapes(urdf, urdf.find_body(carriers))
    places = np.array([frame[:3, 3] for frame, _ in base] + [wheel.place for wheel in wheels])
    tyres = [(radius, wheel.width / 2.0, radius) for wheel in wheels]
    halves = np.array([_find_extent(frame, shape) for frame, shape in base] + tyres)
    low, high = (places - halves).min(axis=0) - centre, (places + halves).max(axis=0) - centre
    length, width = high[0] - low[0], high[1] - low[1]
    body = {"length": _round(length), "width": _round(width)}
    mass = sum(link.mass for link in urdf.links.values())
    if mass > 0.0:
        body["mass"] = _round(mass)
    if base:
        chassis = max(range(len(base)), key=lambda n: halves[n][0] * halves[n][1])
        body["height"] = _round(places[chassis][2] + halves[chassis][2] - centre[2] + radius)
    part.fields["body"] = {name: value for name, value in body.items() if value > 0.0}
    if max(abs(high[:2] + low[:2])) > CENTRED:
        (x0, y0), (x1, y1) = low[:2], high[:2]
        corners = [(x1, y1), (x0, y1), (x0, y0), (x1, y0)]
        part.fields["footprint"] = [(_round(x), _round(y)) for x, y in corners]


def _find_extent(frame: Floats, shape: Shape) -> Floats:
    """Half the size of a shape along the axes of the base frame [m]."""
    half, turn = np.array(shape.half), frame[:3, :3]
    if shape.kind == "box":
        extent: Floats = np.abs(turn) @ half
    elif shape.kind == "sphere":
        extent = half
    else:
        axis = np.abs(turn[:, 2])
        extent = half[2] * axis + half[0] * np.sqrt(np.maximum(0.0, 1.0 - axis**2))
    return extent


def _place_lidar(urdf: Urdf, centre: Floats, radius: float, part: RobotPart) -> None:
    """Set the LiDAR's frame and place over the ground; the middle, where no link is named so."""
    links = [name for name in urdf.find_body() if _LIDAR.search(name)]
    part.fields |= {"lidar_x_offset": 0.0, "lidar_y_offset": 0.0}
    if links:
        name = min(links, key=len)
        x, y, z = urdf.frames[name][:3, 3] - centre
        part.fields |= {"lidar_x_offset": _round(x), "lidar_y_offset": _round(y)}
        part.fields |= {"lidar_z_offset": _round(z + radius), "lidar_frame": name}


def _round(length: float) -> float:
    """Round to micrometres, which products of rotations aren't exact to."""
    return round(float(length), 6)
