"""Blackbody counts that follow no Planck curve are refused, those that do are not."""

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr
from attack.scenes import BLACK, SLOPE, counts_of

from dbthermal import calibration

Floats = npt.NDArray[np.float64]
SLOPES = {"8-14": 115.0, "9.5": 9.9, "12.1": 9.2}  # of bands at 300 K [count/K]


def sensor(name: str, temperature: Floats) -> Floats:
    """Counts of a blackbody by a quadrature that is independent of `bands` and `planck`."""
    return np.asarray(15500.0 + (counts_of(name, temperature) - BLACK) * SLOPES[name] / SLOPE)


def fit(name: str, temperature: Floats, counts: Floats, noise: float | None) -> str:
    """Fit a response to one band's counts and noise [count]; the refusal, or nothing."""
    coords = {"band": [name], "temperature": temperature}
    labelled = None if noise is None else xr.DataArray([noise], {"band": [name]}, "band")
    try:
        calibration.fit_response(xr.DataArray([counts], coords), labelled)
    except ValueError as error:
        return str(error)
    return ""


BAD = (
    *("top", "top, last", "floor", "5 K off", "first off", "last off", "step", "offset", "line"),
    *("root", "log", "exponential", "stefan", "drift", "swapped", "wrapped"),
)


def spoilt(bad: str, c: Floats, t: Floats, s: float) -> Floats:
    """Counts c (temperature) at t [K], of slope s [count/K], spoilt in one of the ways `BAD`."""
    middle, place = c[len(c) // 2], np.arange(len(c))

    def clipped(counts: Floats, level: float) -> Floats:  # a soft limit: a fiftieth of the slope
        return np.asarray(np.where(counts > level, level + (counts - level) / 50.0, counts))

    ways: dict[str, Floats] = {
        "top": clipped(c, middle),
        "top, last": clipped(c, 0.5 * (c[-2] + c[-1])),
        "floor": -clipped(-c, -middle),
        "5 K off": c - 4.9 * s * (place == len(c) // 2),
        "first off": c - 5.0 * s * (place == 0),
        "last off": c + 5.0 * s * (place == len(c) - 1),
        "step": np.where(t > 315.0, 1.3 * c - 0.3 * 15500.0, c),
        "offset": np.where(t > 315.0, c + 4.0 * s, c),
        "line": 15500.0 + s * t,
        "root": 15500.0 + 20.0 * s * np.sqrt(t - 250.0),
        "log": 15500.0 + 40.0 * s * np.log(t - 250.0),
        "exponential": 15500.0 + 10.0 * s * np.exp((t - 283.0) / 10.0),
        "stefan": 15500.0 + s * 300.0 * (t / 300.0) ** 12 / 12.0,
        "drift": c + s * 4.0 * np.sin((t - 283.0) / 10.0),
        "swapped": c[[0, 2, 1, *range(3, len(c))]],
        "wrapped": np.where(c > middle, c - 65536.0, c).astype(np.int32),
    }
    return ways[bad]


def refusal(bad: str, name: str, number: int, noise: float | None) -> str:
    """Message by which a kind of bad counts is refused; empty if they are accepted."""
    temperature, slope = np.linspace(283.15, 343.15, number), SLOPES[name]
    counts = spoilt(bad, sensor(name, temperature), temperature, slope)
    if noise is None:
        return fit(name, temperature, counts, None)
    scatter = noise * slope * np.random.default_rng(1).standard_normal(number)
    return fit(name, temperature, counts + scatter, noise * slope)


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("number", [5, 13])
def test_counts_of_no_blackbody_are_refused(bad: str, number: int) -> None:
    """Saturated, stepped, drifting, straight counts are refused, with and without a noise."""
    for name, noise in (("8-14", 0.03), ("9.5", None), ("12.1", 0.1)):
        assert f"in band '{name}'" in refusal(bad, name, number, noise)


def test_the_wrong_temperature_is_named() -> None:
    """One reading that is off is named, with its distance from the curve of the others."""
    message = refusal("5 K off", "8-14", 13, 0.03)
    assert message.startswith("Invalid counts 24078 at 313.15 K in band '8-14', -56")
    assert "Must lie on one; noise and blackbody explain" in message
    assert "off every Planck curve of 6.67 to 16.8 um, most at" in refusal("line", "8-14", 7, 0.03)


def false_alarms(seeds: range, noise: float | None) -> list[str]:
    """Refusals of good sweeps: any range and number, even or not, rounded or not."""
    messages = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        name = list(SLOPES)[seed % 3]
        number, lowest = int(rng.integers(4, 26)), rng.uniform(258.0, 300.0)
        ends = lowest, lowest + rng.uniform(20.0, 90.0)
        uneven = np.sort(rng.uniform(*ends, number))
        temperature = uneven if rng.random() < 0.5 else np.linspace(*ends, number)
        counts = sensor(name, temperature + 0.1 * rng.standard_normal(number))
        counts += (noise or 0.0) * SLOPES[name] * rng.standard_normal(number)
        counts = np.rint(counts) if rng.random() < 0.5 else counts
        given = None if noise is None else noise * SLOPES[name]
        messages.append(fit(name, temperature, counts, given))
    return [message for message in messages if message]


@pytest.mark.parametrize("noise", [None, 0.03, 0.35, 1.0])
def test_good_sweeps_pass(noise: float | None) -> None:
    """Sweeps of a blackbody that scatters by 0.1 K, with noise of 0.03 to 1 K, are accepted."""
    assert false_alarms(range(40), noise) == []


@pytest.mark.long
def test_good_sweeps_pass_in_all_but_one_of_a_thousand() -> None:
    """At most 0.1 % of good sweeps are refused."""
    noises = (None, 0.03, 0.35, 1.0)
    assert sum(len(false_alarms(range(400), noise)) for noise in noises) <= 1
