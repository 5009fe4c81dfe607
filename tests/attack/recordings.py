"""Hostile recordings: files of FLIR, TIFF, NumPy, HDF5, NetCDF and zarr made here, and damaged."""

import shutil
from functools import cache
from pathlib import Path

import hostile_files as hostile
import numpy as np
import xarray as xr

from attack.files import workplace
from attack.oracle import LIMIT, Attack, Verdict
from attack.stages import RIGHT, wrong

Rng = np.random.Generator


@cache
def _whole(form: str) -> Path:
    """Recording of a form, undamaged."""
    return hostile.write(workplace() / f"whole.{form}", form)


def recordings(rng: Rng) -> Attack:
    """Recordings of every form with a bit flipped, cut, zeroed, a huge number, pieces exchanged."""
    form = str(rng.choice([*hostile.FILES, *hostile.STORES]))
    whole, path = _whole(form), workplace() / f"recording.{form}"
    shutil.rmtree(path, ignore_errors=True)
    (shutil.copytree if whole.is_dir() else shutil.copy)(whole, path)
    every = [one for one in path.rglob("*") if one.is_file()] or [path]
    parts = sorted(one for one in every if one.stat().st_size > 64)
    part = parts[int(rng.integers(len(parts)))]
    before = part.read_bytes()
    what, after = hostile.damaged(before, int(rng.integers(2**31)))
    part.write_bytes(after)

    def judge(found: xr.Dataset) -> Verdict:
        fate = hostile.fate(form, before, after, found)
        if fate == "marked":
            return Verdict("flagged", "frames are marked")
        if fate == "pixels":
            return Verdict(LIMIT, "pixels without a checksum are what the file says")
        return RIGHT if fate == "same" else wrong(f"{form} {what} in {part.name}: {fate}")

    limit = "JPEG-LS has no checksum" if form == "csq" else ""
    if form in hostile.STORES and "zar" not in part.name:
        limit = "chunks without a checksum"
    if form in {"seq", "fff"} and what == "cut":
        limit = "a cut between two frames ends a recording"
    if form in hostile.TIFF and what == "zero":
        limit = "zeros may end the chain of pages"
    act = lambda: hostile.read(path, form)  # noqa: E731
    return Attack(f"recording {form}: {what} in {part.name}", act, judge, (path.name,), limit=limit)
