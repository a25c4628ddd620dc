"""Read and write files of worlds: Gazebo's SDF, ROS maps, and this project's JSON or YAML.

The project's own format has the fields of `World` [m, rad]:

    name: three pillars
    circles: [[2.0, 0.3, 0.1], [3.0, -0.4, 0.1]]    # x, y, radius
    segments: [[0.0, 1.0, 4.0, 1.0]]                # x1, y1, x2, y2
    start: {x: 0.0, y: 0.0, theta: 0.0}             # and radius; without theta any heading
    goal: {x: 4.0, y: 0.0}                          # and radius
    path: [[0.0, 0.0], [4.0, 0.0]]                  # optional
    movers: [{points: [[2.0, -2.0], [2.0, 2.0]], speed: 1.0}]    # optional, see `mover_files`

A YAML with an `image` is a ROS map. Neither a map nor a Gazebo world says where to start and where
to go: `start` and `goal` may be added to a map, or are given beside the file (`Placement`). Only
BARN's own worlds, known by their corridor, have BARN's start and goal, and the path in `path_N.npy`
beside `world_N.world`, or in a folder `path_files` there or above, as in BARN's own repository.
Every file that can't be used raises a WorldError of one line.
"""

from __future__ import annotations

import json
import os
import re
import warnings
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from pydantic import ConfigDict, Field, ValidationInfo, field_validator

from acsar_gym import reading
from acsar_gym.config.section import Section
from acsar_gym.errors import AcsarWarning, ConfigError, WorldError, explain_error, show_value
from acsar_gym.worlds import maps, sdf
from acsar_gym.worlds.generators import (
    BARN_CELL_SIDE,
    BARN_GOAL,
    BARN_START,
    CYLINDER_RADIUS,
    place_cylinders,
)
from acsar_gym.worlds.mover_files import format_mover, parse_movers
from acsar_gym.worlds.movers import MAX_MOVERS
from acsar_gym.worlds.sdf_shapes import LIDAR_HEIGHT
from acsar_gym.worlds.world import MAX_COORDINATE, MAX_OBSTACLES, Floats, Region, World

MAX_IMPORT_BYTES = sdf.MAX_SDF_BYTES  # most bytes of an SDF file or a picture
MODEL_VARIABLES = ("GZ_SIM_RESOURCE_PATH", "IGN_GAZEBO_RESOURCE_PATH", "GAZEBO_MODEL_PATH")
"""Environment variables in which Gazebo finds folders of models."""
MAX_TEXT_BYTES = 5_000_000
"""Most bytes of a JSON or YAML; 20,000 segments and a path of 20,000 points are 3 MB."""
BARN_CELL = 0.15  # side of a cell of a published path [m]
BARN_CORNER = (-4.575, 5.075)  # position of cell (0, 0) of a published path [m]
MISSING_ENDS = {
    (True, True): "has no start and no goal: add --start X,Y,THETA --goal X,Y",
    (True, False): "has no start: add --start X,Y,THETA",
    (False, True): "has no goal: add --goal X,Y",
}
"""Whether a file lacks a start and a goal, and what is said then."""
PLACE_FORM = re.compile(r"\s*[,\s]\s*")  # between the numbers of a place on the command line
WORLD_SUFFIXES = (".world", ".sdf", ".yaml", ".yml", ".json")

Coordinate = Annotated[float, Field(strict=True, ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
Radius = Annotated[float, Field(strict=True, ge=0.0, le=MAX_COORDINATE)]
Rows: Any = Field(default_factory=list, max_length=MAX_OBSTACLES)


class Goal(Section):
    """A goal in a file [m]."""

    section = "goal"
    x: Coordinate
    y: Coordinate
    radius: Radius | None = None


class Start(Goal):
    """A start in a file [m, rad]."""

    section = "start"
    theta: Coordinate | None = None


class WorldFile(Section):
    """The project's own format; a ROS map has further keys."""

    name: str = Field(max_length=1000)
    start: Start
    goal: Goal
    circles: list[tuple[Coordinate, Coordinate, Radius]] = Rows
    segments: list[tuple[Coordinate, Coordinate, Coordinate, Coordinate]] = Rows
    path: list[tuple[Coordinate, Coordinate]] | None = Field(None, max_length=MAX_OBSTACLES)
    movers: list[Any] = Field(default_factory=list, max_length=MAX_MOVERS)


class MapFile(WorldFile):
    """A ROS map with a start and a goal; `maps` reads the other keys."""

    model_config = ConfigDict(extra="ignore")


class Placement(Section):
    """What files of Gazebo and ROS don't say; `worlds=` takes it as a mapping, with the `path`.

    Each place is a list of numbers, or text like "1.5,-2,0.7".
    """

    section = "worlds"
    start: tuple[Coordinate, ...] | None = None
    """x, y [m] and theta [rad]; without theta any heading. None: as the file says."""
    goal: tuple[Coordinate, ...] | None = None
    """x, y [m]. None: as the file says."""
    models: str = Field("", max_length=10_000)
    """Folders of Gazebo's models, separated as in PATH; those of Gazebo's own environment variables
    and those around the file come after them."""
    height: Annotated[float, Field(gt=0.0, le=100.0)] = LIDAR_HEIGHT
    """Height of the LiDAR above the floor, at which meshes and tilted bodies are cut [m]."""

    @field_validator("start", "goal", mode="before")
    @classmethod
    def _parse_place(cls, value: Any, info: ValidationInfo) -> Any:
        """Numbers of a text, and of what else is a sequence of them."""
        if value is None:
            return None
        try:
            place = tuple(
                map(float, PLACE_FORM.split(value.strip()) if isinstance(value, str) else value)
            )
        except (TypeError, ValueError):
            place = ()
        if info.field_name == "start" and len(place) not in (2, 3):
            raise ValueError("must be X,Y or X,Y,THETA [m, rad]")
        if info.field_name == "goal" and len(place) != 2:
            raise ValueError("must be X,Y [m]")
        return place

    @property
    def start_region(self) -> Region | None:
        """Where robots start; None: as the file says."""
        if self.start is None:
            return None
        x, y, *theta = self.start
        return Region(x, y, 0.0, *theta)

    @property
    def goal_region(self) -> Region | None:
        """Where the goal is; None: as the file says."""
        return None if self.goal is None else Region(*self.goal)

    def list_model_folders(self, folder: Path) -> list[Path]:
        """Where a Gazebo world's models are looked for, in this order."""
        texts = [self.models, *(os.environ.get(name, "") for name in MODEL_VARIABLES)]
        named = [
            Path(part).expanduser() for text in texts for part in text.split(os.pathsep) if part
        ]
        return [*named, folder, folder / "models", folder.parent, folder.parent / "models"]


class FileSource(Placement):
    """A file or folder of worlds, with what it doesn't say."""

    path: Path


def load_world(path: Path | str, placement: Placement | None = None) -> World:
    """Read a world from a `.world`, `.sdf`, `.yaml`, `.yml` or `.json` file.

    WorldError where it can't be read, or nobody says where start or goal are; MissingExtraError for
    a map without Pillow, or meshes without trimesh.
    """
    path, placement = Path(path), placement or Placement()
    suffix = path.suffix.lower()
    if suffix in maps.PICTURE_SUFFIXES:
        raise WorldError(f"{path}: is a map's picture: pass the YAML that names it")
    if suffix not in WORLD_SUFFIXES:
        raise WorldError(f"{path}: a world is read from {', '.join(WORLD_SUFFIXES)}")
    try:
        if suffix in (".world", ".sdf"):
            return _read_gazebo(path, placement)
        content = reading.read_content(path, MAX_TEXT_BYTES, WorldError)
        text = reading.decode_text(content, WorldError)
        if suffix == ".json":
            return _parse_world(reading.parse_json(text, WorldError), path, placement)
        return _parse_world(reading.parse_yaml(text, WorldError), path, placement)
    except WorldError as error:
        raise WorldError(f"{path}: {error}") from error


def _read_gazebo(path: Path, placement: Placement) -> World:
    """Read a Gazebo world; warn of what moves there, but not here."""
    content = reading.read_content(path, MAX_IMPORT_BYTES, WorldError)
    obstacles = sdf.read_obstacles(
        content, path.parent, placement.list_model_folders(path.parent), placement.height
    )
    if unmoved := obstacles.describe_unmoved():
        warnings.warn(
            f"{path}: what moves in Gazebo doesn't move here: {unmoved}", AcsarWarning, stacklevel=3
        )
    start, goal, way = placement.start_region, placement.goal_region, None
    if is_barn(obstacles.circles):
        way = _barn_path(path) if start is None and goal is None else None
        start, goal = start or BARN_START, goal or BARN_GOAL
    if start is None or goal is None:
        missing = MISSING_ENDS[start is None, goal is None]
        raise WorldError(f"{missing} [m, rad] in its frame{_describe_extent(obstacles)}")
    return World(
        obstacles.circles, obstacles.segments, start, goal, way, path.stem, obstacles.movers
    )


def _describe_extent(obstacles: sdf.SdfObstacles) -> str:
    """Where the obstacles are, for who looks for a start; empty without any."""
    circles, segments = obstacles.circles, obstacles.segments.reshape(-1, 2)
    centres, radii = circles[:, :2], circles[:, 2:]
    points = np.concatenate([centres - radii, centres + radii, segments])
    if not len(points):
        return ""
    (left, low), (right, high) = points.min(axis=0), points.max(axis=0)
    return f", where obstacles are at x {left:.3g} to {right:.3g}, y {low:.3g} to {high:.3g}"


def is_barn(circles: Floats) -> bool:
    """Whether circles are those of a BARN world: its corridor's cylinders are there."""
    cylinders = circles[np.isclose(circles[:, 2], CYLINDER_RADIUS)]
    corridor = place_cylinders(np.zeros((0, 0), np.bool_))
    cells = {tuple(cell) for cell in np.rint(cylinders[:, :2] / BARN_CELL_SIDE * 2.0).tolist()}
    return all(
        tuple(cell) in cells for cell in np.rint(corridor[:, :2] / BARN_CELL_SIDE * 2.0).tolist()
    )


def load_folder(folder: Path, placement: Placement | None = None) -> list[World]:
    """Read all worlds of a folder in natural order: world_2 comes before world_10.

    WorldError for a folder without worlds or with too many, and for the first bad file.
    """
    try:
        if not folder.is_dir():
            raise WorldError(f"{folder}: there is no such folder")
        paths = [path for path in folder.iterdir() if path.suffix.lower() in WORLD_SUFFIXES]
    except OSError as error:
        raise WorldError(f"{folder}: can't be read: {explain_error(error)}") from error
    paths = [path for path in paths if not path.name.startswith(".")]
    if not paths:
        raise WorldError(f"{folder}: holds no worlds ({', '.join(WORLD_SUFFIXES)})")

    def natural(path: Path) -> tuple[list[str | int], str]:
        parts = re.split(r"(\d+)", path.name)
        return [int(part) if part.isdecimal() else part for part in parts], path.name

    return [load_world(path, placement) for path in sorted(paths, key=natural)]


def save_world(world: World, path: Path) -> None:
    """Write a world in the project's own format: `.json`, `.yaml` or `.yml`."""
    try:
        data = format_world(world, path.suffix)
    except WorldError as error:
        raise WorldError(f"{path}: {error}") from error
    reading.write_atomically(path, data, WorldError)


def format_world(world: World, suffix: str) -> bytes:
    """Format a world in the project's own format, of a suffix as `save_world`."""
    start, goal = ({"x": r.x, "y": r.y, "radius": r.radius} for r in (world.start, world.goal))
    if world.start.theta is not None:
        start["theta"] = world.start.theta
    fields: dict[str, Any] = {
        "name": world.name,
        "start": {key: float(value) for key, value in start.items()},
        "goal": {key: float(value) for key, value in goal.items()},
        "circles": world.circles.tolist(),
        "segments": world.segments.tolist(),
    }
    if world.path is not None:
        fields["path"] = world.path.tolist()
    if world.movers:
        fields["movers"] = list(map(format_mover, world.movers))
    if suffix.lower() not in (".json", ".yaml", ".yml"):
        raise WorldError("a world is saved as .json, .yaml or .yml")
    try:
        if suffix.lower() == ".json":
            lines = [f"  {json.dumps(key)}: {_format_json(value)}" for key, value in fields.items()]
            text = "{\n" + ",\n".join(lines) + "\n}\n"
        else:
            dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
            text = yaml.dump(
                fields, Dumper=dumper, default_flow_style=None, sort_keys=False, width=200
            )
        return text.encode()
    except UnicodeEncodeError as error:
        raise WorldError("can't be written: the world's name isn't UTF-8 text") from error


def _format_json(value: object) -> str:
    """JSON with a line for each row of numbers."""
    if not isinstance(value, list) or not value:
        return json.dumps(value)
    return "[\n    " + ",\n    ".join(map(json.dumps, value)) + "\n  ]"


def _parse_world(data: object, path: Path, placement: Placement) -> World:
    """Make a world of the content of a JSON or YAML file."""
    if not isinstance(data, dict):
        raise WorldError(f"must be a mapping with {', '.join(WorldFile.model_fields)}")
    data = _place_ends(data, placement)
    model = MapFile if "image" in data else WorldFile
    try:
        file = model.model_validate({"name": path.stem, **data})
    except WorldError:
        raise
    except ConfigError as error:
        raise WorldError(str(error)) from error
    start, goal = file.start, file.goal
    segments = np.array(file.segments, np.float64).reshape(-1, 4)
    if model is MapFile:
        config = maps.read_settings(data)
        try:
            picture = reading.read_content(path.parent / config.image, MAX_IMPORT_BYTES, WorldError)
            segments = np.concatenate([segments, maps.map_segments(picture, config)])
        except WorldError as error:
            raise WorldError(f"image {show_value(config.image)}: {error}") from error
    return World(
        np.array(file.circles, np.float64),
        segments,
        Region(start.x, start.y, start.radius or 0.0, start.theta),
        Region(goal.x, goal.y, goal.radius or 0.0),
        None if file.path is None else np.array(file.path, np.float64),
        file.name,
        parse_movers(file.movers),
    )


def _place_ends(data: dict[str, Any], placement: Placement) -> dict[str, Any]:
    """The content of a file with the start and goal that are given; WorldError without them."""
    for end, region in (("start", placement.start_region), ("goal", placement.goal_region)):
        if region is not None:  # the file's path leads from or to another place
            theta = {} if region.theta is None else {"theta": region.theta}
            data = {**data, end: {"x": region.x, "y": region.y, **theta}, "path": None}
    lacks = data.get("start") is None, data.get("goal") is None
    if any(lacks):
        end = "start" if lacks[0] else "goal"
        raise WorldError(
            f"{MISSING_ENDS[lacks]} [m, rad], or a line like '{end}: {{x: 0.0, y: 0.0}}'"
        )
    return data


def _barn_path(path: Path) -> Floats | None:
    """The path from start to goal of a published world, from its cells (row, column)."""
    name = path.stem.replace("world_", "path_", 1) + ".npy"
    folders = (path.parent, path.parent / "path_files", path.parent.parent / "path_files")
    paths = [folder / name for folder in folders if (folder / name).is_file()]
    if not path.stem.startswith("world_") or not paths:
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the file may be of Python 2
            # Mapped, because a header may claim more bytes than the file has.
            cells = np.lib.format.open_memmap(paths[0], mode="r")
    except Exception as error:  # NumPy raises all kinds for broken files
        raise WorldError(f"{name}: isn't a sound .npy file: remove or replace it") from error
    if cells.ndim != 2 or cells.shape[1] != 2 or cells.dtype.kind not in "iuf":
        raise WorldError(f"{name}: must hold cells (row, column), has shape {cells.shape}")
    if len(cells) > MAX_OBSTACLES or not (np.abs(cells) <= MAX_COORDINATE).all():
        raise WorldError(f"{name}: holds too many cells or cells too far away")
    start, goal = ([[region.x, region.y]] for region in (BARN_START, BARN_GOAL))
    return np.concatenate([start, cells.astype(np.float64) * BARN_CELL + BARN_CORNER, goal])
