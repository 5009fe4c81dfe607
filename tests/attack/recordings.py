"""Hostile recordings: files of FLIR, TIFF, NumPy, HDF5, NetCDF and zarr made here, and damaged."""

import shutil
from functools import cache
from pathlib import Path
from typing import Any, Final

import flir_files
import h5py
import numpy as np
import tifffile
import xarray as xr
import zarr

from attack.files import workplace
from attack.oracle import LIMIT, Attack, Verdict
from attack.stages import RIGHT, wrong
from dbthermal import readers

Rng = np.random.Generator

COUNTS: Final = flir_files.scene()
_FLIR: Final = {"seq": "", "fff": "png", "csq": "jpegls", "jpg": "png"}
_STORES: Final = {"zarr2": 2, "zarr3": 3}
FORMS: Final = (*_FLIR, "tif", "raw", "npy", "npz", "nc", "h5", *_STORES)


@cache
def _whole(form: str) -> Path:
    """Recording of a form, undamaged: a file, or the folder of a store."""
    path = workplace() / f"whole.{form}"
    if form == "jpg":
        path.write_bytes(flir_files.jpeg(flir_files.sequence(COUNTS[:1], "png", sums=True), 900))
    elif form in _FLIR:
        path.write_bytes(flir_files.sequence(COUNTS, _FLIR[form], sums=form == "fff"))
    elif form == "tif":
        tifffile.imwrite(path, COUNTS, photometric="minisblack", metadata={"axes": "TYX"})
    elif form == "raw":
        COUNTS.tofile(path)
    elif form in {"npy", "npz"}:
        (np.save if form == "npy" else np.savez_compressed)(path, COUNTS)
    elif form == "h5":
        with h5py.File(path, "w") as file:
            file.create_dataset("entry/frames", data=COUNTS)
    elif form == "nc":
        attrs = {"units": "count", "_Unsigned": "true"}
        frames = xr.DataArray(COUNTS.astype("i2"), dims=("t", "y", "x"), name="frames", attrs=attrs)
        frames.to_netcdf(path, engine="scipy")
    else:
        group = zarr.open_group(path, mode="w", zarr_format=_STORES[form])  # type: ignore[arg-type]
        group.create_array("frames", data=COUNTS, chunks=(1, 16, 32))
    return path


def _read(path: Path, form: str) -> xr.Dataset:
    options: dict[str, Any] = {"unit": "count", "clock": 10.0}
    if form in _FLIR:
        return readers.flir(path)
    if form == "tif":
        return readers.tiff(path, **options)
    if form == "raw":
        return readers.raw(path, COUNTS.shape[1:], byte_order="little", **options)
    return readers.array(path, **options)


def recordings(rng: Rng) -> Attack:
    """Recordings of every form with a bit flipped, cut, zeroed, a huge number, pieces exchanged."""
    form = str(rng.choice(FORMS))
    whole, path = _whole(form), workplace() / f"recording.{form}"
    shutil.rmtree(path, ignore_errors=True)
    (shutil.copytree if whole.is_dir() else shutil.copy)(whole, path)
    every = [one for one in path.rglob("*") if one.is_file()] or [path]
    parts = sorted(one for one in every if one.stat().st_size > 64)
    part = parts[int(rng.integers(len(parts)))]
    before = part.read_bytes()
    what, after = flir_files.damaged(before, int(rng.integers(2**31)))
    part.write_bytes(after)
    # Bytes of the frames as they lie in a file that neither packs nor protects them.
    order = ">u2" if form == "nc" else "<u2"
    images = COUNTS if form == "seq" else COUNTS[np.newaxis]
    places = [before.find(image.astype(order).tobytes()) for image in images]

    def judge(found: xr.Dataset) -> Verdict:
        counts = found["counts"].values
        if "frame_flags" in found and found["frame_flags"].values.any():
            return Verdict("flagged", "frames are marked")
        truth = COUNTS[:1] if form == "jpg" else COUNTS
        if np.array_equal(counts, truth):
            return RIGHT
        stored = b"".join(after[at : at + images[0].nbytes] for at in places if at >= 0)
        if counts.shape == truth.shape and counts.astype(order).tobytes() == stored:
            return Verdict(LIMIT, "pixels without a checksum are what the file says")
        return wrong(f"{form} {what} in {part.name}: {counts.shape} of {truth.shape}")

    limit = "JPEG-LS has no checksum" if form == "csq" else ""
    if form in _STORES and "zar" not in part.name:
        limit = "chunks without a checksum"
    if form in {"seq", "fff"} and what == "cut":
        limit = "a cut between two frames ends a recording"
    if form == "tif" and what == "zero":
        limit = "zeros may end the chain of pages"
    act = lambda: _read(path, form)  # noqa: E731
    return Attack(f"recording {form}: {what} in {part.name}", act, judge, (path.name,), limit=limit)
