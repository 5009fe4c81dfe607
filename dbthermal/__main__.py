"""Command line of dual-band thermal videography: ``dbthermal``, or ``python -m dbthermal``.

Exit status: 0 if done, 1 if refused, with the reason in one line, 2 if the command is not
understood, 130 if interrupted. The summary goes to standard output, all else to standard error.
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

from dbthermal import __version__, _cli

__all__ = ["main"]
__dir__ = __all__.copy

_EXTRAS: Final = {  # library -> the extra that has it
    **dict.fromkeys(("anywidget", "ipywidgets"), "explorer"),
    "jinja2": "report",
    **dict.fromkeys(("pydantic", "serial", "usb", "yaml"), "instruments"),
    **dict.fromkeys(("h5py", "imagecodecs", "tifffile"), "recordings"),
    "av": "video",
    "matplotlib": "figures",
    "skimage": "materials",
}

_KINDS: Final[dict[str, Any]] = {
    "path": Path,
    "name": str,
    "number": _cli.finite,
    "n": int,
    "temperature": _cli.kelvin,
    "point": _cli.kelvin_or_path,
}
_ARGUMENTS: Final = """
files path+             a file for each camera, or lists with '+' between the cameras; or a store
session path            YAML file, see dbthermal.instruments.session
folder path             new folder for the output
capture path            store of a capture
correction path?        store of gain and offset
--corrected-by-camera flag  instead of a correction, if the cameras correct gain and offset
response path           store of the cameras' response
result path             store of a result
shown path*             capture and response of this result, to be shown beside it
materials name*         names as listed by 'data'; all by default
--output path!          new {output}
--overwrite flag        replace the output
--dry-run flag          only list what would be read and written, with sizes
--json flag             print the summary as JSON
--traceback flag        show where an error was raised
--bands name+           names of the bands, such as 8-14 9.5
--unit name             unit of the numbers in TIFF, raw files and arrays ('count')
--clock number+         frame rate [Hz], or a rate for each camera; not needed for FLIR's files
--shape n2          rows and columns of raw files [pixel]
--byte-order little|big byte order of raw files
--header n=0        length of the header of raw files [byte]
--frame-header n=0  length of the header of each frame of raw files [byte]
--simulated flag        label the files, and all results made from them, as simulated
--variable name&        array of a file with several, repeated for each camera, or of a result
--offset number+        start of each further camera minus the first's [s]; else by dates or images
--simulate flag         use emulated devices
--side-by-side flag     cameras side by side instead of one optical path
--at point+&            blackbody temperature, as 20C or 293.15K, and its files; one --at for each
--blackbody path        instead of --at: a store of all temperatures
--sweep name2           instead of --at: folder and session of a sweep by 'record'
--maker path            instead of --at: a capture of FLIR files, for the maker's constants
--frames n+         N: first N frames; A B: frames A to B - 1 (all; of a blackbody the first 64)
--every n=1         take every N-th frame
--rows n2           take rows Y0 to Y1 - 1 of the image
--blackbody-accuracy number  standard deviation of the error of all temperatures [K] (0.1)
--blackbody-emissivity number  emissivity of the blackbody (0.97)
--room-temperature temperature  temperature of the room that the blackbody reflects (22C)
--offset-std number+    drift of each camera's level since the sweep [K] (0.5)
--gain-std number+      relative error of each camera's gain (0.01)
--pattern-std number+   drift of single pixels of each camera since the sweep [K] (0.1)
--background-ratio-std number  relative deviation of the reflections from gray (0.02)
--correction-output path   store for gain and offset; the blackbody must fill the view
--no-shutter flag       no camera has a shutter
--time-constant number  thermal time constant of the pixels [s]
--register none|translation|affine|homography transform of the views (homography); none: same view
--search n=5        largest delay between the cameras that is searched [frame]
--reference name        band whose frames keep their times
--correction path       store of gain and offset: all steps, from a raw capture
--method name           a single method, pixel by pixel: {methods}
--emissivity number+    emissivity of each band, for the method 'calibrated'
--surroundings temperature   temperature of the reflected surroundings, such as 22C
--outdoors flag         the scene reflects the sky, which is not gray: wider error bars
--background-ratio number2  ratio of reflected changes, second band to first, and its deviation
--prior name            material of pixels that cannot be measured, as listed by 'data'
--workers n=2       number of threads
--title name            heading of the report
--author name           name below the heading
--logo path             picture beside the heading, *.png
--noise number!         noise of the camera without a filter [K]
--seconds number=35     length of the capture
--rate number=10        frame rate [Hz]
--span number=25        rise of the object's temperature [K]
--amplitude number=3    height of the reflected changes [K]
--pixel n2&         curve of row Y and column X; may be repeated
--region n4&        curve of rows Y0 to Y1 - 1, columns X0 to X1 - 1; may be repeated
"""
"""Argument, kind and help: ``!`` is required, ``&`` may be repeated, ``=`` is the default."""

_VALUES: Final = {  # option -> names of its values in the help, where it is not that of its kind
    "--at": "TEMPERATURE FILE",
    "--sweep": "FOLDER SESSION",
    "--shape": "ROWS COLUMNS",
    "--pixel": "Y X",
    "--region": "Y0 Y1 X0 X1",
    "--rows": "Y0 Y1",
}

_METHODS: Final = (
    "subspace (first step of the default), calibrated (emissivities as stated), "
    "apparent (temperature as of a black body)"
)
_OUTPUTS: Final = {"explore": "notebook *.ipynb", "report": "page *.html"}
_OUTPUTS["export"] = "file *.csv, *.tif, *.nc, *.gif, *.webp, *.png, *.pdf or *.svg"
"""Command -> kind of its output, if that is no store."""

_FORM: Final = "--unit --clock --shape --byte-order --header --frame-header --variable --simulated"
_COMMANDS: Final = f"""
demo steps.demo folder --side-by-side
write files of a simulated rig, to try everything without cameras, and print the next commands
try-it
try-it --side-by-side

info files.info files {_FORM}
describe a store or recording; for a result temperature, uncertainty, share of measured pixels
result.zarr
video.seq
a.tif --clock 30

import files.make_capture files --bands --offset {_FORM} --frames --every --rows --output
make a capture from cameras' files: FLIR, Telops, TIFF, raw, NumPy, HDF5, MATLAB, NetCDF, zarr
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

separate steps.separate capture response --correction --corrected-by-camera --register --offset \
    --search --method --emissivity --surroundings --outdoors --background-ratio --prior --workers \
    --output
separate emission and reflection: temperatures, emissivities, deviations, status
aligned.zarr response.zarr -o result.zarr
scene.zarr response.zarr --correction nuc.zarr -o result.zarr
aligned.zarr response.zarr --method calibrated --emissivity 0.86 0.72 -o result.zarr

complete steps.complete result capture response --surroundings --prior --workers --output
complete the result of a single method from materials, surroundings or a library
result.zarr aligned.zarr response.zarr --surroundings 22C -o completed.zarr

plan steps.plan materials --noise --seconds --rate --span --amplitude --outdoors
predict the accuracy of a capture before it is recorded, by material and filter
'plate window glass' water --noise 0.03

record record.record session folder --simulate
record a session with the rig, or with emulated devices; --dry-run lists the devices
sessions/scene.yaml recordings --dry-run
sessions/scene.yaml recordings --simulate

export export.export result --variable --pixel --region --output
write a result for other programs: curves, film, picture; or any store as NetCDF
result.zarr --pixel 120 200 --region 10 60 10 90 -o curves.csv
result.zarr --variable background_temperature -o film.tif
result.zarr -o object.png
result.zarr -o object.gif
result.zarr -o result.nc

explore export.explore result shown --output
make a notebook that shows a result or a capture in JupyterLab
result.zarr aligned.zarr response.zarr -o look.ipynb

report export.report result shown --region --title --author --logo --output
write a report on a result as one HTML file, which needs no network
result.zarr aligned.zarr response.zarr --region 10 60 10 90 -o scene.html

data steps.data
list the filters and materials that come with the package
--json

completion main.completion
print the completion of commands for bash and zsh; use it by: eval "$(dbthermal completion)"
-
"""
"""Command, its function and arguments; its summary; examples."""


class _Parser(argparse.ArgumentParser):
    """Parser that asks after the name that was meant."""

    def error(self, message: str) -> NoReturn:
        """Print the usage and the message, and exit."""
        names = ", ".join(self._option_string_actions)
        for wrong in re.findall(r"unrecognized arguments: (--\S+)", message):
            message += _cli.suggestion(f"'{wrong}': choose from {names}")
        if self.epilog and re.match("unrecognized arguments: [^-]|the following", message):
            message += f". Must be as in: {self.epilog.splitlines()[1].strip()}"
        super().error(message + _cli.suggestion(message))

    def parse_known_args(self, *arguments: Any, **named: Any) -> Any:
        """Options; the command refuses those that it does not know."""
        if (parsed := super().parse_known_args(*arguments, **named))[1]:
            self.error(f"unrecognized arguments: {' '.join(parsed[1])}")
        return parsed


def _parser() -> argparse.ArgumentParser:
    """Parser of all commands, made of the tables `_ARGUMENTS` and `_COMMANDS`."""
    # The command itself, and the table of all arguments.
    plain: Any = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False}
    order = "Order of work: demo (or import), calibrate, correct, align, separate, report, explore."
    parser = _Parser("dbthermal", description=f"{__doc__}\n{order}", **plain)
    parser.add_argument("--version", action="version", version=f"dbthermal {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    table = {line.split()[0]: line.split(maxsplit=2)[1:] for line in _ARGUMENTS.split("\n")[1:-1]}
    for block in re.sub(" {2,}", " ", _COMMANDS).strip().split("\n\n"):
        # A block of the table: the command with its arguments, its summary, its examples.
        head, summary, *lines = block.splitlines()
        name, place, *arguments = head.split()
        examples = [f"  dbthermal {name} {line}".rstrip(" -") for line in lines]
        about: Any = {"help": summary, "description": f"{summary[0].upper()}{summary[1:]}."}
        about["epilog"] = "\n".join(["examples:", *examples])
        command = commands.add_parser(name, **about, **plain)
        command.set_defaults(place=place)
        command._negative_number_matcher = re.compile(r"-[\d.]+(e[-+]?\d+)?[CK]?$")  # -5C
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
        options |= {"action": "extend"} if number == "+" else {}  # --clock 12 --clock 10
    if argument.startswith("-"):
        values = _VALUES.get(argument, name.upper()).split()
        options["metavar"] = tuple(values) if len(values) > 1 else values[0]
    options |= {"required": True} if "!" in kind else {}
    options |= {"action": "append", "default": []} if "&" in kind else {}
    if default:
        options |= {"default": _KINDS[name](default), "help": f"{text} ({default})"}
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out one command, and return its exit status; see the module."""
    # A program may be started without a terminal.
    sys.stdout, sys.stderr = sys.stdout or StringIO(), sys.stderr or StringIO()
    say = cache(lambda text: print(_shown(f"Warning: {text}"), file=sys.stderr))  # once
    options = argparse.Namespace()
    warnings.showwarning = lambda message, *_, **__: say(_with_options(str(message), options))
    _parser().parse_args(arguments, options)
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
        status, reason = 1, _with_options(_reason(error, options), options)
        reason = re.sub(r"--frames slice\((\d+), (\d+)(?:, \d+)?\)", r"--frames \1 \2", reason)
        reason += _cli.suggestion(reason)
    print(_shown(f"dbthermal {options.command}: {reason}"), file=sys.stderr)
    return status


def _with_options(text: str, options: argparse.Namespace) -> str:
    """Message in which an argument of Python is named as the option is."""
    for name in vars(options):
        text = re.sub(f" {name}=(?!b') ?", f" --{name.replace('_', '-')} ", text)
    return text


def _reason(error: Exception, options: argparse.Namespace) -> str:
    """Message of an error in one line, with the extra that a missing library belongs to."""
    library = str(error.name).split(".")[0] if isinstance(error, ImportError) else ""
    if isinstance(error, ImportError) and (extra := _EXTRAS.get(library)):
        extra = "report" if options.command == "report" else extra  # which has all that it needs
        return str(import_module("dbthermal._text").missing_library(error.name, extra))
    if isinstance(error, FileNotFoundError) and error.errno:  # of the system, not of dbthermal
        return f"No file or folder '{error.filename or '. (current folder)'}'. Must exist."
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
    for name in {"files", "at"} & vars(options).keys():
        setattr(options, name, _cli.expanded(getattr(options, name)))
    with _cli.stage_shown(options.command):
        _command("files", "refuse_unused")(options, arguments)
        sources, targets = _cli.sources_and_targets(options)
        if options.dry_run:
            summary = _command("steps", "foreseen")(options, sources, targets)
        else:
            with ExitStack() as places:
                for path in targets:  # which no other process writes to from here on
                    if "output" in options:  # and which may be replaced
                        import_module("dbthermal.store._whole").check_place(path, path.suffix)
                    places.enter_context(import_module("dbthermal.store").reserved(path))
                _cli.sources_and_targets(options)  # and to which none has written meanwhile
                summary = _command(module, function)(options)
    # The summary, for programs, in JSON, which has no NaN, or for people.
    plain = json.loads(json.dumps(summary, default=_cli.plain), parse_constant=lambda _: None)
    lines = [json.dumps(plain)] if options.json else _cli.lines_of(summary)
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
