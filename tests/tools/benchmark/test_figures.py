"""The statistics of Agarwal et al. 2021, against their library's tests, scipy and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from benchmark_tools import cell, part
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from acsar_gym.tools.benchmark import figures
from acsar_gym.tools.benchmark.figures import interquartile_mean
from acsar_gym.tools.evaluation.metrics import resample, row_means, stratified_interval

X = np.array([[1.0, 2.0], [2.0, 2.0], [1.0, 1.0], [2.0, 1.0]])
Y = np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]])
"""Scores (runs, tasks) of the unit tests of rliable, the paper's library."""

shapes = st.tuples(st.integers(1, 5), st.integers(1, 9))
matrices = shapes.flatmap(lambda shape: arrays(np.float64, shape, elements=st.integers(0, 4)))


def test_published_values() -> None:
    """As rliable's tests/rliable/metrics_test.py has them."""
    assert interquartile_mean(X.ravel()) == 1.5
    assert interquartile_mean(Y.ravel()) == 2.0
    assert figures.probability_of_improvement(X, Y) == pytest.approx(1.0 / 3.0)


@given(matrices)
def test_the_interquartile_mean_is_a_trimmed_mean(scores: np.ndarray) -> None:
    expected = stats.trim_mean(scores, 0.25, axis=None)
    assert interquartile_mean(scores.ravel()) == pytest.approx(expected)


@given(matrices, st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_the_probability_of_improvement_is_mann_whitneys(
    x: np.ndarray, seeds: int, seed: int
) -> None:
    y = np.random.default_rng(seed).integers(0, 5, (seeds, x.shape[1])).astype(float)
    expected = [
        stats.mannwhitneyu(x[:, scene], y[:, scene]).statistic / (len(x) * seeds)
        for scene in range(x.shape[1])
    ]
    found = figures.probability_of_improvement(x, y)
    assert found == pytest.approx(np.mean(expected))
    assert found + figures.probability_of_improvement(y, x) == pytest.approx(1.0)


@given(matrices)
def test_a_profile_falls_from_the_share_above_zero_to_none(scores: np.ndarray) -> None:
    profile = figures.performance_profile(scores, (-1.0, 0.0, 1.0, 2.0, 4.0))
    assert profile[0] == 1.0
    assert profile[-1] == 0.0
    assert profile == sorted(profile, reverse=True)
    assert profile[1] == np.mean(scores > 0.0)


@given(matrices)
def test_an_interval_lies_within_the_scores(scores: np.ndarray) -> None:
    low, high = stratified_interval(scores, interquartile_mean, resamples=50)
    assert scores.min() - 1e-9 <= low <= high <= scores.max() + 1e-9
    assert stratified_interval(scores, interquartile_mean, resamples=50) == (low, high)


def test_seeds_that_differ_widen_the_interval_as_much_as_their_number_says() -> None:
    """Two hundred scenes of one policy aren't two hundred policies."""
    scores = np.repeat(np.array([[0.0], [1.0], [0.0], [1.0], [0.0], [1.0]]), 200, axis=1)
    low, high = stratified_interval(scores, row_means)
    assert high - low > 0.6


def test_the_interval_of_an_improvement_holds_its_value() -> None:
    rng = np.random.default_rng(1)
    x, y = rng.normal(0.5, 1.0, (5, 60)), rng.normal(0.0, 1.0, (1, 60))
    low, high = figures.improvement_interval(x, y)
    assert 0.5 < low < figures.probability_of_improvement(x, y) < high < 1.0
    assert figures.improvement_interval(x, np.full((1, 60), 99.0)) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("rows", "p"),
    [
        ([[0, 0, 0]], 1.0),
        ([[1] * 6], 2 / 64),
        ([[-1] * 6], 2 / 64),
        ([[1, 1, 1, -1, 0, 0]], 2 * 5 / 16),
        ([[1, -1]], 1.0),
        ([[1] * 6, [1] * 4 + [0] * 2], 2 / 16),  # the less significant seed
        ([[1] * 6, [-1] * 6], 1.0),  # seeds that contradict each other
        ([[1] * 6, [0] * 6], 1.0),
    ],
)
def test_mcnemars_exact_test(rows: list[list[int]], p: float) -> None:
    assert figures.mcnemar_p(np.array(rows, float)) == pytest.approx(p)


def test_the_paired_p_is_that_of_a_paired_t_test_where_there_are_many_scenes() -> None:
    """And few scenes prove nothing, whichever way they all point."""
    rng = np.random.default_rng(3)
    one = rng.normal(0.5, 0.1, 200)
    other = one - rng.normal(0.01, 0.08, 200)
    expected = stats.ttest_rel(one, other).pvalue
    drawn = resample((one - other)[None], row_means)
    assert 0.01 < expected < 0.5
    assert figures.bootstrap_p(drawn, 200) == pytest.approx(expected, abs=0.03)
    assert figures.bootstrap_p(np.ones(2000), 3) == 0.25
    assert figures.bootstrap_p(np.ones(2000), 200) == pytest.approx(2 / 2001)


def test_pairs_are_of_the_same_scenes_though_a_benchmark_is_unfinished() -> None:
    """The parts of two agents that finished first aren't those of the same scenes."""
    parts = [
        part(cell("ours"), (0.9, 0.8), first=0),
        part(cell("ours"), (0.7, 0.0), first=4),
        part(cell("floor"), (0.1, 0.1), first=2),
        part(cell("floor"), (0.5, 0.5), first=4),
    ]
    rows = figures.group_rows(figures.group_cells(parts), {"ours": "learned", "floor": "baseline"})
    score, success = figures.compare_with_best(rows)
    assert score["scene_count"] == 2
    assert score["values"] == pytest.approx([0.35, 0.5])
    assert success["difference"] == -0.5
    (improved,) = figures.compare_pairs(rows)
    assert improved["probability"] == 0.5
