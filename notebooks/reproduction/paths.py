"""The project's folders, known here only.

A notebook is run from its own folder by one tool and from the project's by another, so nothing
relies on the current folder: the root is the folder that holds ``data_manifest.yaml``, sought
upwards. One stem, such as ``03_simulation``, names a notebook, its parameters and all its results::

    root/
      data_manifest.yaml         manifest()
      data/                      data()
      notebooks/NN_name.ipynb    notebook("NN_name")
      params/NN_name.yaml        params("NN_name")
      params/sessions/           session("name")
      recordings/<run>/          recordings(run)
      results/<run>/             results(run)
        NN_name.zarr ...         result(run, "NN_name", ".zarr")
        NN_name/                 emulated(run, "NN_name")
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

_MARKER = "data_manifest.yaml"


def root() -> Path:
    """Folder of the project: the nearest one upwards that holds ``data_manifest.yaml``.

    The search starts in the current folder, so that a checkout finds itself, and then in the folder
    of this package, so that an editable install is found from anywhere.

    Returns
    -------
    Path
        Absolute, with links resolved.

    Raises
    ------
    FileNotFoundError
        If neither search meets the file; the message names both starts.
    """
    starts = [Path.cwd().resolve(), Path(__file__).resolve().parent]
    for start in starts:
        for folder in (start, *start.parents):
            if (folder / _MARKER).is_file():
                return folder
    raise FileNotFoundError(
        f"No {_MARKER} in or above '{starts[0]}', nor '{starts[1]}'. "
        "Must be run inside the project's folder."
    )


def manifest() -> Path:
    """List of the outside files, ``data_manifest.yaml``.

    Returns
    -------
    Path
        The file that also marks the root.
    """
    return root() / _MARKER


def data() -> Path:
    """Folder for the outside files once fetched; it need not exist.

    Returns
    -------
    Path
        ``data`` below the root, never committed.
    """
    return root() / "data"


def notebook(stem: str) -> Path:
    """Notebook of a stem.

    Parameters
    ----------
    stem : str
        Such as ``"03_simulation"``.

    Returns
    -------
    Path
        ``notebooks/<stem>.ipynb`` below the root.

    Raises
    ------
    ValueError
        If `stem` is not two digits and a lower-case name.
    """
    name = f"{_stem(stem)}.ipynb"
    return root() / "notebooks" / name


def params(stem: str) -> Path:
    """Parameters of a notebook's full run.

    Parameters
    ----------
    stem : str
        Such as ``"03_simulation"``.

    Returns
    -------
    Path
        ``params/<stem>.yaml`` below the root.

    Raises
    ------
    ValueError
        If `stem` is not two digits and a lower-case name.
    """
    name = f"{_stem(stem)}.yaml"
    return root() / "params" / name


def session(name: str) -> Path:
    """Description of a recording session.

    Parameters
    ----------
    name : str
        Such as ``"scene"``.

    Returns
    -------
    Path
        ``params/sessions/<name>.yaml`` below the root.

    Raises
    ------
    ValueError
        If `name` is not lower-case letters, digits and ``_``.
    """
    if not re.fullmatch(r"[a-z0-9_]+", name):
        raise ValueError(f"Invalid session {name!r}. Must be lower-case letters, digits and '_'.")
    return root() / "params" / "sessions" / f"{name}.yaml"


def recordings(run: str) -> Path:
    """Folder of what hardware recorded; it need not exist. No task removes it.

    Parameters
    ----------
    run : str
        As for `results`.

    Returns
    -------
    Path
        ``recordings/<run>`` below the root.

    Raises
    ------
    ValueError
        As `results`.
    """
    return root() / "recordings" / results(run).name


def emulated(run: str, stem: str) -> Path:
    """Folder of what a notebook recorded from emulated devices; it need not exist.

    Parameters
    ----------
    run : str
        As for `results`.
    stem : str
        Such as ``"00_acquisition"``.

    Returns
    -------
    Path
        ``results/<run>/<stem>`` below the root, removed with the notebook's other results.

    Raises
    ------
    ValueError
        If `run` or `stem` is not a name as above.
    """
    return results(run) / _stem(stem)


def results(run: str) -> Path:
    """Folder of one run's results; it need not exist, `store` makes it.

    Parameters
    ----------
    run : str
        ``"full"`` for the values in ``params/``, ``"smoke"`` for the small ones in the notebooks,
        or a name of one's own.

    Returns
    -------
    Path
        ``results/<run>`` below the root.

    Raises
    ------
    ValueError
        If `run` is not one folder name of lower-case letters, digits, ``-`` and ``_``.
    """
    if not re.fullmatch(r"[a-z0-9][a-z0-9_-]*", run):
        raise ValueError(f"Invalid run {run!r}. Must be lower-case letters, digits, '-' and '_'.")
    return root() / "results" / run


def result(run: str, stem: str, ending: str) -> Path:
    """File or folder of one result.

    Parameters
    ----------
    run : str
        See `results`.
    stem : str
        The notebook that makes the result, such as ``"03_simulation"``.
    ending : str
        What follows the stem: ``".zarr"``, ``".json"``, ``"_scene.png"``.

    Returns
    -------
    Path
        ``results/<run>/<stem><ending>`` below the root.

    Raises
    ------
    ValueError
        If `run` or `stem` is not a name as above, or `ending` has no suffix or leads to another
        folder.
    """
    if not re.fullmatch(r"(_[a-z0-9_-]+)?\.[a-z0-9]+", ending):
        raise ValueError(
            f"Invalid ending {ending!r}. Must be '.suffix' or '_name.suffix', in lower case."
        )
    return results(run) / f"{_stem(stem)}{ending}"


def cells(stem: str) -> Path:
    """Folder of the finished cells of a notebook's long experiment; it need not exist.

    Parameters
    ----------
    stem : str
        Such as ``"05_methods"``.

    Returns
    -------
    Path
        ``results/cells/<stem>`` below the root; all runs share it, for a cell's name tells what
        made it.

    Raises
    ------
    ValueError
        If `stem` is not two digits and a lower-case name.
    """
    return root() / "results" / "cells" / _stem(stem)


def _stem(stem: str) -> str:
    """Return `stem` if it is one, such as ``"03_simulation"``."""
    if not re.fullmatch(r"[0-9]{2}_[a-z0-9_]+", stem):
        raise ValueError(f"Invalid stem {stem!r}. Must be two digits, '_' and a lower-case name.")
    return stem


def named(stem: str, namespace: Mapping[str, Any]) -> dict[str, Any]:
    """
    Values that a notebook's parameters have, by the names in its YAML file.

    Parameters
    ----------
    stem : str
        Stem of the notebook, such as ``"01_calibration"``.
    namespace : mapping
        Where the values are, such as ``globals()`` of the notebook.

    Returns
    -------
    dict
        Name to value.

    Raises
    ------
    KeyError
        If a parameter has no value.
    """
    names = yaml.safe_load(params(stem).read_text(encoding="utf-8"))
    missing = [name for name in names if name not in namespace]
    if missing:
        raise KeyError(f"Missing parameter '{missing[0]}' of '{stem}'. Must have a value.")
    return {name: namespace[name] for name in names}
