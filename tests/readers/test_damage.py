"""Damaged files of every form: refused by name and rule, or read as what the file says."""

import math
import random
import re
import resource
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import hostile_files as hostile
import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_array_equal

from dbthermal import readers, store
from reproduction import palettes

Read = Callable[[Path], xr.Dataset | dict[str, xr.Dataset]]

SIZES = [
    100,
    pytest.param(1000, marks=pytest.mark.slow),
    pytest.param(10_000, marks=pytest.mark.long),
]
"""Damaged files of a form: the same few in the quick tests, others every week in the slow ones."""


def first_seed(number: int, fewest: int = 100) -> int:
    """First seed of so many, those of the week but for the quick tests; it is printed."""
    seed = 0 if number == fewest else 10_000 * hostile.seed_of_week()
    print(f"DBTHERMAL_SEED={hostile.seed_of_week()}, first seed {seed}")
    return seed


def at_most(share: float, number: int) -> float:
    """Largest count of a share, three standard deviations above what is expected."""
    return share * number + 3 * math.sqrt(share * number) + (1 if share else 0)


@pytest.mark.parametrize("number", SIZES)
@pytest.mark.parametrize("form", hostile.FILES)
def test_recordings(tmp_path: Path, form: str, number: int) -> None:
    """A damaged recording is refused, marked, or its pixels are those that the file holds.

    JPEG-LS has no checksum: a flipped bit may decode to other numbers. One TIFF in a thousand loses
    its last pages, where zeros end their chain and spoil the description. A sequence of FLIR or raw
    numbers may be cut between two frames. Nothing else passes, nor takes a GiB or 5 s of work.
    """
    path = hostile.write(tmp_path / f"a.{form}", form)
    whole, counts, first = path.read_bytes(), Counter[str](), first_seed(number)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for seed in range(first, first + number):
        kind, changed = hostile.damaged(whole, seed)
        path.write_bytes(changed)
        begun = time.process_time()
        try:
            outcome = f"{hostile.fate(form, whole, changed, hostile.read(path, form))}, {kind}"
        except ValueError as refusal:
            clear = re.search("Must |Has |Refused", str(refusal))
            outcome = "refused" if clear else f"unclear: {refusal}"
        counts[outcome] += 1
        assert time.process_time() - begun < 5  # [s]
    taken = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    print(form, dict(counts), f"{taken} KiB")
    assert taken < 2**20  # KiB
    assert not [key for key in counts if key.startswith("unclear")]
    assert counts["refused"] > 0.2 * number or form not in hostile.FLIR
    other = sum(value for key, value in counts.items() if key.startswith("other"))
    fewer = sum(value for key, value in counts.items() if key.startswith("fewer"))
    assert other <= (0.05 * number if form == "csq" else 0)
    assert fewer <= at_most(0.001 if form in hostile.TIFF else 0, number) or form in FRAMEWISE


FRAMEWISE = {"seq", "fff", "csq", "raw"}
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
    path, read = tmp_path / f"{library}.txt", getattr(readers, library)
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
    path = tmp_path / "brick.csv"
    path.write_bytes(hostile.tables()["ucsb"].replace(old, new, 1))
    if not message:
        assert isinstance(readers.ucsb(path), xr.Dataset)
        return
    with pytest.raises(ValueError, match=message):
        readers.ucsb(path)


@pytest.mark.parametrize(
    "number",
    [
        30,
        pytest.param(100, marks=pytest.mark.slow, id="slow"),
        pytest.param(1000, marks=pytest.mark.long),
    ],
)
@pytest.mark.parametrize("ending", hostile.CODECS)
def test_videos(tmp_path: Path, ending: str, number: int) -> None:
    """No cut video passes with other frames; a codec without checksum hides some of the rest.

    Of VP8, the most patient, up to two in five pass; of the others one in five.
    """
    path = hostile.video(tmp_path / f"copy.{ending}")
    content, whole, counts = path.read_bytes(), palettes.palette_video(path), Counter[str]()
    first = first_seed(number, 30)
    for seed in range(first, first + number):
        kind, changed = hostile.damaged(content, seed)
        path.write_bytes(changed)
        try:
            frames = palettes.palette_video(path)
        except ValueError as refusal:
            clear = re.search("copy.*Must ", str(refusal))
            counts["refused" if clear else f"unclear: {refusal}"] += 1
        else:
            equal = np.array_equal(frames, whole) and np.array_equal(frames.time, whole.time)
            counts["same" if equal else f"different, {kind}"] += 1
    print(ending, dict(counts))
    assert not [key for key in counts if key.startswith("unclear") or key == "different, cut"]
    different = sum(count for kind, count in counts.items() if "different" in kind)
    assert different <= (0.4 if ending == "webm" else 0.2) * number
    assert counts["refused"] >= number / 4


def test_checksum_excludes_damage(tmp_path: Path) -> None:
    """With the file's checksum no damaged file passes, also one that decodes without complaint."""
    path = hostile.video(tmp_path / "a.mp4")
    whole, checksum = path.read_bytes(), store.checksum(path)
    assert palettes.palette_video(path, sha256=checksum).sizes["time"] == 12
    for seed in range(30):
        path.write_bytes(changed := hostile.damaged(whole, seed)[1])
        assert changed != whole or seed % 5 == 2  # a block of zeros may be where zeros were
        if changed != whole:
            with pytest.raises(ValueError, match=rf"Wrong SHA-256 .* Must be {checksum}"):
                palettes.palette_video(path, sha256=checksum)


def test_marked_frames_are_refused(tmp_path: Path) -> None:
    """A frame that FFmpeg conceals and marks as corrupt is an error."""
    path = hostile.video(tmp_path / "a.mp4")
    content, marked = path.read_bytes(), 0
    for seed in range(5, 400, 10):  # flips, anywhere
        path.write_bytes(hostile.damaged(content, seed)[1])
        try:
            with av.open(str(path)) as container:
                frames = [*container.decode(video=0)]
        except (av.FFmpegError, IndexError, UnicodeDecodeError):
            continue
        if any(frame.is_corrupt for frame in frames):
            marked += 1
            with pytest.raises(ValueError, match=r"is marked corrupt|Truncated|Damaged"):
                palettes.palette_video(path)
    assert marked > 2


def test_size_is_known_before_memory_is_taken(tmp_path: Path) -> None:
    """A small file of large frames is refused for what it would take, and takes less than that."""
    path = hostile.video(tmp_path / "a.mp4", np.zeros((20, 1080, 1920, 3), dtype=np.uint8))
    assert path.stat().st_size < 30_000
    code = (
        "import resource, sys; from reproduction import palettes\n"
        "peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "palettes.palette_video(sys.argv[1]); before = peak()\n"
        "try: palettes.palette_video(sys.argv[2], memory=3e8)\n"
        "except ValueError as error: print(error)\n"
        "print(peak() - before)"
    )
    arguments = [sys.executable, "-c", code, str(hostile.video(tmp_path / "b.mp4")), str(path)]
    done = subprocess.run(arguments, capture_output=True, text=True, check=True)
    message, taken = done.stdout.splitlines()
    assert "20 frames of 1080 x 1920 pixels take 3.73e+08 bytes. Must be at most" in message
    assert int(taken) < 250_000  # KiB


def test_declared_frames_are_counted(tmp_path: Path) -> None:
    """What a table or the container declares is compared with the frames in the file."""
    path = hostile.video(tmp_path / "a.mp4")
    whole = path.read_bytes()
    table, play, index = whole.index(b"stsz"), whole.index(b"elst") + 12, whole.index(b"moov") - 4
    millions = (1).to_bytes(4) + (10_000_000).to_bytes(4)
    for changed, message in (
        (whole[: table + 8] + millions + whole[table + 16 :], "12 frames present, .* declared|Dam"),
        (whole[:play] + (500).to_bytes(4) + whole[play + 4 :], "'a.mp4': 5 frames decoded, 12 pre"),
        # The encoder writes the index after the frames.
        (whole[: index - 900] + bytes(900) + whole[index:], "Damaged video 'a.mp4': .* Must deco"),
    ):
        path.write_bytes(changed)
        with pytest.raises(ValueError, match=message):
            palettes.palette_video(path)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"no video",
        b"\0" * 5000,
        b"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile:///etc/passwd\n",
        b"ffconcat version 1.0\nfile a.mp4\n",
        b'<?xml version="1.0"?><MPD></MPD>',
        b"v=0\no=- 0 0 IN IP4 127.0.0.1\nm=video 1 RTP/AVP 96\n",
        b"\x89PNG\r\n\x1a\n",
        b"YUV4MPEG2 W4 H4 F25:1\nFRAME\n",
    ],
)
def test_playlists_are_no_videos(tmp_path: Path, content: bytes) -> None:
    """A file that names others, in whatever way, is refused by what it holds, not by its name."""
    hostile.video(tmp_path / "a.mp4")
    (tmp_path / "list.mp4").write_bytes(content)
    with pytest.raises(ValueError, match=r"Invalid video 'list\.mp4'. Must be MP4, MOV, Matroska"):
        palettes.palette_video(tmp_path / "list.mp4")


@pytest.mark.parametrize(
    "name", ["http://localhost/a.mp4", "concat:a.mp4|a.mp4", "file:a.mp4", "%d.mp4", "pipe:0"]
)
def test_addresses_are_no_files(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """An address or a pattern is the name of a file that is missing, and of nothing else."""
    monkeypatch.chdir(tmp_path)
    hostile.video(tmp_path / "1.mp4")
    with pytest.raises(FileNotFoundError):
        palettes.palette_video(name)
    for path in (tmp_path, "/dev/zero"):
        with pytest.raises(ValueError, match="Must be a regular file"):
            palettes.palette_video(path)


def test_what_a_file_names_is_not_opened(tmp_path: Path) -> None:
    """A QuickTime file whose data lie in another file does not open that one."""
    path = hostile.video(tmp_path / "a.mov")
    plain = palettes.palette_video(path)
    content = path.read_bytes().replace(b"url \x00\x00\x00\x01", b"url \x00\x00\x00\x00")
    assert content != path.read_bytes()
    path.write_bytes(content)
    try:
        assert_array_equal(palettes.palette_video(path), plain)  # its data are in itself
    except ValueError as refusal:
        assert "Must" in str(refusal)  # noqa: PT017
