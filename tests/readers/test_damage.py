"""Damaged files of every form: refused by name and rule, or read as what the file says."""

import math
import random
import re
import resource
import time
from collections import Counter
from pathlib import Path
from typing import Any

import hostile_files as hostile
import pytest
from marks import long

from dbthermal import readers
from reproduction import libraries

SIZES = [100, *long(1000, 10_000)]
"""Damaged files of a form: the same few in the quick tests, others every week in the long ones."""


def first_seed(number: int) -> int:
    """First seed of so many, those of the week but for the quick tests; it is printed."""
    seed = 0 if number == 100 else 10_000 * hostile.seed_of_week()
    print(f"DBTHERMAL_SEED={hostile.seed_of_week()}, first seed {seed}")
    return seed


def at_most(share: float, number: int) -> float:
    """Largest count of a share, three standard deviations above what is expected."""
    return share * number + 3 * math.sqrt(share * number) + (1 if share else 0)


@pytest.mark.parametrize("number", SIZES)
@pytest.mark.parametrize("form", [*hostile.FILES, *hostile.STORES])
def test_recordings(tmp_path: Path, form: str, number: int) -> None:
    """A damaged recording is refused, marked, or its pixels are those that the file holds.

    JPEG-LS has no checksum: a flipped bit may decode to other numbers. One TIFF in a thousand loses
    its last pages, where zeros end their chain and spoil the description. A sequence of FLIR or raw
    numbers may be cut between two frames. Nothing else passes, nor takes a GiB or 5 s of work.
    """
    path = hostile.write(tmp_path / f"a.{form}", form)
    counts, first = Counter[str](), first_seed(number)
    files = sorted(one for one in path.rglob("*") if one.is_file() and one.stat().st_size > 64)
    parts = [(part, part.read_bytes()) for part in files or [path]]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for seed in range(first, first + number):
        part, whole = parts[seed // 5 % len(parts)]
        kind, changed = hostile.damaged(whole, seed)
        part.write_bytes(changed)
        begun = time.process_time()
        try:
            outcome = f"{hostile.fate(form, whole, changed, hostile.read(path, form))}, {kind}"
        except UserWarning:
            outcome = "marked"
        except ValueError as refusal:
            clear = re.search("Must |Has |Refused", str(refusal))
            outcome = "refused" if clear else f"unclear: {refusal}"
        if form in hostile.STORES:  # whose chunks have no checksum, and names none of their own
            part.write_bytes(whole)
            outcome = outcome if "zar" in part.name else "chunk"
        counts[outcome] += 1
        assert time.process_time() - begun < 5  # [s]
    taken = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    print(form, dict(counts), f"{taken} KiB")
    assert taken < 2**20  # KiB
    assert not [key for key in counts if key.startswith("unclear")]
    assert counts["refused"] > 0.2 * number or form not in hostile.FLIR
    other = sum(value for key, value in counts.items() if key.startswith("other"))
    fewer = sum(value for key, value in counts.items() if key.startswith("fewer"))
    unseen = f"{dict(counts)}. Must be refused, or be known to `fate` of hostile_files.py."
    assert other <= (0.05 * number if form == "csq" else 0), unseen
    most = at_most(0.001 if form in hostile.TIFF else 0, number)
    assert fewer <= most or form in FRAMEWISE, unseen


FRAMEWISE = {"seq", "fff", "csq", "raw", "hcc"}
"""Forms whose frames follow one another, without a number of them."""


def mutant(content: bytes, seed: str) -> tuple[str, bytes]:
    """Name and content of a table that is cut, or of which a byte or a row is another."""
    rng = random.Random(seed)
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


def same(spectra: Any, whole: Any) -> bool:
    """Whether the numbers are those of the whole file."""
    if isinstance(whole, dict):
        return [*spectra] == [*whole] and all(spectra[key].equals(whole[key]) for key in whole)
    return bool(spectra.equals(whole))


@pytest.mark.parametrize("number", SIZES)
@pytest.mark.parametrize("library", hostile.tables())
def test_spectra(tmp_path: Path, library: str, number: int) -> None:
    """Only a digit that became another digit goes unseen: a cut or a row never does."""
    path = tmp_path / f"{library}.txt"
    read = readers.ecostress if library == "ecostress" else getattr(libraries, library)
    content, counts, first = hostile.tables()[library], Counter[str](), first_seed(number)
    path.write_bytes(content)
    whole = read(path)
    for seed in range(first, first + number):
        kind, changed = mutant(content, f"{library} {seed}")
        path.write_bytes(changed)
        try:
            counts[f"{kind}, {'same' if same(read(path), whole) else 'other'}"] += 1
        except ValueError as refusal:
            message = str(refusal)
            assert path.name in message
            assert re.search("[Mm]ust ", message), message
            assert "\n" not in message
            assert len(message) < 400
            counts[f"{kind}, refused"] += 1
    print(library, dict(counts))
    for kind in ("cut", "cut at a row", "row missing", "row twice"):
        assert counts[f"{kind}, other"] == 0
    bytes_changed = sum(count for key, count in counts.items() if key.startswith("byte"))
    assert counts["byte, other"] <= at_most(0.04, bytes_changed)
