"""Read and write files of worlds: this project's JSON or YAML, ROS maps, and plain Gazebo worlds.

The project's own format has the fields of `World` [m, rad]:

    name: three pillars
    circles: [[2.0, 0.3, 0.1], [3.0, -0.4, 0.1]]    # x, y, radius
    segments: [[0.0, 1.0, 4.0, 1.0]]                # x1, y1, x2, y2
    start: {x: 0.0, y: 0.0, theta: 0.0}             # and radius. Without theta any heading
    goal: {x: 4.0, y: 0.0}                          # and radius
    path: [[0.0, 0.0], [4.0, 0.0]]                  # optional
    movers: [{points: [[2.0, -2.0], [2.0, 2.0]], speed: 1.0}]    # optional, see `mover_files`

A YAML with an `image` is a ROS map. Neither a map nor a Gazebo world contains a start and a goal. A
map may have them as further keys, and for both they can be given with the file (`Placement`). Only
BARN's own worlds, known by their corridor, have BARN's start and goal, and the path in `path_N.npy`
next to `world_N.world`, or in a folder `path_files` there or above, as in BARN's own repository.
Every file that can't be used raises a WorldError of one line.
"""

from __future__ import annotations

import json
import re
import warnings
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from pydantic import Field, ValidationInfo, field_validator

from acsar_gym import reading
from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError, WorldError, explain_error, show_value
from acsar_gym.worlds import maps, sdf
from acsar_gym.worlds.generators import (
    BARN_CELL_SIDE,
    BARN_GOAL,
    BARN_START,
    CYLINDER_RADIUS,
    place_cylinders,
)
from acsar_gym.worlds.mover_files import format_mover, parse_movers
from acsar_gym.worlds.world import Floats, Region, World

MAX_IMPORT_BYTES = sdf.MAX_SDF_BYTES  # most bytes of an SDF file or a picture
MAX_TEXT_BYTES = 5_000_000
"""Most bytes of a JSON or YAML. 20,000 segments and a path of 20,000 points are 3 MB."""
BARN_CELL = 0.15  # side of a cell of a published path [m]
BARN_CORNER = (-4.575, 5.075)  # position of cell (0, 0) of a published path [m]
PLACE_FORM = re.compile(r"\s*[,\s]\s*")  # between the numbers of a place on the command line
WORLD_SUFFIXES = (".world", ".sdf", ".yaml", ".yml", ".json")
Rows: Any = Field(default_factory=list)


class Goal(Section):
    """A goal in a file [m]."""

    section = "goal"
    x: float
    y: float
    radius: float | None = None

    @property
    def region(self) -> Region:
        """The disc in which the goal or the start is drawn."""
        return Region(**self.model_dump(exclude_none=True))


class Start(Goal):
    """A start in a file [m, rad]."""

    section = "start"
    theta: float | None = None


class WorldFile(Section):
    """The project's own format."""

    name: str = Field(max_length=1000)
    start: Start | None = None
    goal: Goal | None = None
    circles: list[tuple[float, float, float]] = Rows
    segments: list[tuple[float, float, float, float]] = Rows
    path: list[tuple[float, float]] | None = None
    movers: list[Any] = Rows


class Placement(Section):
    """What files of Gazebo and ROS don't contain. `worlds=` takes it as a mapping with the `path`.

    Each place is a list of numbers, or text like "1.5,-2,0.7".
    """

    section = "worlds"
    start: Region | None = None
    """x, y [m] and theta [rad]. Without theta any heading. None: the file's."""
    goal: Region | None = None
    """x, y [m]. None: the file's."""
    height: Annotated[float, Field(gt=0.0, le=100.0)] = sdf.LIDAR_HEIGHT
    """Height of the LiDAR above the floor, which bodies of a Gazebo world may reach [m]."""

    @field_validator("start", "goal", mode="before")
    @classmethod
    def _parse_place(cls, value: Any, info: ValidationInfo) -> Region | None:
        if value is None:
            return None
        form = "X,Y or X,Y,THETA [m, rad]" if info.field_name == "start" else "X,Y [m]"
        words = PLACE_FORM.split(value.strip()) if isinstance(value, str) else value
        try:
            x, y, *theta = map(float, words)
        except (TypeError, ValueError) as error:
            raise ValueError(f"must be {form}") from error
        if len(theta) > form.count("THETA"):
            raise ValueError(f"must be {form}")
        return Region(x, y, 0.0, *theta)


class FileSource(Placement):
    """A file or folder of worlds, with what it doesn't contain."""

    path: Path


def load_world(path: Path | str, placement: Placement | None = None) -> World:
    """Read a world from a file.

    Args:
        path: A `.world`, `.sdf`, `.yaml`, `.yml` or `.json` file.
        placement: Start and goal, instead of the file's, and the height of the LiDAR.

    Returns:
        The world.

    Raises:
        WorldError: The file can't be read, or there is no start or no goal.
        MissingExtraError: A map's picture needs Pillow, which isn't installed.
    """
    path = Path(path)
    placement = placement or Placement()
    suffix = path.suffix.lower()
    if suffix not in WORLD_SUFFIXES:
        raise WorldError(
            f"{path}: a world is read from {', '.join(WORLD_SUFFIXES)}; a map from its YAML, not "
            "from its picture"
        )
    try:
        if suffix in (".world", ".sdf"):
            return _read_gazebo(path, placement)

        content = reading.read_content(path, MAX_TEXT_BYTES, WorldError)
        text = reading.decode_text(content, WorldError)
        parse = reading.parse_json if suffix == ".json" else reading.parse_yaml
        return _parse_world(parse(text, WorldError), path, placement)
    except WorldError as error:
        raise WorldError(f"{path}: {error}") from error


def _read_gazebo(path: Path, placement: Placement) -> World:
    content = reading.read_content(path, MAX_IMPORT_BYTES, WorldError)
    circles, segments = sdf.read_obstacles(content, placement.height)
    is_barn = _is_barn(circles)
    start, goal = _choose_ends(
        placement,
        start=BARN_START if is_barn else None,
        goal=BARN_GOAL if is_barn else None,
        extent=_describe_extent(circles, segments),
    )
    way = None
    if is_barn and not (placement.start or placement.goal):
        # The published path leads from BARN's own start to its own goal.
        way = _read_barn_path(path)
    return World(circles, segments, start, goal, path=way, name=path.stem)


def _describe_extent(circles: Floats, segments: Floats) -> str:
    """Where the obstacles are, for users who look for a start, or empty without any."""
    centres = circles[:, :2]
    radii = circles[:, 2:]
    points = np.concatenate([centres - radii, centres + radii, segments.reshape(-1, 2)])
    if not len(points):
        return ""
    min_x, min_y = points.min(axis=0)
    max_x, max_y = points.max(axis=0)
    return f" (obstacles are at x {min_x:.2f} to {max_x:.2f}, y {min_y:.2f} to {max_y:.2f})"


def _choose_ends(
    placement: Placement, start: Region | None, goal: Region | None, extent: str = ""
) -> tuple[Region, Region]:
    """The start and the goal of a placement, or else of a file, or a WorldError."""
    # What is given with the file wins over the file.
    start = placement.start or start
    goal = placement.goal or goal
    if start and goal:
        return start, goal
    names = [name for name, end in (("start", start), ("goal", goal)) if end is None]
    options = " ".join("--start X,Y,THETA" if name == "start" else "--goal X,Y" for name in names)
    raise WorldError(
        f"has no {' and no '.join(names)}: run 'acsar-gym worlds convert FILE OUT.yaml {options}' "
        f"[m, rad]{extent}, or add lines like 'start: {{x: 0.0, y: 0.0}}' to its YAML"
    )


def _is_barn(circles: Floats) -> bool:
    """Whether circles are those of a BARN world: its corridor's cylinders are there."""
    # Published files round their numbers, so places are compared within a quarter of a cell.
    corridor = place_cylinders(np.zeros((0, 0), np.bool_))
    cylinders = circles[np.isclose(circles[:, 2], CYLINDER_RADIUS)]
    distances = np.abs(cylinders[:, None, :2] - corridor[:, :2]).max(axis=2)
    return bool((distances < BARN_CELL_SIDE / 4.0).any(axis=0).all())


def _read_barn_path(path: Path) -> Floats | None:
    """The path from start to goal of a published world, from its cells (row, column)."""
    # The path's file has the world's number, and lies in one of these folders.
    name = f"path_{path.stem.removeprefix('world_')}.npy"
    folders = (path.parent, path.parent / "path_files", path.parent.parent / "path_files")
    for file in (folder / name for folder in folders):
        if file.is_file():
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # the file may be of Python 2
                    # Mapped, because a header may claim more bytes than the file has.
                    cells = np.lib.format.open_memmap(file, mode="r")
                points = cells.astype(np.float64, casting="safe") * BARN_CELL + BARN_CORNER
            except Exception as error:  # NumPy raises all kinds for broken files
                raise WorldError(f"{name}: isn't a .npy file of cells: replace it") from error

            if cells.shape[1:] != (2,):
                raise WorldError(f"{name}: must hold cells (row, column), has shape {cells.shape}")
            return np.array([(BARN_START.x, BARN_START.y), *points, (BARN_GOAL.x, BARN_GOAL.y)])
    return None


def load_folder(folder: Path, placement: Placement | None = None) -> list[World]:
    """Read all worlds of a folder in natural order: world_2 comes before world_10.

    Args:
        folder: The folder. Its subfolders aren't searched.
        placement: Placement of all of them, see `load_world`.

    Returns:
        The worlds.

    Raises:
        WorldError: The folder holds no worlds, or one of them can't be read.
    """
    try:
        files = [path for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError as error:
        raise WorldError(f"{folder}: can't be read: {explain_error(error)}") from error
    paths = [path for path in sorted(files) if path.suffix.lower() in WORLD_SUFFIXES]
    if not paths:
        raise WorldError(f"{folder}: holds no worlds ({', '.join(WORLD_SUFFIXES)})")

    # Numbers of equal length, after a character that comes before all others.
    paths.sort(key=lambda path: re.sub(r"\d+", lambda number: f"\0{number[0]:0>300}", path.name))
    return [load_world(path, placement) for path in paths]


def save_world(world: World, path: Path) -> None:
    """Write a world in the project's own format.

    Args:
        world: The world.
        path: A `.json`, `.yaml` or `.yml` file, which is replaced.

    Raises:
        WorldError: The file has another suffix, or can't be written.
    """
    reading.write_atomically(path, format_world(world, path.suffix), WorldError)


def format_world(world: World, suffix: str) -> bytes:
    """Format a world in the project's own format.

    Args:
        world: The world.
        suffix: Suffix of the files, see `save_world`.

    Returns:
        The content of the file.

    Raises:
        WorldError: The suffix is another one.
    """
    if suffix.lower() not in (".json", ".yaml", ".yml"):
        raise WorldError("a world is saved as .json, .yaml or .yml")
    fields: dict[str, Any] = {
        "name": world.name.encode(errors="replace").decode(),
        "start": _format_region(world.start),
        "goal": _format_region(world.goal),
        "circles": world.circles.tolist(),
        "segments": world.segments.tolist(),
    }
    if world.path is not None:
        fields["path"] = world.path.tolist()
    if world.movers:
        fields["movers"] = list(map(format_mover, world.movers))

    if suffix.lower() == ".json":
        lines = [f"  {json.dumps(key)}: {_format_json(value)}" for key, value in fields.items()]
        text = "{\n" + ",\n".join(lines) + "\n}\n"
    else:
        # The dumper in C is much faster, if libyaml is installed.
        dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
        text = yaml.dump(fields, Dumper=dumper, default_flow_style=None, sort_keys=False, width=200)
    return text.encode()


def _format_region(region: Region) -> dict[str, float]:
    return {key: float(value) for key, value in asdict(region).items() if value is not None}


def _format_json(value: object) -> str:
    """JSON with a line for each row of numbers."""
    if not isinstance(value, list) or not value:
        return json.dumps(value)
    return "[\n    " + ",\n    ".join(map(json.dumps, value)) + "\n  ]"


def _parse_world(data: object, path: Path, placement: Placement) -> World:
    """Make a world of the content of a JSON or YAML file."""
    if not isinstance(data, dict):
        raise WorldError(f"must be a mapping with {', '.join(WorldFile.model_fields)}")
    # A map's YAML has keys of its own, which `maps` checks.
    is_map = "image" in data
    fields = {key: data[key] for key in data if key in WorldFile.model_fields or not is_map}
    try:
        file = WorldFile.model_validate({"name": path.stem, **fields})
    except ConfigError as error:
        raise WorldError(str(error)) from error

    start, goal = _choose_ends(
        placement,
        file.start.region if file.start else None,
        file.goal.region if file.goal else None,
    )
    rows: dict[str, Any] = {"circles": file.circles, "segments": file.segments}
    if not (placement.start or placement.goal):  # or else the path leads elsewhere
        rows["path"] = file.path
    world = World(**rows, start=start, goal=goal, name=file.name, movers=parse_movers(file.movers))
    if not is_map:
        return world
    outlines = _read_map(data, path.parent)
    return replace(world, segments=np.concatenate([world.segments, outlines]))


def _read_map(data: dict[str, Any], folder: Path) -> Floats:
    """The outlines of a map's picture."""
    config = maps.read_settings(data)
    try:
        picture = reading.read_content(folder / config.image, MAX_IMPORT_BYTES, WorldError)
        return maps.map_segments(picture, config)
    except WorldError as error:
        raise WorldError(f"image {show_value(config.image)}: {error}") from error
