"""Separation of captures of any size, from disk to disk, by rows that processes share out."""

import hashlib
import json
import math
import os
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from itertools import accumulate
from multiprocessing import parent_process
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import xarray as xr
from tqdm import tqdm

from dbthermal import _numbers, schema, store
from dbthermal import _text as texts
from dbthermal.separation import _inputs
from dbthermal.separation._inputs import BLOCK_ROWS, Method
from dbthermal.separation._solve import METHODS, get_method, require_whole, solve
from dbthermal.separation._tiles import largest
from dbthermal.store._datasets import chunks_in_turn
from dbthermal.store._integrity import last_sums

if TYPE_CHECKING:
    from dbthermal.separation._solve import Settings

# Memory [byte], from the peaks of processes with one and two threads, of 350 to 3000 frames:
BASE: Final = 450_000_000  # of a process that has imported and compiled all
_READ: Final = 4  # of a sample of a band that is read; the same in dask's chunks beside it
_SAMPLE: Final = 12  # of a sample of a band in a block: results (8), and those being written
_TILE: Final = 140  # of a sample of a band in the tile of a compiled method (110 to 140)
_TIMES: Final = 8  # of a method that is not compiled over that (500 to 900 byte)


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

    Each block of rows is separated as by `solve` and written by one process. A run that was killed
    goes on where it stopped, to the same bytes; a target that the same run has made is left as it
    is. A capture is recognised by its store's checksums; one in memory or lazy by its values.

    TypeError or ValueError as from `solve`; if the memory is too small for a row, or for the chunks
    of dask's that hold it, or the parts are of another run. BlockingIOError, with its name, while
    another process separates into the target. ExceptionGroup of the errors of several captures,
    each with the capture's name; all others are finished.

    Parameters
    ----------
    source : str, Path, Dataset, or a sequence of these
        Stage `corrected` of `schema`: a folder ``*.zarr`` of `store.save`, which every process
        opens by itself, or a lazy Dataset (of zarr, dask), of which a process is sent its rows;
        a chunk of dask's is read once for all its blocks. What `correct_capture` or `align` leave
        to be computed is for threads or a cluster's workers, not for a ProcessPoolExecutor.
    target : str or Path, or as many
        Folder ``*.zarr`` for each result. While it is made, its parts are in ``*.zarr.parts``.
    method : str
        One of `METHODS`. For materials and a shift of the reflections, which need the whole image,
        see `scene.separate_capture`.
    response, settings, emissivity, emissivity_std, emissivity_covariance, mask, response_kind, seed
        As for `solve`, the same for all captures.
    executor : Executor, optional
        Of `concurrent.futures`, or with its interface, as from ``distributed.Client.get_executor``;
        by default two threads, or one where the memory is too small for two.
    memory : float
        Largest memory of a process [byte]; with less, a block has fewer rows than 32. A process of
        an executor separates one block at a time, a ThreadPoolExecutor one in each thread. The
        process that compiles, the first after the installation, takes 0.35 GB more.
    provenance : mapping, optional
        See `store.save`.
    progress : bool
        Show a bar.

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
    require_whole("seed", seed, 0)
    memory = _numbers.real_number("memory [byte]", memory, _numbers.POSITIVE)
    schema.require(provenance, Mapping, "provenance")
    options: dict[str, Any] = {"settings": settings, "mask": mask, "seed": seed}
    options |= {"emissivity": emissivity, "emissivity_std": emissivity_std}
    options |= {"emissivity_covariance": emissivity_covariance, "response_kind": response_kind}
    plan, pairs, blocks = _Plan(response, method, options), _pairs(source, target), list[Any]()
    # Two captures at a time: while one is joined, the processes have the other's rows.
    with (
        ThreadPoolExecutor(2 if executor else 1) as captures,
        tqdm(desc="run", unit="block", total=0, disable=not progress) as bar,
    ):

        def separate(pair: tuple[Path | xr.Dataset, Path]) -> None:
            with store.reserved(pair[1]):
                _separate_capture(*pair, plan, dict(provenance), executor, memory, bar, blocks)

        runs = [captures.submit(separate, pair) for pair in pairs]
        try:
            errors = [capture.exception() for capture in runs]
        finally:
            for job in (*runs, *blocks):
                job.cancel()
    # Report the captures that failed.
    failed = {place: error for (_, place), error in zip(pairs, errors, strict=True) if error}
    if failed and isinstance(target, str | Path):
        raise next(iter(failed.values()))
    for place, error in failed.items():
        error.add_note(f"Of the capture for '{place}'.")
    if failed:
        names = ", ".join(f"'{place}'" for place in failed)
        raise BaseExceptionGroup(
            f"{len(failed)} of {len(pairs)} captures failed, for {names}", [*failed.values()]
        )


@dataclass(frozen=True)
class _Plan:
    """Separation of all blocks of a capture."""

    response: xr.Dataset
    method: str
    options: Mapping[str, Any]  # of `solve`
    height: int = 0  # rows of a block
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def of_rows(self, rows: slice) -> "_Plan":
        """Plan with the options of some rows."""
        arrays = {
            name: value.isel(y=rows, missing_dims="ignore")
            for name, value in self.options.items()
            if isinstance(value, xr.DataArray)
        }
        return replace(self, options={**self.options, **arrays})


def _separate_capture(
    source: Path | xr.Dataset,
    target: Path,
    plan: _Plan,
    provenance: dict[str, Any],
    executor: Executor | None,
    memory: float,
    bar: "tqdm[Any]",
    jobs: list[Future[None]],
) -> None:
    """Separate a capture, or its blocks that are missing, into its target; jobs are appended."""
    # Check the inputs, and recognise the capture.
    capture = store.open_dataset(source) if isinstance(source, Path) else source
    method = get_method(plan.method)
    checked = _inputs.check(capture, plan.response, method, **plan.options)
    settings = plan.options["settings"]
    threads, height, read = _share(capture, memory, executor, method, settings)
    with ThreadPoolExecutor(threads) as pool:
        content = _content(source, capture, read, executor or pool)
    response = checked.response  # with one noise for all blocks
    digest = _digest([content, response, plan.method, plan.options])
    record = json.loads(json.dumps({**(provenance or store.provenance({})), "run": digest}))
    # Leave a result of the same run; go on with its parts.
    folder = Path(f"{target}.parts")
    if target.exists() and store.open_dataset(target).attrs.get("provenance") == record:
        shutil.rmtree(folder, ignore_errors=True)  # of a run that was killed at its very end
        return
    plan = replace(plan, response=response, height=height, provenance=record)
    _begin(folder, {"height": height, **record})
    image = capture.sizes["y"]
    paths = {top: folder / f"{top:06d}.zarr" for top in range(0, image, height)}
    # Separate the blocks that are missing, those of one reading together.
    with ThreadPoolExecutor(threads) as pool:
        missing = list[Future[None]]()
        for top in range(0, image, read):
            rows = slice(top, min(top + read, image))
            blocks = range(top, rows.stop, height)
            places = {row - top: paths[row] for row in blocks if not paths[row].exists()}
            if places:
                block = source if isinstance(source, Path) else capture.isel(y=rows)
                task = block, rows, places, plan.of_rows(rows)
                missing.append((executor or pool).submit(_separate_rows, *task))
        jobs.extend(missing)
        bar.total = (bar.total or 0) + len(missing)
        try:
            for job in as_completed(missing):
                job.result()
                bar.update()
        finally:
            for job in missing:
                job.cancel()
    store.join_parts(paths.values(), target)
    shutil.rmtree(folder)


def _separate_rows(
    source: Path | xr.Dataset, rows: slice, paths: Mapping[int, Path], plan: _Plan
) -> None:
    """Read rows of a capture on disk or in hand; write each block of them whole or not."""
    with chunks_in_turn() if parent_process() else nullcontext():  # as an executor's process
        capture = store.open_dataset(source).isel(y=rows) if isinstance(source, Path) else source
        # What is dask's is computed here: its own threads, or the cluster's, would hold more.
        capture = capture.load(scheduler="synchronous")
        for top, path in paths.items():
            block = slice(top, top + plan.height)
            options = plan.of_rows(block).options
            result = solve(capture.isel(y=block), plan.response, plan.method, workers=1, **options)
            store.save_rows([result], path, plan.provenance, plan.height)
            del result  # before the next block is in memory


def _pairs(source: Any, target: Any) -> list[tuple[Path | xr.Dataset, Path]]:
    """Sources and targets, whose paths do not depend on a process's own folder."""
    single = isinstance(target, str | Path)
    sources, targets = ([source], [target]) if single else (list(source), list(target))
    if len(sources) != len(targets):
        label = f"Invalid number of targets {len(targets)} for {len(sources)} captures"
        raise ValueError(f"{label}. Must be one for each.")
    places = [texts.as_path(place).absolute() for place in targets]
    captures = [
        it if isinstance(it, xr.Dataset) else texts.as_path(it).absolute() for it in sources
    ]
    named = [*places, *(capture for capture in captures if isinstance(capture, Path))]
    for place in places:
        if place.suffix != ".zarr" or named.count(place) > 1:
            rule = "Must end in '.zarr', be no capture that is read, and be named once"
            raise ValueError(f"Invalid target '{place}'. {rule}.")
    return list(zip(captures, places, strict=True))


def _share(
    capture: xr.Dataset, memory: float, executor: Executor | None, method: Method, settings: Any
) -> tuple[int, int, int]:
    """Threads of a process, rows of a block, as `solve` reads or fewer, and rows read."""
    counts, columns = capture["counts"], capture.sizes["x"]
    chunks, stored = counts.chunksizes, counts.encoding.get("preferred_chunks", {})
    row, lazy = counts[..., 0, :].size, chunks.get("y", ())
    chunk = max(lazy, default=stored.get("y", 1))
    sample = _TILE if method.compiled else _TILE * _TIMES
    tile = sample * largest(method, settings, capture) * (row // columns)

    def read(height: int) -> tuple[int, bool]:
        """Rows read together, blocks as far as a chunk of dask's; whether they are whole chunks."""
        rows = height * math.ceil(chunk / height) if lazy else height
        return rows, rows % chunk == 0 and set(lazy[:-1]) <= {chunk}

    def need(height: int) -> float:
        """Memory [byte] of the chunks read, of the blocks' samples, and of a tile."""
        rows, whole = read(height)
        read_again = (rows if whole else rows + 2 * chunk) if lazy else 0
        samples = _READ * (rows + read_again) + _SAMPLE * height
        return samples * row + min(sample * row * height, tile)

    threads = 1 if executor or memory < BASE + 2 * need(1) else 2
    if isinstance(executor, ThreadPoolExecutor):
        threads = executor._max_workers
    free = (memory - BASE) / threads
    if free < need(1):
        raise ValueError(
            f"Invalid memory {memory:g} byte. Must be at least {BASE + threads * need(1):g} for "
            f"a row of {columns} pixels and {capture.sizes['time']} frames"
            + (f", of a source in chunks of {chunk} rows." if lazy else ".")
        )
    # The highest block that fits; a lower one, by less than half, if it reads no chunk twice.
    highest = min(BLOCK_ROWS, capture.sizes["y"])
    fit = [height for height in range(1, highest + 1) if need(height) <= free]
    height = max([rows for rows in fit if 2 * rows > fit[-1] and read(rows)[1]] or fit)
    return threads, height, read(height)[0]


def _begin(folder: Path, plan: Mapping[str, Any]) -> None:
    """Make the folder of the parts, or find it as the same run left it."""
    file, content = folder / "plan.json", json.dumps(plan, indent=2, sort_keys=True)
    folder.mkdir(parents=True, exist_ok=True)
    if not file.exists():
        if foreign := [it.name for it in folder.iterdir() if not it.name.startswith(".plan-")]:
            rule = "Must be of a run, for it is deleted at the end, or none"
            raise ValueError(f"Foreign folder '{folder}', with '{foreign[0]}'. {rule}.")
        draft = folder / f".plan-{os.getpid()}"
        draft.write_text(content)
        draft.replace(file)
    elif file.read_text() != content:
        state = "of a run of another capture, response, version, memory or options"
        rule = "Must be deleted, or the run be started as it was"
        raise ValueError(f"Invalid folder '{folder}': {state}. {rule}.")


def _content(source: Path | xr.Dataset, capture: xr.Dataset, read: int, executor: Executor) -> Any:
    """Checksums of a capture's store, or digests of its values, which the workers read."""
    if isinstance(source, Path) and (sums := last_sums(source)):
        return sums
    films = [name for name, variable in capture.variables.items() if "y" in variable.dims]
    constant, movie = capture.drop_vars(films), capture.drop_vars(capture.variables.keys() - films)
    heights = capture["counts"].chunksizes.get("y") or [read] * math.ceil(capture.sizes["y"] / read)
    ends = zip(accumulate(heights), heights, strict=True)
    blocks = [movie.isel(y=slice(end - height, end)) for end, height in ends]
    in_memory = all(array.variable._in_memory for array in capture.values())
    digests = map(_row_digests, blocks) if in_memory else executor.map(_row_digests, blocks)
    return [_digest(constant), "".join(digests)]


def _row_digests(block: xr.Dataset) -> str:
    """Digests of rows, row by row, whatever the number that are read together."""
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
    elif isinstance(value, Mapping):  # a store lists its arrays in any order
        value = sorted(value.items(), key=lambda item: str(item[0]))
    if isinstance(value, list | tuple):
        value = [_digest(element) for element in value]
    return hashlib.sha256(repr(value).encode()).hexdigest()
