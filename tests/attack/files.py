"""Hostile files: stores, numbers, sessions, parameters, manifests, spectra and videos, damaged."""

import json
import shutil
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr, redirect_stdout
from functools import cache as once
from importlib.metadata import entry_points
from io import StringIO
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, Final

import numpy as np
import xarray as xr
import yaml

from attack.oracle import Attack, Verdict
from attack.scenes import pick, scene
from attack.stages import wrong
from dbthermal import schema, store
from dbthermal.instruments.recording import open_capture
from dbthermal.instruments.session import Session
from reproduction import cache, manifest, paths

Rng = np.random.Generator
REPOSITORY: Final = Path(__file__).parents[2]
main: Final[Callable[[list[str]], int]] = entry_points(group="console_scripts")["dbthermal"].load()
"""The command line, as a shell finds it."""
LINES: Final = "x" * 40  # an attribute of some length


@once
def workplace() -> Path:
    """Folder of this process for the damaged copies."""
    return Path(mkdtemp(prefix="attack-"))


@once
def originals() -> Path:
    """Folder of a whole result, a recording and numbers."""
    folder = workplace() / "whole"
    made = scene(np.random.default_rng(1), shape=(16, 20))
    capture = made.capture.assign(note=((), "a text")).assign_attrs(title=LINES)
    store.save(capture, folder / "result.zarr", store.provenance({"seed": 1}))
    flags = schema.Variable(("band", "time"), "uint16", "1", "flags")
    stamps = schema.Variable(("band", "time"), "float64", "s", "when")
    log = {n: schema.Variable(("log",), "float64", "1", n) for n in ("log_time", "log_value")}
    counts = schema.STAGES["capture"]["counts"]
    variables = {"counts": counts, "frame_flags": flags, "exposure_time": stamps, **log}
    recording = store.Recording(
        folder / "recording.zarr",
        variables,
        {"y": 16, "x": 20},
        ["8-14", "9.5"],
        chunk=10,
        attrs={},
    )
    for _ in range(4):
        for place, band in enumerate(("8-14", "9.5")):
            first = recording.frames[band]
            block: dict[str, Any] = {
                "counts": made.counts()[place, first : first + 10].astype(np.uint16),
                "frame_flags": np.zeros(10, np.uint16),
                "exposure_time": made.time[first : first + 10],
            }
            recording.append(band, block)
        recording.append_log({"log_time": np.arange(3.0), "log_value": np.ones(3)})
        recording.commit()
    recording.close(time=made.time[:40])
    store.save_numbers({"rmse_K": 0.21, "name": "a"}, folder / "numbers.json", {"seed": 1})
    return folder


def _copy(name: str) -> Path:
    """Copy to be damaged, in place of the last one."""
    target = workplace() / "damaged" / name
    shutil.rmtree(target.parent, ignore_errors=True)
    target.parent.mkdir()
    source = originals() / name
    if source.is_dir():
        shutil.copytree(source, target)
    else:
        shutil.copy(source, target)
    return target


def _files(path: Path) -> list[Path]:
    return sorted(file for file in path.rglob("*") if file.is_file())


def flip(rng: Rng, path: Path) -> int:
    """Flip one bit of a file, or of another one if it is empty; its place."""
    content = bytearray(path.read_bytes())
    place = int(rng.integers(len(content)))
    content[place] ^= 1 << int(rng.integers(8))
    path.write_bytes(bytes(content))
    return place


def _open(path: Path) -> xr.Dataset:
    """Open a store with all that it holds, as a user would."""
    opened = store.open_dataset(path).load()
    if path.name.startswith("recording"):
        open_capture(path).load()
    return opened


def _same(path: Path, *, attributes: bool) -> Callable[[xr.Dataset], Verdict]:
    """Judge: what opens is what was written."""
    whole = store.open_dataset(originals() / path.name).load()

    def judge(opened: xr.Dataset) -> Verdict:
        changed = sorted(
            str(name)
            for name in {*whole.variables} | {*opened.variables}
            if name not in opened.variables
            or name not in whole.variables
            or not _alike(whole[name], opened[name])
        )
        part = {str(dim): slice(0, size) for dim, size in opened.sizes.items()}
        kept = [n for n in opened.data_vars if n in whole]
        same = all(_alike(whole[n].isel(part, missing_dims="ignore"), opened[n]) for n in kept)
        if same and opened.attrs.get("complete") is False:
            return Verdict("flagged")
        if not changed and attributes and whole.attrs != opened.attrs:
            changed = ["attributes"]
        return wrong(f"other {changed}", where=bool(changed))

    return judge


def _alike(first: xr.DataArray, second: xr.DataArray) -> bool:
    """Of the same dims, type and values, bit by bit."""
    kinds = (first.dtype.kind, first.dims, first.shape)
    same = kinds == (second.dtype.kind, second.dims, second.shape)
    return same and first.values.tobytes() == second.values.astype(first.dtype).tobytes()


def bits(rng: Rng) -> Attack:
    """One bit flipped anywhere in a store."""
    path = _copy(str(rng.choice(["result.zarr", "recording.zarr"])))
    files = [file for file in _files(path) if file.stat().st_size]
    # As likely in one file as in another: else nearly all were in the counts.
    file = files[int(rng.integers(len(files)))]
    place, inside = flip(rng, file), file.relative_to(path)
    return Attack(
        f"bit of byte {place} of {path.name}/{inside} flipped",
        lambda: _open(path),
        _same(path, attributes=True),
        (path.name, inside.parts[0] if len(inside.parts) > 1 else ""),
    )


def chunks(rng: Rng) -> Attack:
    """A chunk of a store lost, emptied, cut, exchanged with another, or from another store."""
    path = _copy(str(rng.choice(["result.zarr", "recording.zarr"])))
    files = [file for file in _files(path) if file.name != "zarr.json"]
    file = files[int(rng.integers(len(files)))]
    what = str(rng.choice(["lost", "lost", "emptied", "cut", "exchanged", "of noise", "a folder"]))
    if what in ("lost", "a folder"):
        file.unlink()
    if what == "a folder":
        file.mkdir()
    if what == "emptied":
        file.write_bytes(b"")
    if what == "cut":
        file.write_bytes(file.read_bytes()[: -int(rng.integers(1, file.stat().st_size))])
    if what == "of noise":
        file.write_bytes(rng.bytes(file.stat().st_size))
    if what == "exchanged":
        same = [
            f
            for f in files
            if f != file and f.relative_to(path).parts[0] == file.relative_to(path).parts[0]
        ]
        other = same[int(rng.integers(len(same)))] if same else file
        kept = file.read_bytes()
        file.write_bytes(other.read_bytes())
        other.write_bytes(kept)
    inside = file.relative_to(path).parts
    names = (path.name, inside[0] if len(inside) > 1 else "")
    what = f"chunk {file.relative_to(path)} of {path.name} {what}"
    return Attack(what, lambda: _open(path), _same(path, attributes=False), names)


def stores(rng: Rng) -> Attack:
    """Metadata of a store lost, emptied, edited or foreign; arrays renamed, lost or added."""
    path = _copy(str(rng.choice(["result.zarr", "recording.zarr"])))
    arrays = sorted(part.name for part in path.iterdir() if part.is_dir())
    array = str(rng.choice(arrays))
    what = str(rng.choice(list(_METADATA)))
    _METADATA[what](rng, path, array)
    attributes = what != "a foreign file"
    judge = _same(path, attributes=attributes)
    return Attack(f"{path.name}/{array}: {what}", lambda: _open(path), judge, (path.name,))


def _edit(rng: Rng, path: Path, array: str) -> None:
    file = path / array / "zarr.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    key = str(
        rng.choice(["shape", "data_type", "fill_value", "dimension_names", "codecs", "node_type"])
    )
    worse = {
        "shape": [10**9 for _ in content["shape"]],
        "data_type": "int8",
        "fill_value": 7,
        "dimension_names": ["a" for _ in content["shape"]],
        "codecs": [],
        "node_type": "group",
    }
    content[key] = worse[key]
    file.write_text(json.dumps(content), encoding="utf-8")


def _attributes(rng: Rng, path: Path, _: str) -> None:
    file = path / "zarr.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    keys = sorted(content["attributes"])
    content["attributes"][str(rng.choice(keys))] = pick(rng, [None, -1, 1e9, "text"])
    file.write_text(json.dumps(content), encoding="utf-8")


def _replaced(path: Path, content: bytes | None) -> None:
    """An empty folder, or a file, in place of the store."""
    shutil.rmtree(path)
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content)


_METADATA: Final[Mapping[str, Callable[[Rng, Path, str], Any]]] = {
    "metadata of an array lost": lambda _, path, array: (path / array / "zarr.json").unlink(),
    "metadata lost": lambda _, path, __: (path / "zarr.json").unlink(),
    "metadata emptied": lambda _, path, __: (path / "zarr.json").write_bytes(b""),
    "metadata of an array emptied": lambda _, path, a: (path / a / "zarr.json").write_bytes(b""),
    "metadata cut": lambda _, path, a: (path / a / "zarr.json").write_bytes(
        (path / a / "zarr.json").read_bytes()[:-20]
    ),
    "metadata of another text": lambda _, path, a: (path / a / "zarr.json").write_bytes(
        b"[1, 2]\xff"
    ),
    "an array lost": lambda _, path, array: shutil.rmtree(path / array),
    "an array renamed": lambda _, path, array: (path / array).rename(path / f"{array}2"),
    "metadata edited": _edit,
    "attributes edited": _attributes,
    "a foreign file": lambda _, path, __: (path / "notes.txt").write_text("x", encoding="ascii"),
    "emptied": lambda _, path, __: _replaced(path, None),
    "a file": lambda _, path, __: _replaced(path, b"PK"),
    "gone": lambda _, path, __: shutil.rmtree(path),
}


def cell(value: float, seed: int) -> xr.Dataset:
    """Something to be cached."""
    return xr.Dataset({"drawn": ("n", value + np.random.default_rng(seed).random(300))})


def cells(rng: Rng) -> Attack:
    """A cached result whose file is flipped, cut, emptied, lost or foreign: computed anew."""
    folder = workplace() / "cells"
    shutil.rmtree(folder, ignore_errors=True)
    cache.kept(cell, folder)(1.0, 1)
    file = pick(rng, [file for file in _files(folder) if file.stat().st_size])
    what = pick(rng, ["flipped", "flipped", "cut", "emptied", "lost", "of noise"])
    content = file.read_bytes()
    if what == "flipped":
        flip(rng, file)
    elif what == "lost":
        file.unlink()
    else:
        kept = {"cut": content[: int(rng.integers(len(content)))], "emptied": b""}
        file.write_bytes(kept.get(what, rng.bytes(len(content))))

    def judge(found: xr.Dataset) -> Verdict:
        return wrong("other values", where=not found.identical(cell(1.0, 1)))

    act = lambda: cache.kept(cell, folder)(1.0, 1)  # noqa: E731
    return Attack(f"cached {file.name} {what}", act, judge, (file.name,))


def numbers(rng: Rng) -> Attack:
    """Files of numbers cut, flipped, with other types, infinite, repeated or foreign."""
    path = _copy("numbers.json")
    text = path.read_text(encoding="utf-8")
    worse = [
        text[: int(rng.integers(len(text)))],
        text.replace("0.21", "NaN"),
        text.replace("0.21", "1e999"),
        text.replace("0.21", "null"),
        text.replace("0.21", "[1]"),
        text.replace("0.21", '0.21, "rmse_K": 0.9'),
        "[]",
        "{}",
        "\x00" * 30,
        text.replace("rmse", "rm\udcffse"),
        "[" * 100_000,
    ]
    content = str(pick(rng, worse))
    path.write_bytes(content.encode("utf-8", "surrogateescape"))
    # A cut may fall behind the last bracket: nothing is lost then.
    judge = lambda got: wrong(f"{got}", where=got != {"rmse_K": 0.21, "name": "a"})  # noqa: E731
    return Attack(
        f"numbers {content[:60]!r}", lambda: store.read_numbers(path), judge, ("numbers.json",)
    )


SESSION: Final = """
name: plate
simulated: true
protocol: response
duration: 0.15
frame_rate: 100
shape: [4, 80]
telemetry_rows: 2
cameras:
  "8-14":
    video: "v4l2:///dev/video0"
    control: "serial:///dev/ttyACM0"
  "9.5":
    video: "v4l2:///dev/video2"
    control: "serial:///dev/ttyACM1"
devices:
  filter_wheel: "serial:///dev/ttyUSB0"
  thermocouples: "tc08:"
filters: {1: "9.5", 3: "11"}
wheel: {velocity: 50.0, home_velocity: 50.0, acceleration: 2000.0}
sweep: ["9.5", "11"]
thermocouples: {1: blackbody, 4: plate}
blackbody: {temperatures: [300.0, 290.0], stability: 0.1, window: 3, timeout: 20}
"""

_VALUES: Final[tuple[Any, ...]] = (
    *(None, True, -1, 0, 1e400, float("nan"), 10**30, "text", "", [], {}, [0, 0], [4], [-4, 80]),
    *([4.5, 80], [10**9, 10**9], {"a": 1}, "v4l2:///etc/passwd", "sim://", "sim://boson/"),
    *("serial://", "tc08:/tmp/x.so", "file:///etc/passwd", "\x00", "a/b", "../../x", "sim://y16/w"),
    *("http://localhost", [[17, 33]], [["a"]], "1" * 5000, -273.15, 20.0, "2001-01-01"),
)


def sessions(rng: Rng) -> Attack:
    """Session files with values of other kinds, keys that repeat, are unknown or lost, cut text."""
    path = workplace() / "session.yaml"
    content = yaml.safe_load(SESSION)
    what = str(rng.choice(["value", "value", "value", "value", "lost", "unknown", "twice", "text"]))
    text, changed = SESSION, ""
    places = [*_places(content)]
    holder, key = places[int(rng.integers(len(places)))]
    if what == "value":
        holder[key] = _VALUES[int(rng.integers(len(_VALUES)))]
        changed = f"{key}: {str(holder[key])[:30]!r}"
    elif what == "lost":
        del holder[key]
        changed = f"{key}"
    elif what == "unknown":
        key = f"{key}x"
        (holder if isinstance(holder, dict) else content)[key] = 1
        changed = key
    if what in ("value", "lost", "unknown"):
        text = yaml.safe_dump(content, allow_unicode=True)
    elif what == "twice":
        key = str(rng.choice(["name", "duration", "simulated", "protocol"]))
        text, changed = f"{SESSION}{key}: 3\n", f"'{key}' a second time"
    else:
        text = _broken(rng, SESSION)
        key, changed = path.name, repr(text[-30:])
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    return Attack(
        f"session {what} {changed}",
        lambda: _dry_run(path),
        lambda found: _session_verdict(found, what, path, str(key)),
    )


def _places(content: Any) -> Any:
    """Holders and keys of all values."""
    pairs = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in list(pairs):
        yield content, key
        if isinstance(value, (dict, list)):
            yield from _places(value)


def _broken(rng: Rng, text: str) -> str:
    place = int(rng.integers(len(text)))
    worse = ["\t", "]", "{", "\udcff", ": :", "&a *b", "!!python/object/apply:os.system ['true']"]
    kind = int(rng.integers(3))
    if kind == 0:
        return text[:place]
    if kind == 1:
        bomb = "a: &a [x,x,x,x,x,x,x,x,x]\n"
        levels = [
            f"{c}: &{c} [{','.join(['*' + b] * 9)}]"
            for b, c in zip("abcdefgh", "bcdefghi", strict=True)
        ]
        return bomb + "\n".join(levels) + text
    return text[:place] + str(pick(rng, worse)) + text[place:]


def _dry_run(path: Path) -> tuple[int, str, str]:
    """Exit status, output and error of ``dbthermal record --simulate --dry-run``."""
    out, err = StringIO(), StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        folder = str(workplace() / "recordings")
        status = main(["record", str(path), folder, "--simulate", "--dry-run"])
    return status, out.getvalue(), err.getvalue()


def _session_verdict(found: tuple[int, str, str], what: str, path: Path, key: str) -> Verdict:
    """Status 2 and an error that names the key, or a session that is really as described."""
    status, _, err = found
    if status == 0:
        if what in ("twice", "unknown"):
            return wrong(f"{what} key '{key}' is accepted")
        session = Session.load(path)
        sane = 0 < session.shape[0] * session.shape[1] < 1e8 and 0 < session.duration < 1e7
        return wrong(f"accepted: {session}", where=not sane)
    named = key in err or path.name in err
    if named and "Traceback" not in err:
        return Verdict("refused", err[:200])
    return Verdict("traceback", f"status {status}, names not '{key}': {err[:300]}")


def parameters(rng: Rng) -> Attack:
    """``params/<notebook>.yaml`` with repeated or broken text, as the notebooks' Run reads it."""
    from reproduction import run  # noqa: PLC0415 - imports what the notebooks need

    stems = sorted(path.stem for path in (REPOSITORY / "params").glob("0[1-6]*.yaml"))
    stem = str(rng.choice(stems))
    text = (REPOSITORY / "params" / f"{stem}.yaml").read_text(encoding="utf-8")
    what = str(rng.choice(["twice", "broken", "list", "empty", "lost"]))
    good = {**yaml.safe_load(text), "results": "full"}
    spoilt = {
        "twice": text + "\nseed: 3\nseed: 4\n",
        "broken": _broken(rng, text),
        "list": "[1, 2]",
        "empty": "",
        "lost": text + "\nno_such_parameter: 1\n",
    }[what]
    folder = workplace() / "params"
    folder.mkdir(exist_ok=True)
    file = folder / f"{stem}.yaml"
    file.write_bytes(spoilt.encode("utf-8", "surrogateescape"))

    def act() -> Any:
        kept = paths.params
        paths.params = lambda stem: folder / f"{stem}.yaml"
        try:
            return run.Run(stem, good).provenance["parameters"]
        finally:
            paths.params = kept

    return Attack(
        f"parameters of {stem}: {what}",
        act,
        lambda got: wrong(
            f"accepted {got}"[:200], where=what == "twice" or not set(got) <= set(good)
        ),
        (f"{stem}|no_such_parameter",),
    )


def manifests(rng: Rng) -> Attack:
    """``data_manifest.yaml`` with names that leave the folder, other sizes, broken text."""
    entry = {"name": "a.txt", "sha256": "0" * 64, "bytes": 3}
    collection: dict[str, Any] = {
        "title": "t", "origin": "https://localhost/", "citation": ["c"], "terms": "t",
        "used_by": ["u"], "note": "n", "files": [entry],
    }  # fmt: skip
    content: dict[str, Any] = {"collections": {"spectra": collection}}
    what = str(
        rng.choice(["file", "collection", "origin", "sha256", "bytes", "twice", "broken", "key"])
    )
    name = str(pick(rng, ["../a", "/etc/passwd", "..", ".", "", "a/b", "a\x00"]))
    if what == "file":
        entry["name"] = name
    elif what == "collection":
        content["collections"] = {name: collection}
    elif what == "origin":
        collection["origin"] = pick(rng, ["file:///etc/", "", "/etc/"])
    elif what in ("sha256", "bytes"):
        entry[what] = pick(rng, [-1, 0, 1.5]) if what == "bytes" else "z" * 64
    elif what == "key":
        collection["keyx"] = 1
    text = yaml.safe_dump(content)
    text = text + text if what == "twice" else _broken(rng, text) if what == "broken" else text
    path = workplace() / "data_manifest.yaml"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))

    def act() -> Any:
        kept = paths.manifest
        paths.manifest = lambda: path
        try:
            return manifest.load()
        finally:
            paths.manifest = kept

    return Attack(
        f"manifest: {what} {name!r}",
        act,
        lambda got: wrong(f"accepted {got}"[:300], where=what != "broken" or not got.collections),
        ("data_manifest|spectra|name|bytes|origin|sha256|collection",),
    )


def leave() -> None:
    """Remove what this process wrote."""
    shutil.rmtree(workplace(), ignore_errors=True)
