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
from reproduction import cache, paths
from reproduction import manifest as downloads

Rng = np.random.Generator
REPOSITORY: Final = Path(__file__).parents[2]
main: Final[Callable[[list[str]], int]] = entry_points(group="console_scripts")["dbthermal"].load()
"""The command line, as a shell finds it."""
LINES: Final = "x" * 40  # an attribute of some length
STORES: Final = ("result.zarr", "recording.zarr")


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
    path, bands = folder / "recording.zarr", ["8-14", "9.5"]
    recording = store.Recording(path, variables, {"y": 16, "x": 20}, bands, chunk=10, attrs={})
    for _ in range(4):
        for place, band in enumerate(bands):
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
        part = {str(dim): slice(0, size) for dim, size in opened.sizes.items()}
        kept = [n for n in opened.data_vars if n in whole]
        same = all(_alike(whole[n].isel(part, missing_dims="ignore"), opened[n]) for n in kept)
        if same and opened.attrs.get("complete") is False:
            return Verdict("flagged")
        names = {*whole.variables} ^ {*opened.variables}
        common = {*whole.variables} & {*opened.variables}
        names |= {name for name in common if not _alike(whole[name], opened[name])}
        changed = sorted(map(str, names))
        if not changed and attributes and whole.attrs != opened.attrs:
            changed = ["attributes"]
        return wrong(f"other {changed}", where=bool(changed))

    return judge


def _alike(first: xr.DataArray, second: xr.DataArray) -> bool:
    """Of the same dims, type and values, bit by bit."""
    kinds = (first.dtype.kind, first.dims, first.shape)
    same = kinds == (second.dtype.kind, second.dims, second.shape)
    return same and first.values.tobytes() == second.values.astype(first.dtype).tobytes()


def _store_with(what: str, path: Path, file: Path, *, attributes: bool) -> Attack:
    """A store with a damaged file."""
    inside = file.relative_to(path)
    names = (path.name, inside.parts[0] if len(inside.parts) > 1 else "")
    judge = _same(path, attributes=attributes)
    return Attack(f"{path.name}/{inside}: {what}", lambda: _open(path), judge, names)


def bits(rng: Rng) -> Attack:
    """One bit flipped anywhere in a store."""
    path = _copy(str(rng.choice(STORES)))
    # As likely in one file as in another: else nearly all were in the counts.
    file = pick(rng, [file for file in _files(path) if file.stat().st_size])
    return _store_with(f"bit of byte {flip(rng, file)} flipped", path, file, attributes=True)


def chunks(rng: Rng) -> Attack:
    """A chunk of a store lost, emptied, cut, exchanged with another, or from another store."""
    path = _copy(str(rng.choice(STORES)))
    files = [file for file in _files(path) if file.name != "zarr.json"]
    file = pick(rng, files)
    what = str(rng.choice(["lost", "lost", "emptied", "cut", "exchanged", "of noise", "a folder"]))
    whole, size = file.read_bytes(), file.stat().st_size
    if what in ("lost", "a folder"):
        file.unlink()
    if what == "a folder":
        file.mkdir()
    if what == "emptied":
        file.write_bytes(b"")
    if what == "cut":
        file.write_bytes(whole[: -int(rng.integers(1, size))])
    if what == "of noise":
        file.write_bytes(rng.bytes(size))
    if what == "exchanged":
        array = file.relative_to(path).parts[0]
        others = [f for f in files if f != file and f.relative_to(path).parts[0] == array]
        other = pick(rng, others) if others else file
        file.write_bytes(other.read_bytes())
        other.write_bytes(whole)
    return _store_with(f"chunk {what}", path, file, attributes=False)


def stores(rng: Rng) -> Attack:
    """Metadata of a store lost, emptied, edited or foreign; arrays renamed, lost or added."""
    path = _copy(str(rng.choice(STORES)))
    array = str(rng.choice(sorted(part.name for part in path.iterdir() if part.is_dir())))
    what = str(rng.choice(list(_METADATA)))
    _METADATA[what](rng, path, array)
    judge = _same(path, attributes=what != "a foreign file")
    return Attack(f"{path.name}/{array}: {what}", lambda: _open(path), judge, (path.name,))


def _edit(rng: Rng, path: Path, array: str) -> None:
    file = path / array / "zarr.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    sizes = [10**9 for _ in content["shape"]]
    worse = {"shape": sizes, "dimension_names": ["a" for _ in sizes], "data_type": "int8"}
    worse |= {"fill_value": 7, "codecs": [], "node_type": "group"}
    key = str(rng.choice(list(worse)))
    file.write_text(json.dumps({**content, key: worse[key]}), encoding="utf-8")


def _attributes(rng: Rng, path: Path, _: str) -> None:
    file = path / "zarr.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    key = str(rng.choice(sorted(content["attributes"])))
    content["attributes"][key] = pick(rng, [None, -1, 1e9, "text"])
    file.write_text(json.dumps(content), encoding="utf-8")


def _described(change: Callable[[bytes], bytes]) -> Callable[[Rng, Path, str], Any]:
    """Change of an array's metadata."""

    def damage(_: Rng, path: Path, array: str) -> None:
        file = path / array / "zarr.json"
        file.write_bytes(change(file.read_bytes()))

    return damage


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
    "metadata of an array emptied": _described(lambda _: b""),
    "metadata cut": _described(lambda content: content[:-20]),
    "metadata of another text": _described(lambda _: b"[1, 2]\xff"),
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
    values = ("NaN", "1e999", "null", "[1]", '0.21, "rmse_K": 0.9')
    worse = [text[: int(rng.integers(len(text)))], *(text.replace("0.21", one) for one in values)]
    worse += ["[]", "{}", "\x00" * 30, text.replace("rmse", "rm\udcffse"), "[" * 100_000]
    content = str(pick(rng, worse))
    path.write_bytes(content.encode("utf-8", "surrogateescape"))
    # A cut may fall behind the last bracket: nothing is lost then.
    judge = lambda got: wrong(f"{got}", where=got != {"rmse_K": 0.21, "name": "a"})  # noqa: E731
    act = lambda: store.read_numbers(path)  # noqa: E731
    return Attack(f"numbers {content[:60]!r}", act, judge, ("numbers.json",))


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
    holder, key = pick(rng, [*_places(content)])
    if what == "value":
        holder[key] = _VALUES[int(rng.integers(len(_VALUES)))]
    elif what == "lost":
        del holder[key]
    elif what == "unknown":
        (holder if isinstance(holder, dict) else content)[key := f"{key}x"] = 1
    text = yaml.safe_dump(content, allow_unicode=True)
    if what == "twice":
        key = str(rng.choice(["name", "duration", "simulated", "protocol"]))
        text = f"{SESSION}{key}: 3\n"
    elif what == "text":
        text, key = _broken(rng, SESSION), path.name
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    judge = lambda found: _session_verdict(found, what, path, str(key))  # noqa: E731
    shown = str(holder[key])[:30] if what == "value" else text[-30:]
    return Attack(f"session {what} {key}: {shown!r}", lambda: _dry_run(path), judge)


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
    if kind == 1:  # nine times as much a line
        pairs = zip("abcdefgh", "bcdefghi", strict=True)
        levels = [f"{c}: &{c} [{','.join(['*' + b] * 9)}]" for b, c in pairs]
        return "\n".join(["a: &a [x,x,x,x,x,x,x,x,x]", *levels]) + text
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


def _file_of(name: str, path: Path, text: str, act: Callable[[], Any]) -> Callable[[], Any]:
    """A call that finds a file of the checkout with another text."""
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(text.encode("utf-8", "surrogateescape"))

    def call() -> Any:
        kept = getattr(paths, name)
        setattr(paths, name, lambda *_: path)
        try:
            return act()
        finally:
            setattr(paths, name, kept)

    return call


def parameters(rng: Rng) -> Attack:
    """``params/<notebook>.yaml`` with repeated or broken text, as the notebooks' Run reads it."""
    from reproduction import run  # noqa: PLC0415 - imports what the notebooks need

    stem = str(rng.choice(sorted(p.stem for p in (REPOSITORY / "params").glob("0[1-6]*.yaml"))))
    text = (REPOSITORY / "params" / f"{stem}.yaml").read_text(encoding="utf-8")
    good = {**yaml.safe_load(text), "results": "full"}
    spoilt = {"twice": f"{text}\nseed: 3\nseed: 4\n", "broken": _broken(rng, text)}
    spoilt |= {"list": "[1, 2]", "empty": "", "lost": f"{text}\nno_such_parameter: 1\n"}
    what = str(rng.choice(list(spoilt)))

    def judge(got: Any) -> Verdict:
        return wrong(f"accepted {got}"[:200], where=what == "twice" or not set(got) <= set(good))

    act = lambda: run.Run(stem, good).provenance["parameters"]  # noqa: E731
    call = _file_of("params", workplace() / "params" / f"{stem}.yaml", spoilt[what], act)
    return Attack(f"parameters of {stem}: {what}", call, judge, (f"{stem}|no_such_parameter",))


def manifest(rng: Rng) -> Attack:
    """``data_manifest.yaml`` with names that leave the folder, other sizes, broken text."""
    entry = {"name": "a.txt", "sha256": "0" * 64, "bytes": 3}
    collection: dict[str, Any] = {"title": "t", "origin": "https://localhost/", "citation": ["c"]}
    collection |= {"terms": "t", "used_by": ["u"], "note": "n", "files": [entry]}
    what = str(
        rng.choice(["file", "collection", "origin", "sha256", "bytes", "twice", "broken", "key"])
    )
    name = str(pick(rng, ["../a", "/etc/passwd", "..", ".", "", "a/b", "a\x00"]))
    if what == "origin":
        collection["origin"] = pick(rng, ["file:///etc/", "", "/etc/"])
    if what == "key":
        collection["keyx"] = 1
    entry |= {"file": {"name": name}, "sha256": {"sha256": "z" * 64}}.get(what, {})
    entry |= {"bytes": pick(rng, [-1, 0, 1.5])} if what == "bytes" else {}
    kind = name if what == "collection" else "spectra"
    text = yaml.safe_dump({"collections": {kind: collection}})
    text = text + text if what == "twice" else _broken(rng, text) if what == "broken" else text

    def judge(got: Any) -> Verdict:
        return wrong(f"accepted {got}"[:300], where=what != "broken" or not got.collections)

    call = _file_of("manifest", workplace() / "data_manifest.yaml", text, downloads.load)
    names = ("data_manifest|spectra|name|bytes|origin|sha256|collection",)
    return Attack(f"manifest: {what} {name!r}", call, judge, names)


def leave() -> None:
    """Remove what this process wrote."""
    shutil.rmtree(workplace(), ignore_errors=True)
