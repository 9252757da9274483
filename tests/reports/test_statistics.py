"""Summaries of few runs, against numbers worked out by hand and against SciPy."""

import numpy as np
import pytest
from scipy import stats

from mbdpg.reports.statistics import interquartile_mean, probability_of_improvement, summarize


@pytest.mark.parametrize("count", [2, 3, 4, 5, 8, 11])
def test_the_interquartile_mean_is_the_trimmed_mean(count: int) -> None:
    scores = np.random.default_rng(count).normal(size=(3, count)) ** 3
    for row, found in zip(scores, interquartile_mean(scores), strict=True):
        assert found == pytest.approx(stats.trim_mean(row, 0.25))


def test_a_summary_of_few_scores() -> None:
    found = summarize([1.0, 2.0, 3.0, 4.0, 100.0])
    assert (found.seeds, found.mean, found.interquartile_mean) == (5, 22.0, 3.0)
    assert found.std == pytest.approx(np.std([1, 2, 3, 4, 100], ddof=1))
    assert 1.0 <= found.low < 3.0 < found.high <= 100.0
    assert summarize([1.0, 2.0, 3.0, 4.0, 100.0]) == found


def test_the_interval_covers_the_truth_about_as_often_as_it_says() -> None:
    rng, covered = np.random.default_rng(0), 0
    for _ in range(100):
        found = summarize(rng.normal(size=20).tolist())
        covered += found.low <= 0 <= found.high
    assert 85 <= covered <= 99  # with 20 runs the bootstrap is a little too sure


def test_one_score_has_no_spread() -> None:
    found = summarize([5.0])
    assert found[:2] == (1, 5.0) and found.interquartile_mean == 5.0
    assert np.isnan([found.std, found.low, found.high]).all()


def test_the_probability_of_improvement_is_mann_and_whitney_s() -> None:
    ours, theirs = [3.0, 1.0, 2.0], [2.0, 0.0]
    assert probability_of_improvement(ours, theirs) == pytest.approx((2 + 1 + 1.5) / 6)
    u = stats.mannwhitneyu(ours, theirs).statistic
    assert probability_of_improvement(ours, theirs) == pytest.approx(u / 6)
