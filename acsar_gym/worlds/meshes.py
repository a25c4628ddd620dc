"""Outlines of meshes at a height: COLLADA, STL and OBJ, read by pycollada and trimesh."""

from __future__ import annotations

import importlib
import io
import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.errors import WorldError, require_extra
from acsar_gym.worlds.world import Floats

MESH_SUFFIXES = (".dae", ".stl", ".obj")
MAX_MESH_BYTES = 64_000_000  # most bytes of a mesh's file
MAX_PARTS = 100_000  # most parts of a COLLADA file, instances counted each time
JOINT_TOLERANCE = 1e-4
"""Ends of two pieces of an outline that are nearer than this are one corner [m]."""
OUTLINE_TOLERANCE = 0.005  # how far a simplified outline may lie from the mesh's own [m]


class Mesh(NamedTuple):
    """Triangles in the frame of a file."""

    vertices: Floats
    """(vertices, 3) [m]."""
    faces: NDArray[np.int64]
    """(faces, 3): numbers of vertices."""


def read_mesh(path: Path, submesh: str = "", *, centred: bool = False) -> Mesh:
    """Read a mesh as Gazebo does: in the file's unit, with z up whatever it says.

    `submesh` is the name of the only part that counts, `centred` whether it is moved to the origin.
    WorldError where it can't be read, is too large, or has no such part.
    """
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise WorldError(f"a mesh is read from {', '.join(MESH_SUFFIXES)}")
    trimesh, collada = _import_readers()
    data = reading.read_content(path, MAX_MESH_BYTES, WorldError)
    if suffix == ".dae" and (b"<!DOCTYPE" in data or b"<!ENTITY" in data or b"\0" in data):
        raise WorldError("has a document type or entities, which are refused: remove them")
    try:
        if suffix == ".dae":
            parts = _list_collada(collada, data, submesh)
        else:
            parts = _list_parts(trimesh, data, suffix[1:], submesh)
    except Exception as error:  # the parsers raise all kinds for broken files
        raise WorldError(f"isn't a sound {suffix[1:].upper()} file: save it again") from error
    if not parts:
        raise WorldError(f"has no part {submesh!r}" if submesh else "has no triangles")
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + offset for part, offset in zip(parts, offsets, strict=False)]
    mesh = Mesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))
    if not np.isfinite(mesh.vertices).all() or mesh.faces.max() >= len(mesh.vertices):
        raise WorldError(f"isn't a sound {suffix[1:].upper()} file: save it again")
    if centred:
        middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2.0
        return Mesh(mesh.vertices - middle, mesh.faces)
    return mesh


def _import_readers() -> tuple[Any, Any]:
    """The libraries trimesh and collada, which are slow to import."""
    with require_extra("a world with meshes", "meshes"):
        return importlib.import_module("trimesh"), importlib.import_module("collada")


def _list_parts(trimesh: Any, data: bytes, kind: str, submesh: str) -> list[Mesh]:
    """The parts of an STL or OBJ file."""
    options = {"skip_materials": True} if kind == "obj" else {}
    scene = trimesh.load(io.BytesIO(data), file_type=kind, force="scene", process=False, **options)
    return [
        Mesh(np.asarray(part.vertices), np.asarray(part.faces, np.int64))
        for name, part in scene.geometry.items()
        if submesh in ("", name) and len(getattr(part, "faces", ()))
    ]


def _list_collada(collada: Any, data: bytes, submesh: str) -> list[Mesh]:
    """The parts of a COLLADA file's scene; a part is a geometry or a node by its name."""
    document = collada.Collada(io.BytesIO(data), ignore=[collada.common.DaeError])
    unit = float(document.assetInfo.unitmeter or 1.0)
    parts: list[Mesh] = []
    waiting = [(node, np.eye(4), "") for node in document.scene.nodes]
    while waiting:
        node, frame, name = waiting.pop()
        if isinstance(node, collada.scene.GeometryNode):
            if submesh not in ("", name, node.geometry.id, node.geometry.name):
                continue
            for primitive in node.geometry.primitives:
                shape = primitive
                if isinstance(shape, collada.polylist.Polylist):  # polygons are one, too
                    shape = shape.triangleset()
                if isinstance(shape, collada.triangleset.TriangleSet) and shape.vertex is not None:
                    vertices = shape.vertex @ frame[:3, :3].T + frame[:3, 3]
                    parts.append(Mesh(vertices * unit, np.asarray(shape.vertex_index, np.int64)))
        elif isinstance(node, collada.scene.Node):
            inner = node.xmlnode.get("name") or node.xmlnode.get("id") or name
            waiting += [(child, frame @ node.matrix, inner) for child in node.children]
        if len(parts) + len(waiting) > MAX_PARTS:
            raise ValueError("too many parts")
    return [part for part in parts if len(part.faces)]


def cut_mesh(vertices: Floats, faces: NDArray[np.int64], heights: Sequence[float]) -> Floats:
    """The outline of a mesh at some heights, seen from above, (segments, 4) [m]."""
    trimesh, _ = _import_readers()
    mesh = trimesh.Trimesh(vertices, faces, process=False, validate=False)
    outlines = [np.zeros((0, 4))]
    for height in heights:
        # A little off round numbers, where faces and corners would lie in the plane of the cut.
        lines = trimesh.intersections.mesh_plane(mesh, (0.0, 0.0, 1.0), (0.0, 0.0, height + 1e-7))
        outlines.append(simplify_outline(np.asarray(lines)[:, :, :2].reshape(-1, 4)))
    return np.unique(np.concatenate(outlines), axis=0)  # an upright wall is the same at each


def simplify_outline(segments: Floats) -> Floats:
    """Join pieces of an outline (n, 4); leave out corners within OUTLINE_TOLERANCE."""
    ends = np.round(segments.reshape(-1, 2) / JOINT_TOLERANCE).astype(np.int64)
    corners, numbers = np.unique(ends, axis=0, return_inverse=True)
    neighbours: dict[int, set[int]] = defaultdict(set)
    for one, other in numbers.reshape(-1, 2).tolist():
        if one != other:
            neighbours[one].add(other)
            neighbours[other].add(one)
    # Chains end where other than two pieces meet; then only closed ones are left.
    firsts = sorted(neighbours, key=lambda corner: len(neighbours[corner]) == 2)
    rows: list[list[float]] = []
    for first in firsts:
        while neighbours[first]:
            chain = [first]
            while neighbours[chain[-1]] and (len(chain) == 1 or chain[-1] != first):
                following = neighbours[chain[-1]].pop()
                neighbours[following].discard(chain[-1])
                chain.append(following)
                if len(neighbours[following]) != 1:
                    break
            points: Floats = np.asarray(corners[chain] * JOINT_TOLERANCE, np.float64)
            kept = _keep_corners(points)
            rows += np.column_stack([points[kept[:-1]], points[kept[1:]]]).tolist()
    return np.array(rows).reshape(-1, 4)


def _keep_corners(points: Floats) -> list[int]:
    """The corners of a chain that Douglas and Peucker's rule keeps."""
    kept = {0, len(points) - 1}
    pieces = [(0, len(points) - 1)]
    while pieces:
        first, last = pieces.pop()
        if last - first < 2:
            continue
        inner = points[first + 1 : last] - points[first]
        way = points[last] - points[first]
        length = math.hypot(*way)
        if length > 0.0:
            share = np.clip(inner @ way / length**2, 0.0, 1.0)
            inner = inner - share[:, None] * way
        away = np.hypot(inner[:, 0], inner[:, 1])
        farthest = int(away.argmax())
        if away[farthest] > OUTLINE_TOLERANCE:
            middle = first + 1 + farthest
            kept.add(middle)
            pieces += [(first, middle), (middle, last)]
    return sorted(kept)
