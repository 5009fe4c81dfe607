"""Experiments: scores of results with known errors, and scenes of a case that are as described."""

import re
from typing import Any

import numpy as np
import pytest
import xarray as xr

from dbthermal import response as responses
from dbthermal.simulation import Rig
from reproduction.experiments.cases import simulate

TIME = np.arange(350) / 10.0  # s
GLASS: dict[str, Any] = {"case": "glass", "emissivity": [0.86, 0.72], "start": 20, "stop": 60}
OBJECT, BACKGROUND = "object_temperature", "background_temperature"


def drawn(**changes: Any) -> tuple[xr.Dataset, xr.Dataset, xr.Dataset]:
    """Scene, capture and response of a case of glass with changes."""
    return simulate(GLASS | changes, Rig(), TIME, 20, seed=4)


@pytest.mark.parametrize(("duration", "partly"), [(0.0, 0), (2.0, 19)])
def test_jump_of_the_object(duration: float, partly: int) -> None:
    """A sudden or gradual jump begins where the case says, and changes nothing else."""
    plain = drawn()[0]
    jump = {"height": 6.0, "between": [12.0, 15.0], "duration": duration}
    scene = drawn(jump=jump)[0]
    added = (scene[OBJECT] - plain[OBJECT]).values[:, 0]
    np.testing.assert_allclose(added[TIME < 12.0], 0.0, rtol=0, atol=1e-9)  # K
    np.testing.assert_allclose(added[TIME > 17.0], 6.0, rtol=0, atol=1e-9)
    between = np.sum((added > 1e-9) & (added < 6.0 - 1e-9), axis=0)
    assert set(between) <= {partly, partly + 1}  # frames
    assert len({*np.argmax(added > 1e-9, axis=0)}) > 10  # of 20 pixels, each at its own time
    xr.testing.assert_identical(scene[BACKGROUND], plain[BACKGROUND])


def test_changes_of_a_case() -> None:
    """A still background, one that follows the object, swapped roles, frames and noise."""
    plain, still = drawn()[0], {"kind": "still", "level": 290.0}
    assert (drawn(background=still)[0][BACKGROUND] == 290.0).all()
    np.testing.assert_allclose(plain[OBJECT][[0, -1], 0, 0], [293.15, 333.15])
    added = drawn(following=0.2)[0][BACKGROUND] - plain[BACKGROUND]
    np.testing.assert_allclose(added, 0.2 * (plain[OBJECT] - plain[OBJECT][0]), rtol=0, atol=1e-9)
    swapped = drawn(swapped=True)[0]
    np.testing.assert_array_equal(swapped[OBJECT], plain[BACKGROUND])
    np.testing.assert_array_equal(swapped[BACKGROUND], plain[OBJECT])
    scene, capture, response = drawn(frames=100, noise=[0.1, 0.2])
    assert scene.sizes["time"] == 100
    np.testing.assert_array_equal(capture["time"], TIME[:100])
    np.testing.assert_allclose(response["netd"], [0.1, 0.2], rtol=0, atol=0.002)  # K


@pytest.mark.parametrize("offset", [0.5, 1.0, 2.0])
def test_bands_apart(offset: float) -> None:
    """The second band, exposed so much later, sees each pulse begin so many frames sooner."""
    quiet = {"noise": [1e-4, 1e-4], "start": 20, "stop": 20}
    pulses = {"level": 293.15, "count": [1, 1]}
    scene, capture, response = drawn(offset=offset, background=pulses, **quiet)
    np.testing.assert_allclose(capture["time"], TIME, rtol=0, atol=1e-9)  # s
    assert "exposure_time" not in capture
    seen = responses.apparent_temperature(response, capture["counts"]) - 293.15
    first, second = (seen.isel(band=place).values[:, 0] > 0.2 for place in (0, 1))
    np.testing.assert_array_equal(first, scene[BACKGROUND][:, 0] > 294.15)
    inside = (np.argmax(first, axis=0) > 5) & first.any(axis=0) & ~first[-5:].any(axis=0)
    later = (np.argmax(second, axis=0) - np.argmax(first, axis=0))[inside]
    assert inside.sum() > 10
    assert set(later) <= {int(np.floor(-offset)), int(np.ceil(-offset))}  # frames


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": None}, r"Must have \['emissivity', 'start', 'stop'\]"),
        ({"offset": 0.33}, r"Invalid offset 0.33 frames. Must be zero or positive, a multiple"),
        ({"offset": -1.0}, r"Invalid offset -1.0 frames. Must be zero or positive"),
        ({"frames": 351}, r"Invalid number of frames 351. Must lie in \[2, 350\]"),
        ({"jump": {"between": [5.0, 4.0]}}, r"Invalid between \[5.0, 4.0\] s of a jump"),
        ({"jump": {"duration": -1.0}}, r"Invalid duration -1.0 s of a jump"),
        ({"emisivity": [0.9, 0.8]}, re.escape("with keys ['case', 'emisivity', 'emissivity',")),
    ],
)
def test_values_of_a_case(change: dict[str, Any], message: str) -> None:
    """Invalid, unknown and missing values, and bands apart on uneven times, are errors."""
    case = {key: value for key, value in (GLASS | change).items() if value is not None}
    with pytest.raises(ValueError, match=message):
        simulate(case, Rig(), TIME, 20, seed=4)
    uneven = np.append(TIME[:-1], TIME[-1] + 0.05)
    with pytest.raises(ValueError, match="Invalid times of bands that are exposed apart"):
        simulate(GLASS | {"offset": 1.0}, Rig(), uneven, 5, 0)
