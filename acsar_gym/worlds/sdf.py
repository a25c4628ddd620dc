"""Read the obstacles of a plain Gazebo world, such as those of BARN, seen from above.

Upright cylinders, boxes and spheres are read. Level planes count as floor. Lights, physics, the
GUI, visuals and sensors aren't obstacles. Anything else that may be an obstacle or move an obstacle
is refused. If a world of Gazebo classic has a `<state>`, its poses of models replace the models'
own, as in Gazebo. Lengths in m, angles in rad.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from xml.etree.ElementTree import Element, ParseError

import defusedxml.ElementTree
import numpy as np

from acsar_gym.errors import WorldError, explain_error, show_value
from acsar_gym.worlds.world import MAX_COORDINATE, Floats

MAX_SDF_BYTES = 64_000_000  # most bytes of an SDF file
MAX_TAGS = 2_500_000  # most tags of a file. A world of 20,000 cylinders as in BARN has 2 million
LIDAR_HEIGHT = 0.37  # height of the LiDAR of the preset acsar [m]
HEADROOM = 0.5  # a body that begins above this height can't touch the robot or its LiDAR's rays [m]
STEP_HEIGHT = 0.01  # the robot drives over a body that isn't higher than this [m]
MAX_TILT = 0.01  # a body that is tilted less than this counts as upright [rad]
FOREIGN_PATHS = (
    *("include", "actor", "population", "model/include", "model/model", "model/plugin"),
    *("model[@placement_frame]", "state/insertions/*", "state/model/scale[.!='1 1 1']"),
)
"""Elements of a world that would add, move or scale obstacles."""
MAX_NAMED = 4  # most foreign elements that one message names
PLAIN_ATTRIBUTES = {"", "0", "false", "euler_rpy"}
"""Values of attributes that leave a pose plain."""
ADVICE = (
    "only upright cylinders, boxes and spheres with plain poses are read: remove or replace it, "
    "or make a ROS map of the world"
)
CORNER_SIGNS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


def read_obstacles(data: bytes, height: float = LIDAR_HEIGHT) -> tuple[Floats, Floats]:
    """Read the obstacles of a world.

    Args:
        data: Content of the SDF file.
        height: Height of the LiDAR above the floor [m].

    Returns:
        Circles (n, 3) and segments (n, 4) [m]. Bodies that the robot drives over, and those that
        are above it and its LiDAR, are left out.

    Raises:
        WorldError: The file isn't SDF, or contains anything that isn't plain.
    """
    root = _parse_xml(data)
    worlds = root.findall("world")
    if root.tag != "sdf" or len(worlds) != 1:
        raise WorldError("not an SDF file of one <world>")
    world = worlds[0]
    _check_elements(world)

    # Of Gazebo classic: where models were when the world was saved.
    states = {state.get("name"): state for state in world.iterfind("state/model")}
    circles = [np.zeros((0, 3))]
    segments = [np.zeros((0, 4))]
    for model in world.iterfind("model"):
        name = model.get("name")
        try:
            for shape, frame in _list_bodies(model, states.get(name)):
                outline = _outline(shape, frame, max(HEADROOM, height))
                (segments if shape.tag == "box" else circles).append(outline)
        except WorldError as error:
            raise WorldError(f"model {show_value(name)}: {error}") from error
    return np.concatenate(circles), np.concatenate(segments)


def _parse_xml(data: bytes) -> Element:
    """Parse XML. WorldError for what isn't XML, and what would take long or much memory."""
    if data.count(b"<") > MAX_TAGS:
        raise WorldError("holds too many XML elements: cut out a part of it")
    # XML allows no comment before its declaration, but some files have one.
    data = data[max(data.find(b"<?xml"), 0) :]
    try:
        root: Element = defusedxml.ElementTree.fromstring(data, forbid_dtd=True)
    except (ParseError, ValueError, LookupError, AssertionError) as error:
        raise WorldError(f"not XML without a document type: {explain_error(error)}") from error
    return root


def _check_elements(world: Element) -> None:
    """WorldError that names the elements of FOREIGN_PATHS, but for Gazebo's default plugins."""
    # Gazebo saves some plugins that do nothing under this name.
    names = [
        f"{path} {show_value(element.get('name') or element.findtext('uri', ''))}"
        for path in FOREIGN_PATHS
        for element in world.iterfind(path)
        if "__default__" not in element.attrib.values()
    ]
    if names:
        raise WorldError(f"contains {', '.join(names[:MAX_NAMED])}: {ADVICE}")


def _list_bodies(model: Element, state: Element | None) -> Iterator[tuple[Element, Floats]]:
    """The shapes of a model, and their frames in the world."""
    is_saved = state is not None and state.find("pose") is not None

    # A saved simulation has moved its models: their state has the pose.
    frame = _read_frame(state if state is not None and is_saved else model)
    for link in model.iterfind("link"):
        for body in link.iterfind("collision"):
            for shape in body.iterfind("geometry/*"):
                yield shape, frame @ (_read_frame(link) @ _read_frame(body))


def _outline(shape: Element, frame: Floats, top: float) -> Floats:
    """The sides of a box (4, 4), or the circle of a round body (1, 3), or empty if out of reach."""
    is_upright = shape.tag == "sphere" or abs(frame[2, 2]) >= math.cos(MAX_TILT)
    if shape.find("normal") is not None:
        is_upright &= _read_numbers(shape, "normal", 3) == [0.0, 0.0, 1.0]
    kind = shape.tag if is_upright else f"tilted {shape.tag}"
    if kind not in ("box", "cylinder", "sphere", "plane", "empty"):
        raise WorldError(f"has a {kind}: {ADVICE}")
    if kind in ("plane", "empty"):
        return np.zeros((0, 3))

    x, y, z = frame[:3, 3].tolist()
    if kind == "box":
        # The turned rectangle, seen from above.
        size = np.array(_read_numbers(shape, "size", 3, least=0.0))
        half = size[2] / 2.0
        corners = CORNER_SIGNS * size[:2] / 2.0 @ frame[:2, :2].T + frame[:2, 3]
        outline = np.column_stack([corners, np.roll(corners, -1, axis=0)])
    else:
        (radius,) = _read_numbers(shape, "radius", 1, least=0.0)
        half = radius
        if kind == "cylinder":
            half = _read_numbers(shape, "length", 1, least=0.0)[0] / 2.0
        else:  # a sphere counts where it is widest within reach
            gap = max(z - top, STEP_HEIGHT - z, 0.0)
            radius = math.sqrt(max(radius**2 - gap**2, 0.0))
        outline = np.array([[x, y, radius]])

    return outline if z - half <= top and z + half > STEP_HEIGHT else outline[:0]


def _read_frame(parent: Element) -> Floats:
    """The pose of an element as a matrix (4, 4), or the identity if it has none."""
    pose = parent.find("pose")
    if pose is None or not (pose.text or "").strip():
        return np.eye(4)
    if not {*pose.attrib.values()} <= PLAIN_ATTRIBUTES:
        raise WorldError(f"a pose has {show_value(pose.attrib)}: {ADVICE}")

    x, y, z, *angles = _read_numbers(parent, "pose", 6)
    cr, cp, cy = np.cos(angles)
    sr, sp, sy = np.sin(angles)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y],
            [-sp, cp * sr, cp * cr, z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _read_numbers(
    parent: Element, tag: str, count: int, least: float = -MAX_COORDINATE
) -> list[float]:
    """The numbers in a child. Raises WorldError for another count, and for NaN or large numbers."""
    text = parent.findtext(tag, "")
    try:
        numbers = [float(word) for word in text.split(None, count)]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(least <= number <= MAX_COORDINATE for number in numbers):
        raise WorldError(
            f"{tag} must be {count} numbers, {least:g} to {MAX_COORDINATE:g}, is {show_value(text)}"
        )
    return numbers
