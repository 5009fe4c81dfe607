"""Options that another one, or the kind of what is read or written, leaves without effect."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from dbthermal._cli import PLUS, leaves

_KINDS: Final = {
    "TIFF": (".tif", ".tiff", ".btf"),
    "arrays": (".npy", ".npz", ".nc", ".cdf", ".h5", ".hdf5", ".zarr"),
}
_FORM: Final = {
    "FLIR": "clock bands offset",
    "TIFF": "clock bands offset unit simulated",
    "arrays": "clock bands offset unit variable simulated",
    "raw files": "clock bands offset unit shape byte_order header frame_header simulated",
}
"""Kind of files -> the options that it takes."""


def kind_of(path: Path, options: argparse.Namespace) -> str:
    """Kind of a recording's file, by its name; others are raw if a shape is stated, else FLIR's."""
    kinds = [kind for kind, suffixes in _KINDS.items() if path.suffix.lower() in suffixes]
    return [*kinds, "FLIR" if options.shape is None else "raw files"][0]


def refuse(options: argparse.Namespace, arguments: Sequence[str]) -> None:
    """Refuse an option that is stated, and has no effect."""
    stated = {one.partition("=")[0] for one in arguments}
    for why, names in _unused(options).items():
        for flag in (f"--{name.replace('_', '-')}" for name in names.split()):
            if flag in stated:
                raise ValueError(f"Unused option {flag}. Must be left out {why}.")


def _unused(options: argparse.Namespace) -> dict[str, str]:
    """Options of a command that have no effect, by the reason."""
    if options.command in {"import", "info", "calibrate"}:
        return _of_files(options)
    if options.command == "align" and options.offset is not None:
        return {"with --offset": "search"}
    if options.command == "export" and options.output.suffix != ".csv":
        all_of_it = " variable" if options.output.suffix == ".nc" else ""
        return {f"with {options.output.suffix}": f"pixel region{all_of_it}"}
    if options.command != "separate":
        return {}
    if options.correction:
        return {"with --correction": "method emissivity"}
    whole = {"with --method: 'dbthermal complete'": "surroundings prior workers"}
    apart = {"without --correction, for the capture is aligned": "register offset"}
    return apart | (whole if options.method else {"without --method": "emissivity"})


def _of_files(options: argparse.Namespace) -> dict[str, str]:
    """Options that none of the files of a command takes, nor its other source."""
    kinds, foreign = set[str](), options.command == "info" and options.unit is not None
    for group in options.at if options.command == "calibrate" else [options.files]:
        paths = [one for one in leaves(group) if isinstance(one, Path) and one != PLUS]
        if foreign or len(paths) != 1 or not paths[0].is_dir():  # a folder alone is a store
            kinds |= {kind_of(path, options) for path in paths}
    sources = {"blackbody": "frames", "sweep": "", "maker": "frames correction_output"}
    stated = [one for one in sources if vars(options).get(one)]
    if options.command == "calibrate" and not (options.at or stated):
        return {}
    taken = " ".join(_FORM[kind] for kind in kinds).split()
    names = [one for one in " ".join(_FORM.values()).split() if one not in taken]
    names += sources[stated[0]].split() if stated and not kinds else []
    why = " and ".join([*(f"--{one}" for one in stated), *sorted(kinds)]) or "a store"
    return {f"with {why}": " ".join(names)}
