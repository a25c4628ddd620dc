"""Read the obstacles of a Gazebo world: the collision geometry of its models, seen from above.

Cylinders and spheres become circles, boxes four segments. Lengths in m and angles in rad, as in SDF
1.4 to 1.9. Poses of models, links and collisions are composed; where the world has a `<state>`,
its model poses replace the models' own, as in Gazebo. Skipped are the ground plane, and bodies
that end below STEP_HEIGHT or begin above HEADROOM. Lights, actors and visuals are no obstacles.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple
from xml.etree.ElementTree import Element, ParseError

import defusedxml.ElementTree
import numpy as np
from defusedxml.common import DefusedXmlException

from acsar_gym.errors import WorldError
from acsar_gym.worlds.world import MAX_COORDINATE, Floats

Shape = tuple[list[list[float]], list[list[float]]]
"""Circles and segments."""
HEADROOM = 0.5
"""A body that begins above this height can't touch the robot or its LiDAR's rays [m]."""
STEP_HEIGHT = 0.01
"""The robot drives over a body that isn't higher than this [m]."""
MAX_TILT = 0.01
"""A body that is tilted more than this is refused [rad]."""
MAX_TAGS = 2_500_000
"""Most tags of a file; a world of 20,000 cylinders as in BARN has 2 million."""
MAX_ATTRIBUTES = 600_000
"""Most attributes; a world of 20,000 cylinders as in BARN has half as many."""
MAX_TAG_BYTES = 1_000_000
"""Most bytes of a tag, or of a text between two."""
MAX_NESTED_MODELS = 10
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
        WorldError: it isn't SDF, is malicious, or has shapes that can't be read; names the model.
    """
    root = _parse_xml(data)
    worlds = root.findall("world")
    if root.tag != "sdf" or len(worlds) > 1:
        raise WorldError("not an SDF file of one <world>")
    world = worlds[0] if worlds else root
    moved = {model.get("name"): model for model in world.iterfind("state/model")}
    _refuse_includes(world)
    circles: list[list[float]] = []
    segments: list[list[float]] = []
    for model in world.iterfind("model"):
        now = moved.get(model.get("name"), model)
        frame = _read_pose(now if now.find("pose") is not None else model, "model", _name(model))
        for some_circles, some_segments in _read_model(model, frame, 0):
            circles += some_circles
            segments += some_segments
    return np.array(circles).reshape(-1, 3), np.array(segments).reshape(-1, 4)


def _parse_xml(data: bytes) -> Element:
    """Parse XML; refuse what would take long or much memory."""
    ends = np.flatnonzero(np.frombuffer(data, np.uint8) == ord(">"))
    longest = np.diff(ends, prepend=0, append=len(data)).max(initial=0)
    if longest > MAX_TAG_BYTES or data.count(b"=") > MAX_ATTRIBUTES:
        raise WorldError("holds too many attributes, or too long a tag or text, to be a world")
    if data.count(b"<") > MAX_TAGS:
        raise WorldError("holds too many XML elements: cut out a part of it")
    try:
        root: Element = defusedxml.ElementTree.fromstring(data, forbid_dtd=True)
    except DefusedXmlException:
        raise WorldError(
            "has a document type or entities, which are refused: remove them"
        ) from None
    except (ParseError, ValueError, LookupError, AssertionError) as error:
        raise WorldError(f"not valid XML: {' '.join(str(error).split())}") from None
    return root


def _read_model(model: Element, frame: SdfFrame, depth: int) -> Iterator[Shape]:
    name = _name(model)
    if depth > MAX_NESTED_MODELS:
        raise WorldError(f"model {name}: models are nested too deeply")
    if model.get("placement_frame"):
        raise WorldError(f"model {name}: has a placement_frame, which can't be read: remove it")
    _refuse_includes(model)
    for link in model.iterfind("link"):
        link_frame = frame @ _read_pose(link, "link", name)
        for body in link.iterfind("collision"):
            yield _read_body(body, link_frame @ _read_pose(body, "collision", name), name)
    for inner in model.iterfind("model"):
        yield from _read_model(inner, frame @ _read_pose(inner, "model", name), depth + 1)


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


def _read_pose(element: Element, kind: str, model: str) -> SdfFrame:
    """The frame of a model, link or collision in its parent's."""
    pose = element.find("pose")
    if pose is None or not (pose.text or "").strip():
        return SdfFrame()
    base = pose.get("relative_to") or pose.get("frame") or ""
    if base not in ("", {"model": "world", "link": "__model__"}.get(kind, "")):
        raise WorldError(f"model {model}: a pose is relative to {_brief(base)}, not to its parent")
    if pose.get("rotation_format", "euler_rpy") != "euler_rpy":
        raise WorldError(f"model {model}: a rotation isn't roll, pitch and yaw")
    x, y, z, *angles = _read_numbers(pose, "pose", 6, model)
    if pose.get("degrees", "").strip() in ("true", "1"):
        angles = list(map(math.radians, angles))
    roll, pitch = (abs(math.remainder(angle, math.tau)) for angle in angles[:2])
    return SdfFrame(x, y, z, angles[2], max(roll, pitch) > MAX_TILT)


def _read_numbers(element: Element, what: str, count: int, model: str) -> list[float]:
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


def _read_sizes(shape: Element, what: str, count: int, model: str) -> list[float]:
    element = shape.find(what)
    if element is None:
        raise WorldError(f"model {model}: its {shape.tag} has no <{what}>")
    numbers = _read_numbers(element, what, count, model)
    if min(numbers) < 0.0:
        raise WorldError(f"model {model}: {what} must not be negative, is {min(numbers):g}")
    return numbers


def _read_body(body: Element, frame: SdfFrame, model: str) -> Shape:
    """A collision body seen from above; empty where the robot can't touch it."""
    geometry = body.find("geometry")
    shape = None if geometry is None else next(iter(geometry), None)
    circles: list[list[float]] = []
    segments: list[list[float]] = []
    height = 0.0
    if shape is None or shape.tag == "empty":
        return [], []
    if shape.tag in ("cylinder", "sphere"):
        (radius,) = _read_sizes(shape, "radius", 1, model)
        circles = [[frame.x, frame.y, radius]]
        is_sphere = shape.tag == "sphere"
        height = 2.0 * radius if is_sphere else _read_sizes(shape, "length", 1, model)[0]
    elif shape.tag == "box":
        length, width, height = _read_sizes(shape, "size", 3, model)
        signs = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))
        corners = [frame @ SdfFrame(sx * length / 2.0, sy * width / 2.0) for sx, sy in signs]
        pairs = zip(corners, corners[1:] + corners[:1], strict=True)
        segments = [[one.x, one.y, two.x, two.y] for one, two in pairs]
    elif shape.tag == "plane":
        normal = shape.find("normal")
        up = [0.0, 0.0, 1.0] if normal is None else _read_numbers(normal, "normal", 3, model)
        if frame.tilted or math.hypot(*up[:2]) > MAX_TILT * abs(up[2]):
            raise WorldError(f"model {model}: a plane must be level: replace it by a box")
    else:
        raise WorldError(
            f"model {model}: a {shape.tag} can't be read: replace it by cylinders and boxes"
        )
    if frame.tilted:
        raise WorldError(f"model {model}: is tilted: only bodies that stand upright can be read")
    reached = frame.z - height / 2.0 <= HEADROOM and frame.z + height / 2.0 > STEP_HEIGHT
    return (circles, segments) if reached else ([], [])
