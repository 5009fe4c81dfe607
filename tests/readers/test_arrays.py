"""Arrays of counts: files of NumPy without objects, and what other libraries have opened."""

import gzip
import json
import re
import struct
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import google_crc32c
import h5py
import numcodecs
import numpy as np
import pandas as pd
import pytest
import xarray as xr
import zarr
from flir_files import scene
from hostile_files import hdf5_chunk, write, written
from numpy.testing import assert_allclose, assert_array_equal
from refused import assert_refused, raising, refused
from scipy.io import savemat
from zarr.codecs import BloscCodec, GzipCodec

from dbthermal import readers, store


def read(source: Any, name: str | None = None, **options: Any) -> xr.Dataset:
    """Counts at 10 Hz."""
    return readers.array(source, name, **{"unit": "count", "clock": 10.0, **options})


@pytest.mark.parametrize("order", ["<u2", ">u2"])
@pytest.mark.parametrize("layout", ["C", "F"])
def test_files_of_numpy(tmp_path: Path, order: str, layout: Any) -> None:
    """.npy and .npz in any order of bytes and dimensions."""
    counts = np.asarray(scene().astype(order), order=layout)
    np.save(tmp_path / "a.npy", counts)
    np.savez(tmp_path / "a.npz", counts)
    np.savez_compressed(tmp_path / "b.npz", warm=counts, dark=counts - 9)
    for path, name in (("a.npy", None), ("a.npz", None), ("b.npz", "warm")):
        found = read(tmp_path / path, name)
        assert_array_equal(found.counts, scene())
        assert found.counts.dtype == np.dtype("uint16")
        assert_allclose(found.time, [0, 0.1, 0.2])
    with pytest.raises(ValueError, match=r"name of one of the arrays .* in .* \['dark', 'warm'\]"):
        read(tmp_path / "b.npz")


def test_times_of_npz_and_arrays_of_other_libraries(tmp_path: Path) -> None:
    """Times in a .npz are its clock; lists and tensors are arrays; shapes are named."""
    np.savez(tmp_path / "a.npz", frames=scene(), time=[0.0, 0.1, 0.24], notes=np.array([{}]))
    assert_allclose(read(tmp_path / "a.npz", clock=None).time, [0.0, 0.1, 0.24])
    with pytest.raises(ValueError, match=r"Invalid times of 'a\.npz'.* Must agree to half a frame"):
        read(tmp_path / "a.npz", clock=30.0)
    for times in (
        {"time_ns": [7e9, 7.1e9, 7.24e9]},
        {"t_ms": [0, 100, 240]},
        {"t": [3, 3.1, 3.24]},
    ):
        np.savez(tmp_path / "a.npz", frames=scene(), **times)
        assert_allclose(read(tmp_path / "a.npz", clock=None).time, [0.0, 0.1, 0.24])
    assert_array_equal(read([*scene()]).counts, scene())
    np.savez(tmp_path / "a.npz", *[scene()] * 20)
    assert_refused(r"Must be one of \['arr_0', .*, 'arr_5', '\.\.\.'\]\.", read, tmp_path / "a.npz")
    torch = pytest.importorskip("torch")
    with pytest.raises(ValueError, match=r"Invalid dtype int32 of 'array'"):
        read(torch.zeros((3, 4, 5), dtype=torch.int32))
    with pytest.raises(ValueError, match=r"Invalid array of 'b\.h5', named 'Temperature'.*rename"):
        read(hdf5(tmp_path / "b.h5", _long_name="Temperature in 0.01 K"))
    with pytest.raises(ValueError, match=r"frames \(1, 3, 24, 32\)\. .* squeeze axes"):
        read(hdf5(tmp_path / "b.h5", scene()[np.newaxis]))


def test_a_store_of_our_own_is_no_camera(tmp_path: Path) -> None:
    """A capture's store, which has no array of one band, is said to be a capture."""
    one = read(scene())
    both = readers.two_bands(one, read(scene() + 1), bands=("8-14", "9.5"), offset=0.0)
    store.save(both, tmp_path / "scene.zarr", store.provenance({}))
    expected = r"Missing array \(time, y, x\) in 'scene.zarr'.*a store is a capture"
    assert_refused(expected, read, tmp_path / "scene.zarr")


class Quantity(np.ndarray[Any, Any]):
    """Numbers with a unit, as of unyt and pint."""

    units = "K"


FRAMES = xr.DataArray(scene(), dims=("time", "y", "x"), name="frames")
UNKNOWN = SimpleNamespace(shape=(np.nan, 8, 8), dtype=np.dtype("u2"), ndim=3)  # of dask
MILLISECONDS = xr.DataArray(100.0 * np.arange(3), dims="time", attrs={"units": "ms"})


test_what_is_no_array_of_counts = refused(
    lambda source, options: read(source, **options),
    [
        (FRAMES.astype("i4"), {}, r"Invalid dtype int32 of 'array'\. Must be uint16"),
        (FRAMES.assign_attrs(units="K"), {}, "Invalid unit 'K' of 'array'"),
        (FRAMES.assign_attrs(unit="K"), {}, "Invalid unit 'K' of 'array'"),
        (FRAMES.assign_attrs(scale_factor=0.01), {}, "Invalid 'scale_factor' of 'array', 0.01"),
        (FRAMES.assign_attrs(scale=0.01), {}, "Invalid 'scale' of 'array', 0.01. Must be 1"),
        (FRAMES.assign_attrs(slope=[1.0, 0.9]), {}, "Invalid 'slope' of 'array'"),
        (FRAMES.assign_attrs(Intercept=-273.15), {}, "Invalid 'intercept' of 'array', -273.15"),
        (np.ma.masked_equal(scene(), scene()[1, 2, 3]), {}, "Missing counts in 'array': masked"),
        (scene().view(Quantity), {}, "Invalid unit 'K' of 'array'"),
        (scene().byteswap(), {}, "Invalid counts of 'array': rougher than with bytes swapped"),
        (scene()[0], {}, r"Invalid shape \(24, 32\) of 'array'"),
        (scene()[:0], {}, r"Invalid shape \(0, 24, 32\) of .*Must be \(time, y, x\), not 0"),
        (scene().tolist(), {}, "Invalid dtype int64 of 'array'"),
        (UNKNOWN, {}, r"Invalid shape \(nan, 8, 8\) of 'array'"),
        *((scene(), {"memory": it}, "memory.*Must be (a n|fin)") for it in ("1e9", np.nan, True)),
        (scene(), {"unit": ["count"]}, "unit.*Must be 'count'"),
        (scene(), {"clock": None}, "Missing clock= for 'array', which tells no times"),
        *(
            (scene(), {"clock": one}, r"Invalid .*clock .*of 'array'.*in \(0, 1e\+06\] Hz")
            for one in (0, -1.0, np.nan, np.inf, 1e300, 2e6, 1e-9 * np.arange(3))
        ),
        *(
            (scene(), {"clock": one}, "Invalid dtype .* of the clock of 'array'")
            for one in (True, "10", ["10", "11", "12"], np.arange(3).astype("m8[s]"))
        ),
        (scene(), {"clock": MILLISECONDS}, "Invalid units 'ms' of the clock of 'array'"),
    ],
)


def named(folder: Path, dims: tuple[str, ...]) -> dict[str, Any]:
    """Arrays and files whose dims have names."""
    array = xr.DataArray(scene(), dims=dims, name="frames")
    group = zarr.open_group(folder / "3.zarr", mode="w", zarr_format=3)
    group.create_array("frames", data=scene(), dimension_names=dims)
    array.to_dataset().to_zarr(folder / "2.zarr", zarr_format=2)
    with pytest.importorskip("h5py").File(folder / "a.h5", "w") as file:
        file["frames"] = scene()
        for place, dim in enumerate(dims):
            file["frames"].dims[place].label = dim
    return {
        **{name: folder / name for name in ("2.zarr", "3.zarr", "a.h5")},
        "array": array,
        "variable": array.variable,
        "zarr": group["frames"],
    }


WRONG = ("y x t", "time x y", "band y x", "frame Column row", "t width height", "time lat lon")
TURNED = r"Invalid dims \[.*'\. Must be \(time, y, x\): rename or transpose"
RIGHT = ("Frame ROWS cols", "Timestamps y x", "image height width", "dim_0 phony_dim_1 x")


@pytest.mark.parametrize("dims", [*WRONG, "channel y x", *RIGHT])
def test_names_of_dims(tmp_path: Path, dims: str) -> None:
    """Names of the field in any case, and made-up ones, are taken; another order is refused."""
    for source in named(tmp_path, tuple(dims.split())).values():
        with raising(None if dims in RIGHT else TURNED):
            assert_array_equal(read(source).counts, scene())


def test_dims_of_netcdf_without_variables(tmp_path: Path) -> None:
    """A dim of NetCDF 4 that has no values is no clock, and its name that of its scale."""
    with pytest.importorskip("h5py").File(tmp_path / "a.nc", "w") as file:
        frames = file.create_dataset("frames", data=scene())
        for place, (dim, size) in enumerate(zip(("time", "y", "x"), frames.shape, strict=True)):
            file[dim] = np.zeros(size, "f4")
            file[dim].make_scale("This is a netCDF dimension but not a netCDF variable.")
            frames.dims[place].attach_scale(file[dim])
    assert_array_equal(read(tmp_path / "a.nc").counts, scene())


@pytest.mark.parametrize(
    ("times", "units", "fault"),
    [
        ([0.0, 0.1, 0.2], "s", ""),
        ([5.0, 5.1, 5.21], None, ""),
        ([0, 100, 200], "milliseconds since 2000-01-01", ""),
        ([0.0, 0.5, 1.0], "s", r"Invalid times of '.*': frame 1 at 0\.5 s, by clock= at 0\.1"),
        ([0.2, 0.1, 0.0], "s", r"frame 1 at -0\.1 s, after 0 s\. Must rise"),
        ([0.0, np.nan, 0.2], "s", "frame 1 at nan s"),
        ([0, 1, 2], "frames", "Invalid units 'frames' of the times of"),
        ([0, 1 / 600, 1 / 300], "minutes since 2024-05-06 07:08:09", ""),
        ([0, 100_000, 200_000], "usec", ""),
        ([0, 10**8, 2 * 10**8], None, ""),
        ([0.0, 0.1, 0.2], "h", "frame 1 at 0.1 h"),
    ],
)
def test_times_of_an_array_agree_with_the_clock(
    tmp_path: Path, times: Any, units: str | None, fault: str
) -> None:
    """An array's own times that contradict the clock are refused, of a file and an array."""
    time = ("time", times, {} if units is None else {"units": units})
    array = xr.DataArray(scene(), {"time": time}, ("time", "y", "x"), "frames")
    signed = array.astype("i2").assign_attrs(_Unsigned="true").to_dataset()
    signed.to_netcdf(tmp_path / "a.nc", engine="scipy")
    for form in (2, 3):
        options: Any = {"group": "entry", "zarr_format": form, "consolidated": False}
        array.to_dataset().to_zarr(tmp_path / f"{form}.zarr", **options)
    with pytest.importorskip("h5py").File(tmp_path / "a.h5", "w") as file:
        file.update({"frames": scene(), "time": times})
        file["time"].attrs.update(time[2])
        file["time"].make_scale("time")
        file["frames"].dims[0].attach_scale(file["time"])
    names = ("a.nc", "a.h5", "2.zarr", "3.zarr")
    for source in (array, *(tmp_path / name for name in names)):
        with raising(fault):
            assert_allclose(read(source).time, [0, 0.1, 0.2])


@pytest.mark.parametrize(
    ("times", "unit", "expected"),
    [
        ([0.0, 0.1, 0.24], None, [0.0, 0.1, 0.24]),
        ([5, 105, 205], "ms", [0.0, 0.1, 0.2]),
        ([0, 100, 200], None, "Missing unit of the times of 'a.h5', which rise by 100 a frame"),
        ([0.0, 0.2, 0.1], "s", "frame 2 at 0.1 s, after 0.2 s. Must rise"),
        ([0, 1, 2], None, "Missing unit of the times of 'a.h5', which rise by 1 a frame"),
        ([5.0, 5.1], None, "or numbers. Times 'time' of 'a.h5' are 2 for 3 frames. Must be"),
    ],
)
def test_times_of_a_file_are_its_clock(
    tmp_path: Path, times: list[float], unit: str | None, expected: Any
) -> None:
    """Without a clock the times of the file are taken; those without a unit must be seconds."""
    with h5py.File(hdf5(tmp_path / "a.h5", time=times), "r+") as file:
        file["time"].attrs.update({} if unit is None else {"units": unit})
    with raising(re.escape(expected) if isinstance(expected, str) else None):
        made = readers.array(tmp_path / "a.h5", unit="count")
        assert_allclose(made["exposure_time"], expected, atol=1e-9)  # [s]


@pytest.mark.parametrize("name", ["zeit", "clock_s", "Acquisition_Stamp", "elapsed", "seconds"])
def test_further_names_of_times(tmp_path: Path, name: str) -> None:
    """With a value for each frame they are times, but not beside such of the usual name."""
    path, times = tmp_path / "a.h5", [5.0, 5.2, 5.4]
    assert_allclose(read(hdf5(path, **{name: times}), clock=None).time, [0, 0.2, 0.4])
    with pytest.raises(ValueError, match=r"frame 1 at 0\.2 .*, by clock= at 0\.1 s"):
        read(hdf5(path, **{name: times}))
    both = hdf5(path, **{name: times, "time": [0.0, 0.1, 0.2]})
    assert_allclose(read(both, clock=None).time, [0, 0.1, 0.2])
    for arrays in ({name: np.arange(9.0)}, {name: [30.0, 30.1, 30.0]}, {"int_time": [0.01] * 3}):
        assert not read(hdf5(path, **arrays)).attrs.get("warnings")


def test_dates_as_a_clock() -> None:
    """ISO 8601, datetime, and dates of NumPy and pandas; milliseconds since 1970 are refused."""
    dates = pd.date_range("2026-05-01 01:59:59.8", periods=3, freq="100ms", tz="Europe/Berlin")
    texts = [it.isoformat() for it in dates]
    for clock in (
        dates,
        pd.Series(dates),
        texts,
        [*dates.to_pydatetime()],
        dates.tz_localize(None),
    ):
        assert_allclose(read(scene(), clock=clock).time, [0, 0.1, 0.2], atol=1e-6)  # [s]
    with pytest.raises(ValueError, match=r"up to 1\.78e\+12\. Must be .* each in seconds"):
        read(scene(), clock=1.78e12 + 100.0 * np.arange(3))
    with pytest.raises(
        ValueError, match=r"Must rise: correct them, or state the rate, clock= \[Hz"
    ):
        read(scene(), clock=[0.0, 0.2, 0.1])


def test_a_gap_in_the_times_is_named() -> None:
    """As of an hour that the local time leaves out in spring."""
    dates = np.datetime64("2026-03-29T01:59:59.8", "ns") + np.arange(6) * np.timedelta64(100, "ms")
    dates[2:] += np.timedelta64(1, "h")
    array = xr.DataArray(scene(6), {"time": dates}, ("time", "y", "x"))
    with pytest.warns(
        UserWarning, match="'array' leave out frames, 36000 in all, the first before frame 2"
    ):
        assert_allclose(read(array, clock=None).time[[1, 2]], [0.1, 3600.2])


def test_frames_of_bands_in_turn_are_named() -> None:
    """Of a filter wheel; frames of one band are less like later ones."""
    film = scene(24)
    assert not read(film).attrs.get("warnings")
    for bands in (2, 3):
        levels = 500 * (np.arange(24) % bands)[:, None, None].astype(np.uint16)
        film = scene(24) // 9 + levels  # object and noise change little
        with pytest.warns(UserWarning, match=f"are like those {bands} later, not like the next"):
            read(film)
    # Beside another warning, too.
    stated = xr.DataArray(film, dims=("time", "y", "x"), attrs={"fps": 25.0})
    with pytest.warns(UserWarning, match="25 frames"), pytest.warns(UserWarning, match="3 later"):
        read(stated)


def test_dates_of_an_array_agree_with_the_clock() -> None:
    """Dates are times, too; another text is not compared, with a warning."""
    array = xr.DataArray(scene(), dims=("time", "y", "x"))
    steps = np.arange(3) * np.timedelta64(100, "ms")
    read(array.assign_coords(time=np.datetime64("2020-01-01", "ns") + steps))
    zoned = pd.date_range("2026-03-29 01:59:59.8", periods=3, freq="100ms", tz="Europe/Berlin")
    read(array.assign_coords(time=("time", zoned)))
    with pytest.warns(UserWarning, match="Times 'time' of 'array' are another text"):
        read(array.assign_coords(time=["a", "b", "c"]))
    with pytest.raises(ValueError, match=r"frame 1 at 0\.3 s, by clock= at 0\.1"):
        read(array.assign_coords(time=np.datetime64("2020-01-01", "ns") + 3 * steps))


@pytest.mark.parametrize("limits", [{"valid_range": (0, -5336)}, {"valid_max": -5336}])
def test_counts_beyond_the_valid_range(tmp_path: Path, limits: dict[str, Any]) -> None:
    """They are none, by CF; of unsigned numbers in NetCDF 3 the limits have signs, too."""
    counts = 60000 + 100 * np.arange(24).reshape(2, 3, 4)
    for shift, fault in (
        (2100, ""),
        (0, "60000 to 62300. Must lie within valid_range, 0 to 60200"),
    ):
        film = xr.DataArray((counts - shift).astype(np.uint16).view(np.int16), dims=["t", "y", "x"])
        attrs: Any = {name: np.array(limit, np.int16) for name, limit in limits.items()}
        film = film.assign_attrs(attrs, _Unsigned="true")
        film.to_dataset(name="a").to_netcdf(tmp_path / "a.nc", engine="scipy")
        with raising(fault):
            assert readers.array(tmp_path / "a.nc", unit="count", clock=9.0).counts.max() == 60200


def test_a_file_that_is_being_written_is_not_damaged(tmp_path: Path) -> None:
    """Another program holds its lock: it is named as unreadable."""
    opened = f"file = h5py.File({str(tmp_path / 'a.h5')!r}, 'w')"
    code = f"import h5py; {opened}; print(flush=True); input()"
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", code], **pipes) as writer:
        assert writer.stdout is not None
        writer.stdout.readline()
        with pytest.raises(
            BlockingIOError, match=r"Unreadable 'a\.h5': .* closed by other programs"
        ):
            readers.array(tmp_path / "a.h5", unit="count", clock=9.0)
        writer.communicate(b"\n")


@pytest.mark.parametrize("place", ["film/frames", "/", "film/fps", "npz"])
def test_a_frame_rate_in_a_file_is_compared_with_the_clock(tmp_path: Path, place: str) -> None:
    """It is no clock, but a warning says if it is another."""
    path = tmp_path / ("a.npz" if place == "npz" else "a.h5")
    if place == "npz":
        np.savez(path, frames=scene(), fps=25.0)
    else:
        with h5py.File(path, "w") as file:
            file["film/frames"] = scene()
            if place == "film/fps":
                file[place] = [[25.0]]
            else:
                file[place].attrs["FrameRate"] = 25
    assert "warnings" not in read(path, clock=25.0).attrs
    with pytest.warns(UserWarning, match=rf"'{path.name}' states 25 frames a second, and clock="):
        read(path, clock=10.0)


@pytest.mark.parametrize("form", ["h5", "nc", "zarr2", "zarr3"])
def test_containers_by_path(tmp_path: Path, form: str) -> None:
    """HDF5, NetCDF and zarr by path: the counts as they are, the array named if it is missing."""
    path = write(tmp_path / f"a.{form}", form)
    assert_array_equal(read(path).counts, scene())
    assert_refused(r"Missing array 'film' .* one of \['(entry/)?frames'\]", read, path, "film")
    assert_refused("Must be at most memory=100", read, path, memory=100)


def test_arrays_in_other_files_are_refused(tmp_path: Path) -> None:
    """An array of HDF5 that lies in another file, or was never written, has a sentence each."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["frames"] = h5py.ExternalLink("b.h5", "frames")
        form = h5py.VirtualLayout((3, 24, 32), "u2")
        file.create_virtual_dataset("virtual", form)
    assert_refused(r"Invalid 'virtual' in other files", read, tmp_path / "a.h5")
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file.create_dataset("frames", (3, 24, 32), "u2")  # of which nothing was written
    assert_refused(r"shape .* of 'b\.h5'\. Must be all of the 0 bytes", read, tmp_path / "b.h5")


@pytest.mark.parametrize("name", ["a.npy", "a.h5", "a.mat"])
def test_what_is_no_file_of_arrays(tmp_path: Path, name: str) -> None:
    """Bytes of no format are so named, whatever the suffix; a folder of pictures is no zarr."""
    (tmp_path / name).write_bytes(bytes(range(200, 250)))
    rule = r"of no format, by its first bytes.*Must be \.npy, \.npz, HDF5"
    assert_refused(f"Invalid '{name}': {rule}", read, tmp_path / name)
    assert_refused(r"Invalid folder '.*', no whole zarr.* files: .*\.tif", read, tmp_path)


def test_zarr_runs_no_code_and_fills_nothing_in(tmp_path: Path) -> None:
    """A store of pickled objects is not read, and a chunk that is missing is no image of zeros."""
    path = write(tmp_path / "a.zarr", "zarr3")
    (path / "frames" / "c" / "1" / "0" / "0").unlink()
    assert_refused("Missing 1 chunks of 'frames'", read, path)
    path = write(tmp_path / "b.zarr", "zarr2")
    about = json.loads((path / "frames" / ".zarray").read_text())
    about["compressor"] = {"id": "pickle", "protocol": 5}
    (path / "frames" / ".zarray").write_text(json.dumps(about))
    assert_refused(r"Damaged 'b\.zarr': .*pickle", read, path)


def stored(path: Path, frames: int = 3, **options: Any) -> Path:
    """Zarr of frames, which are read as they are."""
    zarr.create_array(path, data=scene()[:frames], **options)
    assert_array_equal(read(path).counts, scene()[:frames])
    return path


@pytest.mark.parametrize("form", [2, 3])
def test_a_blosc_chunk_of_a_false_size_is_not_decoded(tmp_path: Path, form: Any) -> None:
    """Blosc reads as far as a chunk's header says, beyond its memory: a wrong size is refused."""
    blosc: Any = {"id": "blosc", "cname": "lz4"} if form == 2 else BloscCodec(cname="lz4")
    options = {"chunks": (1, 24, 32), "compressors": blosc, "zarr_format": form}
    path = stored(tmp_path / "a.zarr", **options)
    chunk = path / ("1.0.0" if form == 2 else "c/1/0/0")
    whole = chunk.read_bytes()
    for place, content in ((4, b"\xff\xff\xff\x7f"), (12, b"\xff\xff\xff\x7f"), (0, b"")):
        chunk.write_bytes(whole[:place] + content + whole[place + 4 :] if content else content)
        assert_refused(r"Damaged chunk '(1\.0\.)?0' of 'a\.zarr'", read, path)


@pytest.mark.parametrize("form", [2, 3])
@pytest.mark.parametrize("chunks", [(1, 24, 32), (2, 10, 12)], ids=str)
def test_a_smaller_shape_of_zarr_is_no_cropped_picture(
    tmp_path: Path, form: Any, chunks: tuple[int, int, int]
) -> None:
    """A digit of the shape that is less leaves chunks, or parts of them, out: refused."""
    path = stored(tmp_path / "a.zarr", chunks=chunks, zarr_format=form)
    about = path / ("zarr.json" if form == 3 else ".zarray")
    content = json.loads(about.read_text())
    for shape in ([2, 24, 32], [3, 20, 32], [3, 24, 31]):
        about.write_text(json.dumps({**content, "shape": shape}))
        assert_refused(r"Invalid shape .* of 'a\.zarr'\. Must be all", read, path)


def test_objects_are_not_loaded(tmp_path: Path) -> None:
    """A pickle is refused by its type, before it is read; so is a size beyond the memory."""
    path = tmp_path / "a.npy"
    np.save(path, np.array([[[print]]], dtype=object), allow_pickle=True)
    assert_refused(r"Invalid dtype object of 'a\.npy'", read, path)
    np.save(path, scene())
    assert_refused("Must be at most memory=100", read, path, memory=100)
    with pytest.raises(ValueError, match=r"Damaged|Truncated"):
        read(written(path, path.read_bytes().replace(b"(3, 24, 32)", b"(9, 99, 99999)"[:11])))


def hdf5(path: Path, frames: Any = None, **arrays: Any) -> Path:
    """HDF5 of frames and of arrays beside them; attributes of the frames by names that begin _."""
    with h5py.File(path, "w", userblock_size=arrays.pop("userblock", 0)) as file:
        file["frames"] = scene() if frames is None else frames
        for name, values in arrays.items():
            if name.startswith("_"):
                file["frames"].attrs[name[1:]] = values
            else:
                file[name] = values
    return path


@pytest.mark.parametrize("unit", ["DN", "Counts", "digital number", "raw counts", "ADU", "1", ""])
def test_usual_words_for_counts(tmp_path: Path, unit: str) -> None:
    """Words for digital numbers are counts; those of temperatures and radiances are not."""
    assert_array_equal(read(hdf5(tmp_path / "a.h5", _units=unit)).counts, scene())
    for wrong in ("degC", "K", "W m-2 sr-1", "percent"):
        assert_refused(f"Invalid unit '{wrong}'", read, hdf5(tmp_path / "a.h5", _units=wrong))


def test_unsigned_numbers_of_netcdf_4(tmp_path: Path) -> None:
    """Numbers that are unsigned by an attribute, and their fill value, are counts."""
    counts = scene() + np.uint16(20000)
    signed, fill = counts.view("i2"), counts[1, 2, 3].astype("i2")
    path = hdf5(tmp_path / "a.nc", signed, __Unsigned="true")
    assert_array_equal(read(path).counts, counts)
    assert_refused("Missing counts", read, hdf5(path, signed, __Unsigned=b"true", __FillValue=fill))
    assert_refused("Invalid dtype int16", read, hdf5(path, signed))


MOMENTS = [f"2024-05-06T07:08:09.{n}00000Z" for n in range(3)]


@pytest.mark.parametrize("name", ["time", "timestamps", "Frame_Time", "time_s"])
def test_times_beside_frames(tmp_path: Path, name: str) -> None:
    """Times without a dim that names them must agree with the clock, as numbers and as text."""
    path = tmp_path / "a.h5"
    for times in ([7.0, 7.1, 7.2], MOMENTS, np.array(MOMENTS, "S")):
        assert_array_equal(read(hdf5(path, **{name: times})).counts, scene())
    dates = [f"06.05.2024 07:08:09.{tenth}" for tenth in range(3)]  # no ISO 8601
    with pytest.warns(UserWarning, match=rf"Times '{name}' of 'a\.h5' are another text\. Must be"):
        assert_array_equal(read(hdf5(path, **{name: dates})).counts, scene())
    for times in (
        [7.0, 7.2, 7.4],
        [moment.replace(":09.", f":1{moment[-7]}.") for moment in MOMENTS],
    ):
        with pytest.raises(ValueError, match=r"Invalid times of .* Must agree to half a frame"):
            read(hdf5(path, **{name: times}))
    for times in (45000 + np.arange(3) / 864e3, 1_000_000 * np.arange(3)):  # of tables, of Windows
        assert_array_equal(read(hdf5(path, **{name.removesuffix("_s"): times})).counts, scene())
    with pytest.warns(
        UserWarning, match=rf"Times '{name}' of 'a\.h5' are 9 for 3 frames\. Must be"
    ):
        assert_array_equal(read(hdf5(path, **{name: np.arange(9.0)})).counts, scene())
    with pytest.raises(ValueError, match=rf"Invalid axes of 'frames' .* '{name}' has 32\. Must be"):
        read(hdf5(path, **{name: np.arange(32.0)}))
    assert_refused("Invalid times", read, hdf5(path, **{f"other/{name}": np.arange(3.0)}))
    two = {f"other/{name}": np.arange(3.0), "other/frames": scene()}
    assert_array_equal(read(hdf5(path, **two), "frames").counts, scene())
    # Of two films, each has those below the outermost group that has no other film.
    hdf5(path, **{f"b/about/{name}": [0.0, 0.2, 0.4], "b/raw/data": scene(), "c/data": scene()})
    assert_array_equal(read(path, "b/raw/data", clock=None).time, [0.0, 0.2, 0.4])
    assert_refused(r"Invalid times of .* Must agree to half a frame", read, path, "b/raw/data")


def test_user_block_and_matlab(tmp_path: Path) -> None:
    """HDF5 begins behind a block of the user's; MATLAB's is by columns: (y, x, time)."""
    path = hdf5(tmp_path / "a.hdf", userblock=1024)
    assert_array_equal(read(path).counts, scene())
    path = hdf5(tmp_path / "a.mat", np.swapaxes(scene(), 1, 2), userblock=512)
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file")
    assert_array_equal(read(path).counts, scene())


@pytest.mark.parametrize("packed", [False, True])
def test_matlab_5(tmp_path: Path, *, packed: bool) -> None:
    """Of MATLAB's older files the film is read, by columns, with its times; others are refused."""
    path, times = tmp_path / "a.mat", np.arange(len(scene())) / 10.0
    film = np.moveaxis(scene(), 0, 2)
    about = {"camera": "A", "settings": {"gain": 1.0}, "time": times}
    savemat(path, {"frames": film, **about}, do_compression=packed)
    assert_array_equal(readers.array(path, unit="count").counts, scene())
    assert_allclose(readers.array(path, unit="count").time, times)
    assert_refused("Must agree to half a frame", readers.array, path, unit="count", clock=25.0)
    content = path.read_bytes()
    assert_refused(rf"Truncated at {len(content) - 3}", read, written(path, content[:-3]))
    with pytest.raises(ValueError, match=r"Damaged 'a\.mat': Kind|Damaged"):
        read(written(path, b"MATLAB 5.0 MAT-file" + bytes(200)))
    for wrong, rule in (
        ({"frames": film.astype(float)}, "Invalid dtype float64"),
        ({"frames": film, "more": film}, "Missing name of one of the arrays"),
        ({"settings": {"frames": film}}, r"none outside structs, cells.*save bands, fields"),
    ):
        savemat(path, wrong, do_compression=packed)
        assert_refused(rule, read, path)


def test_filters_of_hdf5(tmp_path: Path) -> None:
    """A filter that is missing is named; deflate may come once, last, and unpacks to its chunk."""
    path, values = tmp_path / "a.h5", scene().tobytes()
    assert_array_equal(read(hdf5_chunk(path, zlib.compress(values), {1: (6,)})).counts, scene())
    with pytest.raises(ValueError, match=r"Missing filter 32001, .*python -m pip install hdf5plug"):
        read(hdf5_chunk(path, values, {32001: ()}))
    with pytest.raises(ValueError, match=r"^Invalid filters \[1, 1\] .* Must be shuffle, then"):
        read(hdf5_chunk(path, zlib.compress(zlib.compress(values)), {1: (6,)}, 1))
    with pytest.raises(ValueError, match=r"Invalid chunk of 'frames' .* Must unpack to 4608"):
        read(hdf5_chunk(path, zlib.compress(values + bytes(10**8)), {1: (6,)}))
    with pytest.raises(ValueError, match="Invalid chunk of 800000000 bytes of 'frames'"):
        read(hdf5_chunk(path, b"x", {1: (6,)}, chunks=(400, 1000, 1000)))


def test_chunks_are_not_too_many(tmp_path: Path) -> None:
    """Chunks of a few bytes, of which HDF5 takes kilobytes for each, are limited."""
    with h5py.File(path := tmp_path / "a.h5", "w") as file:
        file.create_dataset("frames", (40, 40, 60), "u2", chunks=(1, 1, 1))
    assert_refused(r"Invalid number 96000 of chunks .* at most 16384", read, path)


def test_times_are_as_many_as_frames(tmp_path: Path) -> None:
    """A scale of another length is named, and not read; an attribute is one value."""
    with h5py.File(hdf5(tmp_path / "a.h5"), "r+") as file:
        file.create_dataset("time", (10**9,), "f8", chunks=(10**6,)).make_scale("time")
        file["frames"].dims[0].attach_scale(file["time"])
    with pytest.warns(UserWarning, match=r"Times 'time' of 'a.h5' are 1000000000 for 3 frames"):
        read(tmp_path / "a.h5")
    assert_refused(
        "^Refused 'a.h5': .* 'units'", read, hdf5(tmp_path / "a.h5", _units=["count"] * 2)
    )
    limits = hdf5(tmp_path / "a.h5", _valid_range=[1, 2, 3])
    assert_refused("^Refused 'a.h5': .* 'valid_range', a list. Must be two values", read, limits)
    with pytest.raises(TypeError, match="or valid_min and valid_max, of"):
        read(hdf5(tmp_path / "a.h5", _valid_min="zero"))
    with pytest.warns(UserWarning, match="^Unknown origin 'lab 3'"):
        assert read(hdf5(tmp_path / "a.h5", _origin="lab 3")).origin == "measured"


def netcdf(path: Path, version: int, *, records: bool, time: bool = False) -> Path:
    """NetCDF 3 of a form, by its specification, written here: scipy knows two of the three."""
    wide = ">q" if version == 5 else ">i"

    def numbers(*values: int) -> bytes:
        return b"".join(struct.pack(wide, value) for value in values)

    def named(name: bytes) -> bytes:
        return numbers(len(name)) + name.ljust(-(-len(name) // 4) * 4, b"\0")

    def tagged(tag: int, *entries: bytes) -> bytes:
        return struct.pack(">i", tag if entries else 0) + numbers(len(entries)) + b"".join(entries)

    counts, times = scene().astype(">u2"), np.array([0, 0.1, 0.2], ">f8")
    unit = tagged(
        12,
        named(b"units") + struct.pack(">i", 2) + named(b"count"),
        named(b"_Unsigned") + struct.pack(">i", 2) + named(b"true"),
    )
    dims = zip((b"time", b"y", b"x"), (0 if records else 3, 24, 32), strict=True)
    start = b"CDF" + bytes([version]) + numbers(3 if records else 0)
    start += tagged(10, *(named(name) + numbers(size) for name, size in dims)) + tagged(12)
    arrays: dict[bytes, Any] = {b"frames": counts} | ({b"time": times} if time else {})
    offset, at, entries = ">i" if version == 1 else ">q", 0, list[bytes]()
    for place in range(2):  # once without, once with the place where data begin
        at, entries = place and len(start + tagged(11, *entries)), []
        for name, values in arrays.items():
            over = numbers(values.ndim, *range(values.ndim))
            over += unit if name == b"frames" else tagged(12)
            kind = 6 if name == b"time" else 8 if version == 5 else 3
            size = values.nbytes // (3 if records else 1)
            entry = struct.pack(">i", kind) + numbers(size) + struct.pack(offset, at)
            entries.append(named(name) + over + entry)
            at += size
    start += tagged(11, *entries)
    parts = [[values[n : n + 1] for values in arrays.values()] for n in range(3)]
    content = [v for part in parts for v in part] if records else arrays.values()
    path.write_bytes(start + b"".join(values.tobytes() for values in content))
    return path


@pytest.mark.parametrize("time", [False, True])
@pytest.mark.parametrize("version", [1, 2, 5])
def test_forms_of_netcdf_3(tmp_path: Path, version: int, time: bool) -> None:
    """All three forms, with frames one after another or as records, must end as they state."""
    path = tmp_path / "a.nc"
    for records in (False, True):
        netcdf(path, version, records=records, time=time)
        assert_array_equal(read(path).counts, scene())
        content = path.read_bytes()
        for changed in (content[:-4], content + bytes(8000)):
            with pytest.raises(ValueError, match=r"Damaged 'a\.nc': .*Must end at|Must end at"):
                read(written(path, changed))
    for number in (0, 1, 2, 4, 2**31 - 1):
        fewer = struct.pack(">q" if version == 5 else ">i", number)
        with pytest.raises(ValueError, match=r"Must"):
            read(written(path, content[:4] + fewer + content[4 + len(fewer) :]))


@pytest.mark.parametrize("axis", [1, 2])
def test_time_along_another_axis_is_noticed(axis: int) -> None:
    """Frames that are the last axis, or rows before time, are a warning; those in order are not."""
    rng, (time, y, x) = np.random.default_rng(3), np.ogrid[:40, :24, :32]
    scenes = (
        40 * y + 25 * x + 400 * np.sin(time / 4),
        300 * rng.random((1, 24, 32)) + time,
        200 * np.sin(y / 2) * np.cos(x / 2) + 900 * np.exp(-((x - time / 2) ** 2) / 30),
    )
    for values in scenes:
        counts = np.rint(18000 + values + rng.normal(0, 4, (40, 24, 32))).astype("u2")
        read(counts)
        with pytest.warns(UserWarning, match=rf"Axis {axis} of 'array' may be time.* transpose"):
            read(np.moveaxis(counts, 0, axis))


def test_headers_and_members_of_npz(tmp_path: Path) -> None:
    """A header of more than 64 kB is not read, nor a member that NumPy does not write."""
    path, start = tmp_path / "a.npz", b"\x93NUMPY\2\0" + struct.pack("<I", 10**9)
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("a.npy", start + b" " * 1000)
    assert_refused(r"Header of 1000000000 bytes\. Must be at most 65536", read, path)
    np.save(tmp_path / "b.npy", scene())
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as file:
        file.write(tmp_path / "b.npy", "b.npy")
    assert_refused(r"Invalid compression 14 .* Must be none or deflate", read, path)


@pytest.mark.parametrize("name", ["gzip", "zlib", "bz2", "lzma", "zstd", "lz4"])
def test_a_chunk_of_zarr_unpacks_to_its_size(tmp_path: Path, name: str) -> None:
    """A chunk that unpacks, or states to unpack, farther than its array is not unpacked."""
    codec = numcodecs.get_codec({"id": name})
    options = {"chunks": (1, 24, 32), "compressors": codec, "zarr_format": 2}
    path = stored(tmp_path / "a.zarr", **options)
    (path / "1.0.0").write_bytes(codec.encode(scene()[1].tobytes() + bytes(10**6)))
    assert_refused(r"Damaged chunk '1\.0\.0' .* unpack to 1536 bytes", read, path)


def test_a_chunk_in_a_shard_unpacks_to_its_size(tmp_path: Path) -> None:
    """Chunks within a shard are held against their size, too."""
    options: Any = {"chunks": (1, 24, 32), "shards": (3, 24, 32), "compressors": GzipCodec()}
    path = stored(tmp_path / "a.zarr", **options)
    shard = path / "c/0/0/0"
    packed = gzip.compress(bytes(10**6))
    index = np.array([[0, len(packed)]] * 3, "<u8").tobytes()
    shard.write_bytes(packed + index + struct.pack("<I", google_crc32c.value(index)))
    assert_refused(r"Damaged chunk '0' of 'a\.zarr'", read, path)


@pytest.mark.parametrize("change", [{"shape": [1, 24, 32]}, {"data_type": "int16"}])
def test_consolidated_metadata_are_a_copy(tmp_path: Path, change: dict[str, Any]) -> None:
    """Those that say something else than the array's are not used."""
    zarr.open_group(tmp_path / "a.zarr", mode="w").create_array("frames", data=scene())
    with pytest.warns(UserWarning, match="Consolidated metadata"):
        zarr.consolidate_metadata(tmp_path / "a.zarr")
    file = tmp_path / "a.zarr" / "zarr.json"
    about = json.loads(file.read_text())
    about["consolidated_metadata"]["metadata"]["frames"] |= change
    file.write_text(json.dumps(about))
    assert_array_equal(read(tmp_path / "a.zarr").counts, scene())


@pytest.mark.parametrize(
    ("code", "lossless"),
    [
        (numcodecs.Delta("u2"), True),
        (numcodecs.Shuffle(2), True),
        (numcodecs.Fletcher32(), True),
        (numcodecs.FixedScaleOffset(offset=0, scale=0.1, dtype="u2"), False),
        (numcodecs.Quantize(digits=1, dtype="f4"), False),
    ],
)
def test_filters_that_change_counts_are_refused(tmp_path: Path, code: Any, lossless: bool) -> None:
    """By their names; those that change nothing are read."""
    with raising(None if lossless else rf"Invalid filter '{code.codec_id}' of 'a'"):
        stored(tmp_path / "a.zarr", filters=[code], zarr_format=2)


@pytest.mark.parametrize("frames", [1, 2])
def test_shards_that_end_beyond_the_frames(tmp_path: Path, frames: int) -> None:
    """A last shard that is not full lacks nothing."""
    stored(tmp_path / "a.zarr", frames, chunks=(1, 12, 16), shards=(2, 36, 32))
