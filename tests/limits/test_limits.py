"""Statistical limits: against closed forms, the whole Fisher matrix, and one another."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import FILMS, RIG, emissivity_of, polynomials
from hypothesis import given, settings
from hypothesis import strategies as st
from refused import refused

from dbthermal import emissivity, limits, mixing, simulation
from dbthermal import response as responses
from dbthermal.limits import SKY, _fisher
from dbthermal.simulation import Background, Rig
from reproduction.experiments.cases import independent_pixels, ratio_variance_bound

THREE = Rig(bands=("8-14", "9.5", "10.6"), noise=(0.03, 0.35, 0.15))
TIME = np.arange(350) / 10.0
NOTHING: dict[str, Any] = {"resting": False, "response_kind": "linear"}


def scene_of(
    *values: float, rig: Rig = RIG, stop: float = 333.15, pixels: int = 6, **background: Any
) -> xr.Dataset:
    """Pixels of one material, heated from 20 C."""
    maps, moves = emissivity_of(*values, bands=rig.bands), Background(**background)
    rng = np.random.default_rng(4)
    return independent_pixels(TIME, maps, moves, pixels, rng, start=293.15, stop=stop)


def linear_noise(rig: Rig) -> tuple[float, float]:
    """Noise [K] of the linear signals."""
    response = rig.response()
    first, second = (response["noise"] / response["linear_slope"]).values
    return float(first), float(second)


@pytest.mark.parametrize("background", [{}, {"kind": "random walk"}, {"drift": 5.0}], ids=str)
def test_ratio_without_rest_is_the_closed_form(background: dict[str, Any]) -> None:
    """Linear, with no frame at rest, the ratio's bound is that of `ratio_variance_bound`."""
    scene = scene_of(0.86, 0.72, **background)
    found = limits.bounds(scene, RIG.response(), order=6, **NOTHING)["reflection_ratio_std"]
    cold = scene["background_temperature"].values[:, 0]
    variance = ratio_variance_bound((0.86, 0.72), linear_noise(RIG), cold, polynomials(TIME, 6))
    np.testing.assert_allclose(found[1, 0], np.sqrt(variance), rtol=1e-7)
    assert np.all(found[0] == 0)  # the quieter band over itself


def test_known_emissivities_give_the_closed_form() -> None:
    """One temperature a frame and known emissivities: the bound is that of `calibrated`."""
    scene = scene_of(0.86, 0.72).isel(time=slice(0, 12))
    found = limits.bounds(scene, RIG.response(), order=12, resting=False, emissivity_std=0.0)
    curves = [responses.curve(RIG.response(), name) for name in RIG.bands]
    temperatures = np.stack([scene[name] for name in FILMS])
    shares = np.array([[0.86, 0.14], [0.72, 0.28]])[..., None, None, None]
    pairs = zip(shares, curves, strict=True)
    mixed = np.stack([share * curve.slope(temperatures) for share, curve in pairs])
    noise = responses.noise(RIG.response(), list(RIG.bands))
    std = noise / [curve.reference_slope for curve in curves]
    # var = J^-1 diag(s^2) J^-T of each sample.
    inverse = np.linalg.inv(np.moveaxis(mixed, (0, 1), (-2, -1)))
    variance = np.moveaxis(inverse**2 @ np.square([std[0], std[1]]), -1, 0)
    for name, expected in zip(FILMS, np.sqrt(variance), strict=True):
        np.testing.assert_allclose(found[f"{name}_std"], expected, rtol=1e-9)
    assert not found["emissivity_std"].any()


def whole_fisher(scene: xr.Dataset, rig: Rig, functions: np.ndarray) -> dict[str, np.ndarray]:
    """Deviations from the inverse of the whole Fisher matrix, by differences of the model."""
    curves = [responses.curve(rig.response(), name) for name in rig.bands]
    slopes = [curve.reference_slope for curve in curves]
    noise = responses.noise(rig.response(), list(rig.bands)) / slopes
    warm, cold = (scene[f"{name}_temperature"].values[:, 0, 0] for name in ("object", "background"))
    e = scene["emissivity"].values[:, 0, 0]
    rest = cold == cold.min()
    bands, order = len(e), functions.shape[1]

    def signal(unknown: np.ndarray) -> np.ndarray:
        own, level, free = unknown[:bands], unknown[bands + order], unknown[bands + order + 1 :]
        x, y = functions @ unknown[bands : bands + order], np.full(len(cold), level)
        y[~rest] = free
        rows = zip(own, curves, noise, strict=True)
        return np.concatenate([mixing.leaving(a, u.signal(x), u.signal(y)) / s for a, u, s in rows])

    truth = np.concatenate([e, functions.T @ warm, [cold.min()], cold[~rest]])
    steps = np.where(np.arange(truth.size) < bands, 1e-4, 0.02)
    jacobian = np.stack(
        [
            (signal(truth + step) - signal(truth - step)) / (2 * size)
            for size, step in zip(steps, np.diag(steps), strict=True)
        ],
        axis=1,
    )
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    of_object = functions @ covariance[bands : bands + order, bands : bands + order] @ functions.T
    ratio = (1 - e[1]) / (1 - e[0])
    gradient = np.array([ratio, -1.0]) / (1 - e[0])
    std = np.sqrt(np.diag(covariance))
    of_background = np.full(len(cold), std[bands + order])
    of_background[~rest] = std[bands + order + 1 :]
    return {
        "emissivity": std[:bands],
        "object_temperature": np.sqrt(np.diag(of_object)),
        "background_temperature": of_background,
        "reflection_ratio": np.sqrt([gradient @ covariance[:2, :2] @ gradient]),
    }


@pytest.mark.parametrize(("rig", "values"), [(RIG, (0.86, 0.72)), (THREE, (0.86, 0.72, 0.82))])
def test_elimination_gives_the_whole_inverse(rig: Rig, values: tuple[float, ...]) -> None:
    """The background eliminated frame by frame, two bands or three, exact response, with rests."""
    scene = scene_of(*values, rig=rig, pixels=1).isel(time=slice(0, 350, 7))
    functions = polynomials(scene["time"].values, 5)
    projected = functions @ (functions.T @ scene["object_temperature"].values[:, 0, 0])
    scene["object_temperature"] = scene["object_temperature"].copy(data=projected[:, None, None])
    found = limits.bounds(scene, rig.response(), order=5)
    assert 5 < int(found["resting"].sum()) < 45
    for name, expected in whole_fisher(scene, rig, functions).items():
        values_found = found[f"{name}_std"].values[:, 0, 0]
        if name == "reflection_ratio":
            values_found = values_found[1:2]
        np.testing.assert_allclose(values_found, expected, rtol=1e-5, err_msg=name)


QUANTITIES = ("object_temperature", "background_temperature", "emissivity", "reflection_ratio")


@pytest.mark.parametrize(
    ("changes", "options", "told"),
    [
        ({}, {}, (True, True, True, True)),
        ({}, NOTHING, (True, False, False, True)),
        ({}, {"resting": False}, (True, False, False, True)),
        ({"kind": "random walk"}, {"response_kind": "linear"}, (True, False, False, True)),
        ({"stop": 293.15}, {"response_kind": "linear"}, (True, False, False, True)),
        ({"kind": "still"}, {"response_kind": "linear"}, (False, True, False, False)),
        ({"kind": "still"}, NOTHING, (False, False, False, False)),
        ({"values": (0.8, 0.8)}, NOTHING, (False, False, False, True)),
        ({"values": (0.8, 0.8)}, {}, (False, False, False, True)),
    ],
    ids=str,
)
def test_what_is_identifiable(
    changes: dict[str, Any], options: dict[str, Any], told: tuple[bool, ...]
) -> None:
    """Constant object, still background, gray body, no rest: each hides what theory says."""
    values = changes.get("values", (0.86, 0.72))
    scene = scene_of(*values, **{k: v for k, v in changes.items() if k != "values"})
    found = limits.bounds(scene, RIG.response(), **options)
    shares = found["identifiable"].sel(quantity=list(QUANTITIES)).mean(("y", "x"))
    assert tuple(shares.values > 0.5) == told
    if options.get("response_kind") == "linear":
        for name, known in zip(QUANTITIES, told, strict=True):
            assert bool(np.isfinite(found[f"{name}_std"].values).all()) == known


SHARE = st.floats(0.1, 0.9)


@settings(max_examples=10)
@given(SHARE, SHARE, SHARE, st.floats(0.3, 3.0))
def test_noise_scales_and_bands_help(
    first: float, second: float, third: float, louder: float
) -> None:
    """The bound is proportional to the noise, and one band more never raises it."""
    scene = scene_of(first, second, third, rig=THREE, pixels=2)
    response = THREE.response()
    found = limits.bounds(scene, response, order=5)
    noisy = response.assign(noise=louder * response["noise"].assign_attrs(units="count"))
    scaled = limits.bounds(scene, noisy, order=5)
    two = limits.bounds(scene.isel(band=[0, 1]), response, order=5)
    for name in ("object_temperature_std", "background_temperature_std"):
        np.testing.assert_allclose(scaled[name], louder * found[name], rtol=1e-6)
    for name in ("object_temperature_std", "background_temperature_std", "emissivity_std"):
        three = found[name].sel(band=two["band"]) if "band" in found[name].dims else found[name]
        assert np.all(three.values <= two[name].values * (1 + 1e-6))


def test_order_leaves_little() -> None:
    """The chosen order leaves at most a tenth of a variance, and one order less leaves more."""
    scene = scene_of(0.86, 0.72)
    found = limits.bounds(scene, RIG.response(), **NOTHING)
    first, second = linear_noise(RIG)
    for pixel, order in enumerate(found["order"].values[0]):
        left = []
        for size in (order, order - 1):
            functions = polynomials(TIME, int(size))
            warm = scene["object_temperature"].values[:, 0, pixel]
            left.append(np.sum((warm - functions @ (functions.T @ warm)) ** 2))
        # z2 - k2 z1 holds (1 - k2) x, and k2 = 2.
        energy = np.array(left) / (second**2 + (2.0 * first) ** 2)
        assert energy[0] <= 0.1 < energy[1]


@pytest.mark.parametrize(
    ("options", "lower"),
    [
        ({"resting": False}, False),
        ({"order": 7}, False),
        ({"order": 5}, True),
        ({"emissivity_std": 0.01}, True),
        ({"emissivity_std": 0.0}, True),
    ],
)
def test_more_is_known_the_less_is_assumed(options: dict[str, Any], lower: bool) -> None:
    """Frames at rest, known emissivities and a smaller subspace each lower the bound."""
    plain, other = (
        limits.bounds(scene_of(0.86, 0.72), RIG.response(), **{"order": 6, **changed})
        for changed in ({}, options)
    )
    ratio = float(other["object_temperature_std"].mean() / plain["object_temperature_std"].mean())
    assert (ratio < 1) == lower


def test_glass_is_as_designed() -> None:
    """Glass to 60 C at noise (0.03, 0.35) K: the design's order of size, and units."""
    found = limits.bounds(scene_of(0.86, 0.72, pixels=100), RIG.response())
    rms = float((found["object_temperature_std"] ** 2).mean() ** 0.5)
    ratio = float(found["reflection_ratio_std"].sel(band="9.5").median())
    assert rms == pytest.approx(0.27, abs=0.05)  # [K]
    assert ratio == pytest.approx(0.073, abs=0.01)
    units = {"object_temperature_std": "K", "emissivity_std": "1", "condition_number": "1"}
    assert {name: found[name].attrs["units"] for name in units} == units
    assert found.attrs["reference_band"] == "8-14"
    condition = float(mixing.condition_number([0.86, 0.72]))
    assert float(found["condition_number"][0, 0]) == pytest.approx(condition)


PLAIN = scene_of(0.86, 0.72)
WARM, COLD = PLAIN["object_temperature"], PLAIN["background_temperature"]
DOUBLED = PLAIN.assign(emissivity=2.0 * PLAIN["emissivity"])


test_bad_scene_is_a_clear_error = refused(
    lambda scene, options: limits.bounds(scene, RIG.response(), **options),
    [
        (PLAIN.drop_vars("emissivity"), {}, "Missing variable 'emissivity'"),
        (PLAIN.isel(band=[0]), {}, "one band"),
        (DOUBLED, {}, "emissivity in band '8-14' 1.72. Must lie in (0, 1)"),
        (PLAIN.assign(object_temperature=WARM + 100), {}, "object_temperature"),
        (PLAIN.assign(object_temperature=COLD), {}, "30 smooth functions"),
        (PLAIN, {"emissivity_std": -0.1}, "emissivity_std -0.1"),
        (PLAIN, {"emissivity_std": 1e-300}, "emissivity_std 1e-300. Must be 0, or at least"),
        (PLAIN, {"order": 0}, "order 0"),
        (PLAIN, {"order": 2.5}, "Invalid order"),
        (PLAIN, {"resting": 1}, "Invalid resting"),
    ],
)


TABLE = emissivity.embedded_table()
NETD = emissivity.filter_noise(0.03, TABLE["band"].values.tolist())


def test_plan_is_the_bound() -> None:
    """The plan of glass is `bounds` of the same film with the rig's own response."""
    row = TABLE.sel(material=["plate window glass"])
    design, rig = limits.CaptureDesign(), Rig(bands=("8-14", "9.5"), noise=(1.0, 1.0))
    time, response = np.arange(350) / 10.0, rig.response()
    rise = np.expm1(-3.0 * time / time[-1]) / np.expm1(-3.0)  # in a third of the time
    pulse = np.mod(time + 0.05, design.period) > design.period - design.duration
    films = design.start + design.span * rise, design.level + design.amplitude * pulse
    warm, cold = (np.asarray(film, np.float64)[:, None, None] for film in films)
    of_glass = row["emissivity"].isel(material=0).sel(band=list(rig.bands)).drop_vars("material")
    counts = NETD.sel(band=list(rig.bands)) * response["noise"]
    response["noise"] = counts.assign_attrs(units="count")
    found = limits.bounds(simulation.scene(time, warm, cold, of_glass), response)
    reference = float(response["reference_temperature"])
    expected = limits.plan(row, NETD, temperature=reference).sel(filter="9.5")
    rms = float((found["object_temperature_std"] ** 2).mean() ** 0.5)
    assert float(expected["object_temperature_std"][0]) == pytest.approx(rms, rel=0.01)
    ratio = float(found["reflection_ratio_std"].sel(band="9.5").item())
    planned = expected["reflection_ratio_std"].sel(band="9.5")
    assert float(planned[0]) == pytest.approx(ratio, rel=0.01)


@pytest.mark.parametrize(
    "conditions", [{"rate": 1000.0}, {"rate": 317.3}, {"rate": 1000.0, "seconds": 2.0}], ids=str
)
def test_plan_of_fast_cameras_is_that_of_all_frames(
    monkeypatch: pytest.MonkeyPatch, conditions: dict[str, float]
) -> None:
    """At most every other frame is computed, and no deviation differs by 1 %."""
    table = TABLE.sel(material=["plate window glass"], band=["8-14", "9.5"])
    design, sizes = limits.CaptureDesign(**conditions), list[int]()
    order = _fisher.smallest_order

    def counted(truth: Any, sensitivity: Any) -> Any:
        sizes.append(truth.time.size)
        return order(truth, sensitivity)

    monkeypatch.setattr(_fisher, "smallest_order", counted)
    quick = limits.plan(table, NETD, design)
    monkeypatch.setattr(limits, "_RESOLVED", 10**9)
    whole = limits.plan(table, NETD, design)
    assert 2 * sizes[0] <= sizes[1] == round(design.seconds * design.rate)
    for name in whole.data_vars.keys() - {"best"}:
        np.testing.assert_allclose(quick[name], whole[name], rtol=0.01, err_msg=name)


def test_plan_outdoors_says_what_the_sky_costs() -> None:
    """The error of two bands in closed form, of 9.5 um beside 10.6 and beside 8-14."""
    table = TABLE.sel(material=["plate window glass"])
    planned = limits.plan(table, NETD, outdoors=True)
    assert planned.attrs["beside"] == "10.6"
    rise = np.expm1(-np.arange(350) / 349 * 3) / np.expm1(-3.0)
    pulse = 3.0 * (np.mod(np.arange(350) + 0.5, 50) > 30)
    contrast = np.sqrt(np.mean((293.15 + 25.0 * rise - 273.15 - pulse) ** 2))
    wide = limits.plan(table, NETD, outdoors=True, beside="8-14")
    for name, answer in {"10.6": planned, "8-14": wide}.items():
        first, second = (float(table["emissivity"].sel(band=band)[0]) for band in (name, "9.5"))
        ratio = (1.0 - second) / (1.0 - first)
        error = (1.0 - second) * (SKY["9.5"] / SKY[name] - 1.0) / abs(1.0 - ratio)
        cost = answer["sky_error"].sel(filter="9.5")
        np.testing.assert_allclose(cost, error * contrast, rtol=1e-6)
    assert float(cost[0]) > 2.0 * float(planned["sky_error"].sel(filter="9.5")[0])
    total = np.hypot(planned["object_temperature_std"].values, planned["sky_error"].values)
    assert planned["best"][0] == planned["filter"][int(np.argmin(total))]


def test_sky_is_the_measured_one() -> None:
    """Its changes are those that notebook 15 measures, recorded beside the tests."""
    recorded = json.loads((Path(__file__).parents[1] / "reference_numbers.json").read_text("utf-8"))
    measured = recorded["with data"]["15_sky"]
    for band in SKY.keys() - {"8-14"}:
        assert SKY[band] == pytest.approx(measured[f"sky: change in {band} [1]"], rel=0.01)


def test_plan_finds_the_filter() -> None:
    """Silicates get a filter in their reststrahlen bands, nearly gray metals get none."""
    expected = limits.plan(TABLE, NETD)
    best = dict(zip(expected["material"].values, expected["best"].values, strict=True))
    assert best["plate window glass"] == "9.5"
    assert best["quartz sandstone"] == "8.5"
    assert best["brass plate"] == "none"
    assert expected["emissivity_std"].isnull().sel(filter="9.5", band="8.5").all()


def test_more_bands_and_more_seconds_help() -> None:
    """A second filter at once never hurts; twice the film cuts the error by the root of two."""
    table = TABLE.isel(material=slice(0, 3))
    one, two = (limits.plan(table, NETD, together=count) for count in (1, 2))
    std = one["object_temperature_std"]
    for label in two["filter"].values:
        both = two["object_temperature_std"].sel(filter=label)
        assert np.all(both <= std.sel(filter=label.split(" + ")).min("filter") * 1.02)
    durations = limits.plan_durations(table, NETD, [40.0, 80.0, 160.0])
    gain = durations["object_temperature_std"].sel(filter="9.5", material="plate window glass")
    np.testing.assert_allclose(gain.values[:-1] / gain.values[1:], np.sqrt(2), rtol=0.05)


MIRROR, MUTE = TABLE.copy(deep=True), NETD.copy(deep=True)
MIRROR["emissivity"][0, 0], MUTE[0] = 1.2, -1.0


test_bad_plan_is_a_clear_error = refused(
    lambda call, arguments, options: call(*arguments, **options),
    [
        (limits.plan, (TABLE, NETD), {"beside": "7.0"}, "Missing band '7.0'"),
        (limits.plan, (TABLE, NETD), {"together": 5}, "together 5"),
        (limits.plan, (TABLE, NETD), {"together": 1.0}, "Invalid together 1.0"),
        (limits.plan, (TABLE, NETD), {"design": 35}, "design of type int. Must be a CaptureDesign"),
        (limits.plan, (MIRROR, NETD), {}, "emissivity of 'plate window glass' in band"),
        (limits.plan, (TABLE, MUTE), {}, "noise"),
        (limits.plan_durations, (TABLE, NETD, [2.0, 1.0]), {}, "Must increase strictly"),
        (limits.CaptureDesign, (), {"duration": 6.0}, "Must"),
        (limits.CaptureDesign, (), {"seconds": 0.1}, "Must"),
        (limits.CaptureDesign, (), {"seconds": 1e9}, "Must"),
        (limits.CaptureDesign, (), {"span": "25"}, "Invalid span '25'"),
    ],
)
