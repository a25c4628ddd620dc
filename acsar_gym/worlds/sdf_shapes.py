"""The outline of a body of a Gazebo world on the floor, where the robot and its LiDAR meet it.

Bodies that end below STEP_HEIGHT or begin above HEADROOM are left out. Upright cylinders and boxes
count with their whole base, spheres where they are widest within reach, and everything else by its
section at the LiDAR's height; what doesn't reach that height, by its shadow.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from acsar_gym.errors import WorldError
from acsar_gym.worlds import meshes
from acsar_gym.worlds.world import MAX_COORDINATE, Floats

Matrix = Floats  # (4, 4): a frame in another one
Shape = tuple[list[list[float]], list[list[float]]]  # circles and segments
LIDAR_HEIGHT = 0.37  # height of the LiDAR of the preset acsar [m]
HEADROOM = 0.5  # a body that begins above this height can't touch the robot or its LiDAR's rays [m]
STEP_HEIGHT = 0.01  # the robot drives over a body that isn't higher than this [m]
MAX_TILT = 0.01  # a body that is tilted less than this counts as upright [rad]
CIRCLE_POINTS = 32  # corners of a circle that becomes a polygon


class ShapeReader:
    """Reads the outlines of bodies at a LiDAR's height; `find_mesh` finds meshes by URI."""

    def __init__(self, height: float, find_mesh: Callable[[str, Path | None], Path | None]) -> None:
        self._height = height
        self._top = max(HEADROOM, height)
        self._find_mesh = find_mesh
        self._meshes: dict[tuple[Path, str, bool], meshes.Mesh] = {}

    def read(
        self,
        geometry: Element | None,
        frame: Matrix,
        scale: Sequence[float],
        model: str,
        folder: Path | None,
    ) -> Shape:
        """Outline a body in its frame; empty where the robot can't touch it.

        `scale` is the model's along x, y and z. WorldError where the shape can't be read.
        """
        shape = None if geometry is None else next(iter(geometry), None)
        if geometry is None or shape is None or shape.tag == "empty":
            return [], []
        if shape.tag in ("heightmap", "image"):
            raise WorldError(
                f"{model}: a {shape.tag} is uneven ground, and the robot's floor is level: replace "
                "it by cylinders and boxes"
            )
        is_tilted = math.hypot(*frame[:2, 2]) > MAX_TILT
        if shape.tag == "sphere" or (shape.tag == "capsule" and not is_tilted):
            return self._outline_round(shape, frame, scale, model)
        if shape.tag == "polyline":  # and its holes
            lines = geometry.findall("polyline")
            rings = [self._outline_polyline(line, frame, scale, model) for line in lines]
            return [], [segment for ring in rings for segment in ring]
        if shape.tag == "mesh":
            return self._outline_mesh(shape, frame, scale, model, folder)
        return self._outline_solid(shape, frame, scale, model)

    def _is_reached(self, bottom: float, top: float) -> bool:
        return bottom <= self._top and top > STEP_HEIGHT

    def _outline_solid(
        self, shape: Element, frame: Matrix, scale: Sequence[float], model: str
    ) -> Shape:
        """Outline a box, cylinder, ellipsoid, cone or tilted capsule; a level plane is floor."""
        wide = max(scale[:2])
        x, y, z = map(float, frame[:3, 3])
        is_upright = abs(frame[2, 2]) >= math.cos(MAX_TILT)
        if shape.tag == "box":
            size = np.array(_read_sizes(shape, "size", 3, model)) * scale
            if is_upright:
                if not self._is_reached(z - size[2] / 2.0, z + size[2] / 2.0):
                    return [], []
                signs = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
                corners = signs * size[:2] / 2.0 @ frame[:2, :2].T + frame[:2, 3]
                return [], _ring(corners)
            points = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T * size
        elif shape.tag in ("cylinder", "cone", "capsule"):
            radius = _read_sizes(shape, "radius", 1, model)[0] * wide
            half = _read_sizes(shape, "length", 1, model)[0] * scale[2] / 2.0
            if is_upright and shape.tag == "cylinder":
                reached = self._is_reached(z - half, z + half)
                return ([[x, y, radius]] if reached else []), []
            if shape.tag == "capsule":
                end = np.array([0.0, 0.0, half])
                points = np.concatenate([_ball() * radius - end, _ball() * radius + end])
            else:
                tip = radius if shape.tag == "cylinder" else 0.0
                rings = ((radius, -half), (tip, half))
                points = np.concatenate([_circle(r, height) for r, height in rings])
        elif shape.tag == "ellipsoid":
            points = _ball() * _read_sizes(shape, "radii", 3, model) * scale
        elif shape.tag == "plane":
            _check_plane(shape, frame, model)
            return [], []
        else:
            raise WorldError(
                f"{model}: a {shape.tag} can't be read: replace it by cylinders and boxes"
            )
        points = points @ frame[:3, :3].T + frame[:3, 3]
        bottom, top = float(points[:, 2].min()), float(points[:, 2].max())
        if not self._is_reached(bottom, top):
            return [], []
        low, high = self._slab(bottom, top)
        return [], _ring(convex_hull(cut_convex(points, low, high)))

    def _slab(self, bottom: float, top: float) -> tuple[float, float]:
        """Between which heights a body counts: at the LiDAR's, or else within reach [m]."""
        if bottom < self._height < top:
            return self._height, self._height
        return STEP_HEIGHT, self._top

    def _outline_round(
        self, shape: Element, frame: Matrix, scale: Sequence[float], model: str
    ) -> Shape:
        """Outline a sphere or an upright capsule."""
        radius = _read_sizes(shape, "radius", 1, model)[0] * max(scale[:2])
        length = 0.0
        if shape.tag == "capsule":
            length = _read_sizes(shape, "length", 1, model)[0] * scale[2]
        half = length / 2.0 + radius
        bottom, top = float(frame[2, 3]) - half, float(frame[2, 3]) + half
        if not self._is_reached(bottom, top):
            return [], []
        low, high = self._slab(bottom, top) if length > 0.0 else (STEP_HEIGHT, self._top)
        reach = half - radius
        gap = max(frame[2, 3] - reach - high, low - frame[2, 3] - reach, 0.0)
        across = math.sqrt(max(radius**2 - gap**2, 0.0))
        return [[float(frame[0, 3]), float(frame[1, 3]), across]], []

    def _outline_polyline(
        self, shape: Element, frame: Matrix, scale: Sequence[float], model: str
    ) -> list[list[float]]:
        """Outline an extruded polygon."""
        if abs(frame[2, 2]) < math.cos(MAX_TILT):
            raise WorldError(f"{model}: a polyline is tilted: replace it by boxes")
        height = _read_sizes(shape, "height", 1, model)[0] * scale[2] * np.sign(frame[2, 2])
        bottom, top = sorted([float(frame[2, 3]), float(frame[2, 3] + height)])
        points = [read_numbers(point, "point", 2, model) for point in shape.iterfind("point")]
        if len(points) < 3 or not self._is_reached(bottom, top):
            return []
        corners = np.array(points) * scale[:2]
        return _ring(corners @ frame[:2, :2].T + frame[:2, 3])

    def _outline_mesh(
        self,
        shape: Element,
        frame: Matrix,
        scale: Sequence[float],
        model: str,
        folder: Path | None,
    ) -> Shape:
        """Outline a mesh at the LiDAR's height, or where it is within reach."""
        uri = (shape.findtext("uri") or "").strip()
        path = self._find_mesh(uri, folder)
        if path is None:
            raise WorldError(
                f"{model}: there is no mesh {uri!r}: name its folder with --models FOLDER"
            )
        submesh = (shape.findtext("submesh/name") or "").strip()
        centred = (shape.findtext("submesh/center") or "").strip() in ("true", "1")
        key = path, submesh, centred
        if key not in self._meshes:
            try:
                self._meshes[key] = meshes.read_mesh(path, submesh, centred=centred)
            except WorldError as error:
                raise WorldError(f"{model}: mesh {path.name!r}: {error}") from error
        factors = np.array(scale)
        if shape.find("scale") is not None:
            factors = factors * read_numbers(shape.find("scale"), "scale", 3, model)
        mesh = self._meshes[key]
        vertices = mesh.vertices * factors @ frame[:3, :3].T + frame[:3, 3]
        if not (np.abs(vertices) <= MAX_COORDINATE).all():
            raise WorldError(f"{model}: mesh {path.name!r}: is too large")
        bottom, top = float(vertices[:, 2].min()), float(vertices[:, 2].max())
        if not self._is_reached(bottom, top):
            return [], []
        segments = np.zeros((0, 4))
        if bottom < self._height < top:
            segments = meshes.cut_mesh(vertices, mesh.faces, [self._height])
        if not len(segments):
            low, high = max(bottom, STEP_HEIGHT), min(top, self._top)
            heights = low + (high - low) * (np.arange(5) + 0.5) / 5
            segments = meshes.cut_mesh(vertices, mesh.faces, heights.tolist())
        return [], segments.tolist()


def cut_convex(points: Floats, low: float, high: float) -> Floats:
    """The corners (m, 2) of a convex body (n, 3) between two heights, seen from above [m].

    Their convex hull is the shadow; the heights may be the same one for a section.
    """
    heights = points[:, 2]
    corners = [points[(heights >= low) & (heights <= high), :2]]
    for level in {low, high}:
        above, below = points[heights > level], points[heights < level]
        share = (level - below[:, 2]) / (above[:, None, 2] - below[:, 2])
        crossing = below[:, :2] + share[..., None] * (above[:, None, :2] - below[:, :2])
        corners.append(crossing.reshape(-1, 2))
    return np.concatenate(corners)


def convex_hull(points: Floats) -> Floats:
    """The corners of the convex hull of points (n, 2), counterclockwise, by Andrew's chains."""

    def chain(ordered: list[list[float]]) -> list[list[float]]:
        kept: list[list[float]] = []
        for x, y in ordered:
            while len(kept) > 1:
                (ax, ay), (bx, by) = kept[-2:]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 1e-12:
                    break
                kept.pop()
            kept.append([x, y])
        return kept[:-1]

    rows = np.unique(np.round(points, 9), axis=0).tolist()
    return np.array(chain(rows) + chain(rows[::-1]) or rows).reshape(-1, 2)


def read_numbers(element: Element | None, what: str, count: int, model: str) -> list[float]:
    """The numbers in an element; WorldError where they aren't so many finite ones."""
    text = "" if element is None else element.text or ""
    try:
        numbers = [float(word) for word in text.split(None, count)]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(abs(number) <= MAX_COORDINATE for number in numbers):
        raise WorldError(
            f"{model}: {what} must be {count} finite number{'s' if count > 1 else ''} of at "
            f"most {MAX_COORDINATE:g}, is {text.strip()[:40]!r}"
        )
    return numbers


def _read_sizes(shape: Element, what: str, count: int, model: str) -> list[float]:
    element = shape.find(what)
    if element is None:
        raise WorldError(f"{model}: its {shape.tag} has no <{what}>")
    numbers = read_numbers(element, what, count, model)
    if min(numbers) < 0.0:
        raise WorldError(f"{model}: {what} must not be negative, is {min(numbers):g}")
    return numbers


def _check_plane(shape: Element, frame: Matrix, model: str) -> None:
    normal = shape.find("normal")
    up = np.array([0.0, 0.0, 1.0] if normal is None else read_numbers(normal, "normal", 3, model))
    if abs(float(frame[2, :3] @ up)) < math.cos(MAX_TILT) * float(np.linalg.norm(up)):
        raise WorldError(f"{model}: a plane must be level: replace it by a box")


def _circle(radius: float, height: float = 0.0) -> Floats:
    """(CIRCLE_POINTS, 3)."""
    angles = math.tau * np.arange(CIRCLE_POINTS) / CIRCLE_POINTS
    heights = np.full(CIRCLE_POINTS, height)
    return np.column_stack([radius * np.cos(angles), radius * np.sin(angles), heights])


def _ball() -> Floats:
    """(n, 3): points of a ball of radius 1."""
    angles = np.linspace(-math.pi / 2.0, math.pi / 2.0, CIRCLE_POINTS // 2 + 1)
    return np.concatenate([_circle(math.cos(angle), math.sin(angle)) for angle in angles])


def _ring(corners: Floats) -> list[list[float]]:
    """Segments from each corner to the next one, and back to the first."""
    ring: list[list[float]] = np.column_stack([corners, np.roll(corners, -1, axis=0)]).tolist()
    return ring if len(corners) > 2 else ring[: len(corners) - 1]
