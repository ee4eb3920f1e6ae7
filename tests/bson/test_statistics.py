import numpy as np
import pytest

from bson.evaluation.metrics import summarise
from bson.evaluation.statistics import (
    difference_of_runs,
    estimate,
    improvement,
    interquartile_mean,
    mean,
    summarise_runs,
)


def nested(rng, runs, episodes, of_runs, of_episodes, noise=1.0):
    """Values (runs, episodes) with a mean of 0: each run is good or bad by itself, and each episode hard or easy."""
    return (
        of_runs * rng.normal(size=(runs, 1))
        + of_episodes * rng.normal(size=(1, episodes))
        + noise * rng.normal(size=(runs, episodes))
    )


def covered(found):
    return found.low <= 0.0 <= found.high


def test_an_interquartile_mean_by_hand():
    values = np.array([[1.0, 100.0, 4.0, 2.0], [3.0, -50.0, 5.0, 6.0]])  # the middle four of eight: 2, 3, 4, 5
    assert interquartile_mean(values).value == 3.5
    assert interquartile_mean(values[:1]).value == 3.0  # of 1, 2, 4, 100
    found = interquartile_mean(np.array([[0.0] + [90.0] * 4]))
    assert found.value == 90.0 and found.low < 90.0 == found.high
    assert interquartile_mean(np.array([[7.0]])) == (7.0, 7.0, 7.0)


def test_a_win_a_loss_and_a_tie_are_all_there_is():
    rng = np.random.default_rng(3)
    x, y = rng.integers(0, 4, (3, 12)).astype(float), rng.integers(0, 4, (2, 12)).astype(float)
    cells = np.array(list("aaaabbbbcccc"))
    there, back = improvement(x, y, cells), improvement(y, x, cells)
    for way in ("paired", "unpaired"):
        ours, theirs, ties = getattr(there, way), getattr(back, way), getattr(there, f"{way}_ties")
        assert ours.value + theirs.value == pytest.approx(1.0) and ties == getattr(back, f"{way}_ties") > 0
        strictly = [ours.value - ties / 2, theirs.value - ties / 2]
        assert sum(strictly) + ties == pytest.approx(1.0)
    down = improvement(x, y, cells, "down")
    assert down.paired.value == pytest.approx(back.paired.value)


def test_a_probability_of_improvement_by_counting():
    x, y, cells = np.array([[3.0, 1.0, 5.0]]), np.array([[2.0, 1.0, 6.0]]), np.array(["a", "a", "b"])
    found = improvement(x, y, cells)
    assert found.paired.value == pytest.approx((1 + 0.5 + 0) / 3) and found.paired_ties == pytest.approx(1 / 3)
    # in a: 3 > 2, 3 > 1, 1 < 2, 1 = 1; in b: 5 < 6
    assert found.unpaired.value == pytest.approx((2 + 0.5 + 0) / 5) and found.unpaired_ties == pytest.approx(1 / 5)
    with_none = improvement(np.array([[3.0, np.nan, 5.0]]), y, cells)
    assert with_none.paired.value == pytest.approx(1 / 2)


def test_the_unpaired_probability_is_that_of_mann_and_whitney():
    from scipy.stats import mannwhitneyu

    x, y = np.random.default_rng(5).integers(0, 9, (2, 1, 40)).astype(float)
    found = improvement(x, y, np.array(["all"] * 40))
    assert found.unpaired.value == pytest.approx(mannwhitneyu(x[0], y[0]).statistic / 1600)


def test_pairs_tell_more_than_strangers_where_episodes_differ():
    """An agent that is a little better in every episode is surely better, though episodes differ by more."""
    y = 10.0 * np.random.default_rng(1).normal(size=(1, 30))
    found = improvement(y + 1.0, y, np.array(["all"] * 30))
    assert found.paired == (1.0, 1.0, 1.0)
    assert found.unpaired.low < 0.5 < found.unpaired.value < 0.7


def test_one_run_has_the_interval_over_episodes():
    values = np.random.default_rng(2).normal(size=(1, 40))
    wanted = summarise([{"SNS": value} for value in values[0]])["SNS"]
    assert mean(values) == pytest.approx((wanted["mean"], wanted["low"], wanted["high"]), rel=1e-9)
    with_none = np.concatenate([values, np.full((1, 5), np.nan)], axis=1)
    assert mean(with_none) == mean(values)


def test_runs_that_are_the_same_are_one_run():
    values = np.random.default_rng(2).normal(size=(1, 40))
    assert mean(np.repeat(values, 4, axis=0)) == pytest.approx(mean(values), abs=0.03)  # what is drawn is not the same


def test_an_interquartile_mean_is_scipys():
    from scipy.stats import bootstrap, trim_mean

    values = np.random.default_rng(8).normal(size=(1, 21)) ** 3
    wanted = bootstrap(
        (values[0],), lambda x, axis: trim_mean(x, 0.25, axis=axis), method="percentile", rng=np.random.default_rng(0)
    )
    low, high = wanted.confidence_interval
    assert interquartile_mean(values) == pytest.approx((trim_mean(values, 0.25, axis=None), low, high))


def test_episodes_of_one_seed_come_together():
    """The same episode in a second cell is no news; as an episode of its own it would make the interval narrow."""
    rng = np.random.default_rng(6)
    one, other = rng.normal(size=(2, 1, 30))
    seeds, cells = np.tile(np.arange(30), 2), np.repeat(["a", "b"], 30)
    twice, twice_other = np.tile(one, 2), np.tile(other, 2)
    assert mean(twice, seeds) == pytest.approx(mean(one)) and interquartile_mean(twice, seeds).low < 0
    wide, narrow = (found.high - found.low for found in (mean(twice, seeds), mean(twice)))
    assert narrow < 0.8 * wide
    found, alone = improvement(twice, twice_other, cells, seeds=seeds), improvement(one, other, cells[:30])
    assert found.paired == pytest.approx(alone.paired) and found.unpaired == pytest.approx(alone.unpaired)
    rows = [[{"SNS": value} for value in run] for run in np.concatenate([twice, twice_other])]
    assert summarise_runs(rows, seeds)["SNS"]["high"] > summarise_runs(rows)["SNS"]["high"]


def test_the_interval_of_one_run_over_cells_is_that_of_its_seeds():
    """A score that depends on the seed alone is known as well from one cell as from 27, and a difference is, too."""
    rng = np.random.default_rng(12)
    ours, theirs = rng.normal(size=(2, 10))
    one, other = ([{"SNS": value} for value in each] for each in (ours, theirs))
    seeds = np.tile(np.arange(10), 27)
    assert summarise_runs([one * 27], seeds)["SNS"] == pytest.approx(summarise(one)["SNS"] | {"count": 270})
    found, alone = difference_of_runs([one * 27], [other * 27], seeds), difference_of_runs([one], [other])
    assert found["SNS"] == pytest.approx(alone["SNS"] | {"count": 270})
    # where no seed stands twice, each episode is drawn for itself
    assert summarise_runs([one], np.arange(10)) == summarise(one) == summarise_runs([one])


def test_intervals_over_cells_that_share_seeds_cover_what_they_promise():
    """On made data of 27 cells and 10 seeds, as `standard` has; episodes for themselves would cover far less."""
    rng, hits, seeds = np.random.default_rng(1), [], np.tile(np.arange(10), 27)
    for _ in range(80):
        rows = [{"SNS": value} for value in nested(rng, 27, 10, 0.0, 1.0).ravel()]
        found = [summary["SNS"] for summary in (summarise_runs([rows], seeds), summarise_runs([rows]))]
        hits.append([row["low"] <= 0.0 <= row["high"] for row in found])
    drawn_by_seed, each_for_itself = np.mean(hits, axis=0)
    assert 0.85 <= drawn_by_seed <= 0.99 and each_for_itself < 0.5


def test_runs_that_differ_make_the_interval_wide():
    """Over episodes alone, it is narrow; the trainings may be all that differs."""
    runs = np.array([[-2.0], [0.0], [3.0], [-1.0]]) + 0.01 * np.random.default_rng(0).normal(size=(4, 50))
    over_both, over_episodes = mean(runs), mean(runs.mean(axis=0, keepdims=True))
    assert over_both.high - over_both.low > 100 * (over_episodes.high - over_episodes.low)
    spread = np.std(runs.mean(axis=1)) / 2  # of the mean of 4
    assert over_both.high - over_both.low == pytest.approx(2 * 1.96 * spread, rel=0.15)


def test_intervals_cover_what_they_promise():
    """On made data of 8 runs and 25 episodes; intervals that leave either level out cover far less."""
    rng, hits = np.random.default_rng(0), []
    for _ in range(60):
        values = nested(rng, 8, 25, 1.0, 1.0)
        over_runs = estimate(lambda runs, v=values: v.mean(axis=1)[runs].mean(axis=-1), (8,))
        over_episodes = mean(values.mean(axis=0, keepdims=True))
        hits.append([covered(mean(values)), covered(over_runs), covered(over_episodes)])
    both, runs, episodes = np.mean(hits, axis=0)
    assert 0.88 <= both <= 0.99 and runs < both and episodes < 0.8


def test_a_difference_of_several_runs_is_between_every_two_of_them():
    rng = np.random.default_rng(4)
    ours, theirs = nested(rng, 3, 12, 1.0, 5.0) + 2.0, nested(rng, 2, 12, 1.0, 5.0)
    rows = [[[{"SNS": value} for value in run] for run in each] for each in (ours, theirs)]
    found = difference_of_runs(*rows)["SNS"]
    assert found["mean"] == pytest.approx(ours.mean() - theirs.mean()) and found["count"] == 3 * 2 * 12
    back = difference_of_runs(*rows[::-1])["SNS"]
    assert (back["mean"], back["low"]) == pytest.approx((-found["mean"], -found["high"]), rel=0.05)
    alone = difference_of_runs(rows[0][:1], rows[1][:1])["SNS"]
    assert alone == summarise([{"SNS": value} for value in ours[0] - theirs[0]])["SNS"]


def test_a_summary_of_several_runs_counts_what_enters():
    rows = [[{"time": 1.0}, {"time": np.inf}, {"time": np.inf}], [{"time": 3.0}, {"time": 5.0}, {"time": np.inf}]]
    found = summarise_runs(rows)["time"]
    assert found["mean"] == pytest.approx(3.0) and found["count"] == 3
    assert summarise_runs(rows[1:]) == summarise(rows[1])
