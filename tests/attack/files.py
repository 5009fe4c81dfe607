"""Stores of which a bit is flipped, and processes that are killed while they save."""

import itertools
import multiprocessing
import os
import re
import shutil
import signal
import sys
from functools import cache as once
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import xarray as xr
import zarr
from hostile_files import record

from attack.damage import Rng, Table, hurt
from attack.oracle import Attack, Verdict, wrong
from attack.scenes import pick, scene
from dbthermal import readers, store
from dbthermal.instruments.recording import open_capture
from reproduction import numbers


@once
def _workplace() -> TemporaryDirectory[str]:
    return TemporaryDirectory(prefix="attack-")


@once
def originals() -> Path:
    """Folder of a whole result, a recording and numbers."""
    folder, made = Path(_workplace().name) / "whole", _made(1)
    capture = made.assign(note=((), "a text")).assign_attrs(title="x" * 40)
    store.save(capture, folder / "result.zarr", store.provenance({"seed": 1}))
    record(folder / "recording.zarr", close=True)
    numbers.save({"rmse_K": 0.21, "name": "a"}, folder / "numbers.json", {"seed": 1})
    foreign = made["counts"].values[0, :8].astype(np.uint16)
    for name, layers in (("foreign", None), ("shards", (4, 16, 20))):
        zarr.create_array(folder / f"{name}.zarr", data=foreign, chunks=(1, 16, 20), shards=layers)
    return folder


@once
def _made(seed: int) -> xr.Dataset:
    return scene(np.random.default_rng(seed), shape=(16, 20)).capture


def emptied() -> Path:
    """Folder of what is to be damaged, without the last one."""
    folder = Path(_workplace().name) / "damaged"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def _copy(name: str) -> Path:
    """Copy to be damaged, in place of the last one."""
    source, target = originals() / name, emptied() / name
    (shutil.copytree if source.is_dir() else shutil.copy)(source, target)
    return target


def _open(path: Path) -> xr.Dataset:
    """Open a store with all that it holds, as a user would."""
    opened = store.open_dataset(path).load()
    if path.name.startswith("recording"):
        open_capture(path).load()
    return opened


def bits(rng: Rng) -> Attack:
    """One bit flipped anywhere in a store: what opens is what was written."""
    path = _copy(pick(rng, ["result.zarr", "recording.zarr"]))
    # As likely in one file as in another: else nearly all were in the counts.
    files = [one for one in sorted(path.rglob("*")) if one.is_file() and one.stat().st_size]
    file = pick(rng, files)
    content = bytearray(file.read_bytes())
    place, inside = int(rng.integers(len(content))), file.relative_to(path)
    content[place] ^= 1 << int(rng.integers(8))
    file.write_bytes(bytes(content))

    def judge(opened: xr.Dataset) -> Verdict:
        whole = store.open_dataset(originals() / path.name).load()
        part = {str(dim): slice(0, size) for dim, size in opened.sizes.items()}
        if opened.attrs.get("complete") is False:
            kept = whole[[*opened.data_vars]].isel(part)
            return Verdict("flagged") if kept.equals(opened) else wrong("other frames")
        types = whole.dtypes == opened.dtypes
        return wrong("other values", where=not (types and whole.identical(opened)))

    names = (path.name, inside.parts[0] if len(inside.parts) > 1 else "")
    what = f"bit of byte {place} of {path.name}/{inside} flipped"
    return Attack(what, lambda: _open(path), judge, names)


def _linked(file: Path, target: Path | str) -> None:
    file.unlink()
    file.symlink_to(target)


def _elsewhere(_: Rng, file: Path) -> None:
    place = Path(_workplace().name) / "elsewhere"
    shutil.copy(file, place)
    _linked(file, place)


def _piped(_: Rng, file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


FOREIGN: Final[Table] = {
    "pipe": _piped,
    "device": lambda _, file: _linked(file, "/dev/zero"),
    "link elsewhere": _elsewhere,
    "link to nothing": lambda _, file: _linked(file, "nowhere"),
    "loop": lambda _, file: (file.parent / "up").symlink_to(".."),
}
"""Damage to a file of a store, which is then no regular file in it."""


def trees(rng: Rng) -> Attack:
    """A pipe, a device, or a link in a store, of ours or of another program: nothing is opened."""
    kind = pick(rng, ["result.zarr", "recording.zarr", "foreign.zarr", "shards.zarr"])
    path = _copy(kind)
    file = pick(rng, [one for one in sorted(path.rglob("*")) if one.is_file()])
    what, _ = hurt(rng, FOREIGN, file)
    read = _foreign if kind in ("foreign.zarr", "shards.zarr") else _open
    judge = lambda _: wrong("opened")  # noqa: E731
    return Attack(f"{what} at {kind}/{file.name}", lambda: read(path), judge, (path.name,))


def _foreign(path: Path) -> xr.Dataset:
    return readers.array(path, unit="count", clock=10.0)


def shards(rng: Rng) -> Attack:
    """A chunk, in a shard or not, that was never written: it is no black frame."""
    shape, gap = (8, 12, 16), int(rng.integers(8))
    path = emptied() / "gap.zarr"
    fill, layers = pick(rng, [0, 18000]), pick(rng, [None, (2, 12, 16), (4, 12, 16), (8, 12, 16)])
    options: dict[str, Any] = {"shape": shape, "dtype": "u2", "chunks": (1, 12, 16)}
    array = zarr.create_array(path, shards=layers, fill_value=fill, **options)
    for place in range(8):
        if place != gap or layers is None:
            array[place] = 20000 + place + np.arange(192, dtype="u2").reshape(12, 16)
    if layers is None:
        (path / "c" / str(gap) / "0" / "0").unlink()
    judge = lambda _: wrong("a frame of the fill value")  # noqa: E731
    return Attack(f"chunk {gap} of {layers}", lambda: _foreign(path), judge, ("missing",))


_CHARACTERS: Final = "aZ_9.-+() /\\\n\r\x00\x1b\u202e\u00e9\u0301\ud800:*\"'%#~"
_WORDS: Final = (
    *("counts", "zarr.json", "checksums.sfv", "c/0", ".."),
    *("", "__x", "com1.x", "a" * 300),
)


def names(rng: Rng) -> Attack:
    """A variable or coordinate of any name: it is saved and comes back, or it is refused."""
    random = "".join(rng.choice([*_CHARACTERS], rng.integers(1, 12)))
    name, path = pick(rng, [*_WORDS, *[random] * 20]), Path(_workplace().name) / "names.zarr"
    time, values = pick(rng, ["time", name]), np.arange(3.0)
    given = xr.Dataset({"a": ("time", values)}).assign_coords({name: (time, values)})
    if alike := bool(rng.random() < 0.1):  # on some disks
        given = given.assign({name.swapcase(): ("time", values)})
    given = given if rng.random() < 0.5 else given.reset_coords(drop=False)

    def act() -> xr.Dataset:
        shutil.rmtree(path, ignore_errors=True)
        store.save(given, path, {})
        return store.open_dataset(path).load()

    def judge(opened: xr.Dataset) -> Verdict:
        twice = alike and name.swapcase() != name
        return wrong("other names", where=twice or not opened.drop_attrs().identical(given))

    plain = re.fullmatch(r"[a-zA-Z][\w-]*", name, re.ASCII) and len(name) <= 60
    return Attack(f"name {name!r}", act, judge, ("name",), good=bool(plain) and not alike)


_OPERATIONS: Final = ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.truncate")
_DEADLINE: Final = 600  # longest life of a process, on a busy machine too [s]


def kills(rng: Rng) -> Attack:
    """A kill while a result or numbers are saved over an earlier one: one is there, whole."""
    kind = pick(rng, ["result.zarr", "numbers.json"])
    target, place = _copy(kind), int(rng.integers(1, 150 if kind == "result.zarr" else 12))

    def judge(_: Any) -> Verdict:
        if not target.exists():
            return Verdict("refused")
        if kind == "numbers.json":
            value = numbers.read(target)["rmse_K"]
            return wrong(f"{value}", where=value not in (0.21, 0.42))
        try:
            opened = store.open_dataset(target).load()
        except ValueError as error:
            return Verdict("rejected", f"the result does not open: {error}")
        whole = any(opened["counts"].equals(_made(seed)["counts"]) for seed in (1, 2))
        return wrong("neither the earlier nor the later result", where=not whole)

    what = f"saving {kind} over another, SIGKILL at file operation {place}"
    return Attack(what, lambda: _end(target, place), judge)


def _end(path: Path, place: int) -> None:
    """Run a process that saves until its n-th file operation, and kill it so."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    process = context.Process(target=_run, args=(path, place))
    process.start()
    process.join(_DEADLINE)
    if process.exitcode is None:
        process.kill()
        raise TimeoutError(f"Still running {_DEADLINE} s after a kill at file operation {place}")


def _run(path: Path, place: int) -> None:
    """Save, counting the file operations in a folder, and kill this process at one of them."""
    seen = itertools.count(1)

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event in _OPERATIONS and str(path) in str(arguments[0]) and next(seen) == place:
            os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)
    if path.suffix == ".json":
        numbers.save({"rmse_K": 0.42}, path, {})
    else:
        store.save(_made(2), path, store.provenance({}))
