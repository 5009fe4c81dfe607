"""The planner: bounds of a capture before it is recorded, the best filter, and its figures."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

from dbthermal import emissivity, limits, simulation
from dbthermal.simulation import Rig


@pytest.fixture(scope="module")
def materials() -> tuple[xr.Dataset, xr.DataArray]:
    """Table of materials, and the noise of a camera behind each filter."""
    table = emissivity.embedded_table()
    return table, emissivity.filter_noise(0.03, table["band"].values.tolist())


Materials = tuple[xr.Dataset, xr.DataArray]


def test_plan_is_the_bound(materials: Materials) -> None:
    """The plan of glass is `bounds` of the same film with the rig's own response."""
    table, noise = materials
    row = table.sel(material=["plate window glass"])
    design, rig = limits.CaptureDesign(), Rig(bands=("8-14", "9.5"), noise=(1.0, 1.0))
    time, response = np.arange(350) / 10.0, rig.response()
    rise = np.expm1(-3.0 * time / time[-1]) / np.expm1(-3.0)  # in a third of the time
    pulse = np.mod(time + 0.05, design.period) > design.period - design.duration
    films = design.start + design.span * rise, design.level + design.amplitude * pulse
    warm, cold = (np.asarray(film, np.float64)[:, None, None] for film in films)
    of_glass = row["emissivity"].isel(material=0).sel(band=list(rig.bands)).drop_vars("material")
    counts = noise.sel(band=list(rig.bands)) * response["noise"]
    response["noise"] = counts.assign_attrs(units="count")
    found = limits.bounds(simulation.scene(time, warm, cold, of_glass), response)
    reference = float(response["reference_temperature"])
    expected = limits.plan(row, noise, temperature=reference).sel(filter="9.5")
    rms = float((found["object_temperature_std"] ** 2).mean() ** 0.5)
    assert float(expected["object_temperature_std"][0]) == pytest.approx(rms, rel=0.01)
    ratio = float(found["reflection_ratio_std"].sel(band="9.5").item())
    planned = expected["reflection_ratio_std"].sel(band="9.5")
    assert float(planned[0]) == pytest.approx(ratio, rel=0.01)


def test_plan_finds_the_filter(materials: Materials) -> None:
    """Silicates get a filter in their reststrahlen bands, nearly gray metals get none."""
    expected = limits.plan(*materials)
    best = dict(zip(expected["material"].values, expected["best"].values, strict=True))
    print(expected["object_temperature_std"].to_pandas().round(2).assign(best=expected["best"]))
    assert best["plate window glass"] == "9.5"
    assert best["quartz sandstone"] == "8.5"
    assert best["brass plate"] == "none"
    assert expected["emissivity_std"].isnull().sel(filter="9.5", band="8.5").all()


def test_more_bands_and_more_seconds_help(materials: Materials) -> None:
    """A second filter at once never hurts; twice the film cuts the error by the root of two."""
    table, noise = materials
    table = table.isel(material=slice(0, 3))
    one, two = (limits.plan(table, noise, together=count) for count in (1, 2))
    std = one["object_temperature_std"]
    for label in two["filter"].values:
        both = two["object_temperature_std"].sel(filter=label)
        assert np.all(both <= std.sel(filter=label.split(" + ")).min("filter") * 1.02)
    durations = limits.plan_durations(table, noise, [40.0, 80.0, 160.0])
    gain = durations["object_temperature_std"].sel(filter="9.5", material="plate window glass")
    print(f"object [K] after 40, 80, 160 s: {gain.values.round(3)}")
    np.testing.assert_allclose(gain.values[:-1] / gain.values[1:], np.sqrt(2), rtol=0.05)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"beside": "7.0"}, "Missing band '7.0'"),
        ({"together": 5}, "together 5"),
        ({"together": 1.0}, "Invalid together 1.0"),
        ({"design": 35}, "Invalid design 35. Must be a CaptureDesign"),
        ({"emissivity": 1.2}, "emissivity 1.2 of 'plate window glass'"),
        ({"noise": -1.0}, "noise"),
        ({"seconds": [2.0, 1.0]}, "Must increase strictly"),
    ],
)
def test_bad_plan_is_a_clear_error(
    materials: Materials, options: dict[str, Any], message: str
) -> None:
    """Invalid materials, noise, durations and options are named, with the rule."""
    table, noise = materials[0].copy(deep=True), materials[1].copy(deep=True)
    rest = dict(options)
    table["emissivity"][0, 0], noise[0] = rest.pop("emissivity", 0.8), rest.pop("noise", 0.03)
    call: Any = limits.plan_durations if "seconds" in options else limits.plan
    with pytest.raises((TypeError, ValueError), match=message):
        call(table, noise, **rest)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("seconds", 0.0),
        ("rate", -1.0),
        ("duration", 6.0),
        ("seconds", 0.1),
        ("seconds", 1e9),
        ("span", "25"),
    ],
)
def test_bad_design_is_a_clear_error(name: str, value: Any) -> None:
    """Invalid capture conditions raise an error with the rule."""
    with pytest.raises((TypeError, ValueError), match=r"Must|Invalid span '25'"):
        limits.CaptureDesign(**{name: value})
