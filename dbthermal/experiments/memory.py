"""Long experiments in cells: each is kept as soon as it is done, and never done twice.

A cell's name is the checksum of its parameters, of this package's source, and of the versions it
runs on; so an interrupted run goes on where it stopped, and changed code starts anew.
"""

import hashlib
import json
import math
import multiprocessing
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import Any

import xarray as xr
from tqdm import tqdm

from dbthermal import provenance, store

Cell = Mapping[str, Any]
"""Parameters of a cell: plain numbers, texts, lists and mappings."""


def remembered(
    function: Callable[..., xr.Dataset],
    cells: Iterable[Cell],
    folder: Path,
    *,
    workers: int = 1,
    progress: bool = False,
) -> list[xr.Dataset]:
    """
    Run a function once for each cell, in several processes, and keep each result at once.

    Parameters
    ----------
    function : callable
        From a cell's parameters, by name, to a small Dataset; with more than one worker, one that
        another process can import. It draws its random numbers from a seed among its parameters.
    cells : iterable of mapping
        Parameters.
    folder : Path
        Where results are kept, `paths.cells`; made where missing.
    workers : int
        Processes; with one, this one.
    progress : bool
        Show a bar.

    Returns
    -------
    list of Dataset
        One a cell, in their order, whether run now or before.

    Raises
    ------
    TypeError, ValueError
        If a parameter is not plain, see `provenance.record`; and what the function raises.
    """
    cells = list(cells)
    record = provenance.record({})
    paths = [folder / f"{_name(function, cell, record)}.zarr" for cell in cells]
    missing = {path: cell for path, cell in zip(paths, cells, strict=True) if not path.exists()}
    work = partial(_keep, function)
    with tqdm(total=len(cells), initial=len(cells) - len(missing), disable=not progress) as bar:
        if workers == 1:
            for path, cell in missing.items():
                work(path, cell)
                bar.update()
        else:
            with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
                for done in as_completed(_submit(pool, work, missing)):
                    done.result()
                    bar.update()
    return [store.open_dataset(path).load() for path in paths]


def _submit(
    pool: Executor, work: Callable[[Path, Cell], None], missing: Mapping[Path, Cell]
) -> list[Future[None]]:
    return [pool.submit(work, path, cell) for path, cell in missing.items()]


def _name(function: Callable[..., xr.Dataset], cell: Cell, record: Mapping[str, Any]) -> str:
    """Checksum of all that decides a cell's result."""
    identity = {
        "function": f"{function.__module__}.{function.__qualname__}",
        "cell": provenance.record(cell)["parameters"],
        "versions": record["versions"],
        "source": provenance.source(),
    }
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:32]


def _keep(function: Callable[..., xr.Dataset], path: Path, cell: Cell) -> None:
    """Run one cell and save it, whole or not at all."""
    store.save(function(**cell), path, provenance.record(cell))


def gridded(parts: Sequence[xr.Dataset], coords: Mapping[str, Sequence[Any]]) -> xr.Dataset:
    """
    Put the results of cells together that run over the product of some values.

    Parameters
    ----------
    parts : sequence of Dataset
        One a cell; the last of `coords` varies fastest.
    coords : mapping
        New dimension -> its values.

    Returns
    -------
    Dataset
        All of them, over the new dimensions; attributes that differ are dropped.

    Raises
    ------
    ValueError
        If there are not as many parts as cells.
    """
    wanted = math.prod(len(values) for values in coords.values())
    if len(parts) != wanted:
        raise ValueError(f"Invalid number of results {len(parts)}. Must be {wanted}.")
    rows = list(parts)
    for dim, values in reversed(list(coords.items())):
        index = xr.DataArray(list(values), dims=dim, name=dim)
        rows = [
            xr.concat(rows[place : place + len(values)], index, combine_attrs="drop_conflicts")
            for place in range(0, len(rows), len(values))
        ]
    return rows[0]
