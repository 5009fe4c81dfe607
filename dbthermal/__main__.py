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
import warnings
from collections.abc import Sequence
from contextlib import ExitStack
from functools import cache
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import Any, Final, NoReturn

from dbthermal import __version__
from dbthermal._cli import (
    finite,
    kelvin,
    kelvin_or_path,
    lines_of,
    plain,
    sources_and_targets,
    stage_shown,
    suggestion,
)

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

_KINDS: Final[dict[str, Any]] = {
    "path": Path,
    "name": str,
    "number": finite,
    "n": int,
    "temperature": kelvin,
    "point": kelvin_or_path,
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
materials name*         as listed by 'data'; all by default
--output path!          new {output}
--overwrite flag        replace the output
--dry-run flag          only say what would be read, with sizes, and written
--json flag             print the summary as JSON
--traceback flag        show where an error was raised
--bands name+           names of the bands: 8-14 9.5
--unit name             of the numbers in TIFF, raw files and arrays: 'count' if not stated
--clock number+         frame rate [Hz], of each camera if they differ; FLIR's files have times
--shape n2          rows and columns of raw files [pixel]
--byte-order little|big of the numbers in raw files
--header n=0        before the first frame of raw files [byte]
--frame-header n=0  before each frame of raw files [byte]
--simulated flag        no camera has recorded it: all that is made of it says so
--variable name         name of an array in a file of several, or in a result
--offset number+        start of each other camera after the first's [s]; else found
--simulate flag         use emulated devices
--side-by-side flag     cameras side by side, in place of one window for both
--at point+&            temperature of a blackbody, as 20C or 293.15K, and its files; repeated
--blackbody path        in place of --at: a store of all temperatures
--sweep name2           in place of --at: folder and session of a sweep by 'record'
--maker path            in place of --at: a capture of FLIR's files, for the maker's constants
--frames n+         the first N, or from A up to B: A B; of each temperature 64
--every n=1         take one frame of so many
--rows n2           take rows Y0 up to Y1 of the image
--blackbody-accuracy number  error that all temperatures share, standard deviation [K] (0.1)
--blackbody-emissivity number  of the blackbody, which mirrors the room (0.97)
--room-temperature temperature  of that room, as 22C
--offset-std number+    drift of the level of each camera since [K] (0.5)
--gain-std number+      error of the gain of each camera (0.01)
--pattern-std number+   drift of the pixels of each camera since [K] (0.1)
--background-ratio-std number  colour of what surfaces mirror, about gray (0.02)
--correction-output path   store of gain and offset, where the blackbody fills the view
--no-shutter flag       no camera has a shutter
--time-constant number  thermal, of the pixels [s]
--register none|translation|affine|homography   between the views (homography); none: on one grid
--search n=5        largest delay that is sought, either way [frame]
--reference name        band whose frames are left as they are in time
--correction path       store of gain and offset: all steps of a raw capture, by rows
--method name           one step alone, by rows: {methods}
--emissivity number+    of each band, for the method 'calibrated'
--surroundings temperature   temperature of what is reflected, as 22C
--outdoors flag         the sky is mirrored, which is not gray: wider bars
--background-ratio number2  changes of what is mirrored, second band over first; its deviation
--prior name            material of pixels that cannot be measured, as listed by 'data'
--workers n=2       number of threads
--title name            heading of the report
--author name           name below it
--logo path             picture beside it, *.png
--noise number!         of the camera without a filter [K]
--seconds number=35     length of the capture
--rate number=10        frame rate [Hz]
--span number=25        rise of the object's temperature [K]
--amplitude number=3    height of the reflected changes [K]
--pixel n2&         row and column of a curve; repeated
--region n4&        rows Y0 up to Y1, columns X0 up to X1 of a curve; repeated
"""
"""Argument, kind and help: ``!`` is required, ``&`` may be repeated, ``=`` is the default."""

_VALUES: Final = {
    "--at": "TEMPERATURE FILE",
    "--sweep": "FOLDER SESSION",
    "--shape": "ROWS COLUMNS",
    "--pixel": "Y X",
    "--region": "Y0 Y1 X0 X1",
    "--rows": "Y0 Y1",
}
"""Option -> names of its values in the help, where it is not that of its kind."""

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
        names = ", ".join(self._option_string_actions)
        for wrong in re.findall(r"unrecognized arguments: (--\S+)", message):
            message += suggestion(f"'{wrong}': choose from {names}")
        super().error(message + suggestion(message))

    def parse_known_args(self, *arguments: Any, **named: Any) -> Any:
        """Options; the command refuses those that it does not know."""
        if (found := super().parse_known_args(*arguments, **named))[1]:
            self.error(f"unrecognized arguments: {' '.join(found[1])}")
        return found


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
        values = _VALUES.get(argument, name.upper()).split()
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
            reason = re.sub(f" {name}=(?!b') ?", f" --{name.replace('_', '-')} ", reason)
        reason = re.sub(r"--frames slice\((\d+), (\d+)\)", r"--frames \1 \2", reason)
        reason += suggestion(reason)
    print(_shown(f"dbthermal {options.command}: {reason}"), file=sys.stderr)
    return status


def _reason(error: Exception, options: argparse.Namespace) -> str:
    """Message of an error in one line, with the extra that a missing library belongs to."""
    library = str(error.name).split(".")[0] if isinstance(error, ImportError) else ""
    if isinstance(error, ImportError) and (extra := _EXTRAS.get(library)):
        extra = "report" if options.command == "report" else extra  # which has all that it needs
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
        sources, targets = sources_and_targets(options)
        if options.dry_run:
            summary = _command("steps", "foreseen")(options, sources, targets)
        else:
            with ExitStack() as places:
                for path in targets:  # which no other process writes to from here on
                    places.enter_context(import_module("dbthermal.store").reserved(path))
                sources_and_targets(options)  # and to which none has written meanwhile
                summary = _command(module, function)(options)
    # The summary, for programs or for people.
    lines = [json.dumps(summary, default=plain)] if options.json else lines_of(summary)
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


def _completion() -> str:
    """Function of bash, and of zsh, for names of commands and options; files are left to it."""
    commands = next(action.choices for action in _parser()._actions if action.choices)
    named = {name: " ".join(it._option_string_actions) for name, it in dict(commands).items()}
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


if __name__ == "__main__":
    sys.exit(main())
