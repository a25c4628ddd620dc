"""The arrays of a batch of robots, and the calls of the compiled loops in `kernel/` on them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import TaskError
from acsar_gym.jit import compiled_beside, record_of
from acsar_gym.physics import Randomization, compute_physics
from acsar_gym.physics.randomization import drawn_places
from acsar_gym.safety.rules import make_rules
from acsar_gym.sensors import Factory, Sensor
from acsar_gym.sensors.lidar import LidarSensor, footprint_edges
from acsar_gym.sensors.map import MapSensor, make_record
from acsar_gym.sensors.way import SCRATCH
from acsar_gym.sensors.simulated import SimulatedLidar
from acsar_gym.tasks.base import Task
from acsar_gym.tasks.episode import Spawn, check_observation
from acsar_gym.tasks.factory import task_name
from acsar_gym.vector import pcg
from acsar_gym.vector.kernel import drive, episode, layout
from acsar_gym.vector.sensors import BatchSensors, BatchView, RobotLink, python_sensors
from acsar_gym.vector.setup import (
    ResetOptions,
    command_slots,
    count_slots,
    make_worlds,
    pad_surroundings,
    spawn_arrays,
    trail_slots,
)
from acsar_gym.vector.task import TaskLoops, make_loops

Mask = NDArray[np.bool_]
Share = Callable[[Callable[[int, int], None], int], None]
"""Runs a loop, given as a function of its first and last block, for a number of blocks, which it
splits into slices for several threads."""


class Batch:
    """The arrays of all robots of a batch, and what is done with them at a reset and in a step.

    Args:
        robots: how many.
        config: of every robot.
        task: of every robot.
        spawn: has the worlds.
        sensors: names, sensors or factories, as `RobotVectorEnv` takes them.
        setup: numbers that all robots share.
        randomization: what every robot draws anew for every episode.

    Attributes: `robots`, how many; `tables`, the arrays; `python`, the sensors written in Python;
    `seeded`, whether the robots have generators.
    """

    def __init__(
        self,
        robots: int,
        config: RobotConfig,
        task: Task,
        spawn: Spawn,
        sensors: Sequence[str | Sensor | Factory],
        setup: layout.Setup,
        randomization: Randomization,
    ) -> None:
        self.robots, self._config, self._task, self._setup = robots, config, task, setup
        sees = setup.sees
        self._pool, worlds = spawn.pool, make_worlds(spawn.pool, follow=task.follows)
        self._spawns = spawn_arrays(task, spawn.pool, worlds)
        self._around = pad_surroundings(worlds, config, sees=sees)
        self._setups, self._rules = record_of(setup), make_rules(config)
        self._drawn = {f"drawn_{name}": list(drawn_places(name)) for name in randomization.names}
        self.tables = self._make_tables(randomization)
        self._view = BatchView(self.tables.numbers, self.tables.random, setup.dt, worlds)
        self.python = BatchSensors(python_sensors(sensors), config, robots, self._view)
        self._first_python = self.tables.observations.shape[1]
        """The first column of the observation that belongs to a sensor written in Python."""
        width = self._first_python + self.python.size
        self.tables = self.tables._replace(observations=np.zeros((robots, width), np.float32))
        self._loops: TaskLoops = make_loops(task, self.tables, setup, self._setups, self._spawns)
        self._together = self._loops.compiled and not len(self.python)
        """Whether a robot's task can run right after its physics, on the same thread."""
        self._info = dict(layout.INFO_FIELDS)
        """Keys of info, and their fields."""
        self._info |= {} if spawn.pool is None else {"world": "world"}
        self._info |= {"scan_age": "scan_age", "scan_stale": "scan_stale"} if sees else {}
        self._info |= {"fault": "fault"} if setup.faults.possible else {}
        self.seeded = False
        self._new = True
        """Whether there was no reset yet."""

    @property
    def sensors(self) -> list[Sensor]:
        """One instance of each kind of sensor, in the order of their numbers in the observation."""
        if not self._setup.sees:
            return self.python.kinds
        lidar = SimulatedLidar(RobotLink(self._view, 0), self._config)
        found: list[Sensor] = [LidarSensor(lidar, self._config), *self.python.kinds]
        return [MapSensor(None, self._config), *found] if self._setup.maps else found

    def _make_tables(self, randomization: Randomization) -> layout.Tables:
        """Make all arrays. Columns for Python sensors are added to the observations later."""
        robots, setup, rays = self.robots, self._setup, len(self._around.directions)
        blocks = layout.make_blocks(robots)
        ranges = randomization.ranges(self._config, setup.ticks * setup.period)
        lines = command_slots(setup, ranges, self._config)

        def make_rings(*shape: int) -> NDArray[np.float64]:
            return np.zeros((len(blocks), *shape, layout.BLOCK_ROBOTS))

        return layout.Tables(
            blocks=blocks,
            numbers=layout.view_numbers(blocks),
            counts=make_rings(count_slots(setup, ranges, self._config), 4),
            commands=make_rings(lines if setup.guarded else 0, 2),
            arrivals=make_rings(lines if setup.faults.possible else 0, 3),
            random=np.zeros((robots, 4), np.uint64),
            nominal=record_of(compute_physics(self._config), changes=True),
            low=np.array(ranges.low),
            high=np.array(ranges.high),
            delays=np.array(ranges.delays),
            drawn=np.zeros((robots, len(ranges.low) if self._drawn else 0)),
            actions=np.zeros((robots, 2)),
            over=np.zeros(robots, np.bool_),
            idle=np.zeros(robots, np.bool_),
            kept=make_rings(layout.EPISODE_ROWS if setup.falls_silent else 0),
            kept_rays=np.zeros((robots if setup.falls_silent else 0, rays), np.float32),
            ranges=np.zeros((robots, rays)),
            trails=np.zeros((2, robots, trail_slots(setup, ranges, self._config), 4)),
            maps=np.repeat(
                make_record(self._config, setup.ticks * setup.period), robots * setup.maps
            ),
            scratch=np.zeros((len(blocks) * setup.maps, SCRATCH), np.int32),
            edges=footprint_edges(self._config)[:rays],
            observations=np.zeros((robots, setup.first_ray + rays), np.float32),
            rewards=np.zeros(robots),
            ends=np.zeros((2, robots), np.bool_),
            ring=np.array([0, 0, 0, setup.ticks], np.int64),
        )

    def read(self, *names: str) -> NDArray[np.float64]:
        """Copy fields of `layout.Robots`, (numbers, robots); those of wheels are four numbers."""
        return layout.read_fields(self.tables.numbers, names, slice(self.robots))

    def seed(self, seeds: list[int | None] | None, mask: Mask) -> None:
        """Make new generators.

        Args:
            seeds: one for each robot; None for a robot, or for all, keeps the generators that there
                are, and draws seeds from the system the first time.
            mask: (robots,): for which robots.
        """
        if seeds is None and self.seeded:
            return
        for robot in np.flatnonzero(mask):
            seed = None if seeds is None else seeds[robot]
            if seed is not None or not self.seeded:
                self.tables.random[robot] = pcg.seed_row(seed)
                self.python.forget(int(robot))
        self.seeded = True

    def set_reset_options(self, options: ResetOptions, mask: Mask) -> None:
        """Set the reset options that hold for the next episodes of the robots in the mask."""
        places = np.divmod(np.flatnonzero(mask), layout.BLOCK_ROBOTS)
        for name in layout.OPTIONS:
            self.tables.blocks[name][places] = options[name][mask] if name in options else 0.0

    def reset(self, mask: Mask, share: Share) -> None:
        """Begin new episodes of the robots in the mask."""
        tables = self.tables
        tables.over[:], tables.idle[:] = mask, True
        another: contextlib.AbstractContextManager[None] = contextlib.nullcontext()
        if self._new:  # compile the step in another process, while this one compiles the rest
            another = compiled_beside(
                drive.step, tables, 0, 1, self._setups, self._rules, self._around
            )
        with another:
            share(self._begin, len(self.tables.blocks))
        self._new = False
        if not self._together:
            self._sense(driven=False)
            self._run_task(share)
        self._check_observations()

    def _begin(self, first: int, last: int) -> None:
        """Begin new episodes of the robots of blocks first to last that are in `tables.over`."""
        setups, rules = self._setups, self._rules
        episode.reset(self.tables, first, last, setups, rules, self._spawns, self._around)
        if self._together:
            self._loops.run(first, last)

    def step(self, share: Share) -> None:
        """Do an env step of all robots with `tables.actions`. Those in `tables.over` begin anew."""
        tables, setup, ring = self.tables, self._setup, self.tables.ring
        if self.python.clocked:
            try:
                for tick in range(setup.ticks):
                    ring[2:] = tick, tick + 1
                    share(self._drive, len(tables.blocks))
                    self.python.poll(np.flatnonzero(~tables.idle))
            finally:
                ring[2:] = 0, setup.ticks
        else:
            share(self._drive, len(tables.blocks))
        if not self._together:
            self._sense(driven=True)
            self._run_task(share)
        ring[0] = (ring[0] + setup.ticks * setup.loops) % tables.counts.shape[1]
        ring[1] = (ring[1] + setup.ticks) % max(tables.commands.shape[1], 1)
        self._check_observations()
        if not np.isfinite(tables.rewards).all():
            robot = int(np.isfinite(tables.rewards).argmin())
            raise TaskError(
                f"{task_name(self._task)}.reward returned {tables.rewards[robot]} for robot "
                f"{robot}: must be a finite number"
            )

    def _check_observations(self) -> None:
        """Raise TaskError where the task observed NaN or infinity."""
        check_observation(self._task, self.tables.observations[:, : self._setup.numbers])

    def _drive(self, first: int, last: int) -> None:
        """Run the physics of blocks first to last, and their task where `_together`."""
        tables = self.tables
        drive.step(tables, first, last, self._setups, self._rules, self._around)
        begun = tables.over[first * layout.BLOCK_ROBOTS : last * layout.BLOCK_ROBOTS]
        if tables.ring[3] == self._setup.ticks and begun.any():
            self._begin(first, last)
        elif self._together:
            self._loops.run(first, last)

    def _run_task(self, share: Share) -> None:
        """Run the task for all robots, on several threads if it is compiled."""
        if self._loops.compiled:
            share(self._loops.run, len(self.tables.blocks))
        else:
            self._loops.run(0, len(self.tables.blocks))

    def _sense(self, *, driven: bool) -> None:
        """Reset and read Python sensors of robots that have begun.

        Read the others' too if driven. Those whose board is silent at the reset get zeros.
        """
        if len(self.python):
            begun, silent = self.tables.over, self.read("silent")[0] > 0.0
            columns = self.tables.observations[:, self._first_python :]
            columns[begun & silent] = 0.0
            self.python.reset(np.flatnonzero(begun & ~silent), columns)
            if driven:
                self.python.read(np.flatnonzero(~self.tables.idle), columns)

    def info(self) -> dict[str, NDArray[np.float64]]:
        """Info with the keys of the single env, each an array with a row for each robot."""
        info = dict(zip(self._info, self.read(*self._info.values()), strict=True))
        if self._pool is not None:
            info["world"] += self._pool.numbers[0]
        info |= self._loops.info()
        for name, places in self._drawn.items():  # (robots,), or (robots, 4) in wheel order
            numbers = self.tables.drawn[:, places]
            info[name] = numbers[:, 0] if len(places) == 1 else numbers
        self.python.add_info(info)
        return info

    def changing_arrays(self) -> dict[str, NDArray[Any]] | None:
        """All arrays that a later step depends on, by name; None where Python code has a state."""
        memory = self._loops.memory
        if memory is None or len(self.python):
            return None
        arrays = self.tables._asdict() | {"memory": memory}
        del arrays["blocks"]  # the memory of `numbers`
        return arrays
