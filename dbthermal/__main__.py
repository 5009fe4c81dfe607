"""Command line of dual-band thermal videography: ``dbthermal``, or ``python -m dbthermal``.

Exit status: 0 if done, 1 if refused, with the reason in one line, 2 if the command is not
understood, 130 if it was interrupted. The summary goes to the standard output, all else to the
standard error.
"""

import argparse
import difflib
import json
import os
import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import cache
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import Any, Final, NoReturn

from dbthermal import __version__
from dbthermal._cli import is_source, leaves, stage_shown

__all__ = ["main"]
__dir__ = __all__.copy

_EXTRAS: Final = {
    **dict.fromkeys(("anywidget", "ipywidgets"), "explorer"),
    "jinja2": "report",
    **dict.fromkeys(("pydantic", "serial", "usb", "yaml"), "instruments"),
    **dict.fromkeys(("h5py", "imagecodecs", "tifffile"), "recordings"),
    "av": "video",
    "matplotlib": "figures",
    "skimage": "materials",
}
"""Library -> the extra that has it."""

_UNIT_DOUBTED: Final = 200.0  # from which degrees Celsius, and below which kelvin, are doubted


def _kelvin(text: str) -> float:
    """Temperature [K] of a text with its unit; 273.15 as in scipy, whose import takes long."""
    try:
        value, unit = float(text[:-1]), text[-1:]
        kelvin = value + {"C": 273.15, "K": 0.0}[unit]
    except (KeyError, ValueError) as error:
        rule = "Must be a number, with a decimal point, and its unit, such as 20.5C or 293.15K"
        raise argparse.ArgumentTypeError(f"Invalid temperature '{text}'. {rule}.") from error
    if unit == "C" and value > _UNIT_DOUBTED:
        warnings.warn(f"{text} is {kelvin:g} K; kelvin are written {value:g}K.", stacklevel=1)
    elif unit == "K" and value < _UNIT_DOUBTED:
        degrees = f"{kelvin - 273.15:g} degrees Celsius"
        warnings.warn(f"{text} is {degrees}; these are written {value:g}C.", stacklevel=1)
    return kelvin


def _kelvin_or_path(text: str) -> float | Path:
    return _kelvin(text) if re.fullmatch(r"[-+\d.,]+ ?\W?[A-Za-z]?", text) else Path(text)


_KINDS: Final[dict[str, Any]] = {
    "path": Path,
    "text": str,
    "number": float,
    "whole": int,
    "kelvin": _kelvin,
    "point": _kelvin_or_path,
}
_ARGUMENTS: Final = """
files path+             files of one camera, then a '+' and the other's; or a store
session path            YAML file, see dbthermal.instruments.session
folder path             new folder for what is written
capture path            store of a capture
correction path?        store of gain and offset
--corrected-by-camera flag  in place of it: each camera corrects gain and offset itself
response path           store of the cameras' response
result path             store of a result
shown path*             its capture, and the cameras' response, to be shown beside it
materials text*         as listed by 'data'; all by default
--output path!          new {output}
--overwrite flag        replace the output
--dry-run flag          only say what would be read, with sizes, and written
--json flag             print the summary as JSON
--traceback flag        show where an error was raised
--bands text+           names of the bands: 8-14 9.5
--unit text             of the numbers in TIFF, raw files and arrays: 'count' if not stated
--clock number+         frame rate [Hz], of each camera if they differ; FLIR's files have times
--shape whole2          rows and columns of raw files [pixel]
--byte-order little|big of the numbers in raw files
--header whole=0        before the first frame of raw files [byte]
--frame-header whole=0  before each frame of raw files [byte]
--simulated flag        no camera has recorded it: all that is made of it says so
--variable text         name of an array in a file of several, or in a result
--offset number+        start of each other camera after the first's [s]; else found
--simulate flag         use emulated devices
--side-by-side flag     cameras side by side, in place of one window for both
--at point+&            temperature of a blackbody, as 20C or 293.15K, and its files; repeated
--blackbody path        in place of --at: a store of all temperatures
--sweep text2           in place of --at: folder and session of a sweep by 'record'
--maker path            in place of --at: a capture of FLIR's files, for the maker's constants
--frames whole+         the first N, or from A up to B: A B; of each temperature 64
--every whole=1         take one frame of so many
--rows whole2           take rows Y0 up to Y1 of the image
--blackbody-accuracy number  error that all temperatures share, standard deviation [K] (0.1)
--blackbody-emissivity number  of the blackbody, which mirrors the room (0.97)
--room-temperature kelvin  of that room, as 22C
--offset-std number+    drift of the level of each camera since [K] (0.5)
--gain-std number+      error of the gain of each camera (0.01)
--pattern-std number+   drift of the pixels of each camera since [K] (0.1)
--background-ratio-std number  colour of what surfaces mirror, about gray (0.02)
--correction-output path   store of gain and offset, where the blackbody fills the view
--no-shutter flag       no camera has a shutter
--time-constant number  thermal, of the pixels [s]
--register none|translation|affine|homography   between the views (homography); none: on one grid
--search whole=5        largest delay that is sought, either way [frame]
--reference text        band whose frames are left as they are in time
--correction path       store of gain and offset: all steps of a raw capture, by rows
--method text           one step alone, by rows: {methods}
--emissivity number+    of each band, for the method 'calibrated'
--surroundings kelvin   temperature of what is reflected, as 22C
--outdoors flag         the sky is mirrored, which is not gray: wider bars
--background-ratio number2  changes of what is mirrored, second band over first; its deviation
--prior text            material of pixels that cannot be measured, as listed by 'data'
--workers whole=2       number of threads
--title text            heading of the report
--author text           name below it
--logo path             picture beside it, *.png
--noise number!         of the camera without a filter [K]
--seconds number=35     length of the capture
--rate number=10        frame rate [Hz]
--span number=25        rise of the object's temperature [K]
--amplitude number=3    height of the reflected changes [K]
--pixel whole2&         row and column of a curve; repeated
--region whole4&        rows Y0 up to Y1, columns X0 up to X1 of a curve; repeated
"""
"""Argument, kind and help: ``!`` is required, ``&`` may be repeated, ``=`` is the default."""

_VALUES: Final = {
    "--at": "TEMPERATURE FILE",
    "--sweep": "FOLDER SESSION",
    "--shape": "ROWS COLUMNS",
    "--pixel": "Y X",
    "--region": "Y0 Y1 X0 X1",
    "--rows": "Y0 Y1",
    "path": "PATH",
    "text": "NAME",
    "number": "NUMBER",
    "whole": "N",
    "kelvin": "TEMPERATURE",
}
"""Option, or its kind -> names of its values in the help."""

_METHODS: Final = (
    "subspace (what the default call begins with), calibrated (emissivities as stated), "
    "apparent (temperature as of a black body)"
)
_OUTPUTS: Final = {
    "export": "file *.csv, *.tif, *.nc, *.gif, *.webp, *.png, *.pdf or *.svg",
    "explore": "notebook *.ipynb",
    "report": "page *.html",
}
"""Command -> kind of its output, if that is no store."""

_FORM: Final = "--unit --clock --shape --byte-order --header --frame-header --variable --simulated"
_COMMANDS: Final = f"""
demo demo.demo folder --side-by-side
write the files of a simulated rig, to try everything without cameras, and say what to do next
try-it
try-it --side-by-side

info files.info files {_FORM}
say what a store or recording is, and of a result how hot, how sure and how much of it
result.zarr
video.seq
a.tif --clock 30

import files.make_capture files --bands --offset {_FORM} --frames --every --rows --output
make a capture of two cameras' files: FLIR, Telops, TIFF, raw, NumPy, HDF5, MATLAB, NetCDF, zarr
a.tif b.tif --bands 8-14 9.5 --clock 30 --offset 0 -o scene.zarr
a*.tif + b*.tif --bands 8-14 9.5 --clock 12 10 --offset 0 -o scene.zarr
wide.seq narrow.seq --bands 8-14 9.5 --frames 0 3000 --every 3 -o scene.zarr

calibrate steps.calibrate --at --blackbody --sweep --maker --frames --bands {_FORM} \
    --blackbody-accuracy --blackbody-emissivity --room-temperature --offset-std --gain-std \
    --pattern-std --background-ratio-std --correction-output --output
fit the cameras' response, and each pixel's gain and offset, to a blackbody
--at 10C a10.tif b10.tif --at 30C a30.tif b30.tif --at 50C a50.tif b50.tif --at 70C a70.tif \
    b70.tif --bands 8-14 9.5 --clock 30 -o response.zarr --correction-output nuc.zarr
--sweep recordings response -o response.zarr
--maker scene.zarr -o response.zarr

correct steps.correct capture correction --corrected-by-camera --no-shutter --time-constant --output
correct a capture: gain and offset, shutter events, bad pixels, lag
scene.zarr nuc.zarr -o corrected.zarr
scene.zarr --corrected-by-camera -o corrected.zarr

align steps.align capture --register --offset --search --reference --output
bring two cameras onto one clock and one pixel grid
corrected.zarr -o aligned.zarr
corrected.zarr --register none --offset 0 -o aligned.zarr

separate steps.separate capture response --correction --register --offset --method \
    --emissivity --surroundings --outdoors --background-ratio --prior --workers --output
separate emission and reflection: temperatures, emissivities, deviations, status
aligned.zarr response.zarr -o result.zarr
scene.zarr response.zarr --correction nuc.zarr -o result.zarr
aligned.zarr response.zarr --method calibrated --emissivity 0.86 0.72 -o result.zarr

complete steps.complete result capture response --surroundings --prior --workers --output
complete the result of a single method by what is known of the scene
result.zarr aligned.zarr response.zarr --surroundings 22C -o completed.zarr

plan steps.plan materials --noise --seconds --rate --span --amplitude --outdoors
say which accuracy a capture can have, by material and filter, before it is recorded
'plate window glass' water --noise 0.03

record record.record session folder --simulate
record a session with the rig, or with emulated devices; a dry run names the devices
sessions/scene.yaml recordings --dry-run
sessions/scene.yaml recordings --simulate

export export.export result --variable --pixel --region --output
write a result for other programs: curves, film, picture, or everything as NetCDF
result.zarr --pixel 120 200 --region 10 60 10 90 -o curves.csv
result.zarr --variable background_temperature -o film.tif
result.zarr -o object.png
result.zarr -o object.gif
result.zarr -o result.nc

explore export.explore result shown --output
make a notebook to look around in a result or a capture, for JupyterLab
result.zarr aligned.zarr response.zarr -o look.ipynb

report export.report result shown --region --title --author --logo --output
write a report on a result, one HTML file that needs no network
result.zarr aligned.zarr response.zarr --region 10 60 10 90 -o scene.html

data steps.data
list the filters and materials that come with the package
--json

completion main.completion
print the completion of commands for bash and zsh, taken over by: eval "$(dbthermal completion)"
-
"""
"""Command, its function and arguments; its summary; examples."""


class _Parser(argparse.ArgumentParser):
    """Parser that asks after the name that was meant."""

    def error(self, message: str) -> NoReturn:
        """Print the usage and the message, and exit."""
        options = re.findall(r"(?m)^--[\w-]+", _ARGUMENTS)
        for wrong in re.findall(r"unrecognized arguments: (--\S+)", message):
            listed = ", ".join(f"'{option}'" for option in options)
            message += _suggestion(f"'{wrong}': choose from {listed}")
        super().error(message + _suggestion(message))


def _parser() -> argparse.ArgumentParser:
    """Parser of all commands, made of the tables `_ARGUMENTS` and `_COMMANDS`."""
    # The command itself, and the table of all arguments.
    plain: Any = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False}
    order = "In this order: demo (or import), calibrate, correct, align, separate, report, explore."
    parser = _Parser("dbthermal", description=f"{__doc__}\n{order}", **plain)
    parser.add_argument("--version", action="version", version=f"dbthermal {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    table = {line.split()[0]: line.split(maxsplit=2)[1:] for line in _ARGUMENTS.split("\n")[1:-1]}
    for block in re.sub(" {2,}", " ", _COMMANDS).strip().split("\n\n"):
        # A block of the table: the command with its arguments, its summary, its examples.
        head, summary, *lines = block.splitlines()
        name, place, *arguments = head.split()
        examples = [f"  dbthermal {name} {line}".rstrip(" -") for line in lines]
        command = commands.add_parser(
            name,
            help=summary,
            description=f"{summary[0].upper()}{summary[1:]}.",
            epilog="\n".join(["examples:", *examples]),
            **plain,
        )
        command.set_defaults(place=place)
        command._negative_number_matcher = re.compile(r"-[\d.]+[CK]?$")  # no option: -5C
        writes = ["--overwrite"] if "--output" in arguments else []
        for argument in (*arguments, *writes, "--dry-run", "--json", "--traceback"):
            short = ["-o"] if argument == "--output" else []
            kind, text = table[argument]
            text = text.format(output=_OUTPUTS.get(name, "store *.zarr"), methods=_METHODS)
            command.add_argument(*short, argument, **_options(argument, kind, text))
    return parser


def _options(argument: str, kind: str, text: str) -> dict[str, Any]:
    """Options of argparse for an argument, its kind and its help; see `_ARGUMENTS`."""
    if kind == "flag":
        return {"action": "store_true", "help": text}
    if "|" in kind:
        return {"choices": kind.split("|"), "help": text}
    ((name, number, default),) = re.findall(r"^([a-z]+)([0-9+*?]?)[!&]?=?(.*)$", kind)
    options: dict[str, Any] = {"type": _KINDS[name], "help": text}
    if number:
        options["nargs"] = int(number) if number.isdigit() else number
    if argument.startswith("-"):
        values = _VALUES.get(argument, _VALUES.get(name, "VALUE")).split()
        options["metavar"] = tuple(values) if len(values) > 1 else values[0]
    if "!" in kind:
        options["required"] = True
    if "&" in kind:
        options |= {"action": "append", "default": []}
    if default:
        options |= {"default": _KINDS[name](default), "help": f"{text} ({default})"}
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out one command, and return its exit status; see the module."""
    # A program may be started without a terminal.
    sys.stdout, sys.stderr = sys.stdout or StringIO(), sys.stderr or StringIO()
    say = cache(lambda text: print(_shown(f"Warning: {text}"), file=sys.stderr))  # once
    warnings.showwarning = lambda message, *_, **__: say(str(message))
    options = _parser().parse_args(arguments)
    # An error ends in a line and a status.
    try:
        return _carry_out(options, sys.argv[1:] if arguments is None else arguments)
    except BrokenPipeError:  # nobody reads the summary any more
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0
    except KeyboardInterrupt:
        status, reason = 130, "interrupted"
    except Exception as error:
        if options.traceback:
            raise
        status, reason = 1, _reason(error, options)
        for name in vars(options):  # an argument of Python is named as the option is
            reason = re.sub(f" {name}= ?", f" --{name.replace('_', '-')} ", reason)
        reason = re.sub(r"--frames slice\((\d+), (\d+)\)", r"--frames \1 \2", reason)
        reason += _suggestion(reason)
    print(_shown(f"dbthermal {options.command}: {reason}"), file=sys.stderr)
    return status


def _reason(error: Exception, options: argparse.Namespace) -> str:
    """Message of an error in one line, with the extra that a missing library belongs to."""
    command = options.command
    extra = _EXTRAS.get(str(error.name).split(".")[0]) if isinstance(error, ImportError) else None
    if isinstance(error, ImportError) and extra:
        extra = command if command == "report" else extra  # which has all that it needs
        return str(import_module("dbthermal._text").missing_library(error.name, extra))
    if isinstance(error, FileNotFoundError) and error.filename:  # of the system, not of dbthermal
        return f"No file or folder '{error.filename}'. Must exist."
    message = " ".join(str(error.args[0] if isinstance(error, KeyError) else error).split())
    if isinstance(error, MemoryError) or "start new thread" in message:
        output = f", '{options.output}' is not written" if "output" in options else ""
        rule = "Must have more, or fewer frames or pixels; --dry-run says what a separation takes"
        return f"Out of memory{output}: {message or 'none is free'}. {rule}."
    if isinstance(error, OSError | ValueError | TypeError | KeyError | ImportError | RuntimeError):
        return message
    return f"{type(error).__name__}: {message} (--traceback shows where)"


def _suggestion(reason: str) -> str:
    """Question after the name that is most like an unknown one, of those that a message lists."""
    unknown = re.search(r"'([^']+)'.*(?:Must be one of|choose from)\s(.*)", reason)
    if unknown is None or "Did you mean" in reason:
        return ""
    wrong, names = unknown.group(1), re.findall(r"'([^']+)'", unknown.group(2))
    names = names or unknown.group(2).strip(" .)").split(", ")
    words = [name for name in names if wrong.lower() in name.lower()]
    like = [*difflib.get_close_matches(wrong, names, 1), *words]
    return f" Did you mean '{like[0]}'?" if like and like[0] != wrong else ""


def _carry_out(options: argparse.Namespace, arguments: Sequence[str]) -> int:
    """Check the options, and what is read and written; run the command; print its summary."""
    if options.command == "completion":
        print(_completion())
        return 0
    module, function = options.place.split(".")
    if options.command == "record":
        return int(_command(module, function)(options))
    with stage_shown(options.command):
        _command("files", "refuse_unused")(options, arguments)
        sources, targets = _sources_and_targets(options)
        if options.dry_run:
            summary = _command("steps", "foreseen")(options, sources, targets)
        else:
            with ExitStack() as places:
                for path in targets:  # which no other process writes to from here on
                    places.enter_context(import_module("dbthermal.store").reserved(path))
                _sources_and_targets(options)  # and to which none has written meanwhile
                summary = _command(module, function)(options)
    # The summary, for programs or for people.
    lines = [json.dumps(summary, default=_plain)] if options.json else _lines(summary)
    print("\n".join(map(_shown, lines)), flush=True)
    return 0


def _shown(text: str) -> str:
    """Text as a terminal takes it: names of files may hold what would control it."""
    encoding = sys.stdout.encoding or "utf-8"
    shown = "".join(it if it.isprintable() else ascii(it)[1:-1] for it in text)
    return shown.encode(encoding, "backslashreplace").decode(encoding)


def _command(module: str, function: str) -> Any:
    """Function of a command, imported when it is needed."""
    return getattr(import_module(f"dbthermal._cli.{module}"), function)


def _sources_and_targets(options: argparse.Namespace) -> tuple[list[Path], list[Path]]:
    """Paths that a command reads, which must exist, and writes, which must be free."""
    arguments = vars(options).items()
    sources = [leaf for name, value in arguments for leaf in leaves(value) if is_source(name, leaf)]
    written = ("output", "folder")
    targets = [value for name, value in arguments if name.endswith(written) and value]
    for path in sources:
        if not path.exists():
            raise FileNotFoundError(f"No file or folder '{path}'. Must exist.")
    taken = [source.resolve() for source in sources]
    for path in targets:
        place = path.resolve()
        if any(place in (used, *used.parents) or used in place.parents for used in taken):
            label = f"Invalid output '{path}': it is another one, or it is read"
            raise ValueError(f"{label}. Must be another place.")
        taken.append(place)
        if path.exists() and not getattr(options, "overwrite", path.is_dir()):
            raise FileExistsError(f"There is something at '{path}'. Must be new, or --overwrite.")
    return sources, targets


def _completion() -> str:
    """Function of bash, and of zsh, for names of commands and options; files are left to it."""
    commands = next(action.choices for action in _parser()._actions if action.choices)
    named = {
        name: " ".join(parser._option_string_actions) for name, parser in dict(commands).items()
    }
    cases = "\n".join(f"    {name}) words='{words}';;" for name, words in named.items())
    return f"""_dbthermal() {{
  local words='{" ".join(named)}'
  [ "$COMP_CWORD" -gt 1 ] && case "${{COMP_WORDS[1]}}" in
{cases}
  esac
  COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
[ -z "${{ZSH_VERSION-}}" ] || {{ autoload -U compinit bashcompinit; compinit; bashcompinit; }}
complete -o default -F _dbthermal dbthermal"""


def _plain(value: Any) -> Any:
    """Value as JSON takes it: an array or number of NumPy as a list or number, else as text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _lines(summary: Any, indent: str = "") -> Iterator[str]:
    """Summary as text: a line for each entry that is not empty, numbers in one line.

    Sentences (`answer`) and commands (`next`) have a line each; `numbers` repeat those of the
    sentences, for programs.
    """
    for key, value in summary.items():
        if key in {"answer", "next", "numbers"}:
            yield from (f"{indent}{line}" for line in value if key != "numbers")
            continue
        entries = value if isinstance(value, dict) else dict[str, Any]()
        if any(isinstance(entry, dict | list | str) for entry in entries.values()):
            yield f"{indent}{key}:"
            yield from _lines(value, indent + "  ")
            continue
        words = [f"{name} {number:g}" for name, number in entries.items()]
        if line := ", ".join(words if isinstance(value, dict) else map(str, leaves(value))):
            yield f"{indent}{key}: {line}"


if __name__ == "__main__":
    sys.exit(main())
