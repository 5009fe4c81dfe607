"""Long experiments in cells: each is kept as soon as it is done, and never done twice.

A cell's name is the checksum of its parameters, of this package's source, and of the versions it
runs on; so an interrupted run goes on where it stopped, and changed code starts anew.
"""

import hashlib
import json
import math
import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import xarray as xr
from tqdm import tqdm

from dbthermal import store
from dbthermal.store import _provenance as provenance

_OPTIONAL: Final = ("torch", "trimesh", "embreex", "robust-laplacian")
_PACKAGE: Final = Path(__file__).parents[1]
# Of the code as it was imported, which is the code that runs.
_SOURCE: Final = provenance.source(_PACKAGE)

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
        If a parameter is not plain, see `provenance.record`; and what the function raises: then no
        further cell is begun.
    RuntimeError
        If the package's source changed since it was imported, so that nobody could say which code
        a result is of.
    """
    if provenance.source(_PACKAGE) != _SOURCE:
        raise RuntimeError("Changed source code. Must be as it was imported: restart the kernel.")
    cells = list(cells)
    paths = [folder / f"{_name(function, cell)}.zarr" for cell in cells]
    missing = {path: cell for path, cell in zip(paths, cells, strict=True) if not path.exists()}
    with tqdm(total=len(cells), initial=len(cells) - len(missing), disable=not progress) as bar:
        for _ in _run(partial(_keep, function), missing, workers):
            bar.update()
    return [store.open_dataset(path).load() for path in paths]


def _run(
    work: Callable[[Path, Cell], None], missing: Mapping[Path, Cell], workers: int
) -> Iterator[None]:
    """Do what is missing, here or in several processes; stop at the first that fails."""
    if workers == 1:
        for path, cell in missing.items():
            work(path, cell)
            yield
        return
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))
    try:
        pending = [pool.submit(work, path, cell) for path, cell in missing.items()]
        for done in as_completed(pending):
            done.result()
            yield
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _versions() -> dict[str, str | None]:
    """Versions of all that a cell's result may hang on; None where it is not installed."""
    found: dict[str, str | None] = dict(provenance.record({})["versions"])
    for package in _OPTIONAL:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = None
    return found


def _name(function: Callable[..., xr.Dataset], cell: Cell) -> str:
    """Checksum of all that decides a cell's result."""
    identity = {
        "function": f"{function.__module__}.{function.__qualname__}",
        "cell": provenance.record(cell)["parameters"],
        "versions": _versions(),
        "source": _SOURCE,
    }
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:32]


def _keep(function: Callable[..., xr.Dataset], path: Path, cell: Cell) -> None:
    """Run one cell and save it, whole or not at all, unless another process was first."""
    if path.exists():
        return
    result = function(**cell)
    if provenance.source(_PACKAGE) != _SOURCE:
        raise RuntimeError("Changed source code during a run. Must stay until it ends.")
    try:
        store.save(result, path, provenance.record(cell))
    except OSError:
        if not path.exists():
            raise


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
