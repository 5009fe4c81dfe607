"""Results and their provenance: text, figures as PNG, films as MP4.

Each result appears whole under its name (`whole`). It carries its provenance and nothing that
differs between two runs of the same code on the same input: no date, no host and no folder.
"""

import hashlib
import json
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping
from fractions import Fraction
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import numpy.typing as npt

from dbthermal import __version__, _numbers, _text, schema
from dbthermal.store._whole import whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PACKAGES = ("numpy", "scipy", "xarray", "zarr")

# FFmpeg's encoder of each codec of a film, with its options.
_ENCODERS: Final[dict[str, tuple[Literal["libvpx-vp9", "libx264"], dict[str, str]]]] = {
    "vp9": ("libvpx-vp9", {"crf": "31", "b": "0", "deadline": "realtime", "cpu-used": "6"}),
    "h264": ("libx264", {}),
}


def provenance(
    parameters: Mapping[str, object], inputs: Mapping[str, str | Path] | None = None
) -> dict[str, Any]:
    """Provenance of a result, for the functions that save it.

    Parameters
    ----------
    parameters : mapping
        Name to value, as in the notebook's parameters cell: finite numbers, strings, booleans,
        None, and lists and mappings of these; TypeError or ValueError with its name for another.
    inputs : mapping, optional
        Name to path of each file, or folder such as a zarr store, that was read, for its checksum;
        FileNotFoundError if it does not exist.

    Returns
    -------
    dict
        ``parameters``; ``versions`` of Python, dbthermal and its core dependencies; ``commit``, 40
        hexadecimal digits, with ``-dirty`` if tracked files differ from it, or ``"unknown"``
        outside a git work tree; and ``inputs``, name to sha256.

    Examples
    --------
    >>> from dbthermal import store
    >>> store.provenance({"frames": 350})["parameters"]
    {'frames': 350}
    """
    schema.require(parameters, Mapping, "parameters")
    return {
        "parameters": {name: _plain(name, value) for name, value in parameters.items()},
        "versions": {
            "python": platform.python_version(),
            "dbthermal": __version__,
            **{package: version(package) for package in _PACKAGES},
        },
        "commit": commit(),
        "inputs": {name: checksum(path) for name, path in (inputs or {}).items()},
    }


def checksum(path: str | Path) -> str:
    """SHA-256 of a file, as of ``sha256sum``, or of a folder's file names and contents.

    Parameters
    ----------
    path : str or Path
        File or folder; FileNotFoundError if it does not exist.
    """
    path = _text.as_path(path)
    if not path.is_dir():
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    files = {file.relative_to(path).as_posix(): file for file in path.rglob("*") if file.is_file()}
    lines = (f"{checksum(files[name])}  {name}\n" for name in sorted(files))
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def commit() -> str:
    """Commit of the code that runs, or ``"unknown"``; see `provenance`."""
    folder = Path(__file__).parent
    tracked = _git(folder, "ls-files", "--error-unmatch", Path(__file__).name)
    described = _git(folder, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    return described.strip() if tracked and described else "unknown"


def _git(folder: Path, *arguments: str) -> str:
    """Output of a git command in `folder`; empty if it fails or git is absent."""
    command = ["git", "-C", str(folder), *arguments]
    # Without variables of another clone, as a hook of git has them.
    environment = {name: it for name, it in os.environ.items() if not name.startswith("GIT_")}
    environment["GIT_OPTIONAL_LOCKS"] = "0"
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    except FileNotFoundError:
        return ""
    return done.stdout if done.returncode == 0 else ""


def _plain(name: str, value: object) -> Any:
    """Value after a round trip through JSON: tuples are lists, keys are strings."""
    try:
        return json.loads(json.dumps(value, allow_nan=False))
    except (TypeError, ValueError) as error:
        rule = f"Must be JSON with finite numbers: {error}."
        raise type(error)(f"Invalid parameter {name!r} = {value!r}. {rule}") from error


def save_text(text: str, path: str | Path, provenance: Mapping[str, Any]) -> None:
    """Save a text in Markdown or HTML, with its provenance in a comment at its end.

    Parameters
    ----------
    text, path, provenance : str, str or Path, mapping
        Text, file ``*.md`` or ``*.html``; see `save`.
    """
    suffix = ".html" if _text.as_path(path).suffix == ".html" else ".md"
    # No string of the provenance can end the comment or begin a tag.
    content = as_json(provenance).replace("--", "-\\u002d").replace("<", "\\u003c")
    with whole(path, suffix) as draft:
        draft.write_text(f"{text}\n<!-- {content} -->\n", encoding="utf-8")


def save_figure(
    figure: "Figure", path: str | Path, provenance: Mapping[str, Any], *, dpi: int = 150
) -> None:
    """Save a figure as PNG, or as vectors in PDF or SVG; the same bytes for the same figure.

    Text stays text, of fonts that PDF embeds; images are pixels within the vectors.

    Parameters
    ----------
    figure, dpi : Figure, int
        Of matplotlib, stays open; resolution [pixel/inch], of the images in PDF and SVG.
    path, provenance : str or Path, mapping
        File ``*.png``, ``*.pdf`` or ``*.svg``; see `save`. The provenance becomes the text chunk
        ``Comment``, the subject or the description, as JSON.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from matplotlib.figure import Figure
    >>> from PIL import Image
    >>> from dbthermal import store
    >>> with TemporaryDirectory() as folder:
    ...     store.save_figure(Figure(figsize=(2, 1)), f"{folder}/wall.png", {"commit": "unknown"})
    ...     Image.open(f"{folder}/wall.png").text["Comment"]
    '{"commit": "unknown"}'
    """
    import matplotlib.figure  # noqa: PLC0415 - loaded with the figure

    schema.require(figure, matplotlib.figure.Figure, "figure")
    text, suffix = as_json(provenance), _text.as_path(path).suffix
    metadata: dict[str, dict[str, Any]] = {
        ".pdf": {"Creator": "dbthermal", "Subject": text, "CreationDate": None},
        ".svg": {"Creator": "dbthermal", "Description": text, "Date": None},
        ".png": {"Software": "dbthermal", "Comment": text},
    }
    kind = suffix if suffix in metadata else ".png"
    fonts: Any = {"pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "dbthermal"}
    with matplotlib.rc_context(fonts), whole(path, kind) as draft:
        figure.savefig(draft, dpi=dpi, metadata=metadata[kind])


def save_video(
    frames: Iterable[npt.NDArray[np.uint8]],
    path: str | Path,
    provenance: Mapping[str, Any],
    *,
    rate: float,
    codec: Literal["vp9", "h264"] = "vp9",
) -> None:
    """Save a film in MP4, as browsers play it.

    Parameters
    ----------
    frames : iterable of ndarray of uint8, shape (rows, columns, 3)
        Colours; at least one frame, all of one size, both sizes even, else ValueError.
    path, provenance : str or Path, mapping
        File ``*.mp4``; see `save`. The provenance becomes the file's comment, as JSON.
    rate : float
        Frame rate [Hz].
    codec : {"vp9", "h264"}
        Compression. VP9's encoder, libvpx, has a permissive licence and a grant of patents. That of
        H.264, x264, is under the GPL, and patents may ask for a licence where films are passed on
        (see docs/licences.md). ValueError for any other.
    """
    import av  # noqa: PLC0415 - optional, and nothing else here needs it

    # Codec and rate, before a file is made.
    _text.check_listed("Invalid codec", codec, sorted(_ENCODERS))
    encoder, options = _ENCODERS[codec]
    frequency = _numbers.real_number("rate [Hz]", rate, (0.01, 1e6))
    with whole(path, ".mp4") as draft, av.open(draft, "w") as film:
        film.metadata["comment"] = as_json(provenance)
        fraction = Fraction(frequency).limit_denominator(1000)
        stream = film.add_stream(encoder, rate=fraction, options=options)
        stream.pix_fmt, stream.width = "yuv420p", 0
        # Frames, of the size of the first.
        for frame in frames:
            height, width = frame.shape[:2]
            if stream.width == 0:
                stream.height, stream.width = height, width
            if (stream.height, stream.width) != (height, width) or height % 2 or width % 2:
                rule = f"Must be of even size, as all others: {stream.height} x {stream.width}"
                raise ValueError(f"Invalid frame of {height} x {width} pixels. {rule}.")
            film.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        if stream.width == 0:
            raise ValueError("Invalid film without frames. Must have at least one.")
        # Frames that the encoder still holds.
        film.mux(stream.encode())


def as_json(content: Mapping[str, Any], indent: int | None = None) -> str:
    return json.dumps(_plain("provenance", content), indent=indent, sort_keys=True)
