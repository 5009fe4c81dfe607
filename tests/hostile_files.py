"""Files of every form that a reader takes, made here, damage to them, and what is read of it."""

import os
import random
import struct
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, Final

import av
import flir_files
import h5py
import numpy as np
import tifffile
import xarray as xr
import zarr
from matplotlib import colormaps
from numpy.typing import NDArray
from scipy.io import savemat

from dbthermal import readers, store
from dbthermal.schema import Variable

COUNTS: Final = flir_files.scene()
"""Counts (time, y, x) of every recording."""
FLIR: Final = {"seq": "", "fff": "png", "csq": "jpegls", "jpg": "png"}
TIFF: Final[dict[str, dict[str, Any]]] = {
    "tif": {"metadata": {"axes": "TYX"}},
    "big.tif": {"byteorder": ">"},
    "64.tif": {"bigtiff": True},
    "tiles.tif": {"tile": (16, 16), "compression": "zlib"},
}
STORES: Final = {"zarr2": 2, "zarr3": 3}
SEQUENCES: Final = ("sfmov", "hcc")
FILES: Final = (*FLIR, *TIFF, *SEQUENCES, "raw", "npy", "npz", "nc", "h5", "mat")
"""Forms of a recording in a single file."""


def hdf5_chunk(
    path: Path, chunk: bytes, filters: dict[int, tuple[int, ...]], *repeated: int, **options: Any
) -> Path:
    """HDF5 of `COUNTS` in one chunk, as it is stored, by filters, of which some are there twice."""
    with h5py.File(path, "w") as file:
        form = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        form.set_chunk(options.get("chunks", COUNTS.shape))
        for code in (*filters, *repeated):
            form.set_filter(code, 1, filters[code])
        space = h5py.h5s.create_simple(COUNTS.shape, (h5py.h5s.UNLIMITED,) * 3)
        array = h5py.h5d.create(file.id, b"frames", h5py.h5t.STD_U16LE, space, form)
        array.write_direct_chunk((0, 0, 0), chunk)
    return path


def seed_of_week() -> int:
    """Seed of this week, its ISO year and number; that of another one is in DBTHERMAL_SEED."""
    year, week, _ = datetime.now(UTC).isocalendar()
    return int(os.environ.get("DBTHERMAL_SEED") or 100 * year + week)


def written(path: Path, content: bytes | bytearray) -> Path:
    """File of a content."""
    path.write_bytes(content)
    return path


def write(path: Path, form: str) -> Path:
    """Recording of a form, undamaged: a file, or the folder of a store."""
    if form == "jpg":
        path.write_bytes(flir_files.jpeg(flir_files.sequence(COUNTS[:1], "png", sums=True), 900))
    elif form in FLIR:
        path.write_bytes(flir_files.sequence(COUNTS, FLIR[form], sums=form == "fff"))
    elif form in TIFF:
        tifffile.imwrite(path, COUNTS, photometric="minisblack", **TIFF[form])
    elif form in CONTENTS:
        path.write_bytes(CONTENTS[form](COUNTS))
    elif form == "mat":
        savemat(path, {"frames": np.moveaxis(COUNTS, 0, 2)}, do_compression=True)
    elif form in {"npy", "npz"}:
        with path.open("wb") as file:
            (np.save if form == "npy" else np.savez_compressed)(file, COUNTS)
    elif form == "h5":
        with h5py.File(path, "w") as file:
            file.create_dataset("entry/frames", data=COUNTS)
    elif form == "nc":
        attrs = {"units": "count", "_Unsigned": "true"}
        frames = xr.DataArray(COUNTS.astype("i2"), dims=("t", "y", "x"), name="frames", attrs=attrs)
        frames.to_netcdf(path, engine="scipy")
    else:
        group = zarr.open_group(path, mode="w", zarr_format=STORES[form])  # type: ignore[arg-type]
        group.create_array("frames", data=COUNTS, chunks=(1, 24, 32)).attrs["units"] = "count"
    return path


def read(path: Path, form: str, **selected: Any) -> xr.Dataset:
    """Recording of a form, as a user reads it, or selected rows."""
    options: dict[str, Any] = {"unit": "count", "clock": 10.0, **selected}
    if form in FLIR:
        return readers.flir(path, **selected)
    if form in TIFF:
        return readers.tiff(path, **options)
    if form in SEQUENCES:
        return readers.sequence(path, clock=10.0)
    if form == "raw":
        return readers.raw(path, COUNTS.shape[1:], byte_order="little", **options)
    return readers.array(path, **options)


def sfmov(counts: NDArray[np.uint16], ending: str = "\r\n", kind: str = "Int16u") -> bytes:
    """Recording of FLIR: lines of names and values, a line of DATA, and the frames."""
    frames, rows, columns = counts.shape
    names = {"xPixls": columns, "yPixls": rows, "DaType": kind, "NumDPs": frames}
    lines = "".join(f"{name} {value}\r\n" for name, value in names.items())
    text = f"{lines}Camera None\r\nsaf_padding {'x' * 400}\r\nDATA{ending}"
    return text.encode() + counts.astype("<u2").tobytes()


def hcc(
    counts: NDArray[np.uint16], mode: int = 1, *, times: bool = True, rate: int = 10_000
) -> bytes:
    """Recording of Telops at 10 frames/s: a header before each frame, with its time."""
    content, (rows, columns) = b"", counts.shape[1:]
    for number, frame in enumerate(counts):
        header = bytearray(4 * columns)
        struct.pack_into("<2sBBHxxI", header, 0, b"TC", 3, 11, len(header), number)
        struct.pack_into("<B3xHH8xI", header, 28, mode, columns, rows, rate)
        clock = (1_700_000_000 + number // 10, number % 10 * 1_000_000) if times else (0, 0)
        struct.pack_into("<II", header, 100, *clock)
        content += header + frame.astype("<u2").tobytes()
    return content


CONTENTS: Final[dict[str, Callable[[NDArray[np.uint16]], bytes]]] = {
    "raw": np.ndarray.tobytes,
    "sfmov": sfmov,
    "hcc": hcc,
}
"""Bytes of a file that is made without a library, by its form."""


def fate(form: str, before: bytes, after: bytes, recording: xr.Dataset) -> str:
    """Reading of a damaged file: marked, same, fewer frames, the pixels that it holds, other."""
    if "frame_flags" in recording and recording["frame_flags"].values.any():
        return "marked"
    truth, counts = COUNTS[:1] if form == "jpg" else COUNTS, recording["counts"].values
    if np.array_equal(counts, truth[: len(counts)]):
        return "same" if len(counts) == len(truth) else "fewer"
    # Bytes of the frames as they lie in a file that neither packs nor protects them.
    order = ">u2" if form in {"nc", "big.tif"} else "<u2"
    places = [before.find(image.astype(order).tobytes()) for image in truth]
    stored = b"".join(after[at : at + truth[0].nbytes] for at in places if at >= 0)
    if counts.astype(order).tobytes() != stored[: counts.nbytes]:
        return "other"
    return "pixels" if len(counts) == len(truth) else "fewer"


def damaged(content: bytes, seed: int) -> tuple[str, bytes]:
    """One flipped bit, the end cut off, zeros, a huge number, or two pieces exchanged."""
    rng, changed = random.Random(seed), bytearray(content)
    kind = ("flip", "cut", "zero", "huge", "swap")[seed % 5]
    # Half of the damage is where the file begins, which says how large all is.
    reach = len(changed) if seed % 2 else min(len(changed), 600)
    place = rng.randrange(reach)
    size = min(rng.choice([1, 4, 16, 64]), reach - place)
    if kind == "flip":
        changed[place] ^= 1 << rng.randrange(8)
    elif kind == "cut":
        del changed[rng.randrange(len(changed)) :]
    elif kind == "zero":
        changed[place : place + size] = bytes(size)
    elif kind == "huge":
        place -= place % 4
        changed[place : place + 4] = rng.choice(
            [b"\xff" * 4, b"\xff\xff\xff\x7f", b"\x7f\xff\xff\xff", b"\0\0\0\x80", b"\x40\0\0\0"]
        )[: len(changed) - place]
    else:
        other = rng.randrange(len(changed) - size)
        first, second = changed[place : place + size], changed[other : other + size]
        changed[place : place + size], changed[other : other + size] = second, first
    return kind, bytes(changed)


VARIABLES: Final = {
    "counts": Variable(("band", "time", "y", "x"), "uint16", "count", "raw counts"),
    "exposure_time": Variable(("band", "time"), "float64", "s", "time of exposure"),
    "log_time": Variable(("log",), "float64", "s", "time of a note"),
    "log_value": Variable(("log",), "float64", "1", "value of a note"),
}


def record(path: Path, *, close: bool) -> store.Recording:
    """Two bands in chunks of two frames, the second one frame behind, zeros among them."""
    rng = np.random.default_rng(1)
    sizes = {"y": 3, "x": 4}
    recording = store.Recording(path, VARIABLES, sizes, ["8-14", "9.5"], chunk=2, attrs={"a": "b"})
    for start in range(0, 6, 2):
        for band, number in (("8-14", 2), ("9.5", 2 if start < 4 else 1)):
            counts = rng.integers(0, 60000 * (start > 0) + 1, (number, 3, 4)).astype("uint16")
            times = start / 60 + np.arange(number) / 60
            recording.append(band, {"counts": counts, "exposure_time": times})
        rows = {"log_time": np.array([start / 60]), "log_value": np.array([0.0])}
        recording.append_log(rows)
        recording.commit()
    if close:
        recording.close(time=np.arange(6) / 60)
    return recording


HEADER = """Name: Plate  Glass
Type: manmade
Class: Glass
Sample No.: 7
Description: a pane: clear, Na\xb7Ca
Measurement: Directional (10 Degree) Hemispherical Reflectance
X Units: Wavelength (micrometers)
Y Units:Reflectence (percent)
First X Value: {first:.4f}
Last X Value: {last:.4f}
Number of X Values: {number}
Additional Information: none

"""


def ecostress(
    wavelength: Sequence[float], reflectance: Sequence[float], newline: str = "\n"
) -> bytes:
    """Spectrum as the ECOSTRESS library writes it, reflectance [%] over micrometres."""
    rows = (f" {w:.4f}\t {r:.4f}\n" for w, r in zip(wavelength, reflectance, strict=True))
    ends = {"first": wavelength[0], "last": wavelength[-1], "number": len(wavelength)}
    text = HEADER.format(**ends) + "".join(rows)
    return text.replace("\n", newline).encode("latin-1")


@cache
def tables() -> dict[str, bytes]:
    """Table of each library of spectra, by the name of its reader."""
    wavenumber = np.linspace(688, 2731, 341)  # 14.53 to 3.66 um, in steps of 6 [1/cm]
    rows = [f"{1e4 / k:.6g},{k:.6g},{0.9 + 0.05 * np.sin(k / 90):.6f}\n" for k in wavenumber]
    fine = np.linspace(1250, 714, 120)  # 8 to 14 um [1/cm]
    pairs = [f"{1e4 / k:.8f},{0.9 + k / 1e5:.8f},{0.95 - k / 1e5:.8f}\n" for k in fine]
    return {
        "ecostress": ecostress([*(1e4 / fine)], [*(5 + fine / 500)], "\r\n"),
        "slum": ("wavelength,A001,A002\n" + "".join(pairs)).encode(),
        "ucsb": ("x1,x2,y_brick\n" + "".join(rows)).encode(),
    }


_NAMES: Final = ("libx264", "libx264", "mpeg4", "mjpeg", "libvpx")
CODECS: Final = dict(zip(("mp4", "mkv", "mov", "avi", "webm"), _NAMES, strict=True))


def wave() -> NDArray[np.float64]:
    """Positions (time, y, x) of a smooth wave that moves."""
    time, y, x = np.ogrid[:12, :48, :64]
    return np.asarray(0.5 + 0.35 * np.sin(y / 9 + time / 4) * np.cos(x / 11))


def coloured(position: NDArray[np.float64], palette: str) -> NDArray[np.uint8]:
    """Draw positions in a palette."""
    colours: NDArray[np.uint8] = colormaps[palette](np.rint(position * 255).astype(int), bytes=True)
    return colours[..., :3]


def video(path: Path, frames: NDArray[np.uint8] | None = None, **options: str) -> Path:
    """Encode RGB frames (time, y, x, 3), or the wave in plasma, at 10 frames/s, by the suffix."""
    frames = coloured(wave(), "plasma") if frames is None else frames
    codec = CODECS[path.suffix[1:]]
    options = {"crf": "18", **options} if codec == "libx264" else options
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec, rate=10, options=options)
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuvj420p" if path.suffix == ".avi" else "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    return path


def falsely_sized(content: bytes) -> bytes:
    """MP4 whose container states pictures of 32,000 x 32,000 pixels; the stream has its own."""
    place = content.index(b"avc1", content.index(b"stsd") + 12) + 28
    return content[:place] + struct.pack(">HH", 32000, 32000) + content[place + 4 :]
