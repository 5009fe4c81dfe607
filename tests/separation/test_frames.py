"""Compiled frames against their readable twins in NumPy."""

import numpy as np
import pytest

from dbthermal import mixing
from dbthermal import response as responses
from dbthermal.separation import _frames as frames
from dbthermal.separation import _tiles as tiles
from dbthermal.separation import _windows as windows
from dbthermal.separation._subspace.reflection_ratio import null_combination
from dbthermal.simulation import Rig

RIG = Rig(bands=("8-14", "9.5", "10.6"), noise=(0.03, 0.35, 0.15))


@pytest.mark.parametrize("bands", [2, 3, 5])
def test_null_weights(bands: int) -> None:
    """They cancel the background, keep the object, and are those of the arrays' form."""
    rng = np.random.default_rng(bands)
    ratio, noise = np.r_[1.0, rng.uniform(0.5, 3.0, bands - 1)], rng.uniform(0.02, 0.4, bands)
    weights = np.empty(bands)
    variance = frames.null_weights(ratio, noise, weights)
    expected, of_noise = null_combination(ratio[:, np.newaxis], noise)
    np.testing.assert_allclose([weights.sum(), weights @ ratio], [1.0, 0.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(weights, expected[:, 0], rtol=1e-12)
    np.testing.assert_allclose(variance, of_noise[0], rtol=1e-12)


def test_gaps_are_bridged_by_lines() -> None:
    """Between neighbours as by interpolation, at the ends as the nearest; surer near a sample."""
    time = np.cumsum(np.random.default_rng(1).uniform(0.1, 0.3, 40))
    curve, variance = np.sin(time), np.full(40, 0.01)
    gap = np.isin(np.arange(40), [0, 1, 7, 20, 21, 22, 38, 39])
    value = np.where(gap, np.nan, curve)
    assert frames.bridge(value, variance, time) == gap.sum()
    np.testing.assert_allclose(value, np.interp(time, time[~gap], curve[~gap]), rtol=0, atol=1e-12)
    assert (variance[gap] > 0.01).all()
    assert variance[21] > max(variance[20], variance[22])
    assert variance[0] > variance[1]


def test_frames_invert_the_image_formation() -> None:
    """Without noise, object and background of every frame, from a level 5 K off."""
    curves = tuple(responses.curve(RIG.response(), name) for name in RIG.bands)
    rng, emissivity = np.random.default_rng(2), np.array([[0.86], [0.72], [0.93]])
    warm, cold = 300.0 + 20.0 * rng.random((50, 1)), 295.0 + 3.0 * rng.standard_normal((50, 1))
    signals = [
        mixing.mixed(e, curve.signal(warm), curve.signal(cold)) - curves[0].reference
        for e, curve in zip(emissivity, curves, strict=True)
    ]
    time, shape = np.arange(50.0), (1, 1)
    tile = tiles.Tile(np.array(signals), time, curves, RIG.noise, shape, rng)
    level = curves[0].signal(np.array([290.0])) - tile.reference
    found = frames.solve(tile, emissivity, level, np.full(1, 1e12))
    for signal, expected in ((found.signal, warm), (found.background, cold)):
        value, _ = frames.temperatures(tile, signal, np.ones_like(signal))
        np.testing.assert_allclose(value, expected, rtol=0, atol=1e-3)  # [K]


def test_a_step_is_not_smoothed_over() -> None:
    """A resting curve is averaged over many frames, a step keeps its two levels."""
    rng, time = np.random.default_rng(3), np.arange(200.0)
    step = np.where(time < 100.0, 0.0, 5.0)[:, np.newaxis]
    noisy, valid = step + 0.1 * rng.standard_normal((200, 1)), np.ones((200, 1), bool)
    curve, variance = windows.smooth(noisy, np.full((200, 1), 0.01), valid, time)
    np.testing.assert_allclose(curve, step, rtol=0, atol=0.35)
    rest = abs(time - 100.0) > 50.0
    assert float(np.std((curve - step)[rest])) < 0.05
    assert float(np.median(variance[rest])) < 0.002
