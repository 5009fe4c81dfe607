"""Cache of long experiments: `memory(folder).cache(experiment)(...)` computes each result once.

A result is read back only if arguments, source code and package versions are those that it was
computed with. A damaged file fails the checksum of its compression and is computed again.
"""

import hashlib
import math
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import distributions
from pathlib import Path
from typing import Any, Final

import joblib
import xarray as xr

import dbthermal


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


def memory(folder: Path) -> joblib.Memory:
    """Cache in a folder; raises a RuntimeError if the source changed since it was imported."""
    if _fingerprint() != _IMPORTED:
        raise RuntimeError("Changed source code. Must be as it was imported: restart the kernel.")
    return joblib.Memory(folder / _IMPORTED[:32], compress=True, verbose=0)


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
