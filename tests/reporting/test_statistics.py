"""Statistics of seeds: hand-worked numbers, and what single seeds cannot say."""

import numpy as np
import pytest

from jaxil.reporting import statistics


def test_mean_and_interval_of_three_seeds_by_hand():
    # mean 20, standard deviation 10, error 10 / sqrt(3) = 5.7735; t(2, 0.95) = 2.91999
    mean, low, high = statistics.mean_interval(np.array([10.0, 20.0, 30.0]))
    assert mean == 20.0
    np.testing.assert_allclose([low, high], [20 - 16.8586, 20 + 16.8586], atol=1e-3)


def test_missing_seeds_are_left_out_column_by_column():
    nan = np.nan
    values = np.array(
        [[1.0, 1.0, nan, nan], [3.0, 3.0, 5.0, nan], [5.0, nan, nan, nan]]
    )
    mean, low, high = statistics.mean_interval(values)
    np.testing.assert_allclose(mean, [3.0, 2.0, 5.0, nan])
    assert np.isnan(low).tolist() == [False, False, True, True]
    alone = statistics.mean_interval(np.array([1.0, 3.0]))
    np.testing.assert_allclose([low[1], high[1]], alone[1:])


def test_equal_seeds_have_an_interval_of_no_width():
    assert statistics.mean_interval(np.array([7.0, 7.0])) == (7.0, 7.0, 7.0)


def test_no_seed_has_no_mean():
    assert np.isnan(statistics.mean_interval(np.zeros((0, 3)))).all()


def test_interquartile_mean_by_hand():
    # Of eight, two are cut at either end: (3 + 4 + 5 + 6) / 4.
    values = np.array([1.0, 2, 3, 4, 5, 6, 7, 1000])
    estimate = statistics.interquartile_interval([values])
    assert estimate.value == 4.5
    assert 1.0 < estimate.low < 4.5 < estimate.high
    # Of three, none is cut; the task of one seed is in every resample.
    strata = [np.array([1.0, 2.0]), np.array([9.0])]
    value, low, high = statistics.interquartile_interval(strata)
    assert (value, low, high) == (4.0, 11 / 3, 13 / 3)


def test_tasks_are_never_mixed_by_resampling():
    # Within each task all seeds agree, so every resample is the data itself.
    strata = [np.full(4, 0.1), np.full(4, 0.9)]
    value, low, high = statistics.interquartile_interval(strata)
    assert value == low == high == pytest.approx(0.5)
    mixed = statistics.interquartile_interval([np.concatenate(strata)])
    assert mixed.low < 0.4
    assert mixed.high > 0.6


def test_single_seeds_have_no_bootstrap_interval():
    value, low, high = statistics.interquartile_interval(
        [np.array([3.0]), np.array([5.0])]
    )
    assert value == 4.0
    assert np.isnan(low)
    assert np.isnan(high)


def test_resampling_repeats_itself():
    strata = [np.arange(5.0), np.arange(3.0)]
    assert statistics.interquartile_interval(
        strata
    ) == statistics.interquartile_interval(strata)


def test_curves_are_joined_within_their_own_range():
    x, y = statistics.join_curves(
        [
            (np.array([10.0, 30.0]), np.array([1.0, 3.0])),
            (np.array([20.0, 40.0]), np.array([5.0, 7.0])),
        ]
    )
    nan = np.nan
    np.testing.assert_array_equal(x, [10, 20, 30, 40])
    np.testing.assert_array_equal(y, [[1, 2, 3, nan], [nan, 5, 6, 7]])


def test_first_reaching():
    frames, returns = np.array([10, 20, 30, 40]), np.array([1.0, np.nan, 8.0, 5.0])
    assert statistics.first_reaching(frames, returns, 5.0) == 30
    assert statistics.first_reaching(frames, returns, 8.0) == 30
    assert np.isnan(statistics.first_reaching(frames, returns, 8.1))
    assert np.isnan(statistics.first_reaching(frames, returns, np.nan))
    assert np.isnan(statistics.first_reaching(frames[:0], returns[:0], 0.0))


def test_mean_until_by_hand():
    frames, shares = np.array([50.0, 150.0]), np.array([0.5, 1.0])
    # 0 to 50: 0.25 in the mean; 50 to 100: from 0.5 to 0.75.
    assert statistics.mean_until(frames, shares, 100.0) == pytest.approx(0.4375)
    assert statistics.mean_until(frames, shares, 50.0) == pytest.approx(0.25)
    assert statistics.mean_until(frames, shares, 150.0) == pytest.approx(87.5 / 150)
    assert np.isnan(statistics.mean_until(frames, shares, 151.0))
    assert np.isnan(statistics.mean_until(frames[:0], shares[:0], 1.0))


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        ([30, 10, 20], 20),
        ([10, 20], 20),
        ([10, 20, np.nan], 20),
        ([10, np.nan], np.nan),
        ([10, np.nan, np.nan], np.nan),
        ([np.nan], np.nan),
        ([], np.nan),
    ],
)
def test_seeds_that_never_arrive_are_later_than_all(times, expected):
    np.testing.assert_equal(statistics.median_arrival(times), float(expected))
