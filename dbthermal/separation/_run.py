"""Separation of captures of any size, from disk to disk, by rows that processes share out."""

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from concurrent.futures import Executor, ThreadPoolExecutor, as_completed
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import xarray as xr
from tqdm import tqdm

from dbthermal import store
from dbthermal.separation import _inputs
from dbthermal.separation._solve import get_method, solve
from dbthermal.separation._tiles import BLOCK_ROWS

if TYPE_CHECKING:
    from dbthermal.separation._solve import Settings

# Memory of a process before it separates anything [byte]; and of a sample of both bands: counts,
# temperatures and deviations, as they are, compressed and on the way to the disk [byte].
_BASE: Final = 500_000_000
_SAMPLE: Final = 96


def run(  # noqa: PLR0913 - those of `solve` are among them
    source: str | Path | xr.Dataset,
    target: str | Path,
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
) -> xr.Dataset:
    """Separate a capture of any size from disk to disk, by blocks of rows, by several processes.

    Each block of rows is separated as by `solve` and written by the one process that has it; what
    is written stays when the run is killed, and the next one goes on from there to the same bytes.

    Parameters
    ----------
    source : str, Path or Dataset
        Stage `corrected` of `schema`, as for `solve`: a folder ``*.zarr`` of `store.save`, which
        every process opens by itself, or a lazy Dataset that can be sent to the processes.
    target : str or Path
        Folder ``*.zarr`` for the result. While it is made, its parts are in ``*.zarr.parts``.
    response : Dataset
        As for `solve`.
    method : str
        One of `METHODS` that takes each pixel alone: materials, and a shift of the reflections, are
        of the whole image, see `scene.separate_capture`.
    settings, emissivity, emissivity_std, emissivity_covariance, mask, response_kind, seed
        As for `solve`.
    executor : Executor, optional
        Of `concurrent.futures`, or with its interface, as from ``distributed.Client.get_executor``;
        two threads if not given.
    memory : float
        Largest memory of a process [byte]; the rows of a block follow from it.
    provenance : mapping, optional
        See `store.save`.
    progress : bool
        Show a bar.

    Returns
    -------
    Dataset
        As from `solve`, lazy.

    Raises
    ------
    TypeError, ValueError
        As `solve` does; for a method of the whole image; if the memory is too small for a row; and
        if the parts at hand are of another run.

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
    ...     result = run(f"{folder}/capture.zarr", f"{folder}/result.zarr", rig.response())
    ...     result.object_temperature.shape
    (200, 4, 6)
    """
    if get_method(method).whole_image:
        raise ValueError(f"Invalid method '{method}' for a run. Must take each pixel alone.")
    options: dict[str, Any] = {
        "settings": settings,
        "emissivity": emissivity,
        "emissivity_std": emissivity_std,
        "emissivity_covariance": emissivity_covariance,
        "mask": mask,
        "response_kind": response_kind,
        "seed": seed,
    }
    if not isinstance(source, xr.Dataset):
        source = Path(source).absolute()  # for a process with another folder of its own
    capture = source if isinstance(source, xr.Dataset) else store.open_dataset(source)
    response = _with_noise(capture, response, method, options)
    height = _rows(capture, memory, 1 if executor else 2)
    parts = Path(f"{target}.parts").absolute()
    plan = {"capture": _digest(capture), "height": height, "method": method}
    plan |= {"options": _digest({"response": response, **options})}
    _begin(parts, plan)
    rows = [slice(top, top + height) for top in range(0, capture.sizes["y"], height)]
    paths = [parts / f"{one.start:06d}.zarr" for one in rows]
    missing = [(one, path) for one, path in zip(rows, paths, strict=True) if not path.exists()]
    task = (source, response, method, options, height, dict(provenance) or store.provenance({}))
    with ThreadPoolExecutor(2) as threads:
        several = executor or threads
        jobs = [several.submit(_separate_part, one, path, *task) for one, path in missing]
        try:
            for job in tqdm(as_completed(jobs), "run", len(jobs), disable=not progress):
                job.result()
        finally:
            for job in jobs:
                job.cancel()
    store.join_parts(paths, target)
    shutil.rmtree(parts)
    return store.open_dataset(target)


def _separate_part(
    rows: slice,
    path: Path,
    source: str | Path | xr.Dataset,
    response: xr.Dataset,
    method: str,
    options: Mapping[str, Any],
    height: int,
    provenance: Mapping[str, Any],
) -> None:
    """Separate a block of rows and write it, whole or not at all."""
    capture = source if isinstance(source, xr.Dataset) else store.open_dataset(source)
    part = capture.isel(y=rows).load()
    here = {name: _of_rows(value, rows) for name, value in options.items()}
    result = solve(part, response, method, workers=1, **here)
    store.save_part(result, path, provenance, height)


def _of_rows(value: Any, rows: slice) -> Any:
    return value.isel(y=rows) if isinstance(value, xr.DataArray) and "y" in value.dims else value


def _with_noise(
    capture: xr.Dataset, response: xr.Dataset, method: str, options: Mapping[str, Any]
) -> xr.Dataset:
    """Response with the noise of the whole capture, that of every block; all inputs are checked."""
    inputs = _inputs.check(capture, response, get_method(method), method, pool=None, **options)
    if "noise" in response:
        return response
    slopes = np.array([curve.reference_slope for curve in inputs.curves])
    order = [str(name) for name in capture["band"].values]
    noise = xr.DataArray(inputs.noise * slopes, dims="band", coords={"band": order})
    return response.sel(band=order).assign(noise=noise.assign_attrs(units="count"))


def _rows(capture: xr.Dataset, memory: float, threads: int) -> int:
    """Rows of a block, of a multiple of those that are read at once where memory allows."""
    row = threads * _SAMPLE * capture["counts"][..., 0, :].size // 2
    rows = int((memory - _BASE) // row)
    if rows < 1:
        raise ValueError(
            f"Invalid memory {memory:g} byte. Must be at least {_BASE + row:g} for one row of "
            f"{capture.sizes['x']} pixels and {capture.sizes['time']} frames."
        )
    rows = min(rows, capture.sizes["y"])
    return rows - rows % BLOCK_ROWS if rows > BLOCK_ROWS else rows


def _begin(parts: Path, plan: Mapping[str, Any]) -> None:
    """Make the folder of the parts, or find it as left by the same run."""
    file, content = parts / "plan.json", json.dumps(plan, indent=2, sort_keys=True)
    parts.mkdir(parents=True, exist_ok=True)
    if not file.exists():
        part = parts / f".plan-{os.getpid()}"
        part.write_text(content)
        part.replace(file)
    elif file.read_text() != content:
        raise ValueError(
            f"Invalid folder '{parts}': of a run of another capture, response or options. Must be "
            "deleted, or the run be started as it was."
        )


def _digest(value: Any) -> str:
    """Digest of options by name, or of a capture by its coordinates, attributes and sizes."""
    if isinstance(value, xr.Dataset):
        short = value.drop_vars([name for name in value.data_vars if value[name].ndim > 1])
        value = {"short": short, "sizes": dict(value.sizes)}
    plain = {n: v.to_dict() if hasattr(v, "to_dict") else v for n, v in value.items()}
    return hashlib.sha256(json.dumps(plain, sort_keys=True, default=repr).encode()).hexdigest()
