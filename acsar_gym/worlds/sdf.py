"""Read the obstacles of a Gazebo world: the collision geometry of its models, seen from above.

Lengths in m and angles in rad, as in SDF 1.4 to 1.12. Frames are those of
http://sdformat.org/tutorials?tut=pose_frame_semantics; where a world of Gazebo classic has a
`<state>`, its poses and scales of models replace the models' own, as in Gazebo. Included models are
read from local folders. `sdf_shapes` says which outline a body has.

What moves in Gazebo moves here, if it is said where: actors by their scripts, and models by plugins
whose C++ source is there, see `sdf_motions`. Others are named: they stand still, or aren't there.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import NamedTuple
from urllib.parse import unquote
from xml.etree.ElementTree import Element, ParseError

import defusedxml.ElementTree
import numpy as np
from defusedxml.common import DefusedXmlException

from acsar_gym import reading
from acsar_gym.errors import WorldError
from acsar_gym.worlds import sdf_motions
from acsar_gym.worlds.movers import Mover
from acsar_gym.worlds.sdf_shapes import (
    LIDAR_HEIGHT,
    Matrix,
    ShapeReader,
    read_numbers,
)
from acsar_gym.worlds.world import Floats

MAX_SDF_BYTES = 64_000_000  # most bytes of an SDF file
MAX_TAGS = 2_500_000  # most tags of a file; a world of 20,000 cylinders as in BARN has 2 million
MAX_BODIES = 100_000  # most bodies of a world, those of included files counted each time
MAX_INCLUDES = 10_000  # most models that are included, likewise
MAX_NESTED_MODELS = 10
MAX_FRAME_CHAIN = 100  # most frames of which each is given relative to the next
HARMLESS_MODELS = ("sun", "ground_plane")
"""Models that nearly every world includes, and that are no obstacles."""
RESTING_PLUGINS = (
    "altimeter|barometer|battery|bumper|camera|contact|depth|detachable|gps|gpu|imu|ir|label|laser|"
    "lidar|light|logger|magnetometer|monitor|odometry|p3d|particle|publisher|range|ray|sensors?|"
    "shader|sonar|thermal|touch|video|visual|wrench"
)
"""Words in the names of plugins that measure, show or tell something, but don't move a model."""
UNFOUND_MODELS = 5  # most models that one message lists as missing


class SdfObstacles(NamedTuple):
    """What is read from a Gazebo world."""

    circles: Floats
    """(C, 3) [m]."""
    segments: Floats
    """(S, 4) [m]."""
    movers: tuple[Mover, ...]
    standing: tuple[str, ...]
    """Models that a plugin moves in Gazebo, in words; they stand where they begin."""
    actors: tuple[str, ...]
    """Actors without a script, in words; they are left out."""

    def describe_unmoved(self) -> str:
        """What moves in Gazebo, but not here, and how it is here; empty where nothing does."""
        notes = []
        if self.standing:
            stand = "stand where they begin" if len(self.standing) > 1 else "stands where it begins"
            notes.append(f"{', '.join(self.standing)} {stand}")
        if self.actors:
            verb = "are" if len(self.actors) > 1 else "is"
            notes.append(f"{', '.join(self.actors)} {verb} left out")
        return "; ".join(notes)


def read_obstacles(
    data: bytes,
    folder: Path | None = None,
    model_folders: Sequence[Path] = (),
    height: float = LIDAR_HEIGHT,
) -> SdfObstacles:
    """Read the obstacles of an SDF file's content.

    `folder` is the file's, where relative paths begin; included models and meshes are looked for in
    `model_folders`. WorldError names the model that can't be read.
    """
    return _WorldReader(model_folders, height).read(parse_xml(data), folder)


def parse_xml(data: bytes) -> Element:
    """Parse XML; WorldError for what would take long or much memory, and what isn't XML."""
    if data.count(b"<") > MAX_TAGS:
        raise WorldError("holds too many XML elements: cut out a part of it")
    data = data.replace(b"<pose frame=>", b"<pose>")  # as DynaBARN's generator writes walls
    try:
        root: Element = defusedxml.ElementTree.fromstring(data, forbid_dtd=True)
    except DefusedXmlException as error:
        raise WorldError(
            "has a document type or entities, which are refused: remove them"
        ) from error
    except (ParseError, ValueError, LookupError, AssertionError) as error:
        raise WorldError(f"not valid XML: {' '.join(str(error).split())}") from error
    return root


@dataclass
class _Model:
    """A model, or the world itself: what the names in it mean."""

    name: str
    element: Element
    pose: Element | None = None
    """Its pose in its parent; None: at the parent's origin."""
    placement: str = ""
    """The frame in it that `pose` places; empty: its own."""
    folder: Path | None = None
    """Of its file."""
    scale: tuple[float, ...] = (1.0, 1.0, 1.0)
    """Of its shapes."""
    plugins: list[Element] = field(default_factory=list)
    children: dict[str, _Model] = field(default_factory=dict)
    merged: list[_Model] = field(default_factory=list)
    """Children whose names count as its own."""
    frames: dict[str, Element] = field(default_factory=dict)
    """Links, joints and explicit frames."""
    resolved: dict[str, Matrix] = field(default_factory=dict)
    pending: list[str] = field(default_factory=list)
    """Names whose frame is being looked for."""

    @property
    def described(self) -> str:
        """Its kind and name, for messages."""
        return f"model {self.name!r}" if self.name else "the world"

    def find(self, name: str, whose: str = "") -> Matrix:
        """The frame of a name in this model's frame; messages say `whose` pose is in it."""
        if name in ("", "__model__") or (name == "world" and not self.name):
            return np.eye(4)
        if name not in self.resolved:
            if name in self.pending or len(self.pending) > MAX_FRAME_CHAIN:
                raise WorldError(f"{self.described}: frames are relative to each other in a circle")
            self.pending.append(name)
            self.resolved[name] = self._find(name, whose or self.described)
            self.pending.pop()
        return self.resolved[name]

    def _find(self, name: str, whose: str) -> Matrix:
        if name in self.children:
            return self.place_child(self.children[name])
        element = self.frames.get(name)
        if element is not None:
            default = element.get("attached_to", "") if element.tag == "frame" else ""
            default = element.findtext("child", "").strip() if element.tag == "joint" else default
            return self.place(element.find("pose"), default)
        child, _, inner = name.partition("::")
        if inner and child in self.children:
            return self.place_child(self.children[child]) @ self.children[child].find(inner)
        for model in self.merged:
            if name in model.frames or name in model.children:
                return self.place_child(model) @ model.find(name)
        raise WorldError(
            f"{whose}: a pose is relative to {name!r}, which isn't in {self.described}"
        )

    def place(self, pose: Element | None, default: str = "", whose: str = "") -> Matrix:
        """A pose in this model's frame, given in the frame `default` unless it names another."""
        base = "" if pose is None else pose.get("relative_to") or pose.get("frame") or ""
        return self.find(base or default, whose) @ _read_pose(pose, whose or self.described)

    def place_child(self, child: _Model) -> Matrix:
        """The frame of a model that is in this one."""
        placed = self.place(child.pose, whose=child.described)
        return placed @ np.linalg.inv(child.find(child.placement)) if child.placement else placed


def _read_pose(pose: Element | None, model: str) -> Matrix:
    """A pose as a matrix; the identity where there is none."""
    matrix = np.eye(4)
    if pose is None or not (pose.text or "").strip():
        return matrix
    if pose.get("rotation_format", "euler_rpy") == "quat_xyzw":
        x, y, z, *quaternion = read_numbers(pose, "pose", 7, model)
        length = math.hypot(*quaternion)
        if not length > 0.0:
            raise WorldError(f"{model}: a quaternion of a pose is zero")
        qx, qy, qz, qw = (number / length for number in quaternion)
        cross = np.array([[0.0, -qz, qy], [qz, 0.0, -qx], [-qy, qx, 0.0]])
        matrix[:3, :3] += 2.0 * (qw * cross + cross @ cross)
    else:
        x, y, z, *angles = read_numbers(pose, "pose", 6, model)
        if pose.get("degrees", "").strip() in ("true", "1"):
            angles = list(map(math.radians, angles))
        matrix[:3, :3] = _turn(angles)
    matrix[:3, 3] = x, y, z
    return matrix


def _turn(angles: Sequence[float]) -> Floats:
    """The rotation by roll, pitch and yaw [rad] about fixed axes, (3, 3)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles), np.sin(angles)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


class _WorldReader:
    """Reads one world, and the files that it includes."""

    def __init__(self, model_folders: Sequence[Path], height: float) -> None:
        self._model_folders = model_folders
        self._shapes = ShapeReader(height, self._find_mesh)
        self._bodies = 0
        self._includes = 0
        self._files: dict[Path, Element] = {}
        self._missing: list[str] = []
        self._movers: list[Mover] = []
        self._standing: list[str] = []
        self._actors: list[str] = []

    def read(self, root: Element, folder: Path | None) -> SdfObstacles:
        """Read the obstacles of a file's root element."""
        worlds = root.findall("world")
        if root.tag != "sdf" or len(worlds) > 1:
            raise WorldError("not an SDF file of one <world>")
        element = worlds[0] if worlds else root
        if element.find("population") is not None:
            raise WorldError("has a <population>, which can't be read: place its models one by one")
        world = _Model("", element, folder=folder)
        self._read_children(world, [element, *element.iterfind("state/insertions")], 0)
        for state in element.iterfind("state/model"):
            model = world.children.get(state.get("name", ""))
            if model is not None and state.find("pose") is not None:
                model.pose, model.placement = state.find("pose"), ""
            if model is not None and (scale := state.find("scale")) is not None:
                model.scale = tuple(read_numbers(scale, "scale", 3, model.described))
        if self._missing:
            names = ", ".join(self._missing[:UNFOUND_MODELS])
            others = len(self._missing) - UNFOUND_MODELS
            raise WorldError(
                f"includes {names}{f' and {others} others' if others > 0 else ''}, which no model "
                "folder has: name the folder with --models FOLDER or in GZ_SIM_RESOURCE_PATH "
                "(models of Fuel must be downloaded), or write it out"
            )
        circles: list[list[float]] = []
        segments: list[list[float]] = []
        for some_circles, some_segments in self._outline(world, np.eye(4), ""):
            circles += some_circles
            segments += some_segments
        return SdfObstacles(
            np.array(circles).reshape(-1, 3),
            np.array(segments).reshape(-1, 4),
            tuple(self._movers),
            tuple(self._standing),
            tuple(self._actors),
        )

    def _read_children(self, parent: _Model, elements: Sequence[Element], depth: int) -> None:
        """Find the frames and models that a model or the world has."""
        if depth > MAX_NESTED_MODELS:
            raise WorldError(f"{parent.described}: models are nested too deeply")
        for element in elements:
            for tag in ("link", "joint", "frame"):
                for inner in element.iterfind(tag):
                    parent.frames[inner.get("name", "")] = inner
            for actor in element.iterfind("actor"):
                self._read_actor(actor, actor.get("name", ""))
            for inner in element.iterfind("model"):
                placement = inner.get("placement_frame", "")
                pose = inner.find("pose")
                name = inner.get("name", "")
                model = _Model(name, inner, pose, placement, parent.folder)
                self._add_child(parent, model, [], depth)
            for include in element.iterfind("include"):
                self._include(parent, include, depth)

    def _add_child(
        self, parent: _Model, model: _Model, plugins: Sequence[Element], depth: int
    ) -> None:
        model.plugins = [*model.element.findall("plugin"), *plugins]
        key = model.name
        while key in parent.children:  # Gazebo renames, too
            key = f"{model.name}_{len(parent.children)}"
        parent.children[key] = model
        self._read_children(model, [model.element], depth + 1)

    def _include(self, parent: _Model, include: Element, depth: int) -> None:
        """Add the model of an <include>."""
        uri = (include.findtext("uri") or "").strip()
        parts = _split_uri(uri)
        names = {part.lower().replace(" ", "_") for part in (*parts[:1], *parts[-1:])}
        if not names.isdisjoint(HARMLESS_MODELS):
            return
        path = self._find_model(uri, parent.folder)
        if path is None:
            of_fuel = uri.startswith(("http://", "https://")) and parts
            name = f"{parts[0]!r} of Fuel" if of_fuel else repr(uri)
            if name not in self._missing:
                self._missing.append(name)
            return
        self._includes += 1
        if self._includes > MAX_INCLUDES:
            raise WorldError(f"includes more than {MAX_INCLUDES:,} models: cut out a part of it")
        root = self._read_file(path)
        name = (include.findtext("name") or "").strip()
        element = root.find("model")
        if element is None:
            actors = root.findall("actor")
            if not actors and root.find("light") is None:
                raise WorldError(f"included {str(path)!r}: holds no model")
            for actor in actors:
                self._read_actor(actor, name or actor.get("name", ""))
            return
        pose, placement = element.find("pose"), element.get("placement_frame", "")
        if include.find("pose") is not None:
            pose, placement = include.find("pose"), ""
        placement = (include.findtext("placement_frame") or placement).strip()
        model = _Model(name or element.get("name", ""), element, pose, placement, path.parent)
        if include.get("merge", "") in ("true", "1"):
            parent.merged.append(model)
        self._add_child(parent, model, include.findall("plugin"), depth)

    def _read_actor(self, actor: Element, name: str) -> None:
        """Make a mover of an actor; one without a script is left out, and named."""
        mover = sdf_motions.read_actor(actor, name)
        if mover is None:
            self._actors.append(f"actor {name!r}")
        else:
            self._movers.append(mover)

    def _read_file(self, path: Path) -> Element:
        """The root element of a file, which is read once."""
        if path not in self._files:
            try:
                content = reading.read_content(path, MAX_SDF_BYTES, WorldError)
                self._files[path] = parse_xml(content)
            except WorldError as error:
                raise WorldError(f"included {str(path)!r}: {error}") from error
        return self._files[path]

    def _find_model(self, uri: str, folder: Path | None) -> Path | None:
        """The SDF file of an included model; None where it isn't here."""
        for path in self._list_places(uri, folder):
            if path.is_file():
                return path
            place = path
            versions = [inner for inner in place.iterdir() if inner.name.isdecimal()]
            if versions and not (place / "model.sdf").is_file():  # as Fuel's are kept on disk
                place = max(versions, key=lambda inner: int(inner.name))
            names = {}
            if (place / "model.config").is_file():
                for sdf in self._read_file(place / "model.config").iterfind("sdf"):
                    version = tuple(map(int, re.findall(r"\d+", sdf.get("version", ""))))
                    names[version] = (sdf.text or "").strip()
            file = place / (names[max(names)] if names else "model.sdf")
            if file.is_file():
                return file
        return None

    def _find_mesh(self, uri: str, folder: Path | None) -> Path | None:
        """The file of a mesh; None where it isn't here."""
        return next((path for path in self._list_places(uri, folder) if path.is_file()), None)

    def _list_places(self, uri: str, folder: Path | None) -> Iterator[Path]:
        """Files and folders of this name that there are, the first ones to be taken first."""
        scheme, _, path_text = uri.rpartition("://")
        parts = _split_uri(uri)
        if not parts:
            return
        candidates = []
        if scheme in ("", "file"):
            candidates += [Path(unquote(path_text))] if path_text.startswith("/") else []
            candidates += [] if folder is None else [folder.joinpath(*parts)]
        for base in self._model_folders:
            for name in (parts[0], parts[0].lower(), parts[0].lower().replace(" ", "_")):
                candidates.append(base.joinpath(name, *parts[1:]))
            around = (base.absolute(), *base.absolute().parents)
            candidates += [up.joinpath(*parts[1:]) for up in around if up.name == parts[0]]
        for path in candidates:
            with contextlib.suppress(OSError, ValueError):  # too long a name, or one with zeros
                if path.exists():
                    yield path

    def _outline(
        self, model: _Model, frame: Matrix, scope: str
    ) -> Iterator[tuple[list[list[float]], list[list[float]]]]:
        """Circles and segments of each body of a model, whose frame in the world is given.

        A model that a plugin moves along known keys becomes a mover instead.
        """
        plugins = [plugin for plugin in model.plugins if _is_mover(plugin)]
        for plugin in plugins:
            keys = sdf_motions.find_keys(plugin, self._plugin_folders(model.folder))
            if keys is not None:
                lifted = np.eye(4)
                lifted[2, 3] = keys.height
                bodies = list(self._outline_bodies(model, lifted, scope))
                self._movers += sdf_motions.move_bodies(bodies, keys, scope)
                return
        if plugins:
            self._standing.append(_describe_mover(scope, plugins[0]))
        yield from self._outline_bodies(model, frame, scope)

    def _plugin_folders(self, folder: Path | None) -> list[Path]:
        """Where the sources of plugins are looked for."""
        return [] if folder is None else [*self._model_folders, folder]

    def _outline_bodies(
        self, model: _Model, frame: Matrix, scope: str
    ) -> Iterator[tuple[list[list[float]], list[list[float]]]]:
        """`_outline`, wherever the model's plugins move it."""
        for link in model.element.iterfind("link"):
            link_frame = model.place(link.find("pose"))
            for body in link.iterfind("collision"):
                self._bodies += 1
                if self._bodies > MAX_BODIES:
                    raise WorldError(f"has more than {MAX_BODIES:,} bodies: cut out a part of it")
                pose = body.find("pose")
                if pose is not None and (pose.get("relative_to") or pose.get("frame")):
                    place = model.place(pose)
                else:
                    place = link_frame @ _read_pose(pose, model.described)
                yield self._shapes.read(
                    body.find("geometry"),
                    frame @ place,
                    model.scale,
                    model.described,
                    model.folder,
                )
        for key, child in model.children.items():
            name = f"{scope}::{key}" if scope else key
            yield from self._outline(child, frame @ model.place_child(child), name)


def _split_uri(uri: str) -> list[str]:
    """The parts of a model's or file's name: ["table", "meshes", "table.dae"]."""
    scheme, _, path_text = uri.replace("\\", "/").rpartition("://")
    parts = [part for part in PurePosixPath(unquote(path_text)).parts if part != "/"]
    if scheme in ("http", "https") and "models" in parts:  # .../models/Table/2/files/meshes/x.dae
        parts = parts[parts.index("models") + 1 :]
        inner = parts[parts.index("files") + 1 :] if "files" in parts else []
        parts = [*parts[:1], *inner]
    return parts


def _is_mover(plugin: Element) -> bool:
    """Whether a plugin may move its model, judging by its names."""
    names = f"{plugin.get('filename', '')} {plugin.get('name', '')}"
    words = re.findall(r"[A-Z]?[a-z0-9]+|[A-Z]+(?![a-z])", names)
    return not any(re.fullmatch(RESTING_PLUGINS, word.lower()) for word in words)


def _describe_mover(name: str, plugin: Element) -> str:
    file = PurePosixPath(plugin.get("filename", "")).name or plugin.get("name", "")
    return f"model {name!r} (plugin {file!r})"
