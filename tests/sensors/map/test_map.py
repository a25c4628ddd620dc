"""The map as a sensor: what it adds to the observation, for one robot and in a batch."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest

import acsar_gym  # noqa: F401 - registers the ids
from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.config.footprint import outline_radius, outline_reach
from acsar_gym.envs import ids
from acsar_gym.errors import ConfigError
from acsar_gym.lidar.scan import make_rays
from acsar_gym.sensors import LIDAR, MAP
from acsar_gym.sensors.map.seen import CELL_SIDE, OCCUPIED
from acsar_gym.sensors.map.sensor import (
    BODY,
    FARTHEST_CLEARANCE,
    MAP_HIGH,
    MAP_LOW,
    MAP_NAMES,
    NEAR_SHARE,
    OLDEST_WAY,
    SECTORS,
    UNSEEN_CLEARANCE,
    clear_map,
    describe_body,
    make_record,
    update_alone,
)
from acsar_gym.sensors.map.way import SCRATCH
from acsar_gym.worlds import Scene

ACSAR = RobotConfig.preset("acsar")
ROUND = ACSAR.with_(
    footprint=tuple((0.3 * math.cos(a), 0.3 * math.sin(a)) for a in np.arange(24) * math.tau / 24),
    lidar_x_offset=0.12,
    lidar_y_offset=-0.08,
)
LONG = ACSAR.with_(lidar_x_offset=0.1, lidar_y_offset=0.05, lidar={"rays": 96, "max_range": 9.0})
HALF_TURN = ACSAR.with_(lidar={"rays": 61, "field_of_view": math.pi})
WALL_AHEAD = 1.2
Pose = tuple[float, float, float]


class Mapped:
    """A map without a robot around it."""

    def __init__(
        self,
        config: RobotConfig,
        goal: tuple[float, float] = (3.0, 0.5),
        update: Callable[..., Any] = update_alone,
    ) -> None:
        made = make_record(config, 0.1)
        self.record: Any = made.view(np.recarray)[0]
        self._records = made if update is update_alone else made.view(np.recarray)
        self._update, self._goal, self.rays = update, goal, make_rays(config)
        self._scratch = np.zeros(SCRATCH, np.int32)
        self.now = 0.0
        clear_map(self.record)

    def see(self, pose: Pose, ranges: Any) -> dict[str, float]:
        out, seen = np.zeros(len(MAP_NAMES)), np.asarray(ranges, np.float64)
        self.now += 0.1
        bearings = self.rays.start + np.arange(len(seen)) * self.rays.step
        measured = bearings, np.full(len(seen), self.now), self.now
        given = self.now, pose, self._goal, seen, self.rays, measured, self._scratch, out
        records = self._records if self._update is update_alone else self._records[0]
        self._update(records, *given)
        assert (out >= MAP_LOW - 1e-9).all()
        assert (out <= MAP_HIGH + 1e-9).all()
        return dict(zip(MAP_NAMES, out.tolist(), strict=True))


def angles(config: RobotConfig) -> Any:
    rays = make_rays(config)
    return rays.start + np.arange(config.lidar.rays) * rays.step


def far(config: RobotConfig) -> Any:
    return np.full(config.lidar.rays, config.lidar.max_range)


def wall_seen(config: RobotConfig, pose: Pose, wall: float = WALL_AHEAD) -> Any:
    """Ranges to an endless wall across x [m]."""
    theta, rays = pose[2], make_rays(config)
    x = pose[0] + math.cos(theta) * rays.mount_x - math.sin(theta) * rays.mount_y
    cos = np.cos(theta + angles(config))
    with np.errstate(divide="ignore"):
        ranges = np.where(cos > 1e-9, (wall - x) / cos, np.inf)
    return np.clip(ranges, config.lidar.min_range, config.lidar.max_range)


def sectors(seen: dict[str, float]) -> Any:
    return np.array([seen[f"clearance_{n}"] for n in range(SECTORS)])


def clearance(share: Any) -> Any:
    """In radii of the footprint."""
    return NEAR_SHARE * (np.exp(share * math.log1p(FARTHEST_CLEARANCE / NEAR_SHARE)) - 1.0)


@pytest.mark.parametrize("config", [ACSAR, ROUND, LONG], ids=["rectangle", "circle", "long"])
@pytest.mark.parametrize("seed", range(3))
def test_clearances_are_those_of_the_exact_footprint(config: RobotConfig, seed: int) -> None:
    rng, radius, rays = (
        np.random.default_rng(seed),
        outline_radius(config.outline),
        make_rays(config),
    )
    low = max(config.lidar.min_range, 2.2 * radius)
    ranges = rng.uniform(low, config.lidar.max_range, config.lidar.rays)
    ranges[rng.random(len(ranges)) < 0.2] = config.lidar.max_range
    wanted = np.full(SECTORS, np.inf)
    for distance, angle in zip(ranges, angles(config), strict=True):
        x = rays.mount_x + distance * math.cos(angle)
        y = rays.mount_y + distance * math.sin(angle)
        bearing = math.atan2(y, x)
        reach = outline_reach(config.outline, (0.0, 0.0), bearing)
        free = min((math.hypot(x, y) - reach) / radius, FARTHEST_CLEARANCE)
        free = FARTHEST_CLEARANCE if distance == config.lidar.max_range else free
        sector = int((bearing + math.pi) / math.tau * SECTORS) % SECTORS
        wanted[sector] = min(wanted[sector], free)
    found = clearance(sectors(Mapped(config).see((1.0, -2.0, 0.7), ranges)))
    seen = np.isfinite(wanted)
    assert seen.sum() > 0.6 * SECTORS
    assert found[seen] == pytest.approx(wanted[seen], abs=0.02)
    between = ~seen & np.roll(seen, 1) & np.roll(seen, -1)
    nearer = np.minimum(np.roll(wanted, 1), np.roll(wanted, -1))
    assert found[between] == pytest.approx(nearer[between], abs=0.02)


def test_a_lidar_that_sees_ahead_alone_remembers_what_is_behind() -> None:
    mapped, radius = Mapped(HALF_TURN), outline_radius(HALF_TURN.outline)
    for _ in range(3):
        seen = sectors(mapped.see((0.0, 0.0, 0.0), wall_seen(HALF_TURN, (0.0, 0.0, 0.0))))
    ahead = clearance(seen[SECTORS // 2])
    reach = HALF_TURN.body.length / 2.0
    assert ahead == pytest.approx((WALL_AHEAD - reach) / radius, abs=0.1)
    never_seen = pytest.approx(UNSEEN_CLEARANCE)
    assert clearance(seen[[0, -1]]) == never_seen
    turned = (0.0, 0.0, math.pi)
    seen = sectors(mapped.see(turned, far(HALF_TURN)))
    assert clearance(seen[[0, -1]]) == pytest.approx(ahead, abs=2.0 * CELL_SIDE)
    assert seen[SECTORS // 2] == 1.0
    for turn in range(64):  # the wall is gone, and what is around is seen by and by
        seen = sectors(mapped.see((0.0, 0.0, 0.2 * turn), far(HALF_TURN)))
    assert seen[0] == 1.0
    clear_map(mapped.record)
    assert clearance(sectors(mapped.see(turned, far(HALF_TURN)))[0]) == never_seen


def test_what_is_gained_adds_up_along_the_way() -> None:
    """Around a wall, as long as the same way is followed."""
    mapped, pace = Mapped(ACSAR, goal=(2.5, 0.2)), ACSAR.max_linear * 0.1
    told, pose, ages = mapped.see((0.0, 0.0, 0.0), far(ACSAR)), (0.0, 0.0, 0.0), []
    total, begin = 0.0, float(mapped.record.left)
    assert told["gained"] == 0.0
    for step in range(OLDEST_WAY - 1):
        pose = (pose[0] + 0.8 * pace, pose[1] + (0.3 if step % 3 else -0.4) * pace, 0.0)
        told = mapped.see(pose, far(ACSAR))
        total += told["gained"] * pace
        ages.append(float(mapped.record.age))
        assert total == pytest.approx(begin - mapped.record.left, abs=1e-9)
    assert ages == list(range(1, OLDEST_WAY))
    assert total > 0.5 * OLDEST_WAY * pace
    assert mapped.see(pose, far(ACSAR))["gained"] == 0.0  # nothing for standing still
    assert mapped.record.age == 0.0


def test_a_way_that_is_blocked_is_planned_anew() -> None:
    mapped, pose = Mapped(ACSAR, goal=(3.0, 0.0)), (0.0, 0.0, 0.0)
    told = mapped.see(pose, far(ACSAR))
    assert (told["way_cos_2"], told["way_sin_2"]) == pytest.approx((1.0, 0.0), abs=0.02)
    before = told["way_left"]
    wide = far(ACSAR)
    ahead = np.abs(angles(ACSAR)) < 0.7
    wide[ahead] = 1.0 / np.cos(angles(ACSAR)[ahead])
    for _ in range(8):
        told = mapped.see(pose, wide)
    assert told["way_left"] > before
    assert abs(told["way_sin_2"]) > 0.3
    assert mapped.record.age < 8.0


@pytest.mark.parametrize(
    ("changes", "name", "factor"),
    [
        ({"max_linear": ACSAR.max_linear / 2.0}, "top_speed", 0.5),
        ({"max_linear": ACSAR.max_linear / 2.0}, "stopping", 0.25),
        ({"lidar": {"max_range": ACSAR.lidar.max_range / 2.0}}, "sight", 0.5),
        ({"max_linear": ACSAR.max_linear * 2.0}, "grip", 0.5),
    ],
)
def test_the_robot_itself_is_described(changes: Any, name: str, factor: float) -> None:
    before, after = describe_body(ACSAR), describe_body(ACSAR.with_(**changes))
    place = BODY.index(name)
    assert 0.0 < before[place] < 1.0
    assert after[place] == pytest.approx(factor * before[place])


def check_same(one: Any, other: Any) -> None:
    """Compare all that two maps remember."""
    for name in one.dtype.names:
        found, wanted = np.asarray(one[name]), np.asarray(other[name])
        if name == "points":
            count = int(one["corners"])
            found, wanted = found[:count], wanted[:count]
        if found.dtype == np.uint8:
            np.testing.assert_array_equal(found, wanted, err_msg=name)
        else:
            np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-9, err_msg=name)


@pytest.mark.parametrize(
    ("robot", "kind"), [("acsar", "obstacle_goal"), ("jackal", "barn"), ("drawn:3", "barn")]
)
def test_the_map_of_a_batchs_robot_is_the_single_ones(robot: str, kind: str) -> None:
    worlds: Any = {"worlds": "clutter:6" if kind == "obstacle_goal" else "barn:4"}
    many: Any = ids.make_vec(ids.full_id(kind), 3, robot=robot, threads=1, **worlds)
    one: Any = gymnasium.make(ids.full_id(kind), link="planar", robot=robot, **worlds)
    many.reset(seed=41)
    one.reset(seed=42)
    rng = np.random.default_rng(0)
    for _ in range(25):
        actions = rng.uniform(-0.3, 1.0, (3, 2)).astype(np.float32)
        many.step(actions)
        *_, ended, _, _ = one.step(actions[1])
        if ended:
            break
        check_same(many.batch.maps.records[1], one.unwrapped.sensors[0]._record)
    assert (np.asarray(one.unwrapped.sensors[0]._record.counts) >= OCCUPIED).any()
    many.close()
    one.close()


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        ([MAP], "sensor 'map': the robot has no 'lidar', which it needs"),
        ([MAP, LIDAR, MAP], "two are named 'map'"),
        (["mep"], "did you mean 'map'"),
    ],
)
def test_a_map_needs_a_lidar(sensors: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Robot(open_link("planar", ACSAR), ACSAR, sensors)
    with pytest.raises(ConfigError, match=message):
        ids.make_vec("acsar_gym/PointGoal-v0", 2, sensors=sensors)


def test_the_map_comes_first_and_the_lidar_after_it() -> None:
    robot = Robot(open_link("planar", ACSAR), ACSAR, [LIDAR, MAP])
    assert [sensor.name for sensor in robot.sensors] == [MAP, LIDAR]
    with pytest.raises(ConfigError, match="the scene has no goal, to which it shows the way"):
        robot.sensors[0].reset(Scene(), np.random.default_rng(0))
