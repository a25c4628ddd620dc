"""Shortest paths against lengths by hand, a visibility graph, and the published BARN worlds."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from samples import samples
from scipy.sparse.csgraph import dijkstra
from search_tools import (
    CUT,
    PILLAR,
    RESOLVED,
    ROUGHLY,
    around,
    array,
    between,
    closest,
    polar,
    random_world,
)

from acsar_gym.config import RobotConfig
from acsar_gym.errors import WorldError
from acsar_gym.worlds import files, search
from acsar_gym.worlds import grid as cells_of
from acsar_gym.worlds.geometry import point_clearance
from acsar_gym.worlds.grid import CELL_SIDE, PATH_SLACK, Grid, free_cells
from acsar_gym.worlds.search import (
    check_region,
    footprint_radius,
    path_length,
    remaining_distance,
    shortest_path,
)
from acsar_gym.worlds.world import Region, World, make_rectangle, make_wall

BARN = Path(__file__).parents[2].parent / "shared" / "barn"
BARN_ROBOT = 0.375
REAL_ROBOT = footprint_radius(RobotConfig.preset("acsar"))


def room(door: float, turn: float = 0.0, shift: Any = (0.0, 0.0)) -> World:
    """From the middle of a closed room of 4 x 4 m through a door to a goal outside."""
    segments = np.concatenate(
        [
            make_wall((2.0, -2.0), (2.0, 2.0), array([2.0 - door / 2.0, 2.0 + door / 2.0])),
            array([2, 2, -2, 2], [-2, 2, -2, -2], [-2, -2, 2, -2]),
        ]
    )
    cos, sin = math.cos(turn), math.sin(turn)
    points = np.concatenate([segments.reshape(-1, 2), array([0, 0], [4, 0])])
    points = points @ array([cos, sin], [-sin, cos]) + shift
    return between(points[-2], points[-1], (), points[:-2].reshape(-1, 4))


def visibility_graph(world: World, radius: float) -> float:
    """Length of a shortest way between circles, at most 0.3 % too long; inf where there is none."""
    corners = 48
    angles = math.tau * np.arange(corners) / corners
    points = [array([world.start.x, world.start.y], [world.goal.x, world.goal.y])]
    for x, y, size in world.circles.tolist():
        outer = (size + radius) / math.cos(math.pi / corners) * 1.0001
        corner = np.column_stack([x + outer * np.cos(angles), y + outer * np.sin(angles)])
        points.append(corner[point_clearance(corner, world) >= radius])
    every = np.concatenate(points)
    i, j = np.triu_indices(len(every), 1)
    way = every[j] - every[i]
    free = np.ones(len(i), np.bool_)
    for x, y, size in world.circles.tolist():
        to = array(x, y) - every[i]
        share = np.clip((to * way).sum(axis=1) / (way * way).sum(axis=1), 0.0, 1.0)
        free &= np.hypot(*(to - share[:, None] * way).T) >= size + radius - 1e-9
    graph = np.zeros((len(every), len(every)))
    graph[i[free], j[free]] = np.hypot(*way[free].T)
    lengths = dijkstra(graph, directed=False, indices=[0])
    return float(lengths[0, 1])


@pytest.mark.parametrize(
    ("circles", "segments"),
    [
        ((), ()),
        (array([1.0, 0.5, 0.2]), ()),  # 0.3 m beside the way
        ((), array([0.0, 0.26, 2.0, 0.26])),
        (array([-0.5, 0.0, 0.2], [2.5, 0.0, 0.2]), ()),  # behind start and goal
    ],
)
def test_where_nothing_is_in_the_way_it_is_straight(circles: Any, segments: Any) -> None:
    path = shortest_path(between((0, 0), (2, 0), circles, segments), 0.25)
    assert path.tolist() == [[0.0, 0.0], [2.0, 0.0]]


@pytest.mark.parametrize("degrees", [*range(0, 91, 10), 180, 217, 333])
def test_round_one_circle_it_is_tangent_arc_tangent(degrees: int) -> None:
    """Pillar of 0.75 m and a disc of 0.25 m: round a circle of 1 m, from 3 m away."""
    start = polar(3.0, math.radians(degrees))
    world = between(start, -start, array([0.0, 0.0, 0.75]))
    path = shortest_path(world, 0.25)
    by_hand = around(start, -start, (0.0, 0.0), 1.0)
    assert by_hand == pytest.approx(2.0 * math.sqrt(8.0) + math.pi - 2.0 * math.acos(1.0 / 3.0))
    assert 1.0 - CUT < path_length(path) / by_hand < ROUGHLY
    assert closest(path, world) > 0.25 - CUT


@pytest.mark.parametrize("radius", [0.1, 0.25, 0.5])
@pytest.mark.parametrize("degrees", [0, 30, 77])
def test_round_a_walls_end_it_is_an_arc_of_the_footprint(radius: float, degrees: int) -> None:
    """The way on the other side of the wall is longer: 1 m to the near end, 5 m to the far one."""
    turn = array(*(polar(1.0, math.radians(degrees + k)) for k in (0, 90)))
    start, goal, near, far = array([-2.0, 0.0], [2.0, 0.5], [0.0, 1.0], [0.0, -5.0]) @ turn
    world = between(start, goal, (), array([*near, *far]))
    path = shortest_path(world, radius)
    by_hand = around(start, goal, near, radius, reflex=True)
    assert 1.0 - CUT < path_length(path) / by_hand < ROUGHLY
    assert closest(path, world) > radius - CUT


def test_the_shorter_side_is_taken() -> None:
    for low, high, expected in ((-1.0, 3.0, -1.25), (-3.0, 1.0, 1.25)):
        path = shortest_path(between((-3, 0), (3, 0), (), array([0.0, low, 0.0, high])), 0.25)
        assert path[:, 1].min() == pytest.approx(min(expected, 0.0), abs=0.05)
        assert path[:, 1].max() == pytest.approx(max(expected, 0.0), abs=0.05)


def test_a_long_way_is_pulled_straight_too() -> None:
    """Past the first block of points that are tried at once, and past several."""
    for length in (search.POINTS_AT_ONCE * CELL_SIDE, 4.1 * search.POINTS_AT_ONCE * CELL_SIDE):
        wall_ahead = array([0.0, -length, 0.0, 1.0])
        world = between((-length, 0), (length, 0), (), wall_ahead)
        path = shortest_path(world, 0.25)
        by_hand = around((-length, 0), (length, 0), (0.0, 1.0), 0.25, reflex=True)
        assert path_length(path) < 1.01 * by_hand
        assert len(path) < 10


@samples(2, 8)
@pytest.mark.parametrize("radius", [0.2, 0.25, 0.4])
def test_a_door_is_passed_where_it_is_just_wide_enough(radius: float, count: int) -> None:
    """Whatever its direction and place, given the room that the grid needs."""
    rng = np.random.default_rng(1)
    for _ in range(count):
        turn, shift = rng.uniform(0.0, math.tau), rng.uniform(-0.1, 0.1, 2)
        world = room(2.0 * (radius + RESOLVED), turn, shift)
        assert path_length(shortest_path(world, radius)) == pytest.approx(4.0)
        aside = Region(*np.add(shift, polar(1.0, turn + 1.7)).tolist())
        path = shortest_path(world, radius, start=aside)
        assert closest(path, world) > radius - CUT
        assert 4.0 < path_length(path) < 5.0
        with pytest.raises(WorldError, match="no way from start to goal"):
            shortest_path(room(2.0 * radius - 2.0 * CUT, turn, shift), radius, start=aside)


@samples(8, 40)
@pytest.mark.parametrize("radius", [0.22, 0.25, 0.35, 0.5])
def test_no_path_comes_nearer_than_its_radius(radius: float, count: int) -> None:
    found = 0
    for seed in range(count):
        world = random_world(seed, radius)
        try:
            path = shortest_path(world, radius)
        except WorldError as error:
            assert "no way from start to goal" in str(error)  # noqa: PT017
            continue
        found += 1
        assert closest(path, world) >= radius - CUT
        ends = array([world.start.x, world.start.y], [world.goal.x, world.goal.y])
        assert path[[0, -1]].tolist() == ends.tolist()
        assert path_length(path) >= math.dist(*ends) - 1e-9
    assert found >= count / 2


@samples(6, 40)
@pytest.mark.parametrize("radius", [0.1, 0.25])
def test_paths_are_about_as_short_as_those_of_a_visibility_graph(radius: float, count: int) -> None:
    """Eight directions may choose the wrong side of an obstacle, which costs 8 % at most."""
    rng = np.random.default_rng(1)
    ratios, walled = [], 0
    for _ in range(count):
        circles = np.column_stack([rng.uniform(-2, 2, (6, 2)), rng.uniform(0.05, 0.6, 6)])
        start = polar(3.2, rng.uniform(0.0, math.tau))
        world = between(start, -start, circles)
        path = shortest_path(world, radius)
        assert path_length(path) >= visibility_graph(world, radius - CUT) * 0.997
        wider = visibility_graph(world, radius + RESOLVED)
        walled += math.isinf(wider)
        ratios.append(path_length(path) / wider)
        assert ratios[-1] < 1.085
    assert np.median(ratios) < 1.005
    assert walled < count / 2


NEEDS = " from an obstacle, a footprint of radius 0.25 m needs {:.2f} m"


@pytest.mark.parametrize(
    ("world", "message"),
    [
        (
            between((0.1, 0), (3, 0), PILLAR),
            "the start (0.1, 0) lies 0.00 m" + NEEDS.format(0.25),
        ),
        (
            between((3, 0), (0.7, 0), PILLAR, name="pillar 7"),
            "pillar 7: the goal (0.7, 0) lies 0.20 m" + NEEDS.format(0.25),
        ),
        (
            World(PILLAR, start=Region(-1.2, 0.0, 0.5), goal=Region(3.0, 0.0)),
            "the start (-1.2, 0) lies 0.70 m" + NEEDS.format(0.75),
        ),
        (
            World(PILLAR, start=Region(3.0, 0.0), goal=Region(-1.2, 0.0, 0.5)),
            "the goal (-1.2, 0) lies 0.70 m" + NEEDS.format(0.75),
        ),
        (
            between((0, 0), (3, 0), (), make_rectangle(-1.0, -1.0, 1.0, 1.0), "cell"),
            "cell: no way from start to goal for a footprint of radius 0.25 m",
        ),
    ],
)
def test_what_has_no_way_is_one_clear_error(world: World, message: str) -> None:
    with pytest.raises(WorldError) as caught:
        shortest_path(world, 0.25)
    assert str(caught.value) == message


def test_a_region_counts_with_all_its_places() -> None:
    world = World(PILLAR)
    check_region(world, "start", Region(-1.2, 0.0, 0.45), 0.25)
    check_region(world, "start", Region(-1.2, 0.0, 0.45), 0.25 + PATH_SLACK / 2.0)
    check_region(World(), "start", Region(0.0, 0.0, 100.0), 50.0)
    with pytest.raises(WorldError, match="the middle"):
        check_region(world, "middle", Region(-1.2, 0.0, 0.45), 0.25 + 2.0 * PATH_SLACK)


@pytest.mark.parametrize("x", [-2.0, -3.0, -5.0, -20.0])
def test_a_start_may_lie_outside_the_world(x: float) -> None:
    """So does a robot that has driven away, for way_left."""
    world = between((-1, 0), (1, 0), PILLAR)
    path = shortest_path(world, 0.25, Region(x, 0.0))
    assert path_length(path) == pytest.approx(1.0 - x, abs=0.5)


@samples(5, 40)
def test_a_start_that_just_fits_has_a_way_though_its_cell_does_not(count: int) -> None:
    rng = np.random.default_rng(3)
    for _ in range(count):
        angle, near = rng.uniform(0.0, math.tau), rng.uniform(-0.05, 0.05, 2)
        ahead = near + polar(0.2501, angle)
        across = polar(1.0, angle + math.pi / 2.0)
        line = array([*(ahead - across), *(ahead + across)])
        for world in (
            between(near, near + polar(1.0, angle), (), line),
            between(near + polar(1.0, angle), near, (), line),
        ):
            path = shortest_path(world, 0.25)
            assert closest(path, world) > 0.25 - RESOLVED
            assert 2.0 < path_length(path) < 3.12


@pytest.mark.skipif(not BARN.is_dir(), reason="the published worlds aren't here")
def test_published_barn_worlds_are_crossed_on_no_longer_a_way() -> None:
    worlds = files.load_folder(BARN)
    assert len(worlds) == 5
    for world in worlds:
        lengths = []
        for radius in (REAL_ROBOT, BARN_ROBOT):
            path = shortest_path(world, radius)
            assert closest(path, world) >= radius - CUT
            lengths.append(path_length(path))
        assert 10.0 <= lengths[0] <= world.length
        # The published path of world 299 comes as near as 0.225 m, where this one may not.
        assert lengths[1] <= world.length + 0.01
        with pytest.raises(WorldError, match=f"^{world.name}: no way"):
            shortest_path(world, 1.5)


@pytest.mark.parametrize("radius", [0.05, 0.024])
def test_no_footprint_goes_through_a_wall(radius: float) -> None:
    path = shortest_path(between((-3, 0), (3, 0), (), array([0.0, -1.0, 0.0, 1.0])), radius)
    assert path_length(path) >= 2.0 * math.hypot(3.0, 1.0) - 1e-9


LARGE = array([-500.0, 0.0, -499.0, 0.0], [499.0, 0.0, 500.0, 0.0])
"""What makes a world 1 km wide."""


@pytest.mark.parametrize("radius", [0.0, 0.25, 5.0])
def test_huge_worlds_are_searched_coarsely(radius: float) -> None:
    square = np.concatenate([LARGE, LARGE[:, [1, 0, 3, 2]]])
    for world, metres in (
        (World(segments=square), 1e3),
        (World(circles=array([1e4, 1e4, 1e4], [-1e4, -1e4, 1e4])), 4e4),
    ):
        grid = free_cells(world, radius)
        assert 0.9 * cells_of.MAX_CELLS < grid.free.size < 1.02 * cells_of.MAX_CELLS
        assert grid.side == pytest.approx(metres / 1000.0, rel=0.1)
    small = free_cells(World(circles=PILLAR), 0.25)
    assert small.side == CELL_SIDE
    assert small.free.size < 5_000


def test_in_a_coarse_world_a_wide_footprint_finds_its_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cells_of, "MAX_CELLS", 40_000)  # 5 m each, as for 10 km
    segments = np.concatenate([LARGE, LARGE[:, [1, 0, 3, 2]], array([0.0, -400.0, 0.0, 100.0])])
    world = between((-200, 0), (200, 0), (), segments)
    path = shortest_path(world, 20.0)
    by_hand = around((-200, 0), (200, 0), (0.0, 100.0), 20.0, reflex=True)
    assert 1.0 - CUT < path_length(path) / by_hand < ROUGHLY
    assert closest(path, world) > 20.0 - 0.2


@samples(3, 10)
def test_free_cells_are_those_of_exact_distances(count: int) -> None:
    for seed in range(count):
        world, radius = random_world(seed, 0.2), 0.1 + 0.05 * seed
        grid = free_cells(world, radius)
        numbers = np.arange(grid.free.size)
        centres = grid.centres(numbers)
        exact = point_clearance(centres, world)
        sure = np.abs(exact - radius) > PATH_SLACK
        assert np.array_equal(grid.free.ravel()[sure], exact[sure] > radius)
        assert [grid.cell(x, y) for x, y in centres[::97].tolist()] == numbers[::97].tolist()
        left, low, right, high = world.bounds
        room_left = 2.0 * radius
        assert (centres.min(axis=0) <= (left - room_left, low - room_left)).all()
        assert (centres.max(axis=0) >= (right + room_left, high + room_left)).all()


def slowly(free: Any, start: int, goal: int) -> float:
    """Dijkstra's algorithm without a heap."""
    count, width = free.size, free.shape[1]
    lengths = {start: 0.0}
    done: set[int] = set()
    while open_cells := set(lengths) - done:
        here = min(open_cells, key=lambda cell: lengths[cell])
        done.add(here)
        i, j = divmod(here, width)
        for k in range(count):
            di, dj = k // width - i, k % width - j
            square = free[min(i, i + di) : max(i, i + di) + 1, min(j, j + dj) : max(j, j + dj) + 1]
            if max(abs(di), abs(dj)) == 1 and square.all():
                length = lengths[here] + math.hypot(di, dj)
                lengths[k] = min(lengths.get(k, math.inf), length)
    return lengths.get(goal, math.inf)


@samples(15, 60)
def test_ways_over_cells_are_those_of_a_slow_search(count: int) -> None:
    rng = np.random.default_rng(2)
    blocked = 0
    for _ in range(count):
        free = rng.random((7, 8)) < 0.75
        first, last = rng.choice(np.flatnonzero(free), 2, replace=False).tolist()
        grid = Grid(free, 0.3, -0.7, 0.05)
        cells = cells_of.search_cells(grid, first, last)
        length = math.inf if cells is None else path_length(grid.centres(cells)) / grid.side
        assert length == pytest.approx(slowly(free, first, last))
        blocked += cells is None
    assert 0 < blocked < 0.8 * count


class TestWayLeft:
    GOAL = Region(3.0, 0.0)
    PILLAR = between((-3, 0), (3, 0), PILLAR)

    def test_it_is_the_shortest_way(self) -> None:
        left = remaining_distance(self.PILLAR, 0.25, Region(-3.0, 0.1), self.GOAL)
        path = shortest_path(self.PILLAR, 0.25, Region(-3.0, 0.1))
        assert left == path_length(path) > 6.1
        assert remaining_distance(World(), 0.25, Region(0.0, 4.0), self.GOAL) == 5.0
        assert remaining_distance(self.PILLAR, 0.25, self.GOAL, self.GOAL) == 0.0

    @pytest.mark.parametrize("gap", [0.0, 0.01, 0.1, 0.24])
    def test_a_robot_that_touches_something_still_has_a_way(self, gap: float) -> None:
        """Its corners reach farther than its sides: the wall is nearer than the disc's radius."""
        world = World(segments=array([-1.0, gap, 1.0, gap]))
        left = remaining_distance(world, 0.25, Region(0.0, 0.0), self.GOAL)
        assert left == pytest.approx(3.0, abs=0.05)

    def test_a_goal_near_a_wall_counts_as_well(self) -> None:
        world = World(segments=array([3.1, -1.0, 3.1, 1.0]))
        assert remaining_distance(world, 0.25, Region(0.0, 0.0), self.GOAL) == pytest.approx(
            3.0, abs=0.05
        )

    def test_inside_an_obstacle_or_walled_in_there_is_none(self) -> None:
        assert remaining_distance(self.PILLAR, 0.25, Region(0.0, 0.0), self.GOAL) == math.inf
        assert remaining_distance(self.PILLAR, 0.25, self.GOAL, Region(0.0, 0.0)) == math.inf
        cell = between((0, 0), (3, 0), (), make_rectangle(-1.0, -1.0, 1.0, 1.0))
        assert remaining_distance(cell, 0.25, Region(0.0, 0.0), self.GOAL) == math.inf

    def test_outside_the_world_there_is_one_too(self) -> None:
        left = remaining_distance(self.PILLAR, 0.25, Region(-9.0, 0.0), self.GOAL)
        assert left == pytest.approx(12.2, abs=0.2)
