"""Smooth curves at known emissivities, against local fits by numpy."""

import numpy as np

from dbthermal.separation._known_emissivity import smooth

TIME = np.arange(60) / 10.0


def test_a_line_in_noise_is_averaged_over_all_frames() -> None:
    """Of a line nothing is bent: the variance that is stated holds a share for it, and no more."""
    rng = np.random.default_rng(2)
    noise = 0.1
    values = 300.0 + 0.5 * TIME[:, np.newaxis] + noise * rng.standard_normal((60, 400))
    valid = np.ones(values.shape, dtype=bool)
    curve, left = smooth(values, np.full(values.shape, noise**2), valid, TIME)
    error = curve - (300.0 + 0.5 * TIME[:, np.newaxis])
    print(f"variance over that of the noise: {(error**2).mean() / noise**2:.3f}, {left.mean():.5f}")
    assert (error**2).mean() < 0.25 * noise**2
    assert 0.6 < (error**2).mean() / left.mean() < 1.0


def test_windows_are_those_of_polyfit() -> None:
    """Without noise that is stated every narrow window agrees with the sample alone: it stays."""
    rng = np.random.default_rng(3)
    values = 300.0 + rng.standard_normal((60, 5))
    valid = np.ones(values.shape, dtype=bool)
    curve, left = smooth(values, np.full(values.shape, 1e-12), valid, TIME)
    np.testing.assert_allclose(curve, values, rtol=0, atol=1e-9)
    np.testing.assert_allclose(left, 1e-12, rtol=1e-9, atol=0)
    # Of much, the widest window is a parabola through nearly all frames.
    curve, _ = smooth(values, np.full(values.shape, 1e6), valid, TIME)
    halves, half = [1], 1
    while (half := max(half + 1, int(half * 1.5))) < len(TIME):
        halves.append(half)
    half = halves[-2]  # one narrower than the widest
    for place in (0, 31, 59):
        window = slice(max(place - half, 0), place + half + 1)
        fit = np.polynomial.Polynomial.fit(TIME[window], values[window, 0], 2)
        np.testing.assert_allclose(curve[place, 0], fit(TIME[place]), rtol=0, atol=1e-8)


def test_samples_that_are_not_valid_are_nan_and_count_nothing() -> None:
    """Other samples are what they are without them; a pixel without any is all NaN."""
    rng = np.random.default_rng(4)
    values = 300.0 + rng.standard_normal((60, 3))
    valid = rng.random(values.shape) > 0.2
    valid[:, 2] = False
    wrong = np.where(valid, values, np.nan), np.where(valid, values, 1e9)
    curves = [smooth(one, np.ones(values.shape), valid, TIME)[0] for one in wrong]
    np.testing.assert_array_equal(curves[0], curves[1])
    np.testing.assert_array_equal(np.isnan(curves[0]), ~valid)
