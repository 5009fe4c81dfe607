"""Folders of the project. Notebook, parameters and results of one stem bear its name.

A notebook runs in its own folder or in the project's, so no path is relative to the current one:
the root is the nearest folder upwards with ``data_manifest.yaml``::

    root/
      data_manifest.yaml         manifest()
      data/                      data()
      notebooks/NN_name.ipynb    notebook("NN_name")
      params/NN_name.yaml        params("NN_name")
      params/sessions/           session("name")
      recordings/<run>/          recordings(run)
      results/<run>/             results(run)
        NN_name.zarr ...         result(run, "NN_name", ".zarr")
        .NN_name.part.ipynb      unfinished(run, "NN_name")
        .NN_name.sums            sums(run, "NN_name")
        NN_name/                 emulated(run, "NN_name")
      results/cells/NN_name/     cells("NN_name")
"""

import re
from pathlib import Path
from typing import Final

_MARKER: Final = "data_manifest.yaml"


def root() -> Path:
    """Root, sought from the current folder, then from this module; else FileNotFoundError."""
    starts = [Path.cwd().resolve(), Path(__file__).resolve().parent]
    for start in starts:
        for folder in (start, *start.parents):
            if (folder / _MARKER).is_file():
                return folder
    rule = "Must be run inside the project's folder"
    raise FileNotFoundError(f"No {_MARKER} in or above '{starts[0]}', nor '{starts[1]}'. {rule}.")


def manifest() -> Path:
    """List of the outside files, ``data_manifest.yaml``, which also marks the root."""
    return root() / _MARKER


def data() -> Path:
    """Folder of the outside files, never committed; it need not exist."""
    return root() / "data"


def notebook(stem: str) -> Path:
    """Notebook as it is stored, without outputs."""
    return root() / "notebooks" / f"{_stem(stem)}.ipynb"


def params(stem: str) -> Path:
    """Parameters of a notebook's full run."""
    return root() / "params" / f"{_stem(stem)}.yaml"


def session(name: str) -> Path:
    """Description of a recording session, such as ``"scene"``."""
    if not re.fullmatch(r"[a-z0-9_]+", name):
        raise ValueError(f"Invalid session {name!r}. Must be lower-case letters, digits and '_'.")
    return root() / "params" / "sessions" / f"{name}.yaml"


def recordings(run: str) -> Path:
    """Folder of what hardware recorded, which no task removes; it need not exist."""
    return root() / "recordings" / results(run).name


def results(run: str) -> Path:
    """Folder of one run's results: ``"full"``, ``"smoke"`` or another name; it need not exist."""
    if not re.fullmatch(r"[a-z0-9][a-z0-9_-]*", run):
        raise ValueError(f"Invalid run {run!r}. Must be lower-case letters, digits, '-' and '_'.")
    return root() / "results" / run


def result(run: str, stem: str, ending: str) -> Path:
    """File or folder of one result; `ending` follows the stem: ``".zarr"``, ``"_scene.png"``."""
    if not re.fullmatch(r"(_[a-z0-9_-]+)?\.[a-z0-9]+", ending):
        rule = "Must be '.suffix' or '_name.suffix', in lower case"
        raise ValueError(f"Invalid ending {ending!r}. {rule}.")
    return results(run) / f"{_stem(stem)}{ending}"


def unfinished(run: str, stem: str) -> Path:
    """Executed notebook until it is whole: as long as it is there, its results are not."""
    return results(run) / f".{_stem(stem)}.part.ipynb"


def finished(run: str, stem: str) -> str:
    """Stem of a notebook whose results are whole; RuntimeError if it runs, or was interrupted."""
    if (draft := unfinished(run, stem)).exists():
        raise RuntimeError(
            f"Unfinished notebook '{stem}' of run '{run}': it is running, or was interrupted. Must "
            f"have run to its end: 'make results/{run}/{stem}.ipynb', or remove '{draft}' and what "
            "it left."
        )
    return stem


def sums(run: str, stem: str) -> Path:
    """Checksums of all files that a notebook wrote."""
    return results(run) / f".{_stem(stem)}.sums"


def emulated(run: str, stem: str) -> Path:
    """Folder of a notebook's recordings of emulated devices, removed with its other results."""
    return results(run) / _stem(stem)


def cells(stem: str) -> Path:
    """Cache of a notebook's experiments, which all runs share; it need not exist."""
    return root() / "results" / "cells" / _stem(stem)


def _stem(stem: str) -> str:
    """Checked stem, such as ``"03_simulation"``; ValueError if it is malformed."""
    if not re.fullmatch(r"[0-9]{2}_[a-z0-9_]+", stem):
        raise ValueError(f"Invalid stem {stem!r}. Must be two digits, '_' and a lower-case name.")
    return stem
