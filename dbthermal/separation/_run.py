"""Separation of captures of any size, from disk to disk, by rows that processes share out."""

import hashlib
import json
import math
import os
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from contextlib import nullcontext
from dataclasses import dataclass, field
from itertools import accumulate
from multiprocessing import parent_process
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import xarray as xr
from tqdm import tqdm

from dbthermal import _numbers, store
from dbthermal import _text as texts
from dbthermal.separation import _inputs
from dbthermal.separation._inputs import BLOCK_ROWS, Method
from dbthermal.separation._solve import METHODS, get_method, require_seed, solve
from dbthermal.separation._tiles import largest
from dbthermal.store._datasets import chunks_in_turn
from dbthermal.store._integrity import last_sums

if TYPE_CHECKING:
    from dbthermal.separation._solve import Settings

# Memory [byte], from the peaks of processes with one thread and with two, of 350 to 3000 frames:
# of a process that has imported and compiled all, and with torch;
BASE: Final = 450_000_000
# of a sample of a band that is read, and of one in the chunks of dask's beside that;
_READ: Final = 4
# of a sample of a band in a block: results (8), and those on the way to the disk;
_SAMPLE: Final = 12
# of a sample of a band in the tile of a compiled method (110 to 140); of another so many times it
# (500 to 900).
_TILE: Final = 140
_TIMES: Final = 8


def run(  # noqa: PLR0913 - those of `solve` are among them
    source: str | Path | xr.Dataset | Sequence[str | Path | xr.Dataset],
    target: str | Path | Sequence[str | Path],
    response: xr.Dataset,
    method: str = "subspace",
    *,
    settings: "Settings | None" = None,
    emissivity: xr.DataArray | None = None,
    emissivity_std: xr.DataArray | None = None,
    emissivity_covariance: xr.DataArray | None = None,
    mask: xr.DataArray | None = None,
    response_kind: str = "exact",
    seed: int = 0,
    executor: Executor | None = None,
    memory: float = 2e9,
    provenance: Mapping[str, Any] = MappingProxyType({}),
    progress: bool = False,
) -> None:
    """Separate captures of any size from disk to disk, by blocks of rows, by several processes.

    Each block of rows is separated as by `solve` and written by the one process that has it; what
    is written stays when the run is killed, and the next one goes on from there to the same bytes.
    A target that the same run has made before is left as it is. A capture is recognised by its
    store's checksums; one in memory or lazy by all its values, which are read once more for it.

    Parameters
    ----------
    source : str, Path, Dataset, or a sequence of these
        Stage `corrected` of `schema`, as for `solve`: a folder ``*.zarr`` of `store.save`, which
        every process opens by itself, or a lazy Dataset (of zarr, dask), of which every process is
        sent its rows; those of a chunk of dask's are read once to separate all their blocks. What
        `correct_capture` or `align` leave to be computed, threads can take, and the workers of a
        cluster, not those of a ProcessPoolExecutor.
    target : str or Path, or as many
        Folder ``*.zarr`` for each result. While it is made, its parts are in ``*.zarr.parts``.
    response : Dataset
        As for `solve`.
    method : str
        One of `METHODS`. Materials, and a shift of the reflections, are of the whole image, see
        `scene.separate_capture`.
    settings, emissivity, emissivity_std, emissivity_covariance, mask, response_kind, seed
        As for `solve`, the same for all captures.
    executor : Executor, optional
        Of `concurrent.futures`, or with its interface, as from ``distributed.Client.get_executor``;
        two threads if not given, or one where the memory is too small for two.
    memory : float
        Largest memory of a process [byte]; if it is tight, a block has fewer rows than 32. Each
        process of an executor separates one block at a time, but that of a ThreadPoolExecutor. The
        first process after the installation, which compiles, takes 0.35 GB more.
    provenance : mapping, optional
        See `store.save`.
    progress : bool
        Show a bar.

    Raises
    ------
    TypeError, ValueError
        As `solve` does; if the memory is too small for a row, with
        the source's chunks; and if the parts at hand are of another run.
    ExceptionGroup
        Of several captures: what was raised, each with the name of its capture; all others are
        finished.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np, xarray as xr
    >>> from dbthermal import simulation, store
    >>> rig, rng = simulation.Rig(), np.random.default_rng(1)
    >>> glass = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(rig.bands)})
    >>> scene = simulation.walkers(np.arange(200) / 10, (4, 6), glass, rng)
    >>> capture = simulation.observe(scene, rig.response(), rng)
    >>> with TemporaryDirectory() as folder:
    ...     store.save(capture, f"{folder}/capture.zarr", store.provenance({}))
    ...     run(f"{folder}/capture.zarr", f"{folder}/result.zarr", rig.response())
    ...     store.open_dataset(f"{folder}/result.zarr").object_temperature.shape
    (200, 4, 6)
    """
    if method not in METHODS:  # a process of an executor imports it by its name
        raise ValueError(f"Unknown method {method!r} of a run. Must be one of {list(METHODS)}.")
    require_seed(seed)
    memory = _numbers.real_number("memory [byte]", memory, _numbers.POSITIVE)
    if not isinstance(provenance, Mapping):
        raise TypeError(
            f"Invalid provenance of type {type(provenance).__name__}. Must be a mapping."
        )
    options: dict[str, Any] = {"settings": settings, "mask": mask, "seed": seed}
    options |= {"emissivity": emissivity, "emissivity_std": emissivity_std}
    options |= {"emissivity_covariance": emissivity_covariance, "response_kind": response_kind}
    pairs = _pairs(source, target)
    # Two captures at a time: while one is joined, the processes have the other's rows.
    with (
        ThreadPoolExecutor(2 if executor else 1) as captures,
        tqdm(desc="run", unit="block", total=0, disable=not progress) as bar,
    ):
        job = _Job(response, method, options, executor, memory, dict(provenance), bar)
        runs = [captures.submit(job.separate, *pair) for pair in pairs]
        try:
            errors = [name.exception() for name in runs]
        finally:
            for name in (*runs, *job.blocks):
                name.cancel()
    failed = [(error, pair) for error, pair in zip(errors, pairs, strict=True) if error]
    if failed and isinstance(target, str | Path):
        raise failed[0][0]
    for error, (_, place) in failed:
        error.add_note(f"Of the capture for '{place}'.")
    if failed:
        names = ", ".join(f"'{place}'" for _, (_, place) in failed)
        raise BaseExceptionGroup(
            f"{len(failed)} of {len(pairs)} captures failed, for {names}",
            [error for error, _ in failed],
        )


@dataclass(frozen=True)
class _Job:
    """Options that all captures of a run share."""

    response: xr.Dataset
    method: str
    options: dict[str, Any]
    executor: Executor | None
    memory: float
    provenance: dict[str, Any]
    bar: "tqdm[Any]"
    blocks: list[Future[None]] = field(default_factory=list)  # of all captures

    def separate(self, source: Path | xr.Dataset, target: Path) -> None:
        """Separate a capture, or what is left of it, into its target."""
        capture = store.open_dataset(source) if isinstance(source, Path) else source
        checked = _inputs.check(
            capture, self.response, get_method(self.method), self.method, **self.options
        )
        response = checked.response  # with one noise for all blocks
        provenance = self.provenance or store.provenance({})
        method, settings = get_method(self.method), self.options["settings"]
        threads, height, read = _share(capture, self.memory, self.executor, method, settings)
        with ThreadPoolExecutor(threads) as own:
            content = _content(source, capture, read, self.executor or own)
        digest = _digest([content, response, self.method, self.options])
        provenance = json.loads(json.dumps({**provenance, "run": digest}))
        parts = Path(f"{target}.parts")
        if target.exists() and store.open_dataset(target).attrs.get("provenance") == provenance:
            shutil.rmtree(parts, ignore_errors=True)  # of a run that was killed at its very end
            return
        _begin(parts, {"height": height, **provenance})
        end = capture.sizes["y"]
        paths = {top: parts / f"{top:06d}.zarr" for top in range(0, end, height)}
        jobs = []
        with ThreadPoolExecutor(threads) as own:
            for top in range(0, end, read):
                rows = slice(top, min(top + read, end))
                blocks = range(top, rows.stop, height)
                left = {row - top: paths[row] for row in blocks if not paths[row].exists()}
                if left:
                    here = {name: _of_rows(value, rows) for name, value in self.options.items()}
                    part = source if isinstance(source, Path) else capture.isel(y=rows)
                    task = (part, rows, left, response, self.method, here, height, provenance)
                    jobs.append((self.executor or own).submit(_separate_rows, *task))
            self.blocks.extend(jobs)
            self.bar.total = (self.bar.total or 0) + len(jobs)
            try:
                for block in as_completed(jobs):
                    block.result()
                    self.bar.update()
            finally:
                for block in jobs:
                    block.cancel()
        store.join_parts(paths.values(), target)
        shutil.rmtree(parts)


def _separate_rows(
    source: Path | xr.Dataset,
    rows: slice,
    paths: Mapping[int, Path],
    response: xr.Dataset,
    method: str,
    options: Mapping[str, Any],
    height: int,
    provenance: Mapping[str, Any],
) -> None:
    """Read rows of a capture on disk or in hand; write each block of them whole or not."""
    with chunks_in_turn() if parent_process() else nullcontext():  # as an executor's process
        part = store.open_dataset(source).isel(y=rows) if isinstance(source, Path) else source
        # What is dask's is computed here: its own threads, or the cluster's, would hold more.
        part = part.load(scheduler="synchronous")
        for top, path in paths.items():
            block = slice(top, top + height)
            here = {name: _of_rows(value, block) for name, value in options.items()}
            result = solve(part.isel(y=block), response, method, workers=1, **here)
            store.save_rows([result], path, provenance, height)
            del result  # or it would be there beside the next one


def _pairs(source: Any, target: Any) -> list[tuple[Path | xr.Dataset, Path]]:
    """Sources and targets, whose paths do not depend on a process's own folder."""
    one = isinstance(target, str | Path)
    sources, targets = ([source], [target]) if one else (list(source), list(target))
    if len(sources) != len(targets):
        raise ValueError(
            f"Invalid number of targets {len(targets)} for {len(sources)} captures. Must be one "
            "for each."
        )
    places = [texts.as_path(place).absolute() for place in targets]
    captures = [
        it if isinstance(it, xr.Dataset) else texts.as_path(it).absolute() for it in sources
    ]
    named = [*places, *(it for it in captures if isinstance(it, Path))]
    for place in places:
        if place.suffix != ".zarr" or named.count(place) > 1:
            rule = "Must end in '.zarr', be no capture that is read, and be named once"
            raise ValueError(f"Invalid target '{place}'. {rule}.")
    return list(zip(captures, places, strict=True))


def _of_rows(value: Any, rows: slice) -> Any:
    return value.isel(y=rows) if isinstance(value, xr.DataArray) and "y" in value.dims else value


def _share(
    capture: xr.Dataset, memory: float, executor: Executor | None, method: Method, settings: Any
) -> tuple[int, int, int]:
    """Threads of a process, rows of a block, as `solve` reads at once or fewer, and of a read."""
    counts = capture["counts"]
    row, lazy = counts[..., 0, :].size, counts.chunksizes.get("y", ())
    chunk = max(lazy, default=counts.encoding.get("preferred_chunks", {}).get("y", 1))
    each = _TILE if method.compiled else _TILE * _TIMES
    tile = each * largest(method, settings, capture) * row / capture.sizes["x"]

    def read(height: int) -> tuple[int, bool]:
        """Rows that are read together: blocks as far as a chunk of dask's; whether no more is."""
        rows = height * math.ceil(chunk / height) if lazy else height
        return rows, rows % chunk == 0 and set(lazy[:-1]) <= {chunk}

    def need(height: int) -> float:
        """Memory [byte] of the chunks read, of the blocks' samples, and of a tile or all as one."""
        rows, exact = read(height)
        chunks = (rows if exact else rows + 2 * chunk) if lazy else 0
        samples = _READ * (rows + chunks) + _SAMPLE * height
        return samples * row + min(each * row * height, tile)

    threads = 1 if executor or memory < BASE + 2 * need(1) else 2
    if isinstance(executor, ThreadPoolExecutor):
        threads = executor._max_workers
    free = (memory - BASE) / threads
    if free < need(1):
        raise ValueError(
            f"Invalid memory {memory:g} byte. Must be at least {BASE + threads * need(1):g} for "
            f"one row of {capture.sizes['x']} pixels and {capture.sizes['time']} frames"
            + (f", of a source in chunks of {chunk} rows." if lazy else ".")
        )
    fit = [
        array for array in range(1, min(BLOCK_ROWS, capture.sizes["y"]) + 1) if need(array) <= free
    ]
    # A somewhat lower block, of which no chunk is read for two.
    height = max([array for array in fit if 2 * array > fit[-1] and read(array)[1]] or fit)
    return threads, height, read(height)[0]


def _begin(parts: Path, plan: Mapping[str, Any]) -> None:
    """Make the folder of the parts, or find it as left by the same run."""
    file, content = parts / "plan.json", json.dumps(plan, indent=2, sort_keys=True)
    parts.mkdir(parents=True, exist_ok=True)
    if not file.exists():
        if foreign := [one.name for one in parts.iterdir() if not one.name.startswith(".plan-")]:
            raise ValueError(
                f"Foreign folder '{parts}', with '{foreign[0]}'. Must be of a run, for it is "
                "deleted at the end, or none."
            )
        part = parts / f".plan-{os.getpid()}"
        part.write_text(content)
        part.replace(file)
    elif file.read_text() != content:
        raise ValueError(
            f"Invalid folder '{parts}': of a run of another capture, response, version, memory or "
            "options. Must be deleted, or the run be started as it was."
        )


def _content(source: Path | xr.Dataset, capture: xr.Dataset, read: int, executor: Executor) -> Any:
    """All by which a capture is recognised: its store's checksums; without these, each value.

    What is lazy is read for it, by those who read it again to separate it.
    """
    if isinstance(source, Path) and (sums := last_sums(source)):
        return sums
    films = [name for name, one in capture.variables.items() if "y" in one.dims]
    rest, every = capture.drop_vars(films), capture.drop_vars(capture.variables.keys() - films)
    heights = capture["counts"].chunksizes.get("y") or [read] * math.ceil(capture.sizes["y"] / read)
    parts = [
        every.isel(y=slice(end - rows, end))
        for end, rows in zip(accumulate(heights), heights, strict=True)
    ]
    in_memory = all(one.variable._in_memory for one in capture.values())
    digests = map(_row_digests, parts) if in_memory else executor.map(_row_digests, parts)
    return [_digest(rest), "".join(digests)]


def _row_digests(block: xr.Dataset) -> str:
    """Digests of rows, each by itself, whatever the number that are read together."""
    block = block.compute(scheduler="synchronous")
    return "".join(_digest(block.isel(y=row)) for row in range(block.sizes["y"]))


def _digest(value: Any) -> str:
    """Digest of numbers, text, arrays, datasets, and of sequences and mappings of these."""
    if isinstance(value, xr.Dataset):
        value = [dict(value.sizes), value.attrs, dict(value.variables)]
    elif isinstance(value, xr.DataArray):
        value = [value.variable, dict(value.coords.variables)]
    elif isinstance(value, xr.Variable):
        plain = value.values.tolist() if value.dtype.hasobject else value.values.tobytes()
        value = [value.dims, value.shape, str(value.dtype), value.attrs, plain]
    elif isinstance(value, Mapping):
        # A store lists its arrays in any order.
        value = sorted(value.items(), key=lambda item: str(item[0]))
    if isinstance(value, list | tuple):
        value = [_digest(one) for one in value]
    return hashlib.sha256(repr(value).encode()).hexdigest()
