"""Input of `solve`: invalid arguments, settings, randomness and what is recorded of it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import emissivity_of

from dbthermal import alignment, separation
from dbthermal import response as responses
from dbthermal.simulation import Rig

RIG = Rig()
TIME = np.arange(350) / 10.0


Glass = tuple[xr.Dataset, xr.Dataset, xr.Dataset]


def test_order_of_bands_and_tiles_does_not_matter(
    glass: Glass,
) -> None:
    """The same pixels give the same values with the bands exchanged, and one by one."""
    _, capture, response = glass
    whole = separation.solve(capture, response)
    exchanged = separation.solve(capture.isel(band=[1, 0]), response).sel(band=list(RIG.bands))
    single = separation.solve(capture.isel(y=[2], x=[3]), response)
    # The prior's spectrum is a small difference: it feels the rounding of single precision.
    for name, rtol in (
        ("object_temperature", 1e-5),
        ("emissivity", 1e-5),
        ("reflection_ratio", 1e-5),
        ("background_temperature_std", 2e-3),
    ):
        np.testing.assert_array_equal(exchanged[name].values, whole[name].values)
        np.testing.assert_allclose(
            single[name].values[..., 0, 0], whole[name].values[..., 2, 3], rtol=rtol
        )


BAD: dict[str, tuple[Callable[[xr.Dataset, xr.Dataset], object], str]] = {
    "negative seed": (
        lambda c, r: separation.solve(c, r, "naive", seed=-1),
        "Invalid seed -1. Must be",
    ),
    "unknown method": (
        lambda c, r: separation.solve(c, r, "magic"),
        r"Unknown method 'magic'. Must be one of \['subspace', 'calibrated', 'dbvt'",
    ),
    "unknown kind": (
        lambda c, r: separation.solve(c, r, response_kind="cubic"),
        "Unknown kind of response 'cubic'",
    ),
    "one band": (lambda c, r: separation.solve(c.isel(band=[0]), r), "Must be two or more"),
    "missing band": (
        lambda c, r: separation.solve(c, r.isel(band=[0])),
        "Missing band '9.5' in the response",
    ),
    "dims": (
        lambda c, r: separation.solve(c.transpose("time", "band", "y", "x"), r),
        r"Invalid dims \('time', 'band', 'y', 'x'\) of 'counts'",
    ),
    "units": (
        lambda c, r: separation.solve(c.assign(counts=c["counts"].assign_attrs(units="K")), r),
        "Invalid units 'K' of 'counts' of the corrected. Must be 'count'",
    ),
    "time": (
        lambda c, r: separation.solve(c.isel(time=[*range(40), 39, *range(40, 80)]), r),
        "Unordered 'time' of 'counts' of the corrected: 3.9 s is followed by 3.9 s",
    ),
    "workers": (lambda c, r: separation.solve(c, r, workers=0), "Invalid number of workers 0"),
    "half a worker": (
        lambda c, r: separation.separate(c, r, workers=1.5),  # type: ignore[arg-type]
        r"Invalid number of workers 1.5. Must be a whole number",
    ),
    "emissivity 1.2": (
        lambda c, r: separation.solve(c, r, "calibrated", emissivity=emissivity_of(0.8, 1.2)),
        r"Invalid emissivity 1.2 in band '9.5', pixel \(0, 0\). Must lie in \(0, 1\)",
    ),
    "gray": (
        lambda c, r: separation.solve(c, r, "calibrated", emissivity=emissivity_of(0.8, 0.8)),
        "the same in both bands. Must differ",
    ),
    "noise in kelvin": (
        lambda c, r: separation.solve(c, r.assign(noise=r["noise"].assign_attrs(units="K"))),
        "Invalid units 'K' of 'noise' of the response. Must be 'count'",
    ),
    "noise without bands": (
        lambda c, r: separation.solve(c, r.assign(noise=3.0)),
        "Invalid dims .. of 'noise' of the response",
    ),
    "status dims": (
        lambda c, r: separation.solve(
            c.assign(status=(("x", "y"), np.zeros((5, 4), np.uint16))), r
        ),
        "Invalid dims .'x', 'y'. of 'status' of the corrected",
    ),
    "status bits": (
        lambda c, r: separation.solve(
            c.assign(status=(("y", "x"), np.full((4, 5), 2**21, np.uint32))), r
        ),
        "Unknown bits 2097152 in the status",
    ),
    "noise": (
        lambda c, r: separation.solve(c, r.assign(noise=("band", [1.0, -1.0]))),
        "Invalid noise .count. -1.0 in band '9.5'. Must be finite and positive",
    ),
    "coefficient": (
        lambda c, r: separation.solve(c, r.assign(offset=("band", [np.nan, 0.0]))),
        "Invalid offset of the response in band '8-14'. Must be finite",
    ),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_input_is_a_clear_error(glass: Glass, what: str) -> None:
    """Invalid input raises an error with the name, the value and the rule."""
    call, message = BAD[what]
    _, capture, response = glass
    with pytest.raises(ValueError, match=message):
        call(capture, response)


def test_raw_counts_are_refused(glass: Glass) -> None:
    """Whole numbers are raw counts, and the error says both ways on."""
    _, capture, response = glass
    raw = capture.assign(counts=capture["counts"].astype(np.uint16))
    message = r"correct_capture, of a camera that corrects itself with correction.corrected_by"
    with pytest.raises(TypeError, match=message):
        separation.solve(raw, response)
    with pytest.raises(TypeError, match=message):
        alignment.align(raw, offset=0.0)


@pytest.mark.parametrize(
    ("settings", "values", "named"),
    [
        (
            separation.SubspaceSettings,
            {"background_drift": None},
            "Invalid background_drift",
        ),
        (
            separation.SubspaceSettings,
            {"background_drift": "3"},
            "Invalid background_drift",
        ),
        (separation.CalibratedSettings, {"smooth": "false"}, "Invalid smooth 'false' of method"),
        (separation.BcpSettings, {"patch": "15"}, "Invalid patch '15' of method"),
        (separation.BcpSettings, {"patch": 15.0}, "Must be a whole number"),
        (separation.NaiveSettings, {"starts": 2.5}, "Invalid starts 2.5 of method"),
        (separation.DbvtSettings, {"batch": 2.5}, "Must be a whole number"),
        (separation.NaiveSettings, {"starts": True}, "Invalid starts True of method"),
        (separation.RatioSettings, {"order": 2.5}, "Invalid order 2.5 of method"),
        (separation.DbvtSettings, {"start": None}, "Invalid start None of method"),
    ],
)
def test_settings_of_another_type(
    settings: Callable[..., object], values: dict[str, object], named: str
) -> None:
    """A setting of a wrong type is named, with its method."""
    with pytest.raises(TypeError, match=named):
        settings(**values)


def test_a_wrong_seed_leaves_nothing_of_a_run(tmp_path: Path, glass: Glass) -> None:
    """It is refused before anything is made, and the right call then goes through."""
    _, capture, response = glass
    wrongs: tuple[dict[str, Any], ...] = ({"seed": "3"}, {"memory": "2e9"}, {"provenance": "x"})
    for wrong in wrongs:
        with pytest.raises((TypeError, ValueError), match="Invalid"):
            separation.run(capture, tmp_path / "a.zarr", response, **wrong)
    assert not list(tmp_path.iterdir())


def test_reflected_change_of_other_results(glass: Glass) -> None:
    """Emissivities in per cent, other dims, and missing variables are named."""
    _, capture, response = glass
    result = separation.solve(capture, response)
    apparent = responses.apparent_temperature(response, capture["counts"])
    with pytest.raises(ValueError, match="not per cent"):
        separation.reflected_change(apparent, result.assign(emissivity=100 * result["emissivity"]))
    with pytest.raises(ValueError, match="Invalid dims"):
        separation.reflected_change(apparent.rename(y="row"), result)
    with pytest.raises(ValueError, match="Missing variable 'emissivity'"):
        separation.reflected_change(apparent, result.drop_vars("emissivity"))


@pytest.mark.parametrize("method", ["naive", "dbvt"])
def test_random_starts_hang_on_the_seed_alone(glass: Glass, method: str) -> None:
    """Random starts depend on the seed: the same one repeats the result, another changes it."""
    capture, response = glass[1].isel(time=slice(0, 60)), glass[2]
    few = separation.DbvtSettings(steps=3, stages=1) if method == "dbvt" else None
    first, again, other = (
        separation.solve(capture, response, method, settings=few, seed=seed)["emissivity"]
        for seed in (1, 1, 2)
    )
    xr.testing.assert_identical(first, again)
    assert float(abs(first - other).max()) > 1e-6


def test_progress_is_shown(glass: Glass, capsys: pytest.CaptureFixture[str]) -> None:
    """A bar counts the pixels, on request."""
    _, capture, response = glass
    separation.solve(capture, response, progress=True)
    assert "subspace: 100%" in capsys.readouterr().err
    separation.solve(capture, response)
    assert capsys.readouterr().err == ""


def test_options_are_recorded(glass: Glass) -> None:
    """The result records the settings of its method."""
    settings = separation.RatioSettings("narrow")
    result = separation.solve(*glass[1:], "ratio", settings=settings)
    assert "kind='narrow'" in result.attrs["settings"]


def test_apparent_is_the_reading_of_the_quieter_band(glass: Glass) -> None:
    """Method "apparent" gives the blackbody temperature of the quieter band's counts."""
    _, capture, response = glass
    found = separation.solve(capture, response, "apparent")["object_temperature"]
    counts = responses.curve(response, "8-14").counts(found.values.astype(np.float64))
    np.testing.assert_allclose(counts, capture["counts"][0], rtol=0, atol=0.05)  # [count]
