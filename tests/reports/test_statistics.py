"""Summaries of few runs, against numbers worked out by hand, against SciPy, and against rliable's."""

import numpy as np
import pytest
from scipy import stats

from mbdpg.reports.statistics import interquartile_mean, probability_of_improvement, summarize

# What rliable 1.2.0 (arch 7.2.0, pandas 2.3.3, SciPy 1.17.1, NumPy 2.4.6) says of these scores, each a matrix of one
# task: metrics.aggregate_iqm, its library.get_interval_estimates with reps=200_000, random_state=RandomState(0), and
# metrics.probability_of_improvement.
SPREAD = [6713.0, 5081.0, 6078.0, 4540.0, 7053.0, 6659.0, 6142.0, -173.0, 8678.0, 3565.0, 6142.0]
FEW = [3195.0, 1453.0, 6142.0, 2360.0, 2418.0]
SKEWED = [10.0, 12.0, 11.0, 300.0, 9.0, 14.0, 8.0]
RLIABLE = [
    (SPREAD, 5907.85714286, (4407.85714286, 6744.14285714)),
    (FEW, 2657.66666667, (1755.33333333, 5159.66666667)),
    (SKEWED, 11.2, (9.2, 127.2)),
]


@pytest.mark.parametrize(("scores", "middle", "interval"), RLIABLE, ids=["spread", "few", "skewed"])
def test_summaries_are_rliables(scores: list[float], middle: float, interval: tuple[float, float]) -> None:
    found = summarize(scores)
    assert found.interquartile_mean == pytest.approx(middle)
    # Both draw at random. An interval of 90 %, of the mean, or of the mean's standard error is farther away.
    near = 0.02 * (interval[1] - interval[0])
    assert (found.low, found.high) == pytest.approx(interval, abs=near)


def test_the_probability_of_improvement_is_rliables() -> None:
    assert probability_of_improvement(SPREAD, FEW) == pytest.approx(0.8181818181818182)  # with ties
    assert probability_of_improvement(FEW, SPREAD) == pytest.approx(0.18181818181818182)
    assert probability_of_improvement(FEW, SKEWED) == 1.0


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
