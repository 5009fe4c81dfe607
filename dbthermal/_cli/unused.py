"""Options without effect, because of another option or of the kind of a file."""

import argparse
from collections.abc import Sequence
from inspect import signature
from pathlib import Path
from typing import Final

from dbthermal._cli import PLUS, leaves
from dbthermal._cli.files import NO_TABLES, READERS, kind_of
from dbthermal.response import ACCURACY

_FORM: Final = "clock unit shape byte_order header frame_header variable simulated bands offset"
"""Options of files, of which each kind takes those that its reader has, and the last two."""


def refuse(options: argparse.Namespace, arguments: Sequence[str]) -> None:
    """Refuse an option that is stated and has no effect."""
    stated = {argument.partition("=")[0] for argument in arguments}
    for reason, names in _unused(options).items():
        for flag in (f"--{name.replace('_', '-')}" for name in names.split()):
            if flag in stated:
                raise ValueError(f"Unused option {flag}. Must be left out {reason}.")


def _unused(options: argparse.Namespace) -> dict[str, str]:
    """Options of a command that have no effect, by the reason."""
    if options.command in {"import", "info", "calibrate"}:
        return _of_files(options)
    if options.command == "align" and options.offset is not None:
        return {"with --offset": "search"}
    if options.command == "export" and options.output.suffix in NO_TABLES:
        suffix = options.output.suffix
        return {f"with {suffix}": "pixel region variable" if suffix == ".nc" else "pixel region"}
    if options.command != "separate":
        return {}
    if options.correction:
        return {"with --correction": "method emissivity"}
    aligned = {"without --correction, for the capture is aligned": "register offset"}
    names = "surroundings outdoors background_ratio prior workers"
    completing = {"with --method: 'dbthermal complete'": names}
    return aligned | (
        completing if options.method else {"without --method calibrated": "emissivity"}
    )


def _of_files(options: argparse.Namespace) -> dict[str, str]:
    """Options that neither the files of a command nor its other source take."""
    # Kinds of the files; a folder alone is a store, unless it is read as another program's.
    kinds, foreign = set[str](), options.command == "info" and options.unit is not None
    for group in options.at if options.command == "calibrate" else [options.files]:
        paths = [leaf for leaf in leaves(group) if isinstance(leaf, Path) and leaf != PLUS]
        if foreign or len(paths) != 1 or not paths[0].is_dir():
            kinds |= {kind_of(path, options) for path in paths}
    # Sources of a calibration in place of files, and what each leaves without effect.
    sources = {"blackbody": "frames", "sweep": ""}
    sources["maker"] = " ".join(["frames", "correction_output", *ACCURACY])
    stated = [source for source in sources if vars(options).get(source)]
    if options.command == "calibrate" and not (options.at or stated):
        return {}
    taken = {"bands", "offset"} if kinds else set[str]()
    for kind in kinds:
        parameters = {*signature(READERS[kind][0]).parameters}
        taken |= parameters | ({"variable"} if "name" in parameters else set())
        taken |= {"simulated"} if kind != "FLIR" else set()
    names = [name for name in _FORM.split() if name not in taken]
    names += sources[stated[0]].split() if stated and not kinds else []
    reason = " and ".join([*(f"--{source}" for source in stated), *sorted(kinds)]) or "a store"
    return {f"with {reason}": " ".join(names)}
