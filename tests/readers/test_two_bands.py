"""Two recordings as one capture, with the maker's constants, all the way to temperatures."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from flir_files import Values, scene, sequence
from hostile_files import written
from numpy.testing import assert_allclose, assert_array_equal
from refused import assert_refused, refused

from dbthermal import alignment, calibration, correction, readers, schema, separation, store
from dbthermal import response as responses
from dbthermal.figures import drawing

BANDS = ("8-14", "9.5")


def recorded(
    path: Path, counts: np.ndarray, start: float, rate: float, values: Values = None
) -> xr.Dataset:
    """Recording of counts by a made-up FLIR camera."""
    seconds = [start + k / rate for k in range(len(counts))]
    return readers.flir(written(path, sequence(counts, seconds=seconds, values=values)))


@pytest.fixture
def pair(tmp_path: Path) -> tuple[xr.Dataset, xr.Dataset]:
    """Two recordings, the second with other constants, a quarter of a second later, and shorter."""
    first = recorded(tmp_path / "a.seq", scene(40), 1.5e9, 10.0)
    return first, recorded(tmp_path / "b.seq", scene(30) + 1, 1.5e9 + 0.25, 12.5, {0x58: 16000.0})


def test_a_text_that_is_drawn_into_the_images_is_named() -> None:
    """Pixels that never change, at the same places of all bands, pull a registration."""
    films = np.stack([scene(20), scene(20)[::-1] + np.uint16(900)])
    films[0, :, 5, 5] = films[1, :, 7, 7] = 65535  # a dead pixel of each

    def joined() -> xr.Dataset:
        cameras = [readers.array(film, unit="count", clock=10.0) for film in films]
        return readers.two_bands(*cameras, bands=BANDS, offset=0.0)

    assert not joined().attrs.get("warnings")
    films[:, :, 3:9, 4:16] = 65535
    with pytest.warns(
        UserWarning, match="^72 pixels never change in any band: saturated, or a text"
    ):
        joined()


def test_a_camera_that_hangs_is_noticed() -> None:
    """All frames of one band are the same image."""
    films = scene(20), np.broadcast_to(scene(20)[:1] + np.uint16(7), scene(20).shape)
    cameras = [readers.array(film, unit="count", clock=10.0) for film in films]
    with pytest.warns(UserWarning, match=r"^Band '9\.5' never changes\. Must be live"):
        readers.two_bands(*cameras, bands=BANDS, offset=0.0)


def test_a_border_is_noticed() -> None:
    """Rows and columns that pad an image are counted in a warning, which stays with the capture."""
    pads = ((0, 0), (4, 4), (0, 3))
    padded = [np.pad(scene(20) + n, pads, constant_values=n) for n in (0, 1)]
    pair = [readers.array(one.astype("u2"), unit="count", clock=10.0) for one in padded]
    expected = "Rows (8), columns (3) of band '9.5' never change: a border"
    with pytest.warns(UserWarning, match="a border") as told:
        capture = readers.two_bands(*pair, bands=BANDS, offset=0.0)
    assert [str(one.message).startswith(expected) for one in told] == [False, True]
    assert capture.attrs["warnings"] == [str(one.message) for one in told]


def test_both_clocks_are_kept(pair: tuple[xr.Dataset, xr.Dataset], tmp_path: Path) -> None:
    """Each band keeps its frames and times; the shorter is filled, flagged, and without times."""
    capture = readers.two_bands(*pair, bands=BANDS)
    schema.check(capture, "capture")
    assert_array_equal(capture.counts[0], pair[0].counts)
    assert_array_equal(capture.counts[1, :30], pair[1].counts)
    times = alignment.exposure_times(capture)
    assert_allclose(times[0], np.arange(40) / 10, rtol=0, atol=1e-9)
    assert_allclose(times[1, :30], 0.25 + np.arange(30) / 12.5, rtol=0, atol=1e-9)
    assert np.isnan(times[1, 30:]).all()
    padded = schema.has_flag(capture.frame_flags, "padded").values
    assert padded.sum() == 10
    assert capture.attrs["files"]["9.5"]["file_planck_R1"] == 16000
    store.save(capture, tmp_path / "capture.zarr", {})
    again = store.open_dataset(tmp_path / "capture.zarr")
    assert again.attrs["files"] == capture.attrs["files"]


def test_one_camera_twice_is_refused(pair: tuple[xr.Dataset, xr.Dataset]) -> None:
    """The same counts in both bands are one camera's, be one recording shorter."""
    with pytest.raises(ValueError, match="is one file named twice"):
        readers.two_bands(pair[0], pair[0].isel(time=slice(30)), bands=BANDS)


@pytest.mark.parametrize(
    ("scale", "zero", "unit"), [(100, 0.0, "degC"), (100, 273.15, "K"), (10, 0.0, "degC")]
)
def test_temperatures_in_hundredths_are_doubted(scale: int, zero: float, unit: str) -> None:
    """Whole numbers that read as one temperature in both bands are warned of, others are not."""
    kelvin = zero + np.random.default_rng(1).normal(30.0, 2.0, (40, 6, 8))
    counts = [np.rint(scale * (kelvin + apart)).astype(np.uint16) for apart in (0.0, 1.5, 20.0)]
    one, same, other = (readers.array(part, unit="count", clock=10.0) for part in counts)
    with pytest.warns(UserWarning, match=rf"over {scale}, are temperatures: .* {unit}\. Must be"):
        readers.two_bands(one, same, bands=BANDS, offset=0.0)
    readers.two_bands(one, other, bands=np.array(BANDS), offset=xr.DataArray(0.0))  # type: ignore[arg-type]


def test_a_capture_goes_through_corrections(pair: tuple[xr.Dataset, xr.Dataset]) -> None:
    """Correction and alignment take the capture; padding and times are theirs."""
    capture = readers.two_bands(*pair, bands=BANDS)
    maps = capture.counts[:, 0].astype(float).drop_vars("time").drop_attrs()
    terms = xr.Dataset({"gain": maps * 0 + 1, "offset": maps * 0, "bad": maps < 0})
    corrected = correction.correct_capture(capture, terms, bad_pixels=None)
    assert corrected.attrs["shutter_closed_frames"] == -1
    assert corrected.attrs["damaged_frames"] == [0, 10]
    aligned = alignment.align(corrected, offset=0.0)
    assert aligned.sizes["band"] == 2
    late = aligned.time > 0.25 + 29.5 / 12.5
    assert late.any()
    assert aligned.counts.sel(band="9.5")[late.values].isnull().all()
    assert aligned.counts.sel(band="9.5")[~late.values].notnull().all()


UNKNOWN = "'exposure_time' of the recording of band '9.5'.* Must (be 1 or more|be finite|increase)"
OTHERS: dict[str, tuple[Callable[[xr.Dataset], xr.Dataset], str]] = {
    "unknown": (lambda one: one.assign(exposure_time=one.exposure_time * np.nan), UNKNOWN),
    "infinite": (lambda one: one.assign(exposure_time=1 / one.exposure_time), UNKNOWN),
    "resting": (lambda one: one.assign(exposure_time=one.exposure_time * 0 - 1), UNKNOWN),
    "falling": (lambda one: one.assign_coords(time=-one.time), "Unordered 'time' of .* band '9.5'"),
    "truth": (lambda one: one.astype(bool), "Invalid dtype bool of .* of band '9.5'"),
    "crop": (lambda one: one.isel(x=slice(1, None)), r"Different sizes \(24, 32\) and \(24, 31\)"),
    "undated": (lambda one: one.drop_attrs(deep=False), r"Unknown dates .* offset="),
    "temperatures": (lambda one: one.astype("f4"), "Invalid dtype float32 of .* of band '9.5'"),
    "picture": (lambda one: one.drop_vars("exposure_time"), "Missing variable 'exposure_time'"),
    "timeless": (lambda one: one.drop_vars("time"), "Missing coordinate 'time'"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_what_makes_no_capture(pair: tuple[xr.Dataset, xr.Dataset], name: str) -> None:
    """Recordings that do not belong together are refused by band and rule."""
    change, message = OTHERS[name]
    with np.errstate(divide="ignore"), pytest.raises((ValueError, TypeError), match=message):
        readers.two_bands(pair[0], change(pair[1]), bands=BANDS)


test_arguments_that_make_no_capture = refused(
    lambda pair, name, value: readers.two_bands(*pair, **{"bands": BANDS, name: value}),
    [
        ("offset", 100.0, r"Invalid offset 100 s: .* do not overlap"),
        ("offset", np.nan, r"Invalid offset \[s\] nan\. Must lie in"),
        ("offset", "0", r"Invalid offset \[s\] '0'\. Must be a number"),
        ("offset", True, r"Invalid offset \[s\] True\. Must be a number"),
        ("bands", "ab", "Invalid bands 'ab'. Must be 2 different trimmed texts"),
        ("bands", ("a", "a"), r"Invalid bands \('a', 'a'\). Must be 2 different trimmed texts"),
        ("bands", ("a", "b "), "Must be 2 different trimmed texts"),
        *(
            ("bands", one, "Invalid bands")
            for one in ((8.0, 9.5), ("a", "b", "c"), ("a", " "), None)
        ),
    ],
    "pair",
)


@pytest.mark.data
@pytest.mark.parametrize("name", ["SampleSEQ.seq", "IR_2412.jpg", "flir_example.jpg", "ax8.jpg"])
def test_maker_formula(mirror: Path, name: str) -> None:
    """The response is the maker's formula, T = B / ln(R1 / (R2 (I + O)) + F), of real files."""
    recording = readers.flir(mirror / "recordings" / name)
    made = calibration.maker_response({"8-14": recording.attrs})
    keys = ("R1", "R2", "B", "F", "O")
    r1, r2, b, f, o = (recording.attrs[f"file_planck_{key}"] for key in keys)
    counts = recording.counts.values.astype(float)
    expected = b / np.log(r1 / (r2 * (counts + o)) + f)
    found = responses.curve(made, "8-14").inverse(counts)
    assert_allclose(found, expected, rtol=0, atol=1e-3)  # [K]
    print(name, f"{expected.min() - 273.15:.1f} to {expected.max() - 273.15:.1f} degrees Celsius")
    assert 240 < expected.min() < expected.max() < 400


def constants(f: float = 1.0) -> dict[str, Any]:
    """Attributes of a camera by its maker."""
    values = {"R1": 16000.0, "R2": 0.0125, "B": 1430.0, "F": f, "O": -6000}
    attrs = {f"file_planck_{key}": value for key, value in values.items()}
    return attrs | {"file_range_min": 233.15, "file_range_max": 423.15}


@pytest.mark.parametrize("f", [0.5, 1.0, 1.5, 2.0])
def test_maker_form(f: float) -> None:
    """For any F the Sakuma-Hattori form is within 0.2 K of the maker's, over the whole range."""
    made = calibration.maker_response({"8-14": constants(f)})
    temperature = np.linspace(233.15, 423.15, 500)
    counts = 16000.0 / (0.0125 * (np.exp(1430.0 / temperature) - f)) + 6000
    error = responses.curve(made, "8-14").inverse(counts) - temperature
    print(f, np.abs(error).max(), made.attrs["form_error"])
    assert np.abs(error).max() < 0.2  # [K]
    assert f != 1 or np.abs(error).max() < 1e-6  # [K]
    assert made.attrs["calibration"] == calibration.NO_BARS
    assert "noise" not in made


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("planck_R1", None, "Missing planck_R1 of band '8-14'. Must be in the file, as in FLIR's"),
        ("planck_B", 0.0, r"Invalid planck_B of band '8-14' 0\.0. Must be finite and positive"),
        ("planck_F", 1e9, "Invalid planck_F"),
        ("planck_O", np.nan, "Invalid planck_O of band '8-14' nan. Must lie in"),
        ("range_min", 600.0, r"Invalid ranges \[\[600\.0, 423\.15\]\] K"),
    ],
)
def test_maker_constants_are_checked(key: str, value: float | None, message: str) -> None:
    """A constant that is missing or impossible is named with its band."""
    attrs = {**constants(), f"file_{key}": value}
    attrs = {name: number for name, number in attrs.items() if number is not None}
    assert_refused(message, calibration.maker_response, {"8-14": attrs})
    for kind, files in {"float": attrs, "list": [attrs]}.items():
        with pytest.raises(TypeError, match=f"band of type {kind}. Must be a Mapping"):
            calibration.maker_response(files)  # type: ignore[arg-type]


def test_from_two_files_to_temperatures(
    tmp_path: Path, glass: tuple[xr.Dataset, xr.Dataset, xr.Dataset]
) -> None:
    """Simulated glass, written as two FLIR sequences, is separated from the files alone.

    Counts are those of the maker's constants, so that these are the true response; the result
    says that its deviations hold no error of the calibration.
    """
    truth, _, _ = glass
    constants = {"8-14": {0x58: 21106.77}, "9.5": {0x58: 16000.0, 0x5C: 1520.0}}
    emissivity, rng = {"8-14": 0.86, "9.5": 0.72}, np.random.default_rng(2)
    recordings = []
    for band, values in constants.items():
        b, r1 = values.get(0x5C, 1501.0), values[0x58]
        ideal = [
            r1 / (0.012545258 * np.expm1(b / truth[name].values)) + 7340
            for name in ("object_temperature", "background_temperature")
        ]
        mixed = emissivity[band] * ideal[0] + (1 - emissivity[band]) * ideal[1]
        counts = np.rint(mixed + rng.normal(0, 3, mixed.shape)).astype(np.uint16)
        recordings.append(recorded(tmp_path / f"{band}.seq", counts, 1.5e9, 10.0, values))
    capture = readers.two_bands(recordings[0], recordings[1], bands=BANDS)
    made = calibration.maker_response(capture.attrs["files"])
    result = separation.solve(capture.assign(counts=capture.counts.astype("float32")), made)
    assert result.attrs["calibration"] == calibration.NO_BARS
    assert "without error bars" in drawing.provenance_note(result)
    difference = result.object_temperature - truth.object_temperature.values
    error = float(np.sqrt((difference**2).mean("time")).median())
    print("median RMSE [K]", error)
    assert error < 0.2  # [K]
    # Over a narrow range the same response is a polynomial, over the camera's it is not.
    narrow = made.assign(temperature_min=made.temperature_min * 0 + 270, temperature_max=345.0)
    same = separation.solve(capture.assign(counts=capture.counts.astype("float32")), narrow)
    assert_allclose(same.object_temperature, result.object_temperature, rtol=0, atol=1e-3)  # [K]
