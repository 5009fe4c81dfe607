"""Cache of long experiments: `kept(experiment, folder)(...)` computes each result once.

A result is read back only if arguments, source code and package versions are those that it was
computed with. It is one file, with its name and a checksum; if one of the two is wrong, the result
is computed again.
"""

import hashlib
import inspect
import logging
import math
import pickle
import platform
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from importlib.metadata import distributions
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any, Final

import joblib
import xarray as xr

import dbthermal

Experiment = Callable[..., Any]

_LOGGER: Final = logging.getLogger(__name__)


def _fingerprint() -> str:
    """SHA-256 of the source code here and in dbthermal, and of all package versions."""
    total = hashlib.sha256(platform.python_version().encode())
    packages = {f"{package.name} {package.version}\n" for package in distributions()}
    total.update("".join(sorted(packages)).encode())
    for folder in (Path(dbthermal.__file__).parent, Path(__file__).parent):
        for path in sorted([*folder.rglob("*.py"), *folder.rglob("*.csv")]):
            total.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return total.hexdigest()


_IMPORTED: Final = _fingerprint()


def kept(experiment: Experiment, folder: Path) -> Experiment:
    """Experiment whose results are kept; RuntimeError if the source changed since its import."""
    if _fingerprint() != _IMPORTED:
        raise RuntimeError("Changed source code. Must be as it was imported: restart the kernel.")
    name = f"{experiment.__module__}.{experiment.__qualname__}"
    return partial(_result, experiment, folder / _IMPORTED[:32] / name)


def _result(experiment: Experiment, folder: Path, *args: Any, **options: Any) -> Any:
    """Result from its file, computed if there is none, or if it is not as it was written."""
    inputs = inspect.signature(experiment).bind(*args, **options)
    inputs.apply_defaults()
    path = folder / f"{joblib.hash(inputs.arguments)}.pkl"
    if path.exists():
        with suppress(Exception):  # zlib compares a checksum; whatever it is, it can be made anew
            name, result = pickle.loads(zlib.decompress(path.read_bytes()))
            if name == path.name:
                return result
        _LOGGER.warning("Damaged result '%s'. It is computed again.", path)
    result = experiment(*args, **options)
    folder.mkdir(parents=True, exist_ok=True)
    with NamedTemporaryFile(dir=folder, prefix=".", delete=False) as draft:
        # Not smaller, but with a checksum: compression would take longer than a small experiment.
        draft.write(zlib.compress(pickle.dumps((path.name, result)), level=0))
    Path(draft.name).replace(path)
    return result


def gridded(results: Sequence[xr.Dataset], coords: Mapping[str, Sequence[Any]]) -> xr.Dataset:
    """Results over the product of some coordinates, of which the last varies fastest, as one."""
    shape = [len(values) for values in coords.values()]
    if len(results) != math.prod(shape):
        raise ValueError(f"Invalid number of results {len(results)}. Must be {math.prod(shape)}.")
    rows = list(results)
    for dim, values in reversed(list(coords.items())):
        index = xr.DataArray(list(values), dims=dim, name=dim)
        rows = [
            xr.concat(rows[first : first + len(values)], index, combine_attrs="drop_conflicts")
            for first in range(0, len(rows), len(values))
        ]
    return rows[0]
