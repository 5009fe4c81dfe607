"""Parts of the alignment, each against a closed form or a behaviour that is known."""

from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from dbthermal.alignment import _clocks as clocks
from dbthermal.alignment import align
from dbthermal.correction import correct_capture
from reproduction.experiments import whole


@pytest.mark.slow
def test_a_large_image_is_aligned_by_means(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clocks and the shift of means over squares are those of all pixels, where some lack."""
    rig: dict[str, Any] = {"shift": (2.4, 1.2), "view": (0, 0), "late": 1, "shutter": (0.4,)}
    options = rig | {"lost": (0.03, 0.005), "steps": 6, "frames": 16}
    recording = whole.record((48, 72), (200, 10.0), 1, **options)
    corrected = correct_capture(recording.capture, whole.calibrate(recording.movies)[0])
    # A pixel that lacks samples does not step the mean of its square, of another level.
    corrected["counts"][:, :, ::2, ::2] += 500.0
    corrected["counts"][1, 60:90, ::2, ::2] = np.nan
    corrected["counts"][0, :, 0:4, 4:8] = np.nan  # a square that one band does not see
    found = []
    for pixels in (48 * 72, 48 * 72 // 4):
        monkeypatch.setattr("dbthermal.alignment._joint._PIXELS", pixels)
        aligned = align(corrected)
        found.append((aligned.attrs["time_offset"][1], aligned.attrs["time_offset_std"]))
    print(f"clocks and deviations {found} s, true 0.05")
    np.testing.assert_allclose([one for one, _ in found], 0.05, atol=0.005)  # 0.05 of a frame
    assert found[1][1] < 1.5 * found[0][1]


def test_a_step_does_not_swing() -> None:
    """A curve would overshoot beside a sudden step: no sample there, and none of it in the rest."""
    time = np.arange(40.0)
    frames = np.sin(2.0 * np.pi * time[:, np.newaxis] / 8.0) + np.outer(time > 19.0, [0.0, 100.0])
    present, segment, moved = np.ones(40, dtype=bool), np.zeros(40, dtype=np.intp), time + 0.5
    result = np.empty_like(frames)
    clocks.interpolation(time, present, moved, segment, 3.0).apply(frames, result, 2.0)
    assert np.flatnonzero(np.isnan(result[:, 0])).tolist() == [39]
    assert np.flatnonzero(np.isnan(result[:, 1])).tolist() == [18, 19, 20, 39]
    np.testing.assert_allclose(result[:18, 1], result[:18, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(result[21:39, 1], result[21:39, 0] + 100.0, rtol=0, atol=1e-12)


def test_lines_and_splines_are_what_is_expected() -> None:
    """Of a random walk the line, of its integral the natural spline; growth is told from noise."""
    nodes, wanted = np.array([[0.0, 1.0, 2.0, 3.0]]), np.array([1.3])
    np.testing.assert_allclose(clocks._expected(nodes, wanted, 1.0), [[0, 0.7, 0.3, 0]], atol=1e-9)
    spline = CubicSpline(nodes[0], np.eye(4), bc_type="natural")(wanted)
    np.testing.assert_allclose(clocks._expected(nodes, wanted, 3.0), spline, rtol=0, atol=1e-9)
    limit = [clocks._expected(nodes, wanted, growth) for growth in (1.999, 2.0, 2.001)]
    np.testing.assert_allclose(limit[::2], [limit[1]] * 2, atol=1e-4)
    noise = np.random.default_rng(1).normal(size=(2, 4000, 50))
    assert clocks.growth(np.cumsum(noise[0], axis=0) + noise[1]) == pytest.approx(1.0, abs=0.1)
    wave = 30.0 * np.sin(np.arange(4000.0) / 5.0)
    assert clocks.growth(wave[:, np.newaxis] + noise[1]) == pytest.approx(3.9, abs=0.1)


def test_frames_beside_lost_ones_are_not_bridged() -> None:
    """The frame period is that of the slots: with most stamps lost, no pause counts as a step."""
    time = np.arange(400) / 10.0
    stamps = np.where(np.random.default_rng(1).random(time.size) < 0.95, np.nan, time)
    assert clocks.frame_period(stamps) == pytest.approx(0.1)
    known = np.isfinite(stamps)
    between = clocks.interpolation(
        stamps, np.ones(time.size, dtype=bool), time + 0.03, np.zeros(time.size, dtype=np.intp), 1.0
    )
    assert not between.valid[~(known & np.roll(known, -1))].any()
