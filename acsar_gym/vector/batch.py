"""The arrays of a batch of robots, and the calls of the compiled loops in `kernel/` on them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import TaskError
from acsar_gym.jit import COMPILED, compiled_beside, record_of
from acsar_gym.lidar.scan import make_rays
from acsar_gym.lidar.simulated import SimulatedLidar
from acsar_gym.physics import Randomization, compute_physics
from acsar_gym.physics.randomization import DrawnRanges, drawn_places
from acsar_gym.sensors import Factory, Sensor
from acsar_gym.sensors.lidar import LidarSensor, footprint_edges
from acsar_gym.sensors.map.sensor import RECORD, MapSensor, make_record
from acsar_gym.sensors.map.way import SCRATCH
from acsar_gym.tasks.episode import ObservationCheck, Spawn
from acsar_gym.tasks.factory import method_place, task_name
from acsar_gym.tasks.task import Task
from acsar_gym.vector import pcg
from acsar_gym.vector.kernel import drive, episode, layout
from acsar_gym.vector.sensors import BatchSensors, BatchView, RobotLink, python_sensors
from acsar_gym.vector.setup import (
    ResetOptions,
    command_slots,
    compute_build,
    count_slots,
    make_worlds,
    pad_surroundings,
    spawn_arrays,
    trail_slots,
)
from acsar_gym.vector.task import TaskLoops, make_loops
from acsar_gym.worlds.geometry import pad_rows


def _stack_records(each: Sequence[Any]) -> NDArray[Any]:
    """Records of named tuples of the same kind, one after the other."""
    stacked = np.concatenate([record_of(one, changes=True) for one in each])
    return stacked if COMPILED else stacked.view(np.recarray)


Mask = NDArray[np.bool_]
Share = Callable[[Callable[[int, int], None], int], None]
"""Runs a loop, given as a function of its first and last block, for a number of blocks, which it
splits into slices for several threads."""


class Batch:
    """The arrays of all robots of a batch, and what is done with them at a reset and in a step.

    Args:
        robots: how many.
        fleet: the kinds of robots; robot i is of kind i % len(fleet).
        task: of every robot.
        spawns: of each kind, have the worlds; the same object where footprints are as large.
        sensors: names, sensors or factories, as `RobotVectorEnv` takes them.
        setup: numbers that all robots share.
        varied: what the robots of each kind draw anew for every episode.
        ranges: of these.

    Attributes: `robots`, how many; `worlds`, all of them, and `places`, where those of each kind
    are; `tables`, the arrays; `python`, the sensors written in Python; `seeded`, whether the robots
    have generators.
    """

    def __init__(
        self,
        robots: int,
        fleet: Sequence[RobotConfig],
        task: Task,
        spawns: Sequence[Spawn],
        sensors: Sequence[str | Sensor | Factory],
        setup: layout.Setup,
        varied: Sequence[Randomization],
        ranges: Sequence[DrawnRanges],
    ) -> None:
        self.robots, self._fleet, self._task, self._setup = robots, fleet, task, setup
        self._observed = ObservationCheck(task)
        sees, pools = setup.sees, [spawn.pool for spawn in spawns]
        self._pool, (worlds, places) = pools[0], make_worlds(pools, follow=task.follows)
        self.worlds, self.places = worlds, places
        self._spawns = spawn_arrays(task, worlds, pools, places)
        self._around = pad_surroundings(worlds, fleet, sees=sees)
        self._setups = record_of(setup)
        names = dict.fromkeys(name for one in varied for name in one.names)
        self._drawn = {f"drawn_{name}": list(drawn_places(name)) for name in names}
        self.tables = self._make_tables(ranges)
        self._build_robots(places)
        self._view = BatchView(self.tables.numbers, self.tables.random, setup.dt, worlds)
        self.python = BatchSensors(python_sensors(sensors), fleet, robots, self._view)
        self._first_python = self.tables.observations.shape[1]
        """The first column of the observation that belongs to a sensor written in Python."""
        width = self._first_python + self.python.size
        self.tables = self.tables._replace(observations=np.zeros((robots, width), np.float32))
        self._loops: TaskLoops = make_loops(task, self.tables, setup, self._setups, self._spawns)
        self._together = self._loops.compiled and not len(self.python)
        """Whether a robot's task can run right after its physics, on the same thread."""
        self._info = dict(layout.INFO_FIELDS)
        """Keys of info, and their fields."""
        self._info |= {} if self._pool is None else {"world": "world"}
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
        lidar = SimulatedLidar(RobotLink(self._view, 0), self._fleet[0])
        found: list[Sensor] = [LidarSensor(lidar, self._fleet[0]), *self.python.kinds]
        return [MapSensor(None, self._fleet[0]), *found] if self._setup.maps else found

    def _build_robots(self, places: Sequence[range]) -> None:
        """Write what follows from the robots' configurations; `places` are the kinds' worlds."""
        kinds = enumerate(zip(self._fleet, places, strict=True))
        built = np.array([compute_build(one, self._setup, k, at) for k, (one, at) in kinds])
        numbers = self.tables.numbers[:, layout.BUILD_ROW :]
        which = np.arange(len(numbers) * layout.BLOCK_ROBOTS).reshape(len(numbers), -1)
        for row, column in enumerate(built.T):
            numbers[:, row] = column[which % len(built)]

    def _make_maps(self) -> NDArray[Any]:
        """(robots,): the robots' empty maps; none where they have no map."""
        if not self._setup.maps:
            return np.zeros(0, RECORD)
        step = self._setup.ticks * self._setup.period
        kinds = np.concatenate([make_record(one, step) for one in self._fleet])
        made = kinds[np.arange(self.robots) % len(kinds)]
        return made if COMPILED else made.view(np.recarray)

    def _make_tables(self, ranges: Sequence[DrawnRanges]) -> layout.Tables:
        """Make all arrays. Columns for Python sensors are added to the observations later."""
        robots, setup, rays = self.robots, self._setup, self._around.directions.shape[1]
        blocks = layout.make_blocks(robots)
        kinds = list(zip(ranges, self._fleet, strict=True))
        lines = max(command_slots(setup, *kind) for kind in kinds)
        turns = max(count_slots(setup, *kind) for kind in kinds)
        slots = max(trail_slots(setup, *kind) for kind in kinds)
        delays = [np.reshape(drawn.delays, (-1, 1)) for drawn in ranges]
        edges = [np.reshape(footprint_edges(one)[:rays], (-1, 1)) for one in self._fleet]

        def make_rings(*shape: int) -> NDArray[np.float64]:
            return np.zeros((len(blocks), *shape, layout.BLOCK_ROBOTS))

        return layout.Tables(
            blocks=blocks,
            numbers=layout.view_numbers(blocks),
            counts=make_rings(turns, 4),
            commands=make_rings(lines if setup.guarded else 0, 2),
            arrivals=make_rings(lines if setup.faults.possible else 0, 3),
            random=np.zeros((robots, 4), np.uint64),
            nominal=_stack_records([compute_physics(one) for one in self._fleet]),
            low=np.array([drawn.low for drawn in ranges]),
            high=np.array([drawn.high for drawn in ranges]),
            delays=pad_rows(delays, (0.0,))[:, :, 0],
            delay_counts=np.array([len(each) for each in delays], np.int64),
            rays=_stack_records([make_rays(one) for one in self._fleet]),
            drawn=np.zeros((robots, len(ranges[0].low) if self._drawn else 0)),
            actions=np.zeros((robots, 2)),
            over=np.zeros(robots, np.bool_),
            idle=np.zeros(robots, np.bool_),
            kept=make_rings(layout.EPISODE_ROWS if setup.falls_silent else 0),
            kept_rays=np.zeros((robots if setup.falls_silent else 0, rays), np.float32),
            ranges=np.zeros((robots, rays)),
            trails=np.zeros((2, robots, slots, 4)),
            maps=self._make_maps(),
            scratch=np.zeros((len(blocks) * setup.maps, SCRATCH), np.int32),
            edges=pad_rows(edges, (0.0,))[:, :, 0],
            observations=np.zeros((robots, setup.first_ray + rays), np.float32),
            rewards=np.zeros(robots),
            ends=np.zeros((2, robots), np.bool_),
            ring=np.array([0, 0, 0, setup.ticks], np.int64),
        )

    def read(self, *names: str) -> NDArray[np.float64]:
        """Copy fields of `layout.Robots`, (numbers, robots); those of wheels are four numbers."""
        return layout.read_fields(self.tables.numbers, names, slice(self.robots))

    def measure_work(self) -> None:
        """Measure the work of the motors from now on, as field `work` [J]; it takes time."""
        self._setup = self._setup._replace(metered=True)
        self._setups = record_of(self._setup)

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
            another = compiled_beside(drive.step, tables, 0, 1, self._setups, self._around)
        with another:
            share(self._begin, len(self.tables.blocks))
        self._new = False
        if not self._together:
            self._sense(driven=False)
            self._run_task(share)
        self._check_observations()

    def _begin(self, first: int, last: int) -> None:
        """Begin new episodes of the robots of blocks first to last that are in `tables.over`."""
        setups, spawns = self._setups, self._spawns
        episode.reset(self.tables, first, last, setups, spawns, self._around)
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
                f"{robot}: must be a finite number{method_place(self._task, 'reward')}"
            )

    def _check_observations(self) -> None:
        """Raise TaskError where the task observed NaN or infinity; warn once of other bounds."""
        self._observed.check(self.tables.observations[:, : self._setup.numbers])

    def _drive(self, first: int, last: int) -> None:
        """Run the physics of blocks first to last, and their task where `_together`."""
        tables = self.tables
        drive.step(tables, first, last, self._setups, self._around)
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
            info["world"] += self._pool.numbers[0] - self.read("first_world")[0]
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
