"""What the explorer shows, curves, files and regions, without the browser."""

import csv
import math
import os
import sys
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import xarray as xr
from captures import RIG, people, still
from hypothesis import example, given
from hypothesis import strategies as st
from PIL import Image
from refused import assert_raises, refused

import dbthermal
from dbthermal import schema, store
from dbthermal.explorer import Region, View
from dbthermal.response import apparent_temperature
from dbthermal.schema import Status

WHOLE = Region("rectangle", ((0, 0), (4, 5)))
NOWHERE = Region("rectangle", ((0, 0), (0.2, 0.2)))
BEYOND = Region("polygon", ((0, 0), (0, 6), (4, 3)))
Glass = tuple[xr.Dataset, xr.Dataset, xr.Dataset]


def separated(**changes: Any) -> xr.Dataset:
    """Three frames of 4 by 5 pixels: object 310 to 312 K, background 300 K, both known by 0.1 K."""
    flat, variables = np.ones((3, 4, 5)), schema.STAGES["separated"]
    values = {
        "object_temperature": flat * np.array([310.0, 311.0, 312.0])[:, None, None],
        "background_temperature": 300.0 * flat,
        "object_temperature_std": 0.1 * flat,
        "background_temperature_std": 0.1 * flat,
        "emissivity": flat[:2] * np.array([0.9, 0.7])[:, None, None],
        "emissivity_std": 1e-3 * flat[:2],
        "status": np.zeros((4, 5), np.uint32),
    } | changes
    arrays = {key: (variables[key].dims, it, variables[key].attrs) for key, it in values.items()}
    return xr.Dataset(arrays, {"time": [0.0, 0.5, 1.0], "band": ["8-14", "9.5"]})


def test_panes_of_a_result_with_its_capture(glass: Glass) -> None:
    """Inputs are apparent temperatures; what is not estimated is left out."""
    _, capture, response = glass
    result = dbthermal.separation.solve(capture, response, "apparent")
    view = View(result, capture, response)
    assert "emissivity" in result.attrs["not_estimated"].split()
    assert {"input 8-14", "input 9.5", "object_temperature", "status"} <= set(view.panes)
    assert not [name for name in view.panes if name.startswith("emissivity")]
    mean = result["object_temperature"].isel(time=0).where(result["status"] == 0).mean()
    curve = view.curve("object_temperature", WHOLE, pixels="measured")
    np.testing.assert_allclose(curve["mean"][0], mean, rtol=1e-6)
    stated = {"emissivity": xr.DataArray([0.86, 0.72], dims="band")}  # without a deviation
    result = dbthermal.separation.solve(capture, response, "calibrated", **stated)
    assert View(result).curve("object_temperature", WHOLE)["std"].notnull().all()
    apparent = apparent_temperature(response, capture["counts"].isel(time=[7]))
    np.testing.assert_allclose(view.frame("input 9.5", 7), apparent[1, 0], rtol=0, atol=5e-5)  # [K]


def test_frames_of_a_store_are_those_in_memory(glass: Glass, tmp_path: Path) -> None:
    """A film that is copied frame by frame from a store has the same frames, ranges and curves."""
    _, capture, response = glass
    result = dbthermal.separation.solve(capture, response)
    for name, part in {"result": result, "capture": capture, "response": response}.items():
        store.save(part, tmp_path / f"{name}.zarr", {})
    paths = [tmp_path / f"{name}.zarr" for name in ("result", "capture", "response")]
    stored, held = View(*paths), View(result, capture, response)
    told: list[float] = []
    stored.progress = lambda _, share: told.append(share)
    assert list(stored.panes) == list(held.panes)
    for name in held.panes:
        np.testing.assert_array_equal(stored.frame(name, 200), held.frame(name, 200))
        assert stored.limits(name) == held.limits(name)
    xr.testing.assert_identical(
        stored.curve("object_temperature", WHOLE), held.curve("object_temperature", WHOLE)
    )
    assert told[-1] == 1.0


def test_curve_and_its_deviation() -> None:
    """Mean and extremes; the emissivities' share of the deviation is not lessened by 20 pixels."""
    data = separated()
    data["object_temperature"][:, 0, 0] += 2.0
    curve = View(data).curve("object_temperature", WHOLE)
    np.testing.assert_allclose(curve["mean"], [310.1, 311.1, 312.1], rtol=0, atol=1e-4)  # [K]
    np.testing.assert_allclose(curve["maximum"] - curve["minimum"], 2.0, rtol=0, atol=1e-4)
    # dx = (x - y) (k de_1 - de_2) / (1 - k), k = 0.3 / 0.1
    shared = np.array([10.0, 11.0, 12.0]) * 1e-3 * np.hypot(3.0, 1.0) / 2.0
    shared = shared * 19 / 20 + (shared * np.array([12, 13, 14]) / np.array([10, 11, 12])) / 20
    own = np.sqrt((0.01 - shared**2) / 20)
    np.testing.assert_allclose(curve["std"], np.hypot(shared, own), rtol=2e-3)


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("emissivity 9.5", {}),
        ("object_temperature", {"status": np.full((4, 5), int(Status.COMPLETED_FROM_PRIOR))}),
        ("object_temperature", {"emissivity": np.full((2, 4, 5), np.nan)}),
    ],
)
def test_deviation_that_is_shared_does_not_shrink(name: str, changes: dict[str, Any]) -> None:
    """Emissivities, completed pixels and unknown shares keep the deviation of one pixel."""
    data = separated(**changes)
    curve = View(data).curve(name, WHOLE)
    one = 1e-3 if name.startswith("emissivity") else 0.1
    np.testing.assert_allclose(curve["std"], one, rtol=1e-6)


@pytest.mark.parametrize("pooled", [False, True], ids=["alone", "pooled"])
def test_mean_of_a_region_is_as_certain_as_stated(pooled: bool) -> None:
    """95 % intervals of means of 12 to 140 pixels hold in 90 to 99 %, materials pooled or not."""
    response, scores = RIG.response(), []
    separate = dbthermal.separation.separate if pooled else dbthermal.separation.solve
    for seed in range(16):
        scene, capture = people(seed, 150, (12, 16))
        view = View(separate(capture, response))
        for corners in (((1, 1), (11, 15)), ((4, 4), (7, 8)), ((2, 2), (9, 10))):
            region = Region("rectangle", corners)
            curve = view.curve("object_temperature", region)
            counted = region.mask(view.shape) & view.counted()
            truth = scene["object_temperature"].values[:, counted].mean(axis=1)
            scores.append((curve["mean"].values - truth) / curve["std"].values)
    assert 0.90 <= np.mean(np.abs(scores) < 1.96) <= 0.99


def test_noise_of_an_input_falls_with_the_number(glass: Glass) -> None:
    """Counts of n pixels have the response's noise, over the root of n."""
    _, capture, response = glass
    curve = View(capture).curve("input 9.5", WHOLE)
    assert np.isnan(curve["std"]).all()  # no response: nothing is known of the noise
    curve = View(capture, response=response).curve("input 9.5", WHOLE)
    slope = dbthermal.response.curve(response, "9.5").count_slope(curve["mean"].values)
    expected = float(response["noise"][1]) / slope / np.sqrt(20)
    np.testing.assert_allclose(curve["std"], expected, rtol=0.02)


def test_flagged_pixels_do_not_count() -> None:
    """Completed pixels count unless only measured ones, and frames, are wanted; flagged if all."""
    status = np.zeros((4, 5), np.uint32)
    status[0], status[1] = int(Status.GRAY), int(Status.GRAY | Status.COMPLETED_FROM_MATERIAL)
    view = View(separated(status=status))
    numbers = {"unflagged": 15, "measured": 10, "all": 20}
    for pixels, number in numbers.items():
        curve = view.curve("object_temperature", WHOLE, pixels=pixels)  # type: ignore[arg-type]
        assert (curve["pixels"] == number).all()
    bridged = np.zeros((3, 4, 5), dtype=bool)
    bridged[1, 2, :2] = True
    made = view.data.assign(bridged=(("time", "y", "x"), bridged))
    curve = View(made).curve("object_temperature", WHOLE, pixels="measured")
    assert curve["pixels"].values.tolist() == [10, 8, 10]
    empty = view.curve("object_temperature", Region("rectangle", ((0, 0), (1, 5))))
    assert np.isnan(empty["mean"]).all()
    assert (empty["pixels"] == 0).all()


def test_events_of_a_capture(glass: Glass) -> None:
    """Segments, runs of flagged frames and what the user names are marked."""
    flags = np.zeros((2, 350), np.uint16)
    flags[1, [20, 21, 40]] = 2
    attrs = {"flag_masks": [1, 2], "flag_meanings": "late shutter_closed"}
    marked = glass[1].assign(
        segment=("time", np.repeat([0, 1, 2], [100, 150, 100])),
        frame_flags=(("band", "time"), flags, attrs),
    )
    expected = {"shutter event 1": 10.0, "shutter event 2": 25.0, "heater on": 3.0}
    expected |= {"shutter closed 1": 2.0, "shutter closed 2": 4.0}
    assert View(marked, events={"heater on": 3.0}).events == expected


def test_copied_code_gives_the_same(glass: Glass, tmp_path: Path) -> None:
    """Code of a view of stores runs alone, that of data in memory with their names."""
    _, capture, response = glass
    regions = {"region 1": Region("ellipse", ((0.5, 0.5), (4, 5)))}
    store.save(capture, tmp_path / "capture.zarr", {})
    store.save(response, tmp_path / "response.zarr", {})
    held = View(capture, response=response)
    views = [View(tmp_path / "capture.zarr", response=tmp_path / "response.zarr"), held]
    for view, names in zip(views, ({}, {"capture": capture, "response": response}), strict=True):
        done: dict[str, Any] = dict(names)
        exec(view.code("input 9.5", 11, regions), done)
        np.testing.assert_array_equal(done["frame"], held.frame("input 9.5", 11))
        xr.testing.assert_identical(
            done["curves"]["region 1"], held.curve("input 9.5", regions["region 1"])
        )


def answer(explorer: Any, **question: Any) -> tuple[dict[str, Any], list[bytes]]:
    """Answer of the explorer to a question of its page."""
    sent: list[Any] = []
    explorer.send = lambda content, buffers=(): sent.append((content, list(buffers)))
    explorer._handle_custom_msg({"page": 1, **question}, [])
    result: tuple[dict[str, Any], list[bytes]] = sent[-1]
    return result


def test_ranges_of_colour() -> None:
    """They are those of completed pixels, too, and need no deviation, at a pixel or at all."""
    data = separated()
    data["object_temperature"].values[:, 1] += 20.0
    data["status"].values[1] = Status.COMPLETED_FROM_PRIOR
    assert View(data).limits("object_temperature") == pytest.approx((310.0, 332.0))
    for pixels in (0, slice(None)):
        data["emissivity_std"].values[:, pixels] = np.nan
        low, high = View(data).limits("emissivity 9.5")
        assert low < high


def test_exported_files(tmp_path: Path) -> None:
    """CSV and NetCDF have the curves, TIFF and NetCDF the frame, PNG a picture; by suffix alone."""
    explorer = dbthermal.explore(separated())
    names = ["object_temperature", "emissivity 9.5", "status"]
    chosen = {"pixels": "unflagged", "panes": names, "index": 1, "celsius": True}
    shown = {"kind": "export", **chosen, "palette": "inferno", "limits": {}}
    assert "without a region" in answer(explorer, **shown, suffix=".csv")[0]["error"]
    regions = [("region 1", WHOLE.kind, WHOLE.points), ("door", "rectangle", ((0, 0), (2, 2)))]
    answer(explorer, kind="curves", pane=names[0], pixels="unflagged", regions=regions)
    for suffix in (".csv", ".tiff", ".png", ".nc"):
        (tmp_path / f"a{suffix}").write_bytes(answer(explorer, **shown, suffix=suffix)[1][0])
    with (tmp_path / "a.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["time [s]"] for row in rows] == ["0", "0.5", "1"]
    assert float(rows[1]["door mean [\N{DEGREE SIGN}C]"]) == pytest.approx(311.0 - 273.15, abs=1e-3)
    assert {row["region 1 pixels"] for row in rows} == {"20"}
    with Image.open(tmp_path / "a.tiff") as image, Image.open(tmp_path / "a.png") as figure:
        np.testing.assert_array_equal(np.asarray(image), np.float32(311.0))
        assert image.tag_v2[270] == "object temperature [K] at 0.500 s"  # type: ignore[attr-defined]
        assert figure.size[0] > 500
    with xr.open_dataset(tmp_path / "a.nc", engine="scipy") as saved:
        assert saved["mean"].sel(region="door").values.tolist() == [310.0, 311.0, 312.0]
        assert saved["object_temperature"].attrs["units"] == "K"
    assert "Must end in one of" in answer(explorer, **shown, suffix=".txt")[0]["error"]
    for suffix in (".gif", ".webp"):  # the films alone, at their own speed
        (tmp_path / f"a{suffix}").write_bytes(answer(explorer, **shown, suffix=suffix)[1][0])
        with Image.open(tmp_path / f"a{suffix}") as film:
            film.seek(1)
            film.load()
            assert (film.n_frames, film.info["duration"]) == (3, 500)  # type: ignore[attr-defined]
    still = {**shown, "panes": ["status"], "suffix": ".gif"}
    assert "Must have a picture that changes" in answer(explorer, **still)[0]["error"]
    explorer.close()


def test_frames_less_a_frame_of_reference() -> None:
    """Films, profiles and values of a pixel are less those of the frame; maps are as they are."""
    explorer = dbthermal.explore(separated())
    names = ["object_temperature", "emissivity 9.5"]
    shown = {"panes": names, "index": 2, "reference": 0}
    frames, _ = answer(explorer, kind="frames", limits=[None, None], isotherm=300.0, **shown)
    assert [value for *_, value in frames["spots"][names[0]]] == [2.0, 2.0]  # [K]
    assert frames["ranges"][0][0] == -frames["ranges"][0][1]
    assert frames["lined"] == []
    line = {"pane": names[0], "points": [[0, 0], [0, 3]]}
    _, (profile,) = answer(explorer, kind="profile", **line, **shown)
    np.testing.assert_array_equal(np.frombuffer(profile, np.float32), 2.0)
    probed, _ = answer(explorer, kind="probe", row=1, column=1, **shown)
    assert probed["values"][names[0]] == (2.0, None)
    assert probed["values"][names[1]][1] is not None
    explorer.close()


def test_codes_are_places_in_a_palette() -> None:
    """A code gives a value back within half a step of 255, its ends beyond them, 0 no number."""
    data = separated()
    frame = np.array([[280.0, 300.5, np.nan, 310.0, 320.0], [np.inf, 320.0, 1e30, 290.0, 285.0]])
    data["object_temperature"].values[0, :2] = frame
    explorer, known = dbthermal.explore(data), np.abs(frame) < schema.LARGEST
    shown = {"kind": "frames", "panes": ["object_temperature"], "isotherm": None, "index": 0}

    def codes(*limits: float) -> np.ndarray:
        buffer = answer(explorer, **shown, limits=[limits])[1][0]
        return np.frombuffer(buffer, np.uint8).reshape(4, 5)[:2]

    wide = codes(280.0, 320.0)
    assert not wide[~known].any()
    back = 280.0 + (wide[known] - 0.5) / 255 * 40.0
    np.testing.assert_allclose(back, frame[known], rtol=0, atol=0.5 * 40 / 255 + 1e-4)  # [K]
    assert codes(290.0, 310.0)[known].tolist() == [1, 134, 255, 255, 255, 1, 1]
    explorer.close()


OTHER: list[tuple[Any, str]] = [
    (3, "Invalid data of type int. Must be a Dataset or a str or a Path"),
    (xr.Dataset({"a": ("x", [1.0])}), "Missing variable 'object_temperature'"),
    (separated().drop_vars("time"), "Missing coordinate 'time'"),
    (separated(object_temperature=np.full((3, 4, 5), 22.0)), "Must be in kelvin, not Celsius"),
    (separated().isel(time=0), "Invalid dims"),
    (separated().isel(time=[]), "Empty 'object_temperature'"),
    (separated().assign_coords(time=[0.0, 0.0, 1.0]), "Unordered 'time'"),
    ("nowhere.zarr", "nowhere.zarr"),
]


test_bad_data_and_questions_are_refused = refused(
    lambda call: call(View(separated())),
    [
        *((lambda _, data=data: View(data), message) for data, message in OTHER),
        (lambda view: view.frame("object", 0), "Unknown pane 'object'"),
        (lambda view: view.frame("object_temperature", 3), "Invalid frame 3"),
        (lambda view: view.code("object_temperature", 3, {}), "Invalid frame 3"),
        (lambda view: view.code("object", 0, {}), "Unknown pane 'object'"),
        (lambda view: view.probe(["object_temperature"], 0, 4, 0), "Invalid row 4. Must lie in"),
        (lambda view: view.probe(["object_temperature"], 0, 0, -1), "Invalid column -1"),
        (lambda view: view.frame("object_temperature", cast(Any, "1")), "Invalid frame '1'"),
        (lambda view: view.curve("object_temperature", NOWHERE), r"Must lie in the image \(4, 5\)"),
        (lambda view: view.curve("object_temperature", BEYOND), r"\(0.0, 6.0\).* image \(4, 5\)"),
        (lambda view: view.curve("status", WHOLE), "Invalid pane 'status'"),
        (lambda view: view.curve("object_temperature", (1, 2)), "Invalid region of type tuple"),
        (lambda view: view.counted("some"), "Unknown pixels 'some'"),
        (lambda _: View(separated(), still()), "Invalid size 60 of 'time' of the capture"),
        (lambda _: View(separated(), events={"lamp": np.nan}), "of the event 'lamp'"),
        (lambda _: View(separated(), events=cast(Any, {"lamp": "on"})), "of the event 'lamp' 'on'"),
        (lambda _: View(separated(), events=cast(Any, [1.0])), "Invalid events of type list"),
    ],
    error=(TypeError, ValueError, FileNotFoundError),
)


def test_explorer_has_a_picture_for_who_has_no_browser() -> None:
    """Beside the widget the output holds a PNG; the traits hold no pixels."""
    explorer = dbthermal.explore(separated())
    bundle = explorer._repr_mimebundle_()
    data = bundle[0] if isinstance(bundle, tuple) else bundle
    assert {"image/png", "application/vnd.jupyter.widget-view+json"} <= set(data)
    state = explorer.get_state()
    assert all(len(str(one)) < 100 for key, one in state.items() if key not in {"_esm", "_css"})
    explorer.close()


def test_without_the_extra_its_name_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """One line says what to install."""
    monkeypatch.delitem(sys.modules, "dbthermal.explorer._widget", raising=False)
    monkeypatch.setitem(sys.modules, "anywidget", None)
    assert_raises(ImportError, r"pip install '\.\[explorer\]'", dbthermal.explore, separated())


def test_no_room_for_a_film_is_an_error(
    glass: Glass, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A film that finds no room on disk is named before the disk is full."""
    place = np.arange(40) // 20  # of a film that is not held in memory
    large = glass[1].isel(y=place, x=place)
    store.save(large, tmp_path / "capture.zarr", {})

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full, raising=False)
    with pytest.raises(OSError, match=r"No film of 2\.24 MB in '.*No space left.* Must have room"):
        View(tmp_path / "capture.zarr").frame("input 8-14", 0)


SHAPE = (120, 160)
coordinates = st.tuples(st.floats(-20, 140), st.floats(-20, 180))


def test_areas() -> None:
    """Numbers of pixels: exact for whole rectangles, within 1 % of ellipse and triangle."""
    assert Region("rectangle", ((10, 20), (40, 80))).mask(SHAPE).sum() == 30 * 60
    ellipse = Region("ellipse", ((10, 20), (110, 140))).mask(SHAPE).sum()
    np.testing.assert_allclose(ellipse, math.pi * 50 * 60, rtol=0.01, atol=0)
    triangle = Region("polygon", ((10, 20), (110, 20), (60, 150))).mask(SHAPE).sum()
    np.testing.assert_allclose(triangle, 0.5 * 100 * 130, rtol=0.01, atol=0)


@given(coordinates, coordinates)
@example((0.5, 0.5), (2.5, 3.5))  # through the centres of pixels
def test_a_rectangle_is_a_polygon_of_four_corners(
    first: tuple[float, float], last: tuple[float, float]
) -> None:
    """Both have the same pixels, whatever the order of the corners and beyond the image too."""
    (top, left), (bottom, right) = first, last
    corners = ((top, left), (top, right), (bottom, right), (bottom, left))
    rectangle, polygon = Region("rectangle", (first, last)), Region("polygon", corners)
    np.testing.assert_array_equal(rectangle.mask(SHAPE), polygon.mask(SHAPE))


test_bad_regions_are_refused = refused(
    Region,
    [
        ("circle", ((0, 0), (1, 1)), "Unknown kind of region 'circle'"),
        ("rectangle", ((0, 0),), "Invalid 1 points of a rectangle. Must be 2"),
        ("polygon", ((0, 0), (1, 1)), "Invalid 2 points of a polygon. Must be 3 to 1000"),
        ("ellipse", ((0, 0), (1, math.nan)), "points of a ellipse nan. Must lie in"),
        ("ellipse", (1, 2), r"Must be pairs \(row, column\)"),
    ],
    error=ValueError,
)
