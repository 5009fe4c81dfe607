"""Flags of suspicion: bands that are not simultaneous, and object and background swapped."""

from typing import Any

import numpy as np

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


def test_the_flag_grows_with_the_offset() -> None:
    """A tenth of a frame costs less than the noise; bands a frame or two apart are flagged."""
    shares = [share("bands_apart", offset=offset) for offset in (0.1, 0.3, 0.5, 1.0)]
    assert np.all(np.diff(shares) >= 0)
    assert shares[0] < 0.05
    assert shares[-1] >= 0.95
    assert share("bands_apart", offset=2.0) >= 0.95


def test_swapped_roles_are_suspected() -> None:
    """An object that moves like a background is flagged in 90 % of the pixels, and so are true
    emissivities of 0.3 and 0.5, whose sum is as small; others are not.
    """
    assert share("roles_may_be_swapped", swapped=True) >= 0.9
    assert share("roles_may_be_swapped", emissivity=[0.3, 0.5]) > 0.9
    assert share("roles_may_be_swapped") < 0.005
