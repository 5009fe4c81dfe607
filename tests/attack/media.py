"""Hostile spectra, videos and recordings: made here, or the public files themselves, damaged."""

import operator
import os
import shutil
from collections.abc import Callable, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

import hostile_files as hostile
import numpy as np
import xarray as xr

from attack.files import flip, workplace
from attack.oracle import LIMIT, Attack, Verdict
from attack.scenes import pick
from attack.stages import RIGHT, wrong
from dbthermal import readers
from reproduction import palettes

Rng = np.random.Generator


@cache
def _whole(kind: str) -> tuple[bytes, ...]:
    """Files of a library: a look-alike, and some of the public ones where they are."""
    folder = os.environ.get("DBTHERMAL_DATA")
    pattern = {"ecostress": "*.txt", "slum": "LUMA*.csv", "ucsb": "*[!T].csv"}[kind]
    public = sorted(Path(folder, kind).glob(pattern))[::40] if folder else []
    return (hostile.tables()[kind], *(path.read_bytes() for path in public))


def spectra(rng: Rng) -> Attack:
    """Spectra of three libraries: cut, with rows lost, swapped or spoilt, of other text."""
    kind = str(rng.choice(["ecostress", "slum", "ucsb"]))
    whole = pick(rng, _whole(kind))
    path = workplace() / f"{kind}.spectrum"
    what = str(rng.choice(list(_TABLES)))
    spoilt = _TABLES[what](rng, whole)
    read: Callable[[Path], Any] = getattr(readers, kind)
    path.write_bytes(whole)
    truth = _values(read(path))
    path.write_bytes(spoilt)

    def judge(found: Any) -> Verdict:
        values = _values(found)
        sizes = [v.shape for v in values]
        same = sizes == [v.shape for v in truth] and all(map(_near, values, truth))
        return wrong(f"{what} accepted: {len(sizes)} arrays, {sizes[:4]}", where=not same)

    # The public file of this library may end at 3.3 or 3.7 um, and does not say so.
    endless = "cut" in what and kind == "ucsb"
    limit = "no number of rows in the file" if endless else ""
    return Attack(f"{kind}: {what}", lambda: read(path), judge, (path.name,), limit=limit)


_near: Final = partial(np.allclose, rtol=0, atol=1e-12)


def _values(found: Any) -> list[np.ndarray]:
    parts = found.values() if isinstance(found, dict) else [found]
    return [one[name].values for one in parts for name in ("emissivity", "wavelength")]


def _line(rng: Rng, whole: bytes, change: Callable[[list[bytes], int], Any]) -> bytes:
    """Change one line of the table, behind the header."""
    lines = whole.split(b"\n")
    filled = [n for n, line in enumerate(lines) if line.strip()[:1].isdigit()]
    change(lines, filled[int(rng.integers(1, len(filled) - 1))])
    return b"\n".join(lines)


def _put(value: bytes) -> Callable[[list[bytes], int], None]:
    """Another value in place of the line's first or last number."""

    def change(lines: list[bytes], place: int) -> None:
        mark = b"," if b"," in lines[place] else None
        parts = lines[place].split(mark)
        parts[0 if value == b"-1" else -1] = value
        lines[place] = (mark or b" ").join(parts)

    return change


def _swap(lines: list[bytes], place: int) -> None:
    lines[place], lines[place + 1] = lines[place + 1], lines[place]


def _cut_at_row(rng: Rng, whole: bytes) -> bytes:
    lines = whole.rstrip().split(b"\n")
    return b"\n".join(lines[: int(rng.integers(len(lines) * 2 // 3, len(lines) - 1))]) + b"\n"


_TABLES: Final[Mapping[str, Callable[[Rng, bytes], bytes]]] = {
    "cut": lambda rng, whole: whole[: int(rng.integers(len(whole) - 30))],
    "cut at a row": _cut_at_row,
    "emptied": lambda *_: b"",
    "zeros": lambda _, whole: b"\x00" * len(whole),
    "of noise": lambda rng, whole: rng.bytes(len(whole)),
    "NaN": lambda rng, whole: _line(rng, whole, _put(b"nan")),
    "infinite": lambda rng, whole: _line(rng, whole, _put(b"inf")),
    "negative wavelength": lambda rng, whole: _line(rng, whole, _put(b"-1")),
    "a word": lambda rng, whole: _line(rng, whole, _put(b"oops")),
    "bad UTF-8": lambda rng, whole: _line(rng, whole, _put(b"\xff\xfe")),
    "a value of 10^9": lambda rng, whole: _line(rng, whole, _put(b"1e9")),
    "rows swapped": lambda rng, whole: _line(rng, whole, _swap),
    "a row short": lambda rng, one: _line(
        rng, one, lambda rows, n: operator.setitem(rows, n, b"8")
    ),
    "a row twice": lambda rng, whole: _line(rng, whole, lambda rows, n: rows.insert(n, rows[n])),
    "no header": lambda _, whole: whole.split(b"\n\n" if b"\n\n" in whole else b"\n", 1)[1],
    "another library": lambda _, whole: _whole("slum" if b"Name" in whole else "ecostress")[0],
    "semicolons": lambda _, whole: whole.replace(b",", b";").replace(b"Name:", b"Title"),
}


@cache
def _film() -> tuple[bytes, np.ndarray]:
    """A small video of a wave drawn in plasma, and its positions."""
    path = hostile.video(workplace() / "whole.mp4")
    return path.read_bytes(), palettes.palette_video(path).values


@cache
def _large() -> bytes:
    """A video of a few kB, whose pictures take a gigabyte."""
    plain = np.broadcast_to(np.array([204, 71, 120], np.uint8), (72, 1080, 1920, 3))
    return hostile.video(workplace() / "whole.mp4", plain, preset="ultrafast").read_bytes()


_LIST: Final = b"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nwhole.mp4\n#EXT-X-ENDLIST\n"


def _spoil(rng: Rng, content: bytes, what: str) -> bytes:
    """Video with its bytes damaged."""
    place = int(rng.integers(len(content) - 100))
    if what == "noise":
        first = content.index(b"mdat") + 4 + int(rng.integers(50, 1500))
        return content[:first] + rng.bytes(20) + content[first + 20 :]
    if what == "size":
        return hostile.falsely_sized(content)
    zeros = content[:place] + bytes(100) + content[place + 100 :]
    return {"cut": content[:place], "text": _LIST, "zeros": zeros}.get(what, content)


def videos(rng: Rng) -> Attack:
    """Videos cut, flipped, emptied, of a false size, no files, addresses and playlists."""
    (whole, truth), path = _film(), workplace() / "video" / "film.mp4"
    path.parent.mkdir(exist_ok=True)
    what = str(rng.choice(["flipped"] * 4 + ["noise", "cut", "size", "address", "text", "zeros"]))
    large = rng.random() < 0.05
    what, given = "large" if large else what, str(path)
    path.write_bytes(_spoil(rng, _large() if large else whole, what))
    if what == "flipped":
        flip(rng, path)
    if what == "address":
        given = str(rng.choice(_ADDRESSES)).format(path)

    def judge(found: Any) -> Verdict:
        if what == "address":
            return wrong(f"'{given[:30]}' was opened")
        if found.shape != truth.shape:
            return wrong(f"{what}: {found.shape[0]} of {truth.shape[0]} frames")
        off = float(np.abs(found.values - truth).max())
        # A bit that the codec cannot tell from another picture changes little of it.
        return wrong(f"{what}: positions off by {off:.2f}", where=off > 0.25) if off else RIGHT

    limit = "H.264 has no checksum" if what in ("flipped", "noise", "zeros") else ""
    told = given if what == "address" else ""
    act = lambda: palettes.palette_video(given)  # noqa: E731
    return Attack(f"video {what} {told}", act, judge, (f"film|{Path(given).name}",), limit=limit)


_ADDRESSES: Final = (
    *("file://{}", "concat:{0}|{0}", "subfile,,start,0,end,900,,:{}", "lavfi:testsrc film"),
    *("data:video/mp4;base64,AAAA film", "pipe:0 film", "cache:{}", "http://localhost:9/film.mp4"),
)


@cache
def _recording(form: str) -> Path:
    """Recording of a form, undamaged."""
    return hostile.write(workplace() / f"whole.{form}", form)


def recordings(rng: Rng) -> Attack:
    """Recordings of every form with a bit flipped, cut, zeroed, a huge number, pieces exchanged."""
    form = str(rng.choice([*hostile.FILES, *hostile.STORES]))
    whole, path = _recording(form), workplace() / f"recording.{form}"
    shutil.rmtree(path, ignore_errors=True)
    (shutil.copytree if whole.is_dir() else shutil.copy)(whole, path)
    every = [one for one in path.rglob("*") if one.is_file()] or [path]
    parts = sorted(one for one in every if one.stat().st_size > 64)
    part = parts[int(rng.integers(len(parts)))]
    before = part.read_bytes()
    what, after = hostile.damaged(before, int(rng.integers(2**31)))
    part.write_bytes(after)

    def judge(found: xr.Dataset) -> Verdict:
        fate = hostile.fate(form, before, after, found)
        if fate == "marked":
            return Verdict("flagged", "frames are marked")
        if fate == "pixels":
            return Verdict(LIMIT, "pixels without a checksum are what the file says")
        return RIGHT if fate == "same" else wrong(f"{form} {what} in {part.name}: {fate}")

    limit = "JPEG-LS has no checksum" if form == "csq" else ""
    if form in hostile.STORES and "zar" not in part.name:
        limit = "chunks without a checksum"
    if form in {"seq", "fff"} and what == "cut":
        limit = "a cut between two frames ends a recording"
    if form in hostile.TIFF and what == "zero":
        limit = "zeros may end the chain of pages"
    act = lambda: hostile.read(path, form)  # noqa: E731
    return Attack(f"recording {form}: {what} in {part.name}", act, judge, (path.name,), limit=limit)
