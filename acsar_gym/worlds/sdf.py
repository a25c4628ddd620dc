"""Read the obstacles of a Gazebo world: the collision geometry of its models, seen from above.

Cylinders and spheres become circles, boxes four segments. Lengths in m and angles in rad, as in SDF
1.4 to 1.9. Poses of models, links and collisions are composed; where the world has a `<state>`,
its model poses replace the models' own, as in Gazebo. Skipped are the ground plane, and bodies
that end below STEP or begin above HEADROOM. Lights, actors and visuals are no obstacles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, ParseError, TreeBuilder

import numpy as np
from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import XMLParser
from numpy.typing import NDArray

from acsar_gym.errors import WorldError
from acsar_gym.worlds.world import MAX_COORDINATE, MAX_OBSTACLES

Floats = NDArray[np.float64]
Shape = tuple[list[list[float]], list[list[float]]]
"""Circles and segments."""
HEADROOM = 0.5
"""A body that begins above this height can't touch the robot or its LiDAR's rays [m]."""
STEP_HEIGHT = 0.01
"""The robot drives over a body that isn't higher than this [m]."""
MAX_TILT = 0.01
"""A body that is tilted more than this is refused [rad]."""
MAX_ELEMENTS = 2_000_000
"""Most XML elements of a file; a world of 20,000 cylinders as in BARN has half as many."""
MAX_ATTRIBUTES = 600_000
"""Most attributes; a world of 20,000 cylinders as in BARN has half as many."""
MAX_TAG_BYTES = 1_000_000
"""Most bytes of a tag, or of a text between two."""
MAX_KEPT_ELEMENTS = 20 * MAX_OBSTACLES
"""Most elements that are read, and so kept in memory."""
PLACE_TAGS = frozenset({"sdf", "world", "state", "model", "link", "collision", "geometry", "pose"})
SIZE_TAGS = frozenset({"radius", "length", "size", "normal"})
INCLUDE_TAGS = frozenset({"include", "uri", "population"})
KEPT_TAGS = PLACE_TAGS | SIZE_TAGS | INCLUDE_TAGS
"""These and every kind of geometry are read; others are skipped with everything in them."""
HARMLESS_MODELS = ("sun", "ground_plane")
"""Models that nearly every world includes, and that are no obstacles."""


class SdfFrame(NamedTuple):
    """A frame in the world: position [m], yaw [rad], and whether it is tilted."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw: float = 0.0
    tilted: bool = False

    def __matmul__(self, inner: SdfFrame) -> SdfFrame:
        """Transform a frame that is given in this one into the world."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        x = self.x + cos * inner.x - sin * inner.y
        y = self.y + sin * inner.x + cos * inner.y
        tilted = self.tilted or inner.tilted
        return SdfFrame(x, y, self.z + inner.z, self.yaw + inner.yaw, tilted)


def read_obstacles(data: bytes) -> tuple[Floats, Floats]:
    """Read the obstacles of an SDF file's content.

    Returns:
        Circles (C, 3) and segments (S, 4) [m].

    Raises:
        WorldError: it isn't SDF, is malicious, has more than 20,000 bodies, or shapes that can't
            be read; names the model.
    """
    root = _parsed(data)
    worlds = root.findall("world")
    if root.tag != "sdf" or len(worlds) > 1:
        raise WorldError("not an SDF file of one <world>")
    circles: list[list[float]] = []
    segments: list[list[float]] = []
    for some_circles, some_segments in _shapes(worlds[0] if worlds else root):
        circles += some_circles
        segments += some_segments
    return np.array(circles).reshape(-1, 3), np.array(segments).reshape(-1, 4)


class _Builder(TreeBuilder):
    """Keeps the elements that are needed, and stops early where there are too many."""

    def __init__(self) -> None:
        super().__init__()
        self._open: list[str] = []
        self._skipped = 0
        self._seen = self._kept = self._bodies = 0

    def start(self, tag: Any, attrs: Any, /) -> Any:
        self._count(tag)
        wanted = tag in KEPT_TAGS or self._open[-1:] == ["geometry"]
        if self._skipped or not wanted:
            self._skipped += 1
            return None
        self._kept += 1
        self._open.append(tag)
        return super().start(tag, attrs)

    def end(self, tag: Any, /) -> Any:
        if self._skipped:
            self._skipped -= 1
            return None
        self._open.pop()
        return super().end(tag)

    def data(self, data: Any, /) -> None:
        if not self._skipped:
            super().data(data)

    def _count(self, tag: str) -> None:
        self._seen += 1
        self._bodies += tag == "collision"
        if self._bodies > MAX_OBSTACLES:
            raise WorldError(f"holds more than {MAX_OBSTACLES:,} bodies: cut out a part of it")
        if self._seen > MAX_ELEMENTS or self._kept > MAX_KEPT_ELEMENTS:
            raise WorldError("holds too many XML elements: cut out a part of it")


def _check_markup(data: bytes) -> None:
    """Refuse data that would make the parser slow."""
    ends = np.flatnonzero(np.frombuffer(data, np.uint8) == ord(">"))
    longest = np.diff(ends, prepend=0, append=len(data)).max(initial=0)
    if longest > MAX_TAG_BYTES or data.count(b"=") > MAX_ATTRIBUTES:
        raise WorldError("holds too many attributes, or too long a tag or text, to be a world")


def _parsed(data: bytes) -> Element:
    _check_markup(data)
    parser = XMLParser(target=_Builder(), forbid_dtd=True)
    try:
        parser.feed(data)
        root: Element | None = parser.close()
    except DefusedXmlException:
        raise WorldError(
            "has a document type or entities, which are refused: remove them"
        ) from None
    except (ParseError, ValueError, LookupError, AssertionError) as error:
        raise WorldError(f"not valid XML: {' '.join(str(error).split())}") from None
    if not isinstance(root, Element):
        raise WorldError("not an SDF file of one <world>")
    return root


def _shapes(world: Element) -> Iterator[Shape]:
    moved = {model.get("name"): model for model in world.iterfind("state/model")}
    _refuse_includes(world)
    for model in world.iterfind("model"):
        now = moved.get(model.get("name"), model)
        placed = _pose(now if now.find("pose") is not None else model, "model", _name(model))
        yield from _of_model(model, placed, 0)


def _of_model(model: Element, placed: SdfFrame, depth: int) -> Iterator[Shape]:
    name = _name(model)
    if depth > 10:
        raise WorldError(f"model {name}: models are nested too deeply")
    if model.get("placement_frame"):
        raise WorldError(f"model {name}: has a placement_frame, which can't be read: remove it")
    _refuse_includes(model)
    for link in model.iterfind("link"):
        link_frame = placed @ _pose(link, "link", name)
        for body in link.iterfind("collision"):
            yield _shape(body, link_frame @ _pose(body, "collision", name), name)
    for inner in model.iterfind("model"):
        yield from _of_model(inner, placed @ _pose(inner, "model", name), depth + 1)


def _refuse_includes(parent: Element) -> None:
    """Refuse models in other files, because obstacles would be missing."""
    if parent.find("population") is not None:
        raise WorldError("has a <population>, which can't be read: place its models one by one")
    for uri in parent.iterfind("include/uri"):
        name = (uri.text or "").strip().rstrip("/")
        if name.rsplit("/", 1)[-1] not in HARMLESS_MODELS:
            raise WorldError(f"includes {_brief(name)}, which lies in another file: write it out")


def _name(element: Element) -> str:
    return _brief(element.get("name", ""))


def _brief(text: str) -> str:
    """Quote a text on one line, at most 40 characters of it."""
    return repr(text if len(text) <= 40 else f"{text[:40]}...")


def _pose(element: Element, kind: str, model: str) -> SdfFrame:
    """The frame of a model, link or collision in its parent's."""
    pose = element.find("pose")
    if pose is None or not (pose.text or "").strip():
        return SdfFrame()
    base = pose.get("relative_to") or pose.get("frame") or ""
    if base not in ("", {"model": "world", "link": "__model__"}.get(kind, "")):
        raise WorldError(f"model {model}: a pose is relative to {_brief(base)}, not to its parent")
    if pose.get("rotation_format", "euler_rpy") != "euler_rpy":
        raise WorldError(f"model {model}: a rotation isn't roll, pitch and yaw")
    x, y, z, *angles = _numbers(pose, "pose", 6, model)
    if pose.get("degrees", "").strip() in ("true", "1"):
        angles = list(map(math.radians, angles))
    roll, pitch = (abs(math.remainder(angle, math.tau)) for angle in angles[:2])
    return SdfFrame(x, y, z, angles[2], max(roll, pitch) > MAX_TILT)


def _numbers(element: Element, what: str, count: int, model: str) -> list[float]:
    text = element.text or ""
    try:
        numbers = [float(word) for word in text.split(None, count)]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(abs(number) <= MAX_COORDINATE for number in numbers):
        raise WorldError(
            f"model {model}: {what} must be {count} finite number{'s' if count > 1 else ''} of at "
            f"most {MAX_COORDINATE:g}, is {_brief(text.strip())}"
        )
    return numbers


def _sizes(shape: Element, what: str, count: int, model: str) -> list[float]:
    element = shape.find(what)
    if element is None:
        raise WorldError(f"model {model}: its {shape.tag} has no <{what}>")
    numbers = _numbers(element, what, count, model)
    if min(numbers) < 0.0:
        raise WorldError(f"model {model}: {what} must not be negative, is {min(numbers):g}")
    return numbers


def _shape(body: Element, placed: SdfFrame, model: str) -> Shape:
    """A collision body seen from above; empty where the robot can't touch it."""
    shape = next(iter(body.find("geometry") or ()), None)
    if shape is None or shape.tag == "empty":
        return [], []
    reader = SHAPE_READERS.get(shape.tag)
    if reader is None:
        raise WorldError(
            f"model {model}: a {shape.tag} can't be read: replace it by cylinders and boxes"
        )
    drawn, half_height = reader(shape, placed, model)
    if placed.tilted:
        raise WorldError(f"model {model}: is tilted: only bodies that stand upright can be read")
    out_of_the_way = placed.z - half_height > HEADROOM or placed.z + half_height <= STEP_HEIGHT
    return ([], []) if out_of_the_way else drawn


def _cylinder(shape: Element, placed: SdfFrame, model: str) -> tuple[Shape, float]:
    radius, length = (_sizes(shape, what, 1, model)[0] for what in ("radius", "length"))
    return ([[placed.x, placed.y, radius]], []), length / 2.0


def _sphere(shape: Element, placed: SdfFrame, model: str) -> tuple[Shape, float]:
    """A circle of the sphere's radius."""
    radius = _sizes(shape, "radius", 1, model)[0]
    return ([[placed.x, placed.y, radius]], []), radius


def _box(shape: Element, placed: SdfFrame, model: str) -> tuple[Shape, float]:
    length, width, height = _sizes(shape, "size", 3, model)
    signs = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))
    corners = [placed @ SdfFrame(sx * length / 2.0, sy * width / 2.0) for sx, sy in signs]
    pairs = zip(corners, corners[1:] + corners[:1], strict=True)
    return ([], [[one.x, one.y, two.x, two.y] for one, two in pairs]), height / 2.0


def _plane(shape: Element, placed: SdfFrame, model: str) -> tuple[Shape, float]:
    """No obstacle; WorldError where the plane isn't level."""
    normal = shape.find("normal")
    x, y, z = (0.0, 0.0, 1.0) if normal is None else _numbers(normal, "normal", 3, model)
    if placed.tilted or math.hypot(x, y) > MAX_TILT * abs(z):
        raise WorldError(f"model {model}: a plane must be level: replace it by a box")
    return ([], []), 0.0


SHAPE_READERS: dict[str, Callable[[Element, SdfFrame, str], tuple[Shape, float]]] = {
    "cylinder": _cylinder,
    "sphere": _sphere,
    "box": _box,
    "plane": _plane,
}
