"""Read a URDF: its links and joints in the base frame, its ros2_control blocks, Gazebo's plugins.

Frames compose from the base link through all joints, at their zero. Meshes aren't opened.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from xml.etree.ElementTree import Element, ParseError

import defusedxml.ElementTree
import numpy as np
from defusedxml.common import DefusedXmlException
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError, show_value

Floats = NDArray[np.float64]
MAX_PARAMS = 1_000
"""Most parameters of a hardware block; each is compared with the names of all fields."""
LARGEST_NUMBER = 1e6  # of lengths, angles and masses that are read
ENDLESS = 4.0 * math.pi  # a revolute joint with a wider range than this turns as a wheel does [rad]
DRIVER_PLUGIN = "ACSARInterface"
"""Class of the robot's own driver, whose parameters are this package's, with its defaults."""
WORLD_LINKS = ("world", "map", "odom")  # links that are no part of a robot
UNEXPANDED = "is xacro that isn't expanded: run 'xacro FILE.urdf.xacro > robot.urdf', and use that"


@dataclass(frozen=True)
class Shape:
    """A box, cylinder, capsule or sphere: its frame in that of its link, and half its sizes [m]."""

    kind: str
    frame: Floats
    half: tuple[float, float, float]


@dataclass(frozen=True)
class Link:
    """Mass [kg], shapes, and names of meshes; shapes that are only seen where none collides."""

    name: str
    mass: float
    shapes: list[Shape]
    meshes: list[str]


@dataclass(frozen=True)
class Joint:
    """A joint: the child's frame in the parent's, and its axis in the child's."""

    name: str
    kind: str
    parent: str
    child: str
    origin: Floats
    axis: Floats
    is_endless: bool
    """Whether it turns without end."""
    problem: str
    """What is wrong with its origin, which matters only where it carries something; or empty."""


@dataclass(frozen=True)
class Block:
    """A ros2_control block: its plugins, its parameters, and the joints that it commands."""

    plugins: list[str]
    params: dict[str, str]
    joints: list[str]

    def is_own(self, names: Collection[str]) -> bool:
        """Whether it is of the robot's own driver, or of no driver and has its parameters alone."""
        is_driver = any(plugin.endswith(DRIVER_PLUGIN) for plugin in self.plugins)
        return is_driver or (
            not self.plugins and bool(self.params) and set(self.params) <= set(names)
        )


@dataclass(frozen=True)
class Plugin:
    """A plugin of Gazebo: its file and name, and the texts of its elements by their tags."""

    name: str
    values: list[tuple[str, str]]


@dataclass
class Urdf:
    """A robot's tree of links.

    Attributes:
        base: name of the base link.
        trunk: names of that link and of those that carry it.
        frames: of the links, in that of the base link.
        above: the joint that carries a link, by the link's name.
        below: the joints on a link, by its name.
        friction: directions that Gazebo's friction has on a link, by its name.
    """

    name: str
    links: dict[str, Link]
    joints: list[Joint]
    blocks: list[Block]
    plugins: list[Plugin]
    friction: dict[str, list[float]]
    base: str = ""
    trunk: set[str] = field(default_factory=set)
    frames: dict[str, Floats] = field(default_factory=dict)
    above: dict[str, Joint] = field(default_factory=dict)
    below: dict[str, list[Joint]] = field(default_factory=dict)

    def find_axis(self, joint: Joint) -> Floats:
        """Return the direction of a joint's axis in the base frame."""
        axis: Floats = self.frames[joint.child][:3, :3] @ joint.axis
        return axis

    def find_chain(self, joint: Joint) -> Iterator[Joint]:
        """Yield a joint and those above it, but for those that carry the base link, too."""
        up: Joint | None = joint
        while up is not None and up.child not in self.trunk:
            yield up
            up = self.above.get(up.parent)

    def find_body(self, through: Iterable[str] = ()) -> list[str]:
        """Return the links that are fixed to the base link; see `find_rigid`."""
        top = self.base
        while (up := self.above.get(top)) and up.kind == "fixed" and up.parent not in WORLD_LINKS:
            top = up.parent
        return self.find_rigid(top, through)

    def find_rigid(self, link: str, through: Iterable[str] = ()) -> list[str]:
        """Return the links fixed below one, itself included; `through` counts as fixed."""
        passed, names = set(through), [link]
        for name in names:  # grows
            joints = self.below.get(name, ())
            names += [
                joint.child
                for joint in joints
                if not joint.problem and (joint.kind == "fixed" or joint.name in passed)
            ]
        return names


def parse_urdf(text: str) -> Urdf:
    """Parse a URDF that was expanded from xacro; ConfigError where it is malformed or no tree."""
    try:
        root: Element = defusedxml.ElementTree.fromstring(text)
    except (ParseError, DefusedXmlException, ValueError) as error:
        if "unbound prefix" in str(error) and "<xacro:" in text:
            raise ConfigError(UNEXPANDED) from error
        raise ConfigError(f"not a valid URDF: {error}") from error
    if root.tag == "sdf":
        raise ConfigError("is a file of Gazebo (SDF): a robot is read from its URDF")
    if any("xacro" in element.tag for element in root.iter()):
        raise ConfigError(UNEXPANDED)
    urdf = Urdf(
        root.get("name", ""),
        {element.get("name", ""): _read_link(element) for element in root.iterfind("link")},
        [_read_joint(element) for element in root.iterfind("joint")],
        [_read_block(element) for element in root.iter("ros2_control")],
        [
            _read_plugin(element)
            for gazebo in root.iterfind("gazebo")
            for element in gazebo.iter("plugin")
        ],
        {
            element.get("reference", ""): _read_friction(element)
            for element in root.iterfind("gazebo")
        },
    )
    _place_links(urdf)
    return urdf


def _place_links(urdf: Urdf) -> None:
    """Compose the frames; ConfigError where the joints form no tree."""
    for joint in urdf.joints:
        for end in (joint.parent, joint.child):
            if end not in urdf.links:
                raise ConfigError(f"joint {show_value(joint.name)}: there is no link {end[:60]!r}")
        if joint.child in urdf.above:
            raise ConfigError(f"link {show_value(joint.child)} is the child of two joints")
        urdf.above[joint.child] = joint
        urdf.below.setdefault(joint.parent, []).append(joint)
    if not urdf.joints:
        return
    first = [name for name in urdf.below if name not in urdf.above]
    placed, frames = list(first), {name: np.eye(4) for name in first}
    for name in placed:  # grows
        for joint in urdf.below.get(name, ()):
            frames[joint.child] = frames[name] @ joint.origin
            placed.append(joint.child)
    if not all(joint.child in frames for joint in urdf.joints):
        raise ConfigError("its joints form a circle: no link is the first")
    urdf.base = next(_find_base(urdf, frames), first[0])
    up: str | None = urdf.base
    while up is not None:
        urdf.trunk.add(up)
        up = urdf.above[up].parent if up in urdf.above else None
    back = np.linalg.inv(frames[urdf.base])
    urdf.frames = {name: back @ frame for name, frame in frames.items()}


def _find_base(urdf: Urdf, links: Collection[str]) -> Iterator[str]:
    """Yield links named as base links are; with a prefix only at the top: arms have bases."""
    for name in ("base_link", "base_footprint"):
        if name in links:
            yield name
        for link in links:
            parent = urdf.above[link].parent if link in urdf.above else "world"
            is_first = parent in WORLD_LINKS or parent.endswith("footprint")
            if is_first and re.search(rf"[/_]{name}$", link):
                yield link


def _read_link(element: Element) -> Link:
    name = element.get("name", "")
    where = f"link {show_value(name)}"
    mass = element.find("inertial/mass")
    weight = 0.0 if mass is None else _parse(mass.get("value", ""), 1, f"{where}: mass")[0]
    solid, seen = (
        [
            shape
            for child_element in element.iterfind(tag)
            if (shape := _read_shape(child_element, where)) is not None
        ]
        for tag in ("collision", "visual")
    )
    meshes = [child_element.get("filename", "") for child_element in element.iter("mesh")]
    return Link(name, weight, solid or seen, meshes)


def _read_shape(element: Element, where: str) -> Shape | None:
    """Read a primitive; None for a mesh."""
    frame = _read_origin(element, where)
    box = element.find("geometry/box")
    if box is not None:
        x, y, z = _parse(box.get("size", ""), 3, f"{where}: box size")
        return Shape("box", frame, (abs(x) / 2.0, abs(y) / 2.0, abs(z) / 2.0))
    for kind in ("cylinder", "capsule", "sphere"):
        solid = element.find(f"geometry/{kind}")
        if solid is None:
            continue
        radius = abs(_parse(solid.get("radius", ""), 1, f"{where}: {kind} radius")[0])
        half = radius
        if kind != "sphere":
            half = abs(_parse(solid.get("length", ""), 1, f"{where}: {kind} length")[0]) / 2.0
        return Shape(kind, frame, (radius, radius, half + radius * (kind == "capsule")))
    return None


def _read_joint(element: Element) -> Joint:
    name, kind = element.get("name", ""), element.get("type", "")
    where = f"joint {show_value(name)}"
    parent, child = element.find("parent"), element.find("child")
    if parent is None or child is None:
        raise ConfigError(f"{where}: needs a <parent> and a <child>")
    axis, limit = element.find("axis"), element.find("limit")
    direction = np.array([1.0, 0.0, 0.0])
    if axis is not None and kind != "fixed":
        direction = np.array(_parse(axis.get("xyz", "1 0 0"), 3, f"{where}: axis"))
    length = float(np.linalg.norm(direction))
    if length == 0.0:
        raise ConfigError(f"{where}: its axis has no direction")
    span = ENDLESS
    if limit is not None and limit.get("lower") and limit.get("upper"):
        try:
            span = float(limit.get("upper", "")) - float(limit.get("lower", ""))
        except ValueError as error:
            raise ConfigError(f"{where}: its limits must be numbers") from error
    endless = kind == "continuous" or (kind == "revolute" and span >= ENDLESS)
    origin, problem = np.eye(4), ""
    try:
        origin = _read_origin(element, where)
    except ConfigError as error:  # as of a sensor whose place an environment variable says
        problem = str(error)
    ends = parent.get("link", ""), child.get("link", "")
    return Joint(name, kind, *ends, origin, direction / length, endless, problem)


def _read_block(element: Element) -> Block:
    params = element.findall("hardware/param")
    if len(params) > MAX_PARAMS:
        raise ConfigError(f"has a hardware block of {len(params):,} params: remove those not used")
    return Block(
        [(child.text or "").strip() for child in element.iterfind("hardware/plugin")],
        {child.get("name", ""): (child.text or "").strip() for child in params},
        [child.get("name", "") for child in element.iterfind("joint")],
    )


def _read_plugin(element: Element) -> Plugin:
    name = f"{element.get('filename', '')} {element.get('name', '')}"
    return Plugin(name, [(child.tag, (child.text or "").strip()) for child in element.iter()])


def _read_friction(element: Element) -> list[float]:
    """Read the direction of friction on a link; empty where there is none."""
    direction = next(element.iter("fdir1"), None)
    if direction is None:
        return []
    try:
        return [float(word) for word in (direction.get("value") or direction.text or "").split()]
    except ValueError:
        return []


def _read_origin(element: Element, where: str) -> Floats:
    """Read an element's frame: turned by roll, pitch and yaw about fixed axes, then moved."""
    origin = element.find("origin")
    frame: Floats = np.eye(4)
    if origin is None:
        return frame
    frame[:3, 3] = _parse(origin.get("xyz", "0 0 0"), 3, f"{where}: origin xyz")
    frame[:3, :3] = turn(_parse(origin.get("rpy", "0 0 0"), 3, f"{where}: origin rpy"))
    return frame


def turn(angles: Sequence[float]) -> Floats:
    """Return the rotation by roll, pitch and yaw [rad] about fixed axes, (3, 3)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles), np.sin(angles)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _parse(text: str, count: int, where: str) -> Sequence[float]:
    """Parse numbers; ConfigError for xacro's expressions, other counts, and what is too large."""
    if "${" in text or "$(" in text:
        raise ConfigError(UNEXPANDED)
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(abs(word) < LARGEST_NUMBER for word in numbers):
        wanted = "a number" if count == 1 else f"{count} numbers"
        raise ConfigError(f"{where} = {show_value(text)}: must be {wanted}")
    return numbers
