"""Provenance of a result: parameters, versions, commit, and checksums of the input.

It holds no date, no host and no folder: the same input, parameters and code give the same record.
"""

import hashlib
import json
import os
import platform
import subprocess
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from dbthermal import __version__

_PACKAGES = ("numpy", "scipy", "xarray", "zarr")


def provenance(
    parameters: Mapping[str, object], inputs: Mapping[str, str | Path] | None = None
) -> dict[str, Any]:
    """Provenance of a result, for the functions that save it.

    Parameters
    ----------
    parameters : mapping
        Name to value, as in the notebook's parameters cell: finite numbers, strings, booleans,
        None, and lists and mappings of these; TypeError or ValueError for any other.
    inputs : mapping, optional
        Name to path of each file, or folder such as a zarr store, that was read, for its checksum.

    Returns
    -------
    dict
        ``parameters``; ``versions`` of Python, dbthermal and its core dependencies; ``commit``, 40
        hexadecimal digits, with ``-dirty`` if tracked files differ from it, or ``"unknown"``
        outside a git work tree; and ``inputs``, name to sha256.

    Examples
    --------
    >>> from dbthermal import store
    >>> store.provenance({"frames": 350})["parameters"]
    {'frames': 350}
    """
    return {
        "parameters": {name: _plain(name, value) for name, value in parameters.items()},
        "versions": {
            "python": platform.python_version(),
            "dbthermal": __version__,
            **{package: version(package) for package in _PACKAGES},
        },
        "commit": commit(),
        "inputs": {name: checksum(path) for name, path in (inputs or {}).items()},
    }


def checksum(path: str | Path) -> str:
    """SHA-256 of a file, as of ``sha256sum``, or of a folder's file names and contents.

    Parameters
    ----------
    path : str or Path
        File or folder; FileNotFoundError if it does not exist.
    """
    path = Path(path)
    if not path.is_dir():
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    files = {file.relative_to(path).as_posix(): file for file in path.rglob("*") if file.is_file()}
    lines = (f"{checksum(files[name])}  {name}\n" for name in sorted(files))
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def commit() -> str:
    """Commit of the code that runs, or ``"unknown"``; see `provenance`."""
    folder = Path(__file__).parent
    tracked = _git(folder, "ls-files", "--error-unmatch", Path(__file__).name)
    described = _git(folder, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    return described.strip() if tracked and described else "unknown"


def _git(folder: Path, *arguments: str) -> str:
    """Output of a git command in `folder`; empty if it fails or git is absent."""
    command = ["git", "-C", str(folder), *arguments]
    environment = {**os.environ, "GIT_OPTIONAL_LOCKS": "0"}
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    except FileNotFoundError:
        return ""
    return done.stdout if done.returncode == 0 else ""


def _plain(name: str, value: object) -> Any:
    """Value after a round trip through JSON: tuples are lists, keys are strings."""
    try:
        return json.loads(json.dumps(value, allow_nan=False))
    except (TypeError, ValueError) as error:
        rule = f"Must be JSON with finite numbers: {error}."
        raise type(error)(f"Invalid parameter {name!r} = {value!r}. {rule}") from error
