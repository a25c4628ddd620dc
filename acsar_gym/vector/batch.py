"""A batch of robots: its arrays, and the calls of the compiled loops in `kernel/` on them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.jit import record_of
from acsar_gym.physics import Randomization
from acsar_gym.physics.randomization import PLACES
from acsar_gym.sensors import LIDAR, MAP, Factory, Sensor
from acsar_gym.sensors.lidar import footprint_edges
from acsar_gym.sensors.suite import BUILT_IN
from acsar_gym.tasks.episode import ObservationCheck, Spawn
from acsar_gym.tasks.factory import task_name
from acsar_gym.tasks.state import CrowdInfo, StepInfo
from acsar_gym.tasks.task import Task
from acsar_gym.vector import arrays, pcg
from acsar_gym.vector.arrays import Kind
from acsar_gym.vector.kernel import drive, episode, layout, lidars
from acsar_gym.vector.sensors import BatchSensors, make_batch_sensors
from acsar_gym.vector.task import TaskLoop
from acsar_gym.worlds.crowd import CLOCK
from acsar_gym.worlds.movers import RADIUS, pad_rows

Mask = NDArray[np.bool_]
Share = Callable[[Callable[[int, int], None], int], None]
"""Runs a loop, given as a function of its first and last block, for a number of blocks, which it
splits into slices for several threads."""


class Batch:
    """The arrays of all robots of a batch, and what is done with them at a reset and in a step.

    Attributes:
        robots: How many robots there are.
        sensors: An instance of each sensor, in the order of their numbers in the observation.
        worlds: All worlds.
        tables: The arrays.
        maps: The robots' maps. None without maps.
        seeded: Whether the robots have generators.

    Args:
        robots: How many robots there are.
        fleet: Kinds of robots. Robot i is of kind i % len(fleet).
        task: Task of every robot.
        spawns: The worlds of each kind. It is the same object for footprints of the same size.
        sensors: Names, sensors or factories, as `RobotVectorEnv` takes them.
        ticks: Control periods in an env step.
        max_steps: Time limit of an episode [env steps], infinite for none.
        randomization: What the robots draw for every episode, see `Randomization.of`.
    """

    def __init__(
        self,
        robots: int,
        fleet: Sequence[RobotConfig],
        task: Task,
        spawns: Sequence[Spawn],
        sensors: Sequence[str | Sensor | Factory],
        *,
        ticks: int,
        max_steps: float,
        randomization: Any,
    ) -> None:
        self.robots = robots
        self.seeded = False
        self._task = task
        self._observed = ObservationCheck(task)
        step = ticks * fleet[0].period

        # Worlds, and what the robots of each kind draw.
        pools = [spawn.pool for spawn in spawns]
        self.worlds, places = arrays.make_worlds(pools, follow=task.follows)
        kinds = []
        for config, pool, place in zip(fleet, pools, places, strict=True):
            drawn = Randomization.of(randomization, config)
            ranges = drawn.ranges(config, step)
            kinds.append(Kind(config, drawn, ranges, pool=pool, worlds=place))
        self._spawns = arrays.make_spawns(task, self.worlds, kinds)
        self._draws = arrays.make_draws(robots, kinds)

        # Columns of an observation: the task's numbers, those of built-in sensors, those of users.
        self.sensors = make_batch_sensors(sensors, fleet[0], step)
        own_sensors = [sensor for sensor in self.sensors if sensor.name not in BUILT_IN]
        sizes = {sensor.name: sensor.size for sensor in self.sensors}
        rays = max(config.lidar.rays for config in fleet) if LIDAR in sizes else 0
        built_in = sum(size for name, size in sizes.items() if name in BUILT_IN)
        numbers = len(task.observation)

        # The numbers that all robots share, and the arrays that all batches have.
        self._setup = arrays.make_setup(
            kinds,
            ticks=ticks,
            max_steps=max_steps,
            sees=LIDAR in sizes,
            numbers=numbers,
            first_ray=numbers + built_in - rays,
        )
        # Compiled loops take a record, Python code reads the named tuple.
        self._setups = record_of(self._setup)
        blocks = layout.make_blocks(robots)
        arrays.write_builds(blocks, kinds, self._setup)
        # All kinds share a ring, which has to be long enough for the slowest wire.
        counts = max(arrays.count_slots(self._setup, kind) for kind in kinds)
        commands = max(arrays.count_commands(self._setup, kind) for kind in kinds)
        edges = [np.reshape(footprint_edges(config)[:rays], (-1, 1)) for config in fleet]
        self.tables = layout.Tables(
            blocks=blocks,
            counts=arrays.make_ring(blocks, counts, 4),
            commands=arrays.make_ring(blocks, commands, 2),
            cursor=record_of(layout.Cursor(counts=0, commands=0)),
            random=np.zeros((robots, 4), np.uint64),
            actions=np.zeros((robots, 2)),
            begins=np.zeros(robots, np.bool_),
            drives=np.zeros(robots, np.bool_),
            ranges=np.zeros((robots, rays)),
            edges=pad_rows(edges, (0.0,))[:, :, 0],
            observations=np.zeros((robots, numbers + sum(sizes.values())), np.float32),
            rewards=np.zeros(robots),
            terminated=np.zeros(robots, np.bool_),
            truncated=np.zeros(robots, np.bool_),
        )

        # Arrays that only some batches need.
        self._scans = arrays.make_scans(robots, self.worlds, self._setup, kinds)
        self._crowds = arrays.make_crowds(self.worlds, self._scans)
        self.maps: layout.Maps | None = None
        if MAP in sizes:
            self.maps = arrays.make_maps(robots, len(blocks), kinds, step)

        # The task and the sensors of users.
        self._task_loop = TaskLoop(task, self.tables, self._setup, self._spawns)
        self._own_sensors = BatchSensors(own_sensors, self.tables, self.worlds, self._setup.dt)

        # Keys of info.
        pool = pools[0]
        self._world_numbers = None if pool is None else pool.numbers
        self._info_keys = [
            *StepInfo._fields,
            *(CrowdInfo._fields if pool is not None and pool.moves else ()),
            *(("world",) if self._world_numbers is not None else ()),
            *(("scan_age", "scan_stale") if self._setup.sees else ()),
        ]
        names = dict.fromkeys(name for kind in kinds for name in kind.randomization.names)
        self._drawn = {f"drawn_{name}": PLACES[name] for name in names}

    def read(self, *names: str) -> NDArray[np.float64]:
        """Copy fields of `layout.Robots`, (numbers, robots). Those of wheels are four numbers."""
        return layout.read_fields(self.tables.blocks, names, slice(self.robots))

    def copy_movers(self, robot: int, world: int) -> NDArray[np.float64] | None:
        """Copy what is seen of the movers around a robot in this world, as `Crowd.copy_states`."""
        if self._crowds is None:
            return None
        radii = self._crowds.motions.movers[world, :, RADIUS]
        # Worlds with fewer movers are padded with rows of radius -1.
        used = radii > 0.0
        return np.column_stack([self._crowds.states[robot, used, :CLOCK], radii[used]])

    def measure_work(self) -> None:
        """Measure the work of the motors from now on, as field `work` [J]. It takes time."""
        self._setup = self._setup._replace(metered=True)
        self._setups = record_of(self._setup)

    def seed(self, seeds: list[int | None] | None, mask: Mask) -> None:
        """Make new generators for robots with a seed, and in the first call for all."""
        if seeds is None and self.seeded:
            return

        # A robot without a seed keeps its generator, except at the first reset.
        for robot in np.flatnonzero(mask):
            seed = None if seeds is None else seeds[robot]
            if seed is not None or not self.seeded:
                self.tables.random[robot] = pcg.seed_row(seed)
                self._own_sensors.forget(int(robot))
        self.seeded = True

    def set_reset_options(self, options: Mapping[str, NDArray[Any]], mask: Mask) -> None:
        """Set the reset options that hold for the next episodes of the robots in the mask."""
        # Options that aren't given are zero, which stands for no option.
        places = np.divmod(np.flatnonzero(mask), layout.BLOCK_ROBOTS)
        for name in layout.OPTIONS:
            self.tables.blocks[name][places] = options[name][mask] if name in options else 0.0

    def reset(self, mask: Mask, share: Share) -> None:
        """Start new episodes of the robots in the mask."""
        self.tables.begins[:] = mask
        # No robot drives in a reset, so users' sensors read only those that start.
        self.tables.drives[:] = False
        share(self._finish_step, len(self.tables.blocks))
        self._observe(share)

    def step(self, share: Share) -> None:
        """Do an env step of all robots with `tables.actions`. Those in `tables.begins` start."""
        tables = self.tables
        np.logical_not(tables.begins, out=tables.drives)
        share(self._drive, len(tables.blocks))

        # All blocks read the same cursor, so it moves on after them.
        cursor = tables.cursor[0]
        loops = self._setup.ticks * self._setup.loops
        cursor["counts"] = (cursor["counts"] + loops) % tables.counts.shape[1]
        cursor["commands"] = (cursor["commands"] + self._setup.ticks) % tables.commands.shape[1]
        self._observe(share)
        # The compiled loop checks outcomes and shapes. Observations are checked by `_observe`.
        if not np.isfinite(tables.rewards).all():
            robot = int(np.isfinite(tables.rewards).argmin())
            raise ConfigError(
                f"{task_name(self._task)}.reward returned {tables.rewards[robot]} for robot "
                f"{robot}: must be a finite number"
            )

    def _drive(self, first: int, last: int) -> None:
        """Run the physics of blocks first to last, and what follows it."""
        obstacles = (self._scans, self._crowds)
        drive.step(self.tables, *obstacles, first, last, self._setups)
        self._finish_step(first, last)

    def _finish_step(self, first: int, last: int) -> None:
        """Start episodes of blocks first to last, read LiDARs, and run the task, if it can."""
        shared: dict[str, Any] = {"first": first, "last": last, "setups": self._setups}
        robots = slice(first * layout.BLOCK_ROBOTS, last * layout.BLOCK_ROBOTS)
        tables = self.tables
        scans = self._scans
        crowds = self._crowds

        # In most steps no episode of these blocks starts.
        if tables.begins[robots].any():
            episode.reset(
                tables,
                layout.view_numbers(tables.blocks),
                scans,
                crowds=crowds,
                draws=self._draws,
                spawns=self._spawns,
                **shared,
            )
        if scans is not None and self._setup.sees:
            lidars.read_scans(tables, scans, crowds, maps=self.maps, **shared)

        # Users' sensors read all robots at once, so the task has to wait for them.
        if not len(self._own_sensors):
            self._task_loop.run(first, last)

    def _observe(self, share: Share) -> None:
        """Read users' sensors, and run the task unless it has been run. Check observations."""
        if len(self._own_sensors):
            self._own_sensors.reset(np.flatnonzero(self.tables.begins))
            self._own_sensors.read(np.flatnonzero(self.tables.drives))
            share(self._task_loop.run, len(self.tables.blocks))
        self._observed.check(self.tables.observations[:, : self._setup.numbers])

    def info(self) -> dict[str, NDArray[np.float64]]:
        """Info with the keys of the single env, each an array with a row for each robot."""
        *rows, first_worlds = self.read(*self._info_keys, "first_world")
        info = dict(zip(self._info_keys, rows, strict=True))

        # Places count through the worlds of all kinds, numbers start at the kind's first world.
        if self._world_numbers is not None:
            info["world"] += self._world_numbers[0] - first_worlds
        info |= self._task_loop.info()
        for name, places in self._drawn.items():  # (robots,), or (robots, 4) in wheel order
            numbers = self._draws.drawn[:, places]
            info[name] = numbers[:, 0] if len(places) == 1 else numbers
        self._own_sensors.add_info(info)
        return info
