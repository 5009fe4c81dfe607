"""Stored results are read back unchanged and complete, with their provenance."""

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import xarray as xr
import zarr
from captures import plain_capture
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from matplotlib.figure import Figure
from PIL import Image
from refused import assert_refused

from dbthermal import store

RECORD: dict[str, Any] = {"parameters": {"frames": 3}, "commit": "unknown", "inputs": {}}
CODED = ("_FillValue", "missing_value", "scale_factor", "add_offset")
DTYPES = st.sampled_from(["uint16", "float32", "float64", "int64", "bool"])


@pytest.fixture
def capture() -> xr.Dataset:
    """Two bands of three frames, with a gap in one and all that may accompany them."""
    temperature = 280 + np.arange(24, dtype="float32").reshape(3, 2, 4)
    temperature[1, 1, 1] = np.nan
    return xr.Dataset(
        {
            "counts": (
                ("band", "time", "y", "x"),
                np.arange(48, dtype="uint16").reshape(2, 3, 2, 4),
            ),
            "object_temperature": (("time", "y", "x"), temperature, {"units": "K"}),
            "status": (("y", "x"), np.eye(2, 4, dtype="uint16"), {"flag_masks": [1, 2]}),
            "valid": (("y", "x"), np.eye(2, 4) > 0),
        },
        coords={
            "band": ["8-14", "9.5"],
            "time": ("time", [0.0, 0.1, 0.2], {"units": "s"}),
            "clock": ("time", np.arange(3).astype("timedelta64[ns]")),
            "scene": "coffee pot",
        },
        attrs={"radiometric": 0},
    )


def test_dataset_comes_back_identical(capture: xr.Dataset, tmp_path: Path) -> None:
    """Values, dtypes, dims, coordinates and attributes survive, gaps and zeros included."""
    before = capture.copy(deep=True)
    store.save(capture, tmp_path / "a.zarr", RECORD)
    xr.testing.assert_identical(capture, before)
    opened = store.open_dataset(tmp_path / "a.zarr")
    assert opened.attrs.pop("provenance") == RECORD
    xr.testing.assert_identical(opened, capture)
    assert {n: v.dtype for n, v in opened.variables.items()} == {
        n: v.dtype for n, v in capture.variables.items()
    }


@given(values=DTYPES.flatmap(lambda dtype: arrays(dtype, array_shapes(min_dims=2, max_dims=4))))
def test_any_array_comes_back(
    values: np.ndarray[Any, np.dtype[Any]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Any array is read back bit by bit, infinities and NaN included."""
    path = tmp_path_factory.mktemp("any") / "a.zarr"
    dims = ("band", "time", "y", "x")[-values.ndim :]
    store.save(xr.Dataset({"value": (dims, values)}), path, RECORD)
    np.testing.assert_array_equal(store.open_dataset(path)["value"], values, strict=True)


def test_a_save_replaces_all_or_nothing(capture: xr.Dataset, tmp_path: Path) -> None:
    """A failed one leaves the earlier result, and nothing beside it; a later one none of it."""
    store.save(capture, tmp_path / "a.zarr", RECORD)
    first = store.checksum(tmp_path / "a.zarr")
    broken = capture.assign(material=("band", np.array([object(), object()])))
    with pytest.raises((TypeError, ValueError)):
        store.save(broken, tmp_path / "a.zarr", RECORD)
    assert store.checksum(tmp_path / "a.zarr") == first
    assert [path.name for path in tmp_path.iterdir()] == ["a.zarr"]
    store.save(capture[["valid"]], tmp_path / "a.zarr", RECORD)
    assert list(store.open_dataset(tmp_path / "a.zarr").data_vars) == ["valid"]
    assert [path.name for path in tmp_path.iterdir()] == ["a.zarr"]


def test_nothing_is_saved_inside_a_store(capture: xr.Dataset, tmp_path: Path) -> None:
    """What is saved inside a store, which would then be refused as changed, is refused itself."""
    store.save(capture, tmp_path / "a.zarr", RECORD)
    with pytest.raises(ValueError, match=r"Invalid path .*b\.zarr', inside a store"):
        store.save(capture, tmp_path / "a.zarr" / "b.zarr", RECORD)
    with pytest.raises(ValueError, match=r"Invalid path .*n\.md', inside a store"):
        store.save_text("a", tmp_path / "a.zarr" / "counts" / "n.md", RECORD)
    store.open_dataset(tmp_path / "a.zarr").load()
    with pytest.raises(TypeError, match="Invalid dataset of type DataArray"):
        store.save(capture["counts"], tmp_path / "c.zarr", RECORD)  # type: ignore[arg-type]


def test_degrees_celsius_are_not_saved_as_kelvin(capture: xr.Dataset, tmp_path: Path) -> None:
    """Under their own unit, or as NaN alone, temperatures are saved."""
    celsius = capture.assign(object_temperature=(film := capture["object_temperature"]) - 273.15)
    for units in ({}, {"units": "K"}):
        celsius["object_temperature"].attrs = units
        assert_refused(
            "temperature 12.4. Must be in kelvin", store.save, celsius, tmp_path / "a.zarr", RECORD
        )
    store.save(capture.assign(object_temperature=film * np.nan), tmp_path / "a.zarr", RECORD)
    celsius["object_temperature"].attrs = {"units": "degC"}
    store.save(celsius, tmp_path / "a.zarr", RECORD)
    chunked = store.open_dataset(tmp_path / "a.zarr")
    assert chunked["object_temperature"].units == "degC"


def test_opening_reads_no_values(capture: xr.Dataset, tmp_path: Path) -> None:
    """Values are read when they are used: a later save is told by a dataset opened before it."""
    store.save(capture, tmp_path / "a.zarr", RECORD)
    opened = store.open_dataset(tmp_path / "a.zarr")
    store.save(capture.assign(counts=capture["counts"] + 1), tmp_path / "a.zarr", RECORD)
    assert_refused(r"Since it was opened, replaced file 'counts/c/0/0/0/0'", opened.load)
    with pytest.raises(FileNotFoundError, match=r"No dataset '.*b\.zarr'"):
        store.open_dataset(tmp_path / "b.zarr")
    (tmp_path / "b.zarr").mkdir()
    assert_refused(
        r"Invalid store '.*b\.zarr': it has no 'zarr\.json'",
        store.open_dataset,
        tmp_path / "b.zarr",
    )
    zarr.open_group(tmp_path / "c.zarr", mode="w").create_array("a", shape=(2, 3), dtype="u2")
    with pytest.warns(UserWarning, match="No checksums"):
        assert_refused("c.zarr'. Must name the dims", store.open_dataset, tmp_path / "c.zarr")


def test_figures(tmp_path: Path) -> None:
    """The same figure gives the same bytes and its provenance; vectors keep text and images."""
    for name in ("a", "b"):
        for suffix in ("png", "pdf", "svg"):
            figure = Figure(figsize=(2, 1))
            axes = figure.subplots()
            axes.imshow([[293.15, 294.15]])
            axes.set_title("wall")
            store.save_figure(figure, tmp_path / f"{name}.{suffix}", RECORD, dpi=50)
    for suffix in ("png", "pdf", "svg"):
        assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()
    with Image.open(tmp_path / "a.png") as image:
        assert image.size == (100, 50)
        assert json.loads(image.info["Comment"]) == RECORD
    vectors = (tmp_path / "a.svg").read_text()
    assert all(text in vectors for text in (">wall</text>", "<image", *RECORD))
    content = (tmp_path / "a.pdf").read_bytes()
    assert all(part in content for part in (b"/FontFile2", b"/Subtype /Image", b"/Subject"))


@pytest.mark.parametrize("save", [store.save, store.save_text, store.save_figure])
def test_suffix_tells_the_kind(save: Callable[..., None], tmp_path: Path) -> None:
    """A result's name ends in its format."""
    content = {store.save: xr.Dataset(), store.save_text: "", store.save_figure: Figure()}[save]
    with pytest.raises(ValueError, match=r"Invalid path '.*a\.txt'. Must end in"):
        save(content, tmp_path / "a.txt", RECORD)


def test_record_holds_what_made_a_result(tmp_path: Path) -> None:
    """Parameters, versions, commit and input checksums are kept, the same each time."""
    (tmp_path / "in.txt").write_text("abc")
    record = store.provenance({"levels": (1, 2)}, {"input": tmp_path / "in.txt"})
    assert record == store.provenance({"levels": (1, 2)}, {"input": tmp_path / "in.txt"})
    assert record["parameters"] == {"levels": [1, 2]}
    assert record["versions"]["numpy"] == np.__version__
    assert re.fullmatch(r"[0-9a-f]{40}(-dirty)?|unknown", record["commit"])
    # FIPS 180-2, appendix B.1
    assert record["inputs"]["input"].startswith("ba7816bf8f01cfea414140de5dae2223")
    assert_refused("Invalid parameter 'noise' = nan", store.provenance, {"noise": math.nan})
    with pytest.raises(TypeError, match="Invalid parameter 'folder' = "):
        store.provenance({"folder": tmp_path})


def test_commit_is_that_of_the_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in a hook of git, which names the clone that it runs in."""
    commit = store.provenance({})["commit"]
    monkeypatch.setenv("GIT_DIR", "/nowhere")
    monkeypatch.setenv("GIT_WORK_TREE", "/")
    assert store.provenance({})["commit"] == commit


def test_checksum_of_a_folder(tmp_path: Path) -> None:
    """A folder's checksum depends on its names and contents alone."""
    for name in ("a", "b"):
        (tmp_path / name / "sub").mkdir(parents=True)
        (tmp_path / name / "sub" / "file").write_text("abc")
    before = store.checksum(tmp_path / "a")
    assert before == store.checksum(tmp_path / "b")
    (tmp_path / "b" / "sub" / "file").rename(tmp_path / "b" / "file")
    assert before != store.checksum(tmp_path / "b")


def film(*shapes: tuple[int, int]) -> list[np.ndarray]:
    """Frames of one gray level each."""
    return [np.full((*shape, 3), 40 * index, np.uint8) for index, shape in enumerate(shapes, 1)]


@pytest.mark.parametrize("options", [{}, {"codec": "h264"}])
def test_video_comes_back(tmp_path: Path, options: Any) -> None:
    """A video, VP9 unless asked for, has its frames, rate, nearly its colours, and provenance."""
    codec, frames = options.get("codec", "vp9"), film((64, 96), (64, 96), (64, 96))
    for name in ("a.mp4", "b.mp4"):
        store.save_video(frames, tmp_path / name, RECORD, rate=10.0, **options)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
    with av.open(tmp_path / "a.mp4") as video:
        assert video.streams.video[0].codec_context.codec.canonical_name == codec
        assert video.streams.video[0].average_rate == 10
        assert json.loads(video.metadata["comment"]) == RECORD
        levels = [frame.to_ndarray(format="rgb24").mean() for frame in video.decode(video=0)]
    np.testing.assert_allclose(levels, [40, 80, 120], rtol=0, atol=3)  # of 255


@pytest.mark.parametrize(
    ("frames", "codec", "message"),
    [
        (film((32, 47)), "vp9", "Invalid frame of 32 x 47 pixels. Must be of even size"),
        (film((32, 48), (32, 46)), "vp9", "as all others: 32 x 48"),
        ([], "vp9", "Invalid film without frames"),
        (film((32, 48)), "gif", r"Invalid codec 'gif'. Must be one of \['h264', 'vp9'"),
    ],
)
def test_no_video_of_nonsense(tmp_path: Path, frames: Any, codec: Any, message: str) -> None:
    """Frames that cannot be a video raise a ValueError, and no file is left behind."""
    with pytest.raises(ValueError, match=message):
        store.save_video(frames, tmp_path / "a.mp4", RECORD, rate=10.0, codec=codec)
    assert not any(tmp_path.iterdir())


def test_text_keeps_its_record(tmp_path: Path) -> None:
    """The text comes first, the record in a comment."""
    store.save_text("| a |\n", tmp_path / "a.md", RECORD)
    text, _, comment = (tmp_path / "a.md").read_text().partition("\n<!-- ")
    assert text == "| a |\n"
    assert json.loads(comment.removesuffix(" -->\n")) == RECORD


def rows(count: int) -> list[xr.Dataset]:
    """Rows of a small capture with attributes, one in each part."""
    values = np.arange(2 * 3 * count * 4, dtype=np.float32).reshape(2, 3, count, 4)
    whole = plain_capture(values, np.arange(3.0))
    whole.attrs = {"origin": "simulated", "warnings": ["one"]}
    return [whole.isel(y=slice(top, top + 1)) for top in range(count)]


@pytest.mark.parametrize("count", [1, 2, 3])
def test_rows_keep_the_attributes(tmp_path: Path, count: int) -> None:
    """Parts have those of the first, in the store and its variables."""
    store.save_rows(rows(count), tmp_path / "a.zarr", store.provenance({"frames": 3}))
    opened = store.open_dataset(tmp_path / "a.zarr")
    assert opened.attrs["origin"] == "simulated"
    assert opened.attrs["warnings"] == ["one"]
    assert opened.attrs["provenance"]["parameters"] == {"frames": 3}
    assert opened.counts.attrs == {"units": "count"}
    whole = xr.concat(rows(count), "y")
    assert opened.drop_attrs().equals(whole.drop_attrs())
    chunked = whole.chunk({"y": 1, "time": 2})
    store.save(chunked, tmp_path / "b.zarr", store.provenance({}))
    assert store.open_dataset(tmp_path / "b.zarr").counts.equals(whole.counts)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda one: one.isel(band=[1, 0]), "'band' of rows 1"),
        (lambda one: one.assign_coords(time=one.time + 1.0), "'time' of rows 1"),
        (lambda one: one.assign(counts=one.counts.assign_attrs(units="K")), "'counts'"),
        (lambda one: one.astype(np.float64), "'counts' of rows 1"),
        (lambda one: one.isel(time=slice(2)), "of rows 1"),
        (lambda one: one.rename(counts="c"), "with, or without"),
    ],
)
def test_rows_of_another_kind_are_refused(
    tmp_path: Path, change: Callable[[xr.Dataset], xr.Dataset], named: str
) -> None:
    """Another part is named by its number, and nothing is left behind."""
    first, second = rows(2)
    with pytest.raises(ValueError, match=named):
        store.save_rows([first, change(second)], tmp_path / "a.zarr", store.provenance({}))
    assert_refused("Must be at least one part", store.save_rows, [], tmp_path / "a.zarr", {})
    with pytest.raises(ValueError, match="Invalid height -1"):
        store.save_rows([first], tmp_path / "a.zarr", {}, height=-1)
    assert not (tmp_path / "a.zarr").exists()


@pytest.mark.parametrize(
    ("values", "attrs", "named"),
    [
        (np.array(["a", None], object), {}, "of 'a'"),
        (np.ones(2, np.longdouble), {}, "of 'a'"),
        ([0.5], {"z": b"x"}, "'z' of 'a'"),
        ([0.5], {"dtype": "bool"}, "'dtype' of 'a'"),
        ([0.5], {"units": "seconds since 2000-01-01"}, "'units' of 'a'"),
        ([0.5], {"coordinates": "b"}, "'coordin"),
        *(([2], {name: 2}, f"Invalid attribute '{name}' of 'a'") for name in CODED),
    ],
)
def test_what_would_open_as_other_values_is_refused(
    tmp_path: Path, values: Any, attrs: dict[str, Any], named: str
) -> None:
    """Values that zarr cannot hold, and attributes that it would decode by, are named."""
    with pytest.raises((TypeError, ValueError), match=named):
        store.save(xr.Dataset({"a": ("x", values, attrs)}), tmp_path / "a.zarr", RECORD)
    assert not (tmp_path / "a.zarr").exists()
