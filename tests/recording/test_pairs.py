"""Episodes of the same seed and goal."""

from __future__ import annotations

from acsar_gym.recording.pairs import have_same_goal, number_seeds


def test_repeated_seeds_are_told_apart() -> None:
    assert number_seeds([3, None, 3, 4, None]) == [(3, 0), (None, 0), (3, 1), (4, 0), (None, 1)]


def test_goals_are_the_same_within_a_centimetre_or_where_one_is_not_told() -> None:
    assert have_same_goal([1.0, 0.0], (1.0, 0.009))
    assert not have_same_goal([1.0, 0.0], [1.0, 0.011])
    assert have_same_goal(None, [1.0, 0.0])
