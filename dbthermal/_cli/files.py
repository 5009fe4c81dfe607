"""Stores and files of the commands: read, written, and summarised."""

import re
from argparse import Namespace
from collections.abc import Callable, Sequence
from contextlib import suppress
from inspect import Parameter, signature
from itertools import groupby
from pathlib import Path
from tempfile import gettempdir
from typing import Any, Final
from warnings import catch_warnings, filterwarnings

import numpy as np
import xarray as xr

from dbthermal import _arrays, readers, schema, store
from dbthermal._cli import PLUS, accepted, is_source, leaves
from dbthermal.explorer._answer import answer
from dbthermal.readers import _formats as formats
from dbthermal.response import ACCURACY
from dbthermal.store import _integrity as integrity

_MADE_BY = {
    "capture": "import",
    "correction": "calibrate --correction-output",
    "corrected": "correct ('separate --correction' takes raw counts)",
    "response": "calibrate",
    "separated": "separate",
}
READERS: Final[dict[str, tuple[Callable[..., xr.Dataset], tuple[str, ...]]]] = {
    "TIFF": (readers.tiff, (".tif", ".tiff", ".btf", ".png")),
    "arrays": (readers.array, (".npy", ".npz", ".nc", ".cdf", ".h5", ".hdf5", ".mat", ".zarr")),
    "sequences": (readers.sequence, (".sfmov", ".hcc")),
    "FLIR": (readers.flir, (".fff", ".seq", ".csq", ".jpg", ".jpeg")),
    "raw files": (readers.raw, ()),
}
"""Kind of files -> its reader, whose arguments are the options, and its suffixes."""
PICTURES: Final = (".png", ".pdf", ".svg")
ANIMATED: Final = (".gif", ".webp")
NO_TABLES: Final = (".tif", ".nc", *PICTURES, *ANIMATED)
_UNEQUAL: Final = 0.05  # of the duration, by which two cameras' recordings may differ
_NO_RATE: Final = 1e-6  # that no file states [Hz]
# Options of files, of which each kind takes those that its reader has, and the last two.
_FORM: Final = "clock unit shape byte_order header frame_header variable simulated bands offset"
_NOT_RECORDED: Final = {"dry_run", "json", "overwrite", "place", "traceback"}


def opened(path: Path) -> xr.Dataset:
    """Dataset of a store, or stage `capture` of a recording."""
    dataset = schema.check_kelvin(store.open_dataset(path))
    if "log_time" not in dataset:  # what is made of a recording has its attributes, and no log
        return dataset
    from dbthermal.instruments import recording  # noqa: PLC0415 - optional

    return recording.open_capture(path)


def staged(options: Namespace, **stages: str) -> list[xr.Dataset]:
    """Stores that arguments name, each of a stage of `schema`, or of one of several: ``a|b``."""
    datasets = {name: opened(getattr(options, name)) for name in stages}
    actual = {name: stage_of(dataset) for name, dataset in datasets.items()}
    wrong = [name for name, wanted in stages.items() if actual[name] not in wanted.split("|")]
    for name in wrong:
        fitting = [argument for argument in wrong if actual[name] in stages[argument].split("|")]
        hint = f" Exchanged with the {fitting[0]}?" if fitting else ""
        label = f"{name} '{getattr(options, name)}' of stage '{actual[name]}'"
        stage = stages[name].partition("|")[0]
        rule = f"Must be of stage '{stage}', as from: dbthermal {_MADE_BY[stage]}"
        raise ValueError(f"Invalid {label}. {rule}.{hint}")
    return [*datasets.values()]


def kind_of(path: Path, options: Namespace) -> str:
    """Kind of a recording's file: by its first bytes, its suffix, or a shape that is stated."""
    reader, suffix, raw = formats.reader_of(path), path.suffix.lower(), options.shape is not None
    kinds = [kind for kind, (function, _) in READERS.items() if function.__name__ == reader]
    kinds += [kind for kind, (_, suffixes) in READERS.items() if suffix in suffixes]
    if not reader and raw:  # of any suffix but those of TIFF and arrays
        kinds = [*(kind for kind in kinds if kind != "FLIR"), "raw files"]
    if not kinds:
        formats.refuse_text(path)  # a file that is missing has no format
        label = f"Unknown format of '{path.name}', by its first bytes and '{suffix}'"
        rule = "Must be a recording, or its TIFF; bare numbers need --shape and --byte-order"
        raise ValueError(f"{label}. {rule}.")
    return kinds[0]


def recording(paths: list[Path], options: Namespace, camera: int = 0) -> xr.Dataset:
    """Recording of one camera, by the kind of its files, with its origin; large ones on disk."""
    kind = kind_of(paths[0], options)
    reader, _ = READERS[kind]
    if kind != "raw files":
        formats.refuse_text(paths[0])  # of a suffix that promises more
    stated = _arguments(reader, options, paths[0].name, camera)
    selected = {}  # by the reader, not all at hand
    for name in {"frames", "rows"} & stated.keys():
        if stated.pop(name) and "rows" in options:
            stated[name] = selected[name] = between(options, name)
    several = kind in {"FLIR", "TIFF"}  # whose files make one recording together
    if len(paths) > 1 and not several:
        raise ValueError(f"Invalid list of {len(paths)} {kind}. Must be joined in a file or store.")
    with _arrays.on_disk(_room(options)):  # films that are large
        movie = reader(paths if several else paths[0], **stated)
    if "frames" in selected and (first := stated["frames"].start):  # times since the files' first
        ends = reader(paths, **{**stated, "frames": slice(0, first + 1, first)})
        lead = ends["exposure_time"].values[1]
        movie["exposure_time"].values[:] += lead
        start = {"start": ends.attrs["start"]} if "start" in ends.attrs else {}
        movie = movie.assign_coords(time=movie["time"] + lead).assign_attrs(start)
    movie = _selected(movie, options, paths[0], *selected) if "rows" in options else movie
    return movie.assign_attrs(origin="simulated") if options.simulated else movie


def _selected(movie: xr.Dataset, options: Namespace, path: Path, *by_reader: str) -> xr.Dataset:
    """Selected frames and rows; ValueError if some are not in the file or store."""
    for name, dim in (("frames", "time"), ("rows", "y")):
        selected = between(options, name)
        movie = movie if name in by_reader else movie.isel({dim: selected})
        check_all(movie.sizes[dim], options, name, f"'{path.name}'")
    return movie


def check_all(number: int, options: Namespace, name: str, label: str) -> None:
    """Raise ValueError if fewer frames or rows than are selected are there."""
    ends, selected = vars(options)[name] or [], between(options, name)
    if number < (wanted := len(range(selected.start, selected.stop or 0, selected.step))):
        rule = f"it has {number} of these {wanted}. Must have all"
        raise ValueError(f"Invalid --{name} {' '.join(map(str, ends))} of {label}: {rule}.")


def _arguments(
    reader: Callable[..., xr.Dataset], options: Namespace, file: str, camera: int
) -> dict[str, Any]:
    """Arguments of a reader, by the options of the same names; ValueError if one is missing."""
    parameters, stated = signature(reader).parameters, accepted(reader, options)
    if "unit" in parameters:
        stated.setdefault("unit", "count")
    for name, values in {"clock": options.clock, "name": options.variable}.items():
        if values and name in parameters:
            stated[name] = values[min(camera, len(values) - 1)]
    stated |= {"shape": tuple(options.shape)} if "shape" in stated else {}
    for name, parameter in parameters.items():
        required = parameter.kind is Parameter.KEYWORD_ONLY and parameter.default is Parameter.empty
        if required and name not in stated:
            label = f"Missing --{name.replace('_', '-')}: '{file}' does not tell"
            raise ValueError(f"{label}. Must be stated.")
    return stated


def between(options: Namespace, name: str, most: int | None = None) -> slice:
    """Frames or rows that are selected: the first N, or from A up to B; every so many frames."""
    ends: list[int] = vars(options).get(name) or []
    first, end = (ends[0] if len(ends) > 1 else 0), (ends[-1] if ends else most)
    every = vars(options).get("every", 1) if name == "frames" else 1
    if len(ends) > 2 or first < 0 or (end is not None and not first < end < 2**31):
        rule = "Must be first and end, which is larger and below 2^31: 100 400"
        rule += "; or one number from 1" if name == "frames" else ""
        raise ValueError(f"Invalid --{name} {' '.join(map(str, ends))}. {rule}.")
    if every < 1:
        raise ValueError(f"Invalid --every {every}. Must be 1 or more.")
    return slice(first, end, every)


def capture(paths: list[Path], options: Namespace, offset: Any) -> xr.Dataset:
    """Capture of two bands or more: a store, or the files of each camera, with '+' between."""
    if len(paths) == 1 and _is_store(paths[0]):
        return staged(Namespace(capture=paths[0]), capture="capture|corrected")[0]
    number, cameras = len(options.bands or "ab"), _cameras(paths, options)
    if len(cameras) < 2 or paths.count(PLUS) not in {0, len(cameras) - 1}:
        label = f"Invalid {len(paths)} files {[*map(str, paths[:3])]}: of which camera is not clear"
        rule = "a file of two bands twice, with --variable for each"
        raise ValueError(f"{label}. Must be one of each camera, or: a*.tif + b*.tif; {rule}.")
    if options.bands is None:
        raise ValueError("Missing --bands. Must name all, such as: --bands 8-14 9.5.")
    if number != len(cameras):
        label = f"Invalid --bands of {number} names: {', '.join(options.bands)}"
        raise ValueError(f"{label}. Must be {len(cameras)}, one for each camera, with spaces.")
    movies = [recording(files, options, camera) for camera, files in enumerate(cameras)]
    with _arrays.on_disk(_room(options)):
        return readers.two_bands(*movies, bands=options.bands, offset=offset)


def _cameras(paths: list[Path], options: Namespace) -> list[list[Path]]:
    """Files of each camera, with '+' between; without it, of two, of all bands or stores, one."""
    number = len(vars(options).get("bands") or "ab")
    cameras = [[*group] for is_plus, group in groupby(paths, PLUS.__eq__) if not is_plus]
    if PLUS not in paths and (len(paths) in {2, number} or all(map(_is_store, paths))):
        cameras = [[path] for path in paths]
    for name, values in {"clock": options.clock or (), "variable": options.variable or ()}.items():
        if len(values) not in {0, 1, len(cameras)}:
            label = f"Invalid --{name} of {len(values)} values"
            raise ValueError(f"{label}. Must be one, or one for each camera, here {len(cameras)}.")
    return cameras


def _room(options: Namespace) -> Path:
    """Folder for films on disk: beside the output, or that of the system."""
    folder: Path = (vars(options).get("output") or Path(gettempdir(), "film")).absolute().parent
    return folder if folder.is_dir() else Path(gettempdir())


def make_capture(options: Namespace) -> dict[str, Any]:
    """Command `import`."""
    from dbthermal import separation  # noqa: PLC0415 - takes long

    scene = capture(options.files, options, options.offset)
    if options.files[0].is_dir() and len(options.files) == 1:
        scene = _selected(scene, options, options.files[0])
    if options.rows:  # of the detector, by which `correct` selects the rows of its correction
        above = scene.attrs.get("rows", [0])[0]
        scene = scene.assign_attrs(rows=[above + row for row in options.rows])
    # What speaks against separating it later.
    stamps = scene.get("exposure_time", scene["time"])
    lengths = np.atleast_1d(stamps.max("time") - stamps.min("time"))
    if np.ptp(lengths) > _UNEQUAL * lengths.max():
        label = f"The cameras recorded {' and '.join(f'{length:.1f} s' for length in lengths)}"
        scene = schema.warned(scene, f"{label}. Must be the same time: is a part of one missing?")
    fewest = separation.get_method("subspace").minimum_frames
    if (frames := scene.sizes["time"]) < fewest:
        rule = f"Must be at least {fewest} to be separated, better 200 to 400"
        scene = schema.warned(scene, f"Too few frames of the capture: {frames}. {rule}.")
    return saved(scene, options)


def saved(result: xr.Dataset, options: Namespace, path: Path | None = None) -> dict[str, Any]:
    """Save a result with its provenance, a capture by rows, which may be lazy, and describe it."""
    path, blocks = path or options.output, [slice(None)]
    if "counts" in result and result["counts"].ndim == 4:
        blocks = [*_arrays.blocks(result["counts"].shape)]
    store.save_rows(_arrays.slabs(result, blocks), path, provenance(options))
    return {str(path): summary(store.open_dataset(path))}


def provenance(options: Namespace) -> dict[str, Any]:
    """Provenance of a command: its options, and the checksums of what it reads."""
    parameters, inputs = dict[str, Any](), dict[str, Path]()
    for name, value in vars(options).items():
        sources = [leaf for leaf in leaves(value) if is_source(name, leaf)]
        inputs |= {f"{name} {number}": path for number, path in enumerate(sources)}
        plain = [leaf for leaf in leaves(value) if leaf is not None and not isinstance(leaf, Path)]
        if plain and name not in _NOT_RECORDED:
            parameters[name] = plain if isinstance(value, list) else value
    return store.provenance(parameters, inputs)


def info(options: Namespace) -> dict[str, Any]:
    """Command `info`; it describes each of several stores."""
    cameras = _cameras(options.files, options)
    keys = [f"{it[0]}{f' ({n + 1})' * (cameras.count(it) > 1)}" for n, it in enumerate(cameras)]
    return {key: _described(cameras[n], options, n) for n, key in enumerate(keys)}


def _described(paths: list[Path], options: Namespace, camera: int) -> dict[str, Any]:
    """Summary of a store, or of a camera's recording; its sizes even without a clock."""
    if len(paths) == 1 and _is_store(paths[0]) and options.unit is None:
        return summary(opened(paths[0]), everything=True)
    try:
        return summary(recording(paths, options, camera), everything=True)
    except ValueError as error:
        if options.clock is not None or not re.match("Missing (--)?clock", str(error)):
            raise
    with catch_warnings():
        filterwarnings("ignore", ".*, (and|by) clock= ")  # of a rate that is not this one
        lines = _described(paths, Namespace(**{**vars(options), "clock": [_NO_RATE]}), camera)
    lines = {it: value for it, value in lines.items() if it not in {"seconds", "frame_rate_Hz"}}
    notes = lines["attributes"].get("warnings", [])
    notes[:] = [re.sub(", (and|by) clock= .*?[.] ", ". ", it) for it in notes]
    return lines | {"clock": "not in the file: state the frame rate by --clock"}


def _is_store(path: Path) -> bool:
    """Tell whether a folder is a store of dbthermal or a part of one, not one of other programs."""
    group, member = path.parent / "zarr.json", path / "zarr.json"
    if (path / integrity.SUMS).is_file():
        return True
    if not member.is_file():
        return False
    text = (group if group.is_file() else member).read_text(encoding="utf-8", errors="replace")
    return "provenance" in text or "frames_written" in text or '"attributes"' not in text


def refuse_unused(options: Namespace, arguments: Sequence[str]) -> None:
    """Refuse an option that is stated and has no effect."""
    stated = {argument.partition("=")[0] for argument in arguments}
    for reason, names in _unused(options).items():
        for flag in sorted(stated & {f"--{name.replace('_', '-')}" for name in names.split()}):
            raise ValueError(f"Unused option {flag}. Must be left out {reason}.")


def _unused(options: Namespace) -> dict[str, str]:
    """Options of a command that have no effect, by the reason."""
    if options.command in {"import", "info", "calibrate"}:
        return _of_files(options)
    timed = {"with --offset": "search"} if vars(options).get("offset") is not None else {}
    if options.command == "align":
        return timed
    if options.command == "export" and options.output.suffix in NO_TABLES:
        suffix = options.output.suffix
        return {f"with {suffix}": "pixel region variable" if suffix == ".nc" else "pixel region"}
    if options.command != "separate":
        return {}
    if options.correction or options.corrected_by_camera:
        return timed | {"with --correction or --corrected-by-camera": "method emissivity"}
    aligned = {"without --correction, for the capture is aligned": "register offset search"}
    names = "surroundings outdoors background_ratio prior workers"
    later = {"with --method: 'dbthermal complete'": names}
    return aligned | (later if options.method else {"without --method calibrated": "emissivity"})


def _of_files(options: Namespace) -> dict[str, str]:
    """Options that neither the files of a command nor its other source take."""
    # Kinds of the files; a folder alone is a store, unless it is read as another program's.
    kinds, foreign = set[str](), options.command == "info" and options.unit is not None
    groups = options.at if options.command == "calibrate" else [options.files]
    listed = [[it for it in leaves(group) if is_source("", it)] for group in groups]
    for paths in listed:
        if foreign or len(paths) != 1 or not _is_store(paths[0]):
            kinds |= {kind_of(path, options) for path in paths}
    # Sources of a calibration in place of files, and what each leaves without effect.
    sources = {"blackbody": "frames", "sweep": ""}
    sources["maker"] = " ".join(["frames", "correction_output", *ACCURACY])
    stated = [source for source in sources if vars(options).get(source)]
    if not (stated or (listed and all(listed))):
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


def outline(dataset: xr.Dataset) -> dict[str, Any]:
    """Stage, sizes, bands and clock of a dataset."""
    lines: dict[str, Any] = {"stage": stage_of(dataset), "sizes": dict(dataset.sizes)}
    if "band" in dataset.coords:
        lines["bands"] = [str(band) for band in np.atleast_1d(dataset["band"].values)]
    if dataset.sizes.get("time", 0) > 1 and "time" in dataset.coords:
        time = dataset["time"].values
        lines["seconds"] = round(float(time[-1] - time[0]), 6)
        steps = np.diff(time)  # of whole milliseconds their mean is the period, without gaps
        lines["frame_rate_Hz"] = round(1 / steps[steps < 1.5 * np.median(steps)].mean(), 6)
    return lines


def summary(dataset: xr.Dataset, *, everything: bool = False) -> dict[str, Any]:
    """Outline, flags, clocks, views and medians of a dataset; with everything its attributes."""
    lines, attrs = outline(dataset), dataset.attrs
    if lines["stage"] == "separated" and "x" in dataset.sizes:
        sentences, numbers = answer(dataset)
        lines = {"answer": sentences, "numbers": numbers, **lines}
    # Shares of the flags, frames that were lost or bridged, and the offset of the clocks.
    for name in ("status", "frame_flags"):
        if name in dataset and "flag_masks" in dataset[name].attrs:
            lines[f"{name}_shares"] = _shares(dataset[name])
    names = ("frames_missing", "frames_bridged", "frames_lost", "time_offset", "time_offset_std")
    for name in (name for name in names if attrs.get(name) is not None):
        unit, decimals = ("_s", 6) if name.startswith("time") else ("", 1)
        lines[f"{name}{unit}"] = np.round(attrs[name], decimals).tolist()
    lines |= _shifts(dataset)
    # Medians over the pixels without a flag, where every band has one.
    for name, unit in (("netd", "_K"), ("emissivity", "")):
        if name in dataset and dataset[name].dims[:1] == ("band",):
            good = dataset[name].astype(float).where(np.isfinite)
            good = good.where(dataset["status"] == 0 if "status" in dataset else True)
            medians = good.median([dim for dim in good.dims if dim != "band"])
            if medians.notnull().all():
                lines[f"median_{name}{unit}"] = medians.round(4).to_series().to_dict()
    if not everything:
        return lines
    lines["variables"] = {
        str(name): f"{array.dtype} {array.dims} [{array.attrs.get('units', '-')}]"
        for name, array in dataset.data_vars.items()
    }
    long = ("provenance", "files", "transform")
    lines["attributes"] = {name: value for name, value in attrs.items() if name not in long}
    return lines | {name: attrs.get(name, {}) for name in long[:2]}


def stage_of(dataset: xr.Dataset) -> str:
    """Stage of `schema` that a dataset fits, "other" if none."""
    fitting = ["other"]
    for stage, variables in sorted(schema.STAGES.items(), key=lambda stage: len(stage[1])):
        with suppress(TypeError, ValueError):
            schema.check(dataset, stage)
            raw = "counts" in variables and dataset["counts"].dtype.kind != "f"
            if stage not in {"capture", "corrected"} or raw == (stage == "capture"):
                fitting.append(stage)
    return fitting[-1]


def _shifts(dataset: xr.Dataset) -> dict[str, Any]:
    """Rows down, columns right by which views, at their centre, and reflections lie elsewhere."""
    lines, views = dict[str, Any](), len(dataset.attrs.get("transform", ())) / 9
    if {"y", "x"} <= dataset.sizes.keys() and views and views == dataset.sizes.get("band"):
        column, row = (0.5 * (dataset.sizes[dim] - 1) for dim in ("x", "y"))
        matrices = np.reshape(dataset.attrs["transform"], (-1, 3, 3))
        right, down, scale = (matrices @ [column, row, 1.0]).T
        shifts = np.stack([down / scale - row, right / scale - column], axis=1).round(2).tolist()
        lines["view_shift_pixel"] = dict(zip(map(str, dataset["band"].values), shifts, strict=True))
    if "reflection_shift" in dataset:
        shifts = dataset["reflection_shift"].median(("y", "x")).values.round(2).tolist()
        lines["reflection_shift_pixel"] = dict(zip(("rows", "columns"), shifts, strict=True))
    return lines


def _shares(flags: xr.DataArray) -> dict[str, float]:
    """Share of the values without a flag, and of each flag found."""
    shares = {"no_flag": float((flags.values == 0).mean())}
    names = str(flags.attrs["flag_meanings"]).split()
    shares |= {name: float(schema.has_flag(flags, name).mean()) for name in names}
    return {name: round(share, 6) for name, share in shares.items() if share or name == "no_flag"}
