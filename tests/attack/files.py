"""Stores of which a bit is flipped, and processes that are killed while they save."""

import multiprocessing
import os
import shutil
import signal
import sys
from collections.abc import Callable
from functools import cache as once
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, Final

import numpy as np
import xarray as xr

from attack.oracle import Attack, Verdict
from attack.scenes import pick, scene
from attack.stages import wrong
from dbthermal import schema, store
from dbthermal.instruments.recording import open_capture

Rng = np.random.Generator
LINES: Final = "x" * 40  # an attribute of some length


@once
def workplace() -> Path:
    """Folder of this process for the damaged copies."""
    return Path(mkdtemp(prefix="attack-"))


@once
def originals() -> Path:
    """Folder of a whole result, a recording and numbers."""
    folder = workplace() / "whole"
    made = scene(np.random.default_rng(1), shape=(16, 20))
    capture = made.capture.assign(note=((), "a text")).assign_attrs(title=LINES)
    store.save(capture, folder / "result.zarr", store.provenance({"seed": 1}))
    flags = schema.Variable(("band", "time"), "uint16", "1", "flags")
    stamps = schema.Variable(("band", "time"), "float64", "s", "when")
    log = {n: schema.Variable(("log",), "float64", "1", n) for n in ("log_time", "log_value")}
    counts = schema.STAGES["capture"]["counts"]
    variables = {"counts": counts, "frame_flags": flags, "exposure_time": stamps, **log}
    path, bands = folder / "recording.zarr", ["8-14", "9.5"]
    recording = store.Recording(path, variables, {"y": 16, "x": 20}, bands, chunk=10, attrs={})
    for _ in range(4):
        for place, band in enumerate(bands):
            first = recording.frames[band]
            block: dict[str, Any] = {
                "counts": made.counts()[place, first : first + 10].astype(np.uint16),
                "frame_flags": np.zeros(10, np.uint16),
                "exposure_time": made.time[first : first + 10],
            }
            recording.append(band, block)
        recording.append_log({"log_time": np.arange(3.0), "log_value": np.ones(3)})
        recording.commit()
    recording.close(time=made.time[:40])
    store.save_numbers({"rmse_K": 0.21, "name": "a"}, folder / "numbers.json", {"seed": 1})
    return folder


def _copy(name: str) -> Path:
    """Copy to be damaged, in place of the last one."""
    target = workplace() / "damaged" / name
    shutil.rmtree(target.parent, ignore_errors=True)
    target.parent.mkdir()
    source = originals() / name
    if source.is_dir():
        shutil.copytree(source, target)
    else:
        shutil.copy(source, target)
    return target


def flip(rng: Rng, path: Path) -> int:
    """Flip one bit of a file, or of another one if it is empty; its place."""
    content = bytearray(path.read_bytes())
    place = int(rng.integers(len(content)))
    content[place] ^= 1 << int(rng.integers(8))
    path.write_bytes(bytes(content))
    return place


def _open(path: Path) -> xr.Dataset:
    """Open a store with all that it holds, as a user would."""
    opened = store.open_dataset(path).load()
    if path.name.startswith("recording"):
        open_capture(path).load()
    return opened


def _same(path: Path) -> Callable[[xr.Dataset], Verdict]:
    """Judge: what opens is what was written."""
    whole = store.open_dataset(originals() / path.name).load()

    def judge(opened: xr.Dataset) -> Verdict:
        part = {str(dim): slice(0, size) for dim, size in opened.sizes.items()}
        kept = [n for n in opened.data_vars if n in whole]
        same = all(_alike(whole[n].isel(part, missing_dims="ignore"), opened[n]) for n in kept)
        if same and opened.attrs.get("complete") is False:
            return Verdict("flagged")
        names = {*whole.variables} ^ {*opened.variables}
        common = {*whole.variables} & {*opened.variables}
        names |= {name for name in common if not _alike(whole[name], opened[name])}
        changed = sorted(map(str, names))
        if not changed and whole.attrs != opened.attrs:
            changed = ["attributes"]
        return wrong(f"other {changed}", where=bool(changed))

    return judge


def _alike(first: xr.DataArray, second: xr.DataArray) -> bool:
    """Of the same dims, type and values, bit by bit."""
    kinds = (first.dtype.kind, first.dims, first.shape)
    same = kinds == (second.dtype.kind, second.dims, second.shape)
    return same and first.values.tobytes() == second.values.astype(first.dtype).tobytes()


def bits(rng: Rng) -> Attack:
    """One bit flipped anywhere in a store."""
    path = _copy(str(rng.choice(["result.zarr", "recording.zarr"])))
    # As likely in one file as in another: else nearly all were in the counts.
    file = pick(
        rng, [one for one in sorted(path.rglob("*")) if one.is_file() and one.stat().st_size]
    )
    place, inside = flip(rng, file), file.relative_to(path)
    names = (path.name, inside.parts[0] if len(inside.parts) > 1 else "")
    what = f"bit of byte {place} of {path.name}/{inside} flipped"
    return Attack(what, lambda: _open(path), _same(path), names)


_OPERATIONS: Final = ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.truncate")
_DEADLINE: Final = 600  # longest life of a process, on a busy machine too [s]


def kills(rng: Rng) -> Attack:
    """A kill while a result or numbers are saved over an earlier one: one is there, whole."""
    folder = workplace() / "ended"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    kind = str(rng.choice(["result.zarr", "numbers.json"]))
    place = int(rng.integers(1, 150 if kind == "result.zarr" else 12))
    source, target = originals() / kind, folder / kind
    if source.is_dir():
        shutil.copytree(source, target)
    else:
        shutil.copy(source, target)

    def judge(_: Any) -> Verdict:
        if not target.exists():
            return Verdict("refused")
        if kind == "numbers.json":
            value = store.read_numbers(target)["rmse_K"]
            return wrong(f"{value}", where=value not in (0.21, 0.42))
        try:
            opened = store.open_dataset(target).load()
        except ValueError as error:
            return Verdict("rejected", f"the result does not open: {error}")
        before = store.open_dataset(source).load()
        counts = opened["counts"].values
        whole = np.array_equal(counts, before["counts"]) or np.array_equal(counts, _later())
        return wrong("neither the earlier nor the later result", where=not whole)

    what = f"saving {kind} over another, SIGKILL at file operation {place}"
    return Attack(what, lambda: _end(target, place), judge)


@once
def _later() -> Any:
    return scene(np.random.default_rng(2), shape=(16, 20)).counts()


def _save(path: Path) -> None:
    if path.suffix == ".json":
        store.save_numbers({"rmse_K": 0.42}, path, {})
    else:
        later = scene(np.random.default_rng(2), shape=(16, 20))
        store.save(later.capture, path, store.provenance({}))


def _end(path: Path, place: int) -> None:
    """Run a process that saves until its n-th file operation, and kill it so."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    process = context.Process(target=_run, args=(path, place))
    process.start()
    process.join(_DEADLINE)
    if process.exitcode is None:
        process.kill()
        process.join()
        raise TimeoutError(f"Still running {_DEADLINE} s after a kill at file operation {place}")


def _run(path: Path, place: int) -> None:
    """Count the file operations in a folder, and kill this process at one of them."""
    for stream in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    seen = 0

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal seen
        seen += event in _OPERATIONS and str(path) in str(arguments[0])
        if seen == place:
            os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)
    _save(path)


def leave() -> None:
    """Remove what this process wrote."""
    shutil.rmtree(workplace(), ignore_errors=True)
