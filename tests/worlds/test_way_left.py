"""How much of the way to a goal is left."""

from __future__ import annotations

import math

import pytest
from search_tools import PILLAR, array, between

from acsar_gym.worlds.search import path_length, remaining_distance, shortest_path
from acsar_gym.worlds.world import Region, World, make_rectangle


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
