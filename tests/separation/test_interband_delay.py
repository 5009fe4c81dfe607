"""Flags of suspicion: bands that are not simultaneous, and object and background swapped."""

from typing import Any

import numpy as np
import pytest

from dbthermal import schema
from dbthermal.simulation import Rig
from reproduction import experiments

RIG = Rig()
TIME = np.arange(350) / 10.0
GLASS: dict[str, Any] = {"emissivity": [0.86, 0.72], "start": 20, "stop": 60}


def share(flag: str, pixels: int = 400, seed: int = 1, rig: Rig = RIG, **changes: Any) -> float:
    """Share of the pixels of a case that carry a flag."""
    _, result = experiments.run_case({**GLASS, **changes}, rig, TIME, pixels, seed)
    found = float((result["status"].values & schema.Status.bits()[flag] != 0).mean())
    print(f"{changes}: {100 * found:.2f} % carry {flag}")
    return found


@pytest.mark.parametrize("offset", [1.0, 2.0])
def test_a_frame_apart_is_told(offset: float) -> None:
    """Bands a frame or two apart are flagged in 95 % of the pixels."""
    assert share("bands_apart", offset=offset) >= 0.95


def test_the_flag_grows_with_the_offset() -> None:
    """An offset of a tenth of a frame costs less than the noise; a harmful one is flagged."""
    shares = [share("bands_apart", offset=offset) for offset in (0.1, 0.3, 0.5, 1.0)]
    assert np.all(np.diff(shares) >= 0)
    assert shares[0] < 0.05


@pytest.mark.parametrize("noise_known", [True, False])
@pytest.mark.parametrize(
    "background",
    [{}, {"drift": 5.0}, {"amplitude": 12.0}]
    + [{"kind": "random walk", "correlation_time": time} for time in (0.3, 3.0, 30.0)],
    ids=str,
)
def test_simultaneous_bands_are_not_suspected(
    background: dict[str, Any], noise_known: bool
) -> None:
    """Fewer than one pixel in 200 of synchronous bands is flagged."""
    rig = Rig(highest=370.0)
    found = share("bands_apart", 1000, rig=rig, background=background, noise_known=noise_known)
    assert found < 0.005


def test_swapped_roles_are_suspected() -> None:
    """An object that moves like a background is flagged in 90 % of the pixels."""
    assert share("roles_may_be_swapped", swapped=True) >= 0.9


def test_honest_roles_are_not_suspected() -> None:
    """Emissivities that sum to clearly more than 1 are not flagged as swapped."""
    assert share("roles_may_be_swapped") < 0.005


def test_the_suspicion_is_of_the_sum_alone() -> None:
    """True emissivities of 0.3 and 0.5 are flagged too, as the data cannot tell the cases apart."""
    assert share("roles_may_be_swapped", emissivity=[0.3, 0.5]) > 0.9
