"""Processes that save or record, ended at a file operation, or robbed of their folder."""

import multiprocessing
import os
import shutil
import signal
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from attack.files import SESSION, main, originals, workplace
from attack.oracle import Attack, Verdict
from attack.scenes import scene
from attack.stages import RIGHT, wrong
from dbthermal import store

Rng = np.random.Generator

_OPERATIONS: Final = (
    "open",
    *(f"os.{n}" for n in ("mkdir", "rename", "remove", "rmdir", "truncate", "link")),
)
_SCENE: Final = SESSION.split("filters:", maxsplit=1)[0].replace(": response", ": scene")
_FRAMES: Final = 40  # fewer than the 50 of such a recording on a busy machine
_DEADLINE: Final = 600  # longest life of a process, on a busy machine too [s]


def kills(rng: Rng) -> Attack:
    """Ends of a process at its n-th file operation, by a kill, SIGTERM or SIGHUP, or a renaming."""
    folder = workplace() / "ended"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    if rng.random() < 0.4:
        return _saved(rng, folder)
    what = str(rng.choice(["SIGKILL", "SIGTERM", "SIGHUP", "rename", "rename parent"]))
    place = int(np.exp(rng.uniform(0, np.log(900))))
    act = lambda: _end(_record, folder, place, what)  # noqa: E731
    judge = lambda status: _recorded(folder, what, status)  # noqa: E731
    return Attack(f"recording, {what} at file operation {place}", act, judge)


def _saved(rng: Rng, folder: Path) -> Attack:
    """A result, or numbers, saved over an earlier one: one of both must be there, whole."""
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
    return Attack(what, lambda: _end(_save, target, place, "SIGKILL"), judge)


@cache
def _later() -> Any:
    return scene(np.random.default_rng(2), shape=(16, 20)).counts()


def _save(path: Path) -> int:
    if path.suffix == ".json":
        store.save_numbers({"rmse_K": 0.42}, path, {})
    else:
        later = scene(np.random.default_rng(2), shape=(16, 20))
        store.save(later.capture, path, store.provenance({}))
    return 0


def _record(folder: Path) -> int:
    (folder / "session.yaml").write_text(_SCENE.replace("0.15", "0.5"), encoding="utf-8")
    return main(["record", str(folder / "session.yaml"), str(folder / "recordings")])


def _recorded(folder: Path, what: str, status: int) -> Verdict:
    """A recording that was ended opens, with what it says, and says how it ended."""
    places = sorted(folder.glob("*/*.zarr"))
    if len(places) > 1 or (status < 0 and what != "SIGKILL"):
        return wrong(f"{len(places)} recordings, ended by {what} with status {status}")
    if not places:
        return Verdict("refused")
    try:
        opened = store.open_dataset(places[0]).load()
    except ValueError as error:
        # Ended with an error before its first frame, it has lost nothing.
        empty = status > 0 and not list(places[0].glob("counts/c/*"))
        return Verdict("refused" if empty else "rejected", f"does not open: {error}")
    frames = list(opened.attrs["frames_written"].values())
    spoilt = [False] * len(frames)
    for band, number in enumerate(frames):
        part = opened.isel(band=band, time=slice(0, min(number, opened.sizes["time"])))
        leaps = np.diff(part["sequence"].values.astype(int))
        black = (part["counts"] == 0).all(["y", "x"])
        spoilt[band] = bool(black.any()) or bool((leaps < 1).any())
    if any(spoilt):
        return wrong(f"zeros, or frames out of order: {spoilt}")
    attrs = opened.attrs
    unclosed = what in ("SIGTERM", "SIGHUP") and not attrs["closed"] and max(frames) > 0
    early = attrs["complete"] and (status != 0 or min(frames) < _FRAMES)
    if unclosed or early:
        return wrong(f"closed {attrs['closed']}, {frames} frames, {what}, status {status}")
    return RIGHT if attrs["complete"] else Verdict("flagged")


def _end(victim: Callable[[Path], int], path: Path, place: int, what: str) -> int:
    """Run a process until its n-th file operation, and end it so; its exit status."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__, "dbthermal.instruments.recording"])
    process = context.Process(target=_run, args=(victim, path, place, what))
    process.start()
    process.join(_DEADLINE)
    if process.exitcode is None:
        process.kill()
        process.join()
        raise TimeoutError(f"Still running {_DEADLINE} s after {what} at file operation {place}")
    return process.exitcode


def _run(victim: Callable[[Path], int], path: Path, place: int, what: str) -> None:
    """Count the file operations in a folder, and end this process at one of them."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    seen, inside = 0, str(path if path.suffix else path / "recordings")

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal seen
        if event not in _OPERATIONS or inside not in str(arguments[0]):
            return
        seen += 1
        if seen != place:
            return
        if what.startswith("SIG"):
            os.kill(os.getpid(), getattr(signal, what))
        else:
            folder = path / "recordings"
            source = folder if what == "rename parent" else folder / "plate.zarr"
            if source.exists():
                source.rename(source.with_name("moved" + source.suffix))

    sys.addaudithook(hook)
    sys.exit(victim(path))
