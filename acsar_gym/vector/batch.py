"""The arrays of a batch of robots, and the calls of the compiled loops in `kernel/` on them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig, whole_ratio
from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.jit import record_of
from acsar_gym.lidar.scan import count_trail_rows, make_rays, ray_spec
from acsar_gym.lidar.simulated import SimulatedLidar
from acsar_gym.links.faults import Faults
from acsar_gym.physics import Randomization, compute_physics
from acsar_gym.physics.model import loop_period, wire_loops
from acsar_gym.physics.randomization import PLACES, DrawnRanges
from acsar_gym.safety import rules
from acsar_gym.sensors import LIDAR, MAP, MOVERS, Factory, Sensor
from acsar_gym.sensors.lidar import LidarSensor, footprint_edges, stale_after
from acsar_gym.sensors.map.movers import MOVER_NAMES, MoversSensor
from acsar_gym.sensors.map.sensor import MAP_NAMES, MapSensor, make_record
from acsar_gym.sensors.map.way import SCRATCH
from acsar_gym.tasks.episode import ObservationCheck, Spawn, path_from_start
from acsar_gym.tasks.factory import method_place, task_name
from acsar_gym.tasks.state import CROWD_INFO, INFO
from acsar_gym.tasks.task import Task
from acsar_gym.vector import pcg
from acsar_gym.vector.kernel import drive, episode, layout, lidars
from acsar_gym.vector.sensors import BatchSensors, BatchView, RobotLink, python_sensors
from acsar_gym.vector.task import make_loops
from acsar_gym.wire import STANDSTILL_TIMEOUT
from acsar_gym.worlds import World, geometry
from acsar_gym.worlds.crowd import CLOCK, STATE_NUMBERS
from acsar_gym.worlds.movers import RADIUS, make_motions
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import align_with_path

MAX_WORLDS = 10_000  # worlds of a batch, at most
PADDING_PLACE = 1e6  # coordinates of the unused circles and segments that pad the arrays [m]
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
        ticks: control periods in an env step.
        max_steps: time limit of an episode [env steps]; infinite for none.
        faults: of the wire.
        randomization: what the robots draw anew for every episode, see `Randomization.of`.

    Attributes: `robots`, how many; `worlds`, all of them, and `places`, where those of each kind
    are; `tables`, the arrays; `maps`, None without; `python`, the sensors written in Python;
    `seeded`, whether the robots have generators.
    """

    def __init__(  # noqa: PLR0913 - all that a batch is made of
        self,
        robots: int,
        fleet: Sequence[RobotConfig],
        task: Task,
        spawns: Sequence[Spawn],
        sensors: Sequence[str | Sensor | Factory],
        *,
        ticks: int,
        max_steps: float,
        faults: Faults,
        randomization: Any,
    ) -> None:
        self.robots, self._fleet, self._task = robots, fleet, task
        self._observed = ObservationCheck(task)
        step = ticks * fleet[0].period
        varied = [Randomization.of(randomization, config) for config in fleet]
        ranges = [drawn.ranges(config, step) for drawn, config in zip(varied, fleet, strict=True)]
        names = dict.fromkeys(name for drawn in varied for name in drawn.names)
        self._drawn = {f"drawn_{name}": PLACES[name] for name in names}
        pools = [spawn.pool for spawn in spawns]
        self._pool = pools[0]
        self._numbers = None if self._pool is None else self._pool.numbers
        self.worlds, self.places = make_worlds(pools, follow=task.follows)
        self._spawns = spawn_arrays(task, self.worlds, pools, self.places)
        sees = LIDAR in sensors
        self._has_map, self._has_movers = MAP in sensors, MOVERS in sensors
        mapped = self._has_map * len(MAP_NAMES) + self._has_movers * len(MOVER_NAMES)
        numbers = len(task.observation)
        self._setup = setup = make_setup(
            fleet,
            ticks=ticks,
            max_steps=max_steps,
            faults=make_faults(fleet[0], faults),
            isotropic="turn_factor" not in names
            and all(config.body.turn_factor is None for config in fleet),
            sees=sees,
            numbers=numbers,
            first_ray=numbers + mapped,
        )
        self._setups = record_of(setup)
        blocks, rays = layout.make_blocks(robots), max(ray_count(config, sees) for config in fleet)
        random = np.zeros((robots, 4), np.uint64)
        view = BatchView(layout.view_numbers(blocks), random, setup.dt, self.worlds)
        self.python = BatchSensors(python_sensors(sensors), fleet, robots, view)
        self._lidar_link = RobotLink(view, 0)
        self._first_python = setup.first_ray + rays
        """The first column of the observation that belongs to a sensor written in Python."""
        kinds = list(zip(varied, fleet, strict=True))
        edges = [np.reshape(footprint_edges(config)[:rays], (-1, 1)) for config in fleet]
        self.tables = layout.Tables(
            blocks=blocks,
            numbers=layout.view_numbers(blocks),
            counts=make_rings(blocks, max(count_slots(setup, *kind) for kind in kinds), 4),
            random=random,
            actions=np.zeros((robots, 2)),
            over=np.zeros(robots, np.bool_),
            idle=np.zeros(robots, np.bool_),
            ranges=np.zeros((robots, rays)),
            edges=geometry.pad_rows(edges, (0.0,))[:, :, 0],
            observations=np.zeros((robots, self._first_python + self.python.size), np.float32),
            rewards=np.zeros(robots),
            ends=np.zeros((2, robots), np.bool_),
            ring=np.array([0, 0, 0, ticks], np.int64),
        )
        self._draws = make_draws(robots, fleet, ranges, varies=bool(names))
        self._commands = make_commands(blocks, setup, kinds)
        self._lines = make_lines(blocks, setup, self._commands)
        self._scans = make_scans(robots, self.worlds, setup, kinds)
        self._crowds = make_crowds(self.worlds, self._scans)
        self.maps: layout.Maps | None = None
        if self._has_map:
            records = np.concatenate([make_record(config, step) for config in fleet])
            scratch = np.zeros((len(blocks), SCRATCH), np.int32)
            self.maps = layout.Maps(records[np.arange(robots) % len(records)], scratch)
        write_builds(self.tables.numbers, fleet, setup, self.places)
        self._loops = make_loops(task, self.tables, setup, self._spawns)
        self._together = self._loops.compiled and not len(self.python)
        """Whether a robot's task can run right after its physics, on the same thread."""
        optional = {
            "world": self._numbers is not None,
            "scan_age": sees,
            "scan_stale": sees,
            "fault": faults.possible,
        }
        self._info = INFO | {name: name for name, has_it in optional.items() if has_it}
        if self._pool is not None and self._pool.moves:
            self._info |= CROWD_INFO
        """Keys of info, and their fields."""
        self.seeded = False

    @property
    def sensors(self) -> list[Sensor]:
        """One instance of each kind of sensor, in the order of their numbers in the observation."""
        if not self._setup.sees:
            return self.python.kinds
        config = self._fleet[0]
        lidar = LidarSensor(SimulatedLidar(self._lidar_link, config), config)
        seeing: list[Sensor] = [MapSensor(None, config)] if self._has_map else []
        seeing += [MoversSensor(None, config)] if self._has_movers else []
        return [*seeing, lidar, *self.python.kinds]

    def read(self, *names: str) -> NDArray[np.float64]:
        """Copy fields of `layout.Robots`, (numbers, robots); those of wheels are four numbers."""
        return layout.read_fields(self.tables.numbers, names, slice(self.robots))

    def copy_movers(self, robot: int, world: int) -> NDArray[np.float64] | None:
        """Copy what is seen of the movers around a robot in this world, as `Crowd.copy_states`."""
        if self._crowds is None:
            return None
        radii = self._crowds.motions.movers[world, :, RADIUS]
        used = radii > 0.0
        return np.column_stack([self._crowds.states[robot, used, :CLOCK], radii[used]])

    def measure_work(self) -> None:
        """Measure the work of the motors from now on, as field `work` [J]; it takes time."""
        self._setup = self._setup._replace(metered=True)
        self._setups = record_of(self._setup)

    def seed(self, seeds: list[int | None] | None, mask: Mask) -> None:
        """Make new generators."""
        if seeds is None and self.seeded:
            return
        for robot in np.flatnonzero(mask):
            seed = None if seeds is None else seeds[robot]
            if seed is not None or not self.seeded:
                self.tables.random[robot] = pcg.seed_row(seed)
                self.python.forget(int(robot))
        self.seeded = True

    def set_reset_options(self, options: Mapping[str, NDArray[Any]], mask: Mask) -> None:
        """Set the reset options that hold for the next episodes of the robots in the mask."""
        places = np.divmod(np.flatnonzero(mask), layout.BLOCK_ROBOTS)
        for name in layout.OPTIONS:
            self.tables.blocks[name][places] = options[name][mask] if name in options else 0.0

    def reset(self, mask: Mask, share: Share) -> None:
        """Begin new episodes of the robots in the mask."""
        tables = self.tables
        tables.over[:], tables.idle[:] = mask, True
        share(self._begin, len(tables.blocks))
        self._run_python(share, driven=False)
        self._check_observations()

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
        self._run_python(share, driven=True)
        ring[0] = (ring[0] + setup.ticks * setup.loops) % tables.counts.shape[1]
        if self._commands is not None:
            ring[1] = (ring[1] + setup.ticks) % self._commands.shape[1]
        self._check_observations()
        if not np.isfinite(tables.rewards).all():
            robot = int(np.isfinite(tables.rewards).argmin())
            raise ConfigError(
                f"{task_name(self._task)}.reward returned {tables.rewards[robot]} for robot "
                f"{robot}: must be a finite number{method_place(self._task, 'reward')}"
            )

    def _check_observations(self) -> None:
        """Raise ConfigError where the task observed NaN or infinity; warn once of other bounds."""
        self._observed.check(self.tables.observations[:, : self._setup.numbers])

    def _drive(self, first: int, last: int) -> None:
        """Run the physics of blocks first to last, and after a step's last tick what follows it."""
        tables, options = self.tables, (self._commands, self._lines, self._scans, self._crowds)
        drive.step(tables, *options, first, last, self._setups)
        if tables.ring[3] == self._setup.ticks:
            self._begin(first, last)

    def _begin(self, first: int, last: int) -> None:
        """Begin episodes of blocks' robots in `tables.over`; read LiDARs; run tasks if `_together`.

        Blocks are first to last.
        """
        tables, setups = self.tables, self._setups
        if tables.over[first * layout.BLOCK_ROBOTS : last * layout.BLOCK_ROBOTS].any():
            options = self._commands, self._lines, self._scans, self._crowds
            episode.reset(tables, *options, self._draws, first, last, setups, self._spawns)
        if self._scans is not None and self._setup.sees:
            optional = self._crowds, self.maps
            lidars.read_scans(tables, self._scans, *optional, first, last, setups)
        if self._together:
            self._loops.run(first, last)

    def _run_python(self, share: Share, *, driven: bool) -> None:
        """Read sensors written in Python, then run the task, where `_begin` hasn't done it.

        Sensors of robots that have begun are reset and read, those of others read if driven. Those
        whose board is silent at the reset get zeros.
        """
        if self._together:
            return
        if len(self.python):
            begun, silent = self.tables.over, self.read("silent")[0] > 0.0
            columns = self.tables.observations[:, self._first_python :]
            columns[begun & silent] = 0.0
            self.python.reset(np.flatnonzero(begun & ~silent), columns)
            if driven:
                self.python.read(np.flatnonzero(~self.tables.idle), columns)
        if self._loops.compiled:
            share(self._loops.run, len(self.tables.blocks))
        else:
            self._loops.run(0, len(self.tables.blocks))

    def info(self) -> dict[str, NDArray[np.float64]]:
        """Info with the keys of the single env, each an array with a row for each robot."""
        info = dict(zip(self._info, self.read(*self._info.values()), strict=True))
        if self._numbers is not None:
            info["world"] += self._numbers[0] - self.read("first_world")[0]
        info |= self._loops.info()
        for name, places in self._drawn.items():  # (robots,), or (robots, 4) in wheel order
            numbers = self._draws.drawn[:, places]
            info[name] = numbers[:, 0] if len(places) == 1 else numbers
        self.python.add_info(info)
        return info


def ray_count(config: RobotConfig, sees: bool) -> int:
    """How many rays a robot's LiDAR has; 0 without one."""
    return config.lidar.rays if sees else 0


def make_setup(fleet: Sequence[RobotConfig], **numbers: Any) -> layout.Setup:
    """Compute the numbers that all robots of a batch share."""
    config, loop_rate = fleet[0], fleet[0].firmware.loop_rate
    return layout.Setup(
        dt=loop_period(config),
        period=config.period,
        wire_time=config.wire_time,
        window=round(config.encoder.window * loop_rate),
        loops=whole_ratio("firmware.loop_rate", loop_rate, "", config.control_rate),
        **numbers,
    )


def make_faults(config: RobotConfig, faults: Faults) -> layout.LineFaults:
    """Convert the faults of the wire to numbers."""
    return layout.LineFaults(
        possible=faults.possible,
        episodes=float(faults.episodes),
        feedback=faults.direction != "commands",
        commands=faults.direction != "feedback",
        dropped=float(faults.dropped_lines),
        late=float(faults.late_lines),
        lateness=float(faults.lateness) if faults.possible else 0.0,
        patience=math.ceil(STANDSTILL_TIMEOUT / config.period),
        line_time=config.line_time,
        processing_time=config.firmware.processing_time,
        command_timeout=config.firmware.command_timeout or math.inf,
    )


def make_rings(blocks: NDArray[Any], *shape: int) -> NDArray[np.float64]:
    """Zeros of this shape for each robot, (blocks, ..., BLOCK_ROBOTS)."""
    return np.zeros((len(blocks), *shape, layout.BLOCK_ROBOTS))


def stack_records(tuples: Sequence[Any]) -> NDArray[Any]:
    """Records of named tuples of the same kind, one after the other."""
    return np.concatenate([record_of(values) for values in tuples])


def make_draws(
    robots: int, fleet: Sequence[RobotConfig], ranges: Sequence[DrawnRanges], *, varies: bool
) -> layout.Draws:
    """Make the arrays from which the physics of episodes is drawn."""
    delays = [np.reshape(drawn.delays, (-1, 1)) for drawn in ranges]
    return layout.Draws(
        nominal=np.array([compute_physics(config) for config in fleet]),
        low=np.array([drawn.low for drawn in ranges]),
        high=np.array([drawn.high for drawn in ranges]),
        delays=geometry.pad_rows(delays, (0.0,))[:, :, 0],
        delay_counts=np.array([len(rows) for rows in delays], np.int64),
        drawn=np.zeros((robots, len(ranges[0].low) if varies else 0)),
    )


Kinds = Sequence[tuple[Randomization, RobotConfig]]
"""What each kind of robots draws, and its configuration."""


def make_commands(
    blocks: NDArray[Any], setup: layout.Setup, kinds: Kinds
) -> layout.Commands | None:
    """Make the ring of commands; None where all commands of a step are the same."""
    is_limited = any(
        config.geofence is not None or not rules.is_unlimited(config) for _, config in kinds
    )
    delay = max(command_loops(config, drawn) for drawn, config in kinds)
    is_late = delay * setup.dt > setup.ticks * setup.period - setup.dt / 2.0
    if not (is_limited or is_late or setup.faults.possible):
        return None
    late = 2 * math.ceil(setup.faults.lateness / setup.period)
    return make_rings(blocks, 2 + late + math.ceil(delay / setup.loops), 2)


def make_lines(
    blocks: NDArray[Any], setup: layout.Setup, commands: layout.Commands | None
) -> layout.Lines | None:
    """Make what lost and late lines need; None where there are no faults."""
    if commands is None or not setup.faults.possible:
        return None
    rows = layout.EPISODE_ROWS if setup.faults.feedback else 0
    return layout.Lines(make_rings(blocks, commands.shape[1], 3), make_rings(blocks, rows))


def make_scans(
    robots: int, worlds: Sequence[World], setup: layout.Setup, kinds: Kinds
) -> layout.Scans | None:
    """Make the arrays of obstacles, rays and trails; None where there is nothing to see or touch.

    Obstacles are padded to the world with most of them.
    """
    if not (setup.sees or any(world.obstacles or world.movers for world in worlds)):
        return None
    fleet, far = [config for _, config in kinds], PADDING_PLACE
    specs = [ray_spec(config) if setup.sees else None for config in fleet]
    slots = 0
    for drawn, config in kinds if setup.sees else ():  # two revolutions of the slowest LiDAR
        rates = drawn.lidar_rate or (config.lidar.rate,)
        slots = max(slots, count_trail_rows(2.0 / rates[0], config.period))
    return layout.Scans(
        around=geometry.surround_kinds(
            geometry.pad_rows([world.circles for world in worlds], (far, far, 0.0)),
            geometry.pad_rows([world.segments for world in worlds], (far, far, far, far)),
            specs,
            fleet,
        ),
        rays=stack_records([make_rays(config) for config in fleet]),
        trails=np.zeros((2, robots, slots, 4)),
    )


def make_crowds(worlds: Sequence[World], scans: layout.Scans | None) -> layout.Crowds | None:
    """Make the arrays of what moves; None where nothing does."""
    if scans is None or not any(world.movers for world in worlds):
        return None
    motions = make_motions([world.movers for world in worlds])
    robots, slots = scans.trails.shape[1:3]
    most = motions.movers.shape[1]
    return layout.Crowds(
        motions,
        np.zeros((robots, most, STATE_NUMBERS)),
        np.zeros((robots, slots, most, 2)),
    )


def write_builds(
    numbers: NDArray[np.float64],
    fleet: Sequence[RobotConfig],
    setup: layout.Setup,
    places: Sequence[range],
) -> None:
    """Write the numbers of `layout.Build`, and those of the safety rules, of all robots."""
    rows = []
    for kind, (config, worlds) in enumerate(zip(fleet, places, strict=True)):
        per_radian = config.encoder.counts_per_revolution / (2.0 * math.pi)
        built: dict[str, Any] = {
            "kind": kind,
            "ramp": [config.motor.of_wheel(w).acceleration * setup.dt for w in range(4)],
            "counts_per_radian": per_radian,
            "speed_per_count": 1.0 / (per_radian * setup.window * setup.dt),
            "quantum": config.encoder.quantum or 0.0,
            "max_linear": config.max_linear,
            "max_angular": config.max_angular,
            "stale": stale_after(config),
            "rays": ray_count(config, setup.sees),
            "first_world": worlds.start,
            "worlds": len(worlds),
        }
        guards = rules.make_rules(config)[1:]  # but for the period
        rows.append(np.hstack([*(built[name] for name in layout.BUILD), *guards]))
    kinds = np.arange(len(numbers) * layout.BLOCK_ROBOTS).reshape(len(numbers), -1) % len(fleet)
    for row, column in enumerate(np.array(rows, np.float64).T):
        numbers[:, layout.BUILD_ROW + row] = column[kinds]


def count_slots(setup: layout.Setup, drawn: Randomization, config: RobotConfig) -> int:
    """Size of the ring of encoder counts [firmware loops].

    The oldest feedback line that may still be on its way, and the encoders' window before it.

    Raises:
        ConfigError: where feedback is on its way for as long as `feedback_timeout`.
    """
    delay = wire_loops(config) + round((drawn.latency or (0.0,))[-1] / setup.dt)
    if delay * setup.dt >= config.feedback_timeout:
        raise ConfigError(
            f"feedback_timeout = {config.feedback_timeout:g} s: feedback takes "
            f"{delay * setup.dt:g} s on this wire (baud_rate, firmware.processing_time): must be "
            "longer"
        )
    rates = drawn.feedback_rate or (config.feedback_rate,)
    slowest = math.ceil(1.0 / (rates[0] * setup.dt))
    late = math.ceil(setup.faults.lateness / setup.dt)
    return int(setup.window + delay + late + slowest + setup.loops + 1)


def command_loops(config: RobotConfig, drawn: Randomization) -> int:
    """The longest time until a command has effect, without faults [firmware loops]."""
    latency = (drawn.latency or (0.0,))[-1] / loop_period(config)
    return round(wire_loops(config, drawn.longest_delay(config)) + latency)


def make_worlds(pools: Sequence[Pool | None], *, follow: bool) -> tuple[list[World], list[range]]:
    """Make all worlds of all pools, each pool's once."""
    worlds: list[World] = []
    places: dict[int, range] = {}
    for pool in pools:
        if pool is None or id(pool) in places:
            continue
        if len(pool) > MAX_WORLDS:
            raise WorldError(
                f"worlds: {len(pool):,} ({pool}) are too many for a batch, which makes them all "
                f"when it begins: at most {MAX_WORLDS:,}"
            )
        made = [align_with_path(world) if follow else world for world in pool]
        places[id(pool)] = range(len(worlds), len(worlds) + len(made))
        worlds += made
    return worlds, [range(0) if pool is None else places[id(pool)] for pool in pools]


def spawn_arrays(
    task: Task, worlds: Sequence[World], pools: Sequence[Pool | None], places: Sequence[range]
) -> layout.Spawns:
    """Make the arrays of starts, goals and paths; pools and their places are of each kind."""
    low, high = task.goal_distance
    starts = [world.start for world in worlds]
    order = np.arange(len(worlds), dtype=np.int64)
    for pool, place in zip(pools, places, strict=True):
        if pool is not None and pool.generated:
            order[place.start : place.stop] = place.start + pool.by_difficulty[0]
    paths = [path_from_start(world) for world in worlds] if task.follows else []
    return layout.Spawns(
        min_distance=float(low),
        max_distance=float(high),
        starts=np.array(
            [(s.x, s.y, s.radius, math.nan if s.theta is None else s.theta) for s in starts]
        ).reshape(-1, 4),
        goals=np.array([(w.goal.x, w.goal.y, w.goal.radius) for w in worlds]).reshape(-1, 3),
        lengths=np.array([world.length for world in worlds], np.float64),
        paths=geometry.pad_rows(paths, (0.0, 0.0, 0.0)),
        samples=np.array([len(samples) for samples in paths], np.int64),
        order=order,
    )
