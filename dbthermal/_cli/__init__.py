"""Subcommands of the command line, and the line that says their stage; see `__main__`."""

import difflib
import math
import re
import sys
import threading
import time
import warnings
from argparse import ArgumentTypeError, Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from inspect import signature
from pathlib import Path
from typing import Any, Final

_UNIT_DOUBTED: Final = 200.0  # from which degrees Celsius, and below which kelvin, are doubted
PLUS: Final = Path("+")  # between the files of two cameras
_QUIET, _STEP = 1.5, 0.5  # without a word, and between two looks [s]
_STAGES: Final = {  # modules -> what is done in them; the innermost of a thread counts
    "numba.core": "compiling, once after an installation for about a minute",
    "dbthermal.separation._completion": "completing",
    "dbthermal.separation._pooling": "grouping pixels by material",
    "dbthermal.separation": "separating",
    "dbthermal.alignment": "aligning",
    "dbthermal.correction": "correcting",
    "dbthermal.readers": "reading",
    "dbthermal.store": "reading or writing",
    "dbthermal.figures": "drawing",
}


def expanded(values: list[Any]) -> list[Any]:
    """Values of an argument, in place of a pattern that no shell expanded its files by numbers."""
    result = list[Any]()
    for value in values:
        is_pattern = isinstance(value, Path) and not value.exists()
        names = Path(value.anchor).glob(str(value.relative_to(value.anchor))) if is_pattern else ()
        files = [it for it in names if it.name[0] != "." or value.name[0] == "."]  # as a shell
        files.sort(key=lambda file: ([*map(int, re.findall("[0-9]+", str(file)))], file))
        result += files or [expanded(value) if isinstance(value, list) else value]
    return result


def leaves(value: Any) -> Iterator[Any]:
    """Yield the values of an argument, whose lists may hold lists."""
    for entry in value if isinstance(value, list) else [value]:
        yield from leaves(entry) if isinstance(entry, list) else [entry]


def is_source(name: str, value: Any) -> bool:
    """Tell whether a value of an argument is a path that is read."""
    return isinstance(value, Path) and value != PLUS and not name.endswith(("output", "folder"))


def accepted(function: Callable[..., Any], options: Namespace) -> dict[str, Any]:
    """Options that a function takes by name; paths, which are opened first, are not among them."""
    names, stated = signature(function).parameters, vars(options).items()
    return {name: it for name, it in stated if name in names and not isinstance(it, Path | None)}


def finite(text: str) -> float:
    """Finite number of a text."""
    form = r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d\d?)?"
    if not re.fullmatch(form, text, re.IGNORECASE) or math.isinf(float(text)):
        rule = "Must be digits, with a decimal point"
        rule += "; times in a file go to clock= in Python" * text.endswith((".csv", ".txt", ".npy"))
        raise ArgumentTypeError(f"Invalid number '{text}'. {rule}.")
    return float(text)


def kelvin(text: str) -> float:
    """Temperature [K] of a text with its unit; 273.15 as in scipy, whose import takes long."""
    try:
        value, unit = finite(text[:-1].rstrip("\N{DEGREE SIGN} ")), text[-1:]
        temperature = round(value + {"C": 273.15, "K": 0.0}[unit], 9)
    except (KeyError, ArgumentTypeError) as error:
        rule = "Must be a number, with a decimal point, and its unit, such as 20.5C or 293.15K"
        raise ArgumentTypeError(f"Invalid temperature '{text}'. {rule}.") from error
    if unit == "C" and value > _UNIT_DOUBTED:
        warnings.warn(f"{text} is {temperature:g} K; kelvin are written {value:g}K.", stacklevel=1)
    elif unit == "K" and value < _UNIT_DOUBTED:
        degrees = f"{temperature - 273.15:g} degrees Celsius"
        warnings.warn(f"{text} is {degrees}; these are written {value:g}C.", stacklevel=1)
    return temperature


def kelvin_or_path(text: str) -> float | Path:
    """Temperature, or the path of a file."""
    form = r"[-+\N{MINUS SIGN}\N{EN DASH}\d.,]*\d[.,]? ?(deg\w* ?)?\W?[A-Za-z]?"
    return kelvin(text) if re.fullmatch(form, text) else Path(text)


def sources_and_targets(options: Namespace) -> tuple[list[Path], list[Path]]:
    """Paths that a command reads, which must exist, and writes, which must be free."""
    arguments = vars(options).items()
    sources = [leaf for name, value in arguments for leaf in leaves(value) if is_source(name, leaf)]
    targets = [value for name, value in arguments if name.endswith(("output", "folder")) and value]
    end = {"explore": ".ipynb", "report": ".html", "export": ""}.get(options.command, ".zarr")
    if missing := [path for path in sources if not path.exists()]:
        raise FileNotFoundError(f"No file or folder '{missing[0]}'. Must exist.")
    taken = [source.resolve() for source in sources]
    for path in targets:
        place = path.resolve()
        if any(place in (used, *used.parents) or used in place.parents for used in taken):
            label = f"Invalid output '{path}': an input or another output lies there"
            raise ValueError(f"{label}. Must be another place.")
        taken.append(place)
        if "output" in options and not path.name.endswith(end):
            raise ValueError(f"Invalid output '{path}'. Must end in '{end}'.")
        may_exist = getattr(options, "overwrite", path.is_dir())
        if (path.exists() or path.is_symlink()) and not may_exist:
            rule = "new, or --overwrite" if "overwrite" in options else "new, or a folder"
            raise FileExistsError(f"There is something at '{path}'. Must be {rule}.")
    return sources, targets


def plain(value: Any) -> Any:
    """Value as JSON takes it: an array or number of NumPy as a list or number, else as text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def lines_of(summary: Any, indent: str = "") -> Iterator[str]:
    """Summary as text: a line for each entry that is not empty, sentence or command."""
    for key, value in summary.items():
        if key in {"answer", "next", "numbers"}:
            yield from (f"{indent}{it}" for it in value if key != "numbers")  # for programs
            continue
        entries = value if isinstance(value, dict) else dict[str, Any]()
        if any(isinstance(entry, dict | list | str) for entry in entries.values()):
            yield f"{indent}{key}:"
            yield from lines_of(value, indent + "  ")
            continue
        words = [f"{name} {it if it is None else f'{it:g}'}" for name, it in entries.items()]
        if line := ", ".join(words if isinstance(value, dict) else map(str, leaves(value))):
            yield f"{indent}{key}: {line}"


def suggestion(reason: str) -> str:
    """Question after the name that is most like an unknown one, of those that a message lists."""
    unknown = re.search(r"'([^']+)'.*(?:Must be one of (?=[\[(])|choose from )(.*)", reason)
    if unknown is None or "Did you mean" in reason:
        return ""
    wrong, names = unknown.group(1), re.findall(r"'([^']+)'", unknown.group(2))
    names = names or unknown.group(2).strip(" .)").split(", ")
    words = [name for name in names if wrong.lower() in name.lower()]
    like = [*difflib.get_close_matches(wrong, names, 1, 0.7), *words]
    return f" Did you mean '{like[0]}'?" if like and like[0] != wrong else ""


@contextmanager
def stage_shown(command: str) -> Iterator[None]:
    """Show the stage of this thread on the terminal, and at the end the seconds that it took."""
    thread, start, ended = threading.get_ident(), time.monotonic(), threading.Event()
    stream: Any = sys.stderr
    write, last = stream.write, [start]  # time of what was written last, beside the stage

    def write_and_note(text: str) -> Any:
        last[0] = time.monotonic()
        return write(text)

    def show() -> None:
        while not ended.wait(_STEP):
            if time.monotonic() - last[0] > _QUIET:
                write(f"\r{command}: {_stage(thread)}, {time.monotonic() - start:.0f} s\x1b[K")
                stream.flush()

    showing = threading.Thread(target=show, daemon=True)
    if is_terminal := stream.isatty():
        stream.write = write_and_note
        showing.start()
    try:
        yield
    finally:
        ended.set()
        if is_terminal:
            showing.join()
            stream.write = write
            write("\r\x1b[K")
    write(f"{command}: {time.monotonic() - start:.1f} s\n")


def _stage(thread: int) -> str:
    """What a thread does, by the modules of its calls."""
    frame = sys._current_frames().get(thread)
    while frame is not None:
        module = str(frame.f_globals.get("__name__"))
        for name, stage in _STAGES.items():
            if module.startswith(name):
                return stage
        frame = frame.f_back
    return "working"
