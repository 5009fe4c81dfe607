"""Tables of spectra that were cut or changed: refused by file and line, or the same numbers."""

import random
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from test_readers import library_file

from dbthermal import readers

WAVENUMBERS = np.linspace(2731, 688, 341)  # 3.66 to 14.53 um, in steps of 6 [1/cm]
FINE = np.linspace(1250, 714, 120)  # 8 to 14 um [1/cm]

Read = Callable[[Path], xr.Dataset | dict[str, xr.Dataset]]


def tables(folder: Path) -> dict[str, tuple[Path, Read]]:
    """Write a file of each library, with a reader of each."""
    rows = [f"{1e4 / k:.6g},{k:.6g},{0.9 + 0.05 * np.sin(k / 90):.6f}" for k in WAVENUMBERS[::-1]]
    ucsb = folder / "brick.csv"
    ucsb.write_text("x1,x2,y_brick\n" + "".join(f"{row}\n" for row in rows))
    slum = folder / "slum.csv"
    rows = [f"{1e4 / k:.8f},{0.9 + k / 1e5:.8f},{0.95 - k / 1e5:.8f}" for k in FINE]
    slum.write_text("wavelength,A001,A002\n" + "".join(f"{row}\n" for row in rows))
    ecostress = library_file(folder, [*(1e4 / FINE)], [*(5 + FINE / 500)], "\r\n")
    return {
        "ecostress": (ecostress, readers.ecostress),
        "slum": (slum, readers.slum),
        "ucsb": (ucsb, readers.ucsb),
    }


def changed(content: bytes, rng: random.Random) -> tuple[str, bytes]:
    """Name and content of a table that is cut, or of which a byte or a row is another."""
    kind = rng.choice(["cut", "byte", "row missing", "row twice", "cut at a row"])
    lines, place = content.splitlines(keepends=True), rng.randrange(len(content))
    row = rng.randrange(len(lines))
    if kind == "cut":
        return kind, content[:place]
    if kind == "byte":
        return kind, content[:place] + bytes([rng.randrange(256)]) + content[place + 1 :]
    if kind == "cut at a row":
        return kind, b"".join(lines[:row])
    return kind, b"".join(
        lines[:row] + (lines[row : row + 1] * 2 if "twice" in kind else []) + lines[row + 1 :]
    )


def fates(folder: Path, number: int) -> Counter[tuple[str, str]]:
    """Count what became of changed tables: refused, the same, or other numbers."""
    counts: Counter[tuple[str, str]] = Counter()
    for name, (path, read) in tables(folder).items():
        content, whole = path.read_bytes(), read(path)
        for seed in range(number):
            kind, mutant = changed(content, random.Random(f"{name} {seed}"))
            path.write_bytes(mutant)
            found = read_or_message(read, path)
            if isinstance(found, str):
                assert path.name in found, found
                assert "Must " in found or "must " in found, found
                assert "\n" not in found
                assert len(found) < 400
                counts[kind, "refused"] += 1
            else:
                counts[kind, "same" if same(found, whole) else "other"] += 1
    return counts


def read_or_message(read: Read, path: Path) -> xr.Dataset | dict[str, xr.Dataset] | str:
    """Spectra, or the message with which their file is refused."""
    try:
        return read(path)
    except ValueError as error:
        return str(error)


def same(found: Any, whole: Any) -> bool:
    """Whether the numbers are those of the whole file."""
    if isinstance(whole, dict):
        return [*found] == [*whole] and all(found[key].equals(whole[key]) for key in whole)
    return bool(found.equals(whole))


def check(counts: Counter[tuple[str, str]]) -> None:
    """Only a digit that became another digit goes unseen: a cut or a row never does."""
    for kind in ("cut", "cut at a row", "row missing", "row twice"):
        assert counts[kind, "other"] == 0, counts
    changed_bytes = sum(count for (kind, _), count in counts.items() if kind == "byte")
    assert counts["byte", "other"] <= 0.06 * changed_bytes, counts


def test_changed_tables_are_refused_by_line(tmp_path: Path) -> None:
    """Of 150 changed tables of each library, no cut and no missing or repeated row passes."""
    check(fates(tmp_path, 150))


@pytest.mark.slow
def test_many_changed_tables_are_refused_by_line(tmp_path: Path) -> None:
    """The same of 2,000 of each."""
    counts = fates(tmp_path, 2000)
    print({f"{kind}, {fate}": count for (kind, fate), count in sorted(counts.items())})
    check(counts)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"0.9", b"\xff.9", r"brick\.csv, line 2, column \d+: Invalid byte 0xff. Must be text"),
        (b"0.9", b"nan", r"brick\.csv, line \d+, column \d: Invalid number 'nan"),
        (b",688,", b",nan,", r"brick\.csv, line 2, column 2: Invalid number 'nan'. Must be finite"),
        (b",688,", b",750,", r"brick\.csv, line 2: Invalid wavenumber 750.0 1/cm at 14.5349"),
        (b",688,", b',"688",', ""),
        (b",688,", b',"6,88",', r"line 2, column 2: Invalid number '6,88'. Must be finite"),
        (b",688,", b",688;", r"line 2: Invalid row .* Must be 3 numbers"),
        (b",688,", b",-688,", r"Invalid wavenumber -688.0"),
        (b",688,", "\uff16\uff18\uff18".encode().join([b",", b","]), r"column 2: Invalid number"),
    ],
)
def test_a_number_is_named_by_line(tmp_path: Path, old: bytes, new: bytes, message: str) -> None:
    """Bad bytes, numbers that are none and other separators are named by line and column."""
    path, read = tables(tmp_path)["ucsb"]
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    if not message:
        assert isinstance(read(path), xr.Dataset)
        return
    with pytest.raises(ValueError, match=message):
        read(path)
