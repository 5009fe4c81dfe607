"""Command line of dual-band thermal videography: ``dbthermal``, or ``python -m dbthermal``.

Exit status: 0 if done, 1 if refused, with the reason in one line, 2 if the command is not
understood, 130 if it was interrupted. The summary goes to the standard output, all else to the
standard error.
"""

import argparse
import json
import os
import re
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from dbthermal import __version__
from dbthermal._cli import is_source, leaves

__all__ = ["main"]
__dir__ = __all__.copy

_EXTRAS: Final = {
    **dict.fromkeys(("anywidget", "ipywidgets"), "explorer"),
    "jinja2": "report",
    **dict.fromkeys(("pydantic", "serial", "usb", "yaml"), "instruments"),
    **dict.fromkeys(("h5py", "imagecodecs", "tifffile"), "recordings"),
    "av": "video",
    "cv2": "alignment",
    "matplotlib": "figures",
    "skimage": "materials",
    "torch": "torch",
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
folder path             where the recordings go
capture path            store of a capture
correction path?        store of gain and offset
--corrected-by-camera flag  in place of it: each camera corrects gain and offset itself
response path           store of the cameras' response
result path             store of a result
shown path*             its capture, and the cameras' response, to be shown beside it
materials text*         as listed by 'data'; all by default
--output path!          what is made: store *.zarr, or of the kind that the examples below have
--overwrite flag        replace the output
--dry-run flag          only say what would be read, with sizes, and written
--json flag             print the summary as JSON
--traceback flag        show where an error was raised
--bands text2           names of both bands: 8-14 9.5
--unit text             of the numbers in TIFF, raw files and arrays: must be 'count'
--clock number          frame rate [Hz]; FLIR's files have their own times
--shape whole2          rows and columns of raw files [pixel]
--byte-order little|big of the numbers in raw files
--header whole=0        before the first frame of raw files [byte]
--frame-header whole=0  before each frame of raw files [byte]
--simulated flag        no camera has recorded it: all that is made of it says so
--variable text         name of an array in a file of several, or in a result
--offset number         how much later the second camera began, or was exposed [s]; else found
--simulate flag         use emulated devices
--at point+&            temperature of a blackbody, as 20C or 293.15K, and its files; repeated
--blackbody path        in place of --at: a store of all temperatures
--sweep text2           in place of --at: folder and session of a sweep by 'record'
--maker path            in place of --at: a capture of FLIR's files, for the maker's constants
--frames whole=64       at most, of each temperature
--correction-output path   store of gain and offset, where the blackbody fills the view
--no-shutter flag       no camera has a shutter
--time-constant number  thermal, of the pixels [s]
--register none|translation|affine|homography   between the views (homography); none: on one grid
--search whole=5        largest delay that is sought, either way [frame]
--reference text        band whose frames are left as they are in time
--correction path       store of gain and offset: all steps of a raw capture, by rows
--method text           one step alone, by rows: subspace, calibrated, dbvt, apparent
--emissivity number+    of each band, for the method 'calibrated'
--surroundings kelvin   temperature of what is reflected, as 22C
--prior text            material of pixels that cannot be measured, as listed by 'data'
--workers whole=2       number of threads
--noise number!         of the camera without a filter [K]
--seconds number=35     length of the capture
--rate number=10        frame rate [Hz]
--span number=25        rise of the object's temperature [K]
--amplitude number=3    height of the reflected changes [K]
--pixel whole2&         y x of a curve; repeated
--region whole4&        y0 y1 x0 x1 of a curve; repeated
"""
"""Argument, kind and help: ``!`` is required, ``&`` may be repeated, ``=`` is the default."""

_FORM: Final = "--unit --clock --shape --byte-order --header --frame-header --variable --simulated"
_COMMANDS: Final = f"""
info files.info files {_FORM}
say what a store or recording is: sizes, clock, bands, provenance, shares of the status
capture.zarr
video.seq
a.tif --unit count --clock 30

import files.make_capture files --bands --offset {_FORM} --output
make a capture of two cameras' files: FLIR, TIFF, raw, NumPy, HDF5, NetCDF, zarr
a.tif b.tif --bands 8-14 9.5 --unit count --clock 30 --offset 0 -o scene.zarr
a*.tif + b*.tif --bands 8-14 9.5 --unit count --clock 30 --offset 0 -o scene.zarr
wide.seq narrow.seq --bands 8-14 9.5 -o scene.zarr

calibrate steps.calibrate --at --blackbody --sweep --maker --frames --bands {_FORM} \
    --correction-output --output
fit the cameras' response, and each pixel's gain and offset, to a blackbody
--at 10C a10.tif b10.tif --at 30C a30.tif b30.tif --at 50C a50.tif b50.tif --at 70C a70.tif \
    b70.tif --bands 8-14 9.5 --unit count --clock 30 -o response.zarr --correction-output nuc.zarr
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
    --emissivity --surroundings --prior --workers --output
separate emission and reflection: temperatures, emissivities, deviations, status
aligned.zarr response.zarr -o result.zarr
scene.zarr response.zarr --correction nuc.zarr -o result.zarr
aligned.zarr response.zarr --method calibrated --emissivity 0.86 0.72 -o result.zarr

complete steps.complete result capture response --surroundings --prior --workers --output
complete the result of a single method by what is known of the scene
result.zarr aligned.zarr response.zarr --surroundings 22C -o completed.zarr

plan steps.plan materials --noise --seconds --rate --span --amplitude
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
result.zarr -o result.nc

explore export.explore result shown --output
make a notebook to look around in a result or a capture, for JupyterLab
result.zarr aligned.zarr response.zarr -o look.ipynb

report export.report result shown --region --output
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


def _parser() -> argparse.ArgumentParser:
    """Parser of all commands, made of the tables `_ARGUMENTS` and `_COMMANDS`."""
    # The command itself, and the table of all arguments.
    plain: Any = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False}
    parser = argparse.ArgumentParser("dbthermal", description=__doc__, **plain)
    parser.add_argument("--version", action="version", version=f"dbthermal {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    table = {line.split()[0]: line.split(maxsplit=2)[1:] for line in _ARGUMENTS.split("\n")[1:-1]}
    for block in _COMMANDS.replace(" \\\n    ", " ").strip().split("\n\n"):
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
            command.add_argument(*short, argument, **_options(*table[argument]))
    return parser


def _options(kind: str, text: str) -> dict[str, Any]:
    """Options of argparse for a kind and a help; see `_ARGUMENTS`."""
    if kind == "flag":
        return {"action": "store_true", "help": text}
    if "|" in kind:
        return {"choices": kind.split("|"), "help": text}
    ((name, number, default),) = re.findall(r"^([a-z]+)([0-9+*?]?)[!&]?=?(.*)$", kind)
    options: dict[str, Any] = {"type": _KINDS[name], "help": text}
    if number:
        options["nargs"] = int(number) if number.isdigit() else number
    if "!" in kind:
        options["required"] = True
    if "&" in kind:
        options |= {"action": "append", "default": []}
    if default:
        options |= {"default": _KINDS[name](default), "help": f"{text} ({default})"}
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out one command, and return its exit status; see the module."""
    say = cache(lambda text: print(f"Warning: {text}", file=sys.stderr))  # once
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
        status, reason = 1, _reason(error, options.command)
        for name in vars(options):  # an argument of Python is named as the option is
            reason = re.sub(f" {name}= ?", f" --{name.replace('_', '-')} ", reason)
    print(f"dbthermal {options.command}: {reason}", file=sys.stderr)
    return status


def _reason(error: Exception, command: str) -> str:
    """Message of an error in one line, with the extra that a missing library belongs to."""
    extra = _EXTRAS.get(str(error.name).split(".")[0]) if isinstance(error, ImportError) else None
    if isinstance(error, ImportError) and extra:
        extra = command if command == "report" else extra  # which has all that it needs
        return str(import_module("dbthermal._text").missing_library(error.name, extra))
    if isinstance(error, FileNotFoundError) and error.filename:  # of the system, not of dbthermal
        return f"No file or folder '{error.filename}'. Must exist."
    message = " ".join(str(error.args[0] if isinstance(error, KeyError) else error).split())
    if isinstance(error, OSError | ValueError | TypeError | KeyError | ImportError | RuntimeError):
        return message
    return f"{type(error).__name__}: {message} (--traceback shows where)"


def _carry_out(options: argparse.Namespace, arguments: Sequence[str]) -> int:
    """Check the options, and what is read and written; run the command; print its summary."""
    if options.command == "completion":
        print(_completion())
        return 0
    module, function = options.place.split(".")
    if options.command == "record":
        return int(_command(module, function)(options))
    _command("unused", "refuse")(options, arguments)
    sources, targets = _sources_and_targets(options)
    if options.dry_run:
        summary = _command("steps", "foreseen")(options, sources, targets)
    else:
        start = time.monotonic()
        summary = _command(module, function)(options)
        if not sys.stderr.isatty():  # where no bar was shown
            print(f"{options.command}: {time.monotonic() - start:.1f} s", file=sys.stderr)
    # The summary, for programs or for people.
    text = json.dumps(summary, default=_plain) if options.json else "\n".join(_lines(summary))
    print(text, flush=True)
    return 0


def _command(module: str, function: str) -> Any:
    """Function of a command, imported when it is needed."""
    return getattr(import_module(f"dbthermal._cli.{module}"), function)


def _sources_and_targets(options: argparse.Namespace) -> tuple[list[Path], list[Path]]:
    """Paths that a command reads, which must exist, and writes, which must be free."""
    arguments = vars(options).items()
    sources = [leaf for name, value in arguments for leaf in leaves(value) if is_source(name, leaf)]
    targets = [value for name, value in arguments if name.endswith("output") and value]
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
        if path.exists() and not options.overwrite:
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
    """Summary as text: a line for each entry that is not empty, numbers in one line."""
    for key, value in summary.items():
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
