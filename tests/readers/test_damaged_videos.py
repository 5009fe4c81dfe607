"""Videos that are damaged, enormous or no plain file: refused before they cost memory or trust."""

import random
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from test_readers import coloured, film, wave

from dbthermal import readers, store
from dbthermal.readers import _decoding as decoding

CODECS = {"mp4": "libx264", "mkv": "libx264", "mov": "mpeg4", "avi": "mjpeg", "webm": "libvpx"}


def encoded(path: Path) -> Path:
    """Encode the wave with the codec of the file's ending."""
    frames = coloured(wave(), "plasma")
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(CODECS[path.suffix[1:]], rate=10)
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuvj420p" if path.suffix == ".avi" else "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    return path


def damaged(content: bytes, seed: int) -> tuple[str, bytes]:
    """One flipped bit, the end cut off, or a block of zeros, and its name."""
    rng, changed = random.Random(seed), bytearray(content)
    kind = ("flip", "cut", "zero")[seed % 3]
    if kind == "flip":
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    elif kind == "cut":
        del changed[rng.randrange(len(changed) // 10, len(changed)) :]
    else:
        size = rng.choice([1, 16, 64, 512])
        start = rng.randrange(len(changed) - size)
        changed[start : start + size] = bytes(size)
    return kind, bytes(changed)


def decoded(path: Path) -> decoding.Film | str:
    """Frames of a video, or the message with which it is refused."""
    try:
        return decoding.decode(path, None, decoding.MEMORY, None)
    except ValueError as error:
        return str(error)


def outcomes(path: Path, number: int) -> Counter[str]:
    """Count the fates of damaged copies: refused, the same, or different frames."""
    content, copy = path.read_bytes(), path.with_stem("copy")
    whole, counts = decoding.decode(path, None, decoding.MEMORY, None), Counter[str]()
    for seed in range(number):
        kind, changed = damaged(content, seed)
        copy.write_bytes(changed)
        found = decoded(copy)
        if isinstance(found, str):
            assert "copy" in found
            assert "Must " in found
            counts["refused"] += 1
        else:
            same = np.array_equal(found.codes, whole.codes)
            same &= np.array_equal(found.times, whole.times)
            counts["same" if same else f"different, {kind}"] += 1
    return counts


@pytest.mark.parametrize(("ending", "silent"), [("mp4", 0.15), ("avi", 0.2), ("mkv", 0.15)])
def test_damage_is_refused_or_without_effect(tmp_path: Path, ending: str, silent: float) -> None:
    """No cut file passes with other frames; a codec without checksum hides few flips and zeros."""
    counts = outcomes(encoded(tmp_path / f"a.{ending}"), 60)
    assert counts["different, cut"] == 0
    assert counts["different, flip"] + counts["different, zero"] <= silent * 60
    assert counts["refused"] >= 20


@pytest.mark.slow
@pytest.mark.parametrize("ending", CODECS)
def test_damage_in_many_files(tmp_path: Path, ending: str) -> None:
    """The same of 200 files of each codec; of VP8, the most patient, up to two in five pass."""
    counts = outcomes(encoded(tmp_path / f"a.{ending}"), 200)
    print(ending, dict(counts))
    assert counts["different, cut"] == 0
    assert counts["different, flip"] + counts["different, zero"] <= 0.4 * 200


def test_checksum_excludes_damage(tmp_path: Path) -> None:
    """With the file's checksum no damaged file passes, also one that decodes without complaint."""
    path = encoded(tmp_path / "a.mp4")
    whole, checksum = path.read_bytes(), store.checksum(path)
    assert readers.palette_video(path, sha256=checksum).sizes["time"] == 12
    for seed in range(30):
        path.write_bytes(changed := damaged(whole, seed)[1])
        assert changed != whole or seed % 3 == 2  # a block of zeros may be where zeros were
        if changed != whole:
            with pytest.raises(ValueError, match=rf"Wrong SHA-256 .* Must be {checksum}"):
                readers.palette_video(path, sha256=checksum)


def test_marked_frames_are_refused(tmp_path: Path) -> None:
    """A frame that FFmpeg conceals and marks as corrupt is an error."""
    path = encoded(tmp_path / "a.mp4")
    content, marked = path.read_bytes(), 0
    for seed in range(0, 120, 3):
        path.write_bytes(damaged(content, seed)[1])
        try:
            with av.open(str(path)) as container:
                frames = [*container.decode(video=0)]
        except (av.FFmpegError, IndexError):
            continue
        if any(frame.is_corrupt for frame in frames):
            marked += 1
            with pytest.raises(ValueError, match=r"is marked corrupt|Truncated|Damaged"):
                readers.palette_video(path)
    assert marked > 2


def test_size_is_known_before_memory_is_taken(tmp_path: Path) -> None:
    """A small file of large frames is refused for what it would take, and takes less than that."""
    path = film(tmp_path / "a.mp4", np.zeros((20, 1080, 1920, 3), dtype=np.uint8))
    assert path.stat().st_size < 30_000
    code = (
        "import resource, sys; from dbthermal import readers\n"
        "peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "readers.palette_video(sys.argv[1]); before = peak()\n"
        "try: readers.palette_video(sys.argv[2], memory=3e8)\n"
        "except ValueError as error: print(error)\n"
        "print(peak() - before)"
    )
    arguments = [sys.executable, "-c", code, str(encoded(tmp_path / "b.mp4")), str(path)]
    done = subprocess.run(arguments, capture_output=True, text=True, check=True)
    message, taken = done.stdout.splitlines()
    assert "20 frames of 1080 x 1920 pixels take 3.73e+08 bytes. Must be at most" in message
    assert int(taken) < 250_000  # KiB


def test_declared_frames_are_counted(tmp_path: Path) -> None:
    """A table that declares ten million frames of one size is compared with those in the file."""
    path = encoded(tmp_path / "a.mp4")
    content = bytearray(path.read_bytes())
    table = content.index(b"stsz")
    content[table + 8 : table + 16] = (1).to_bytes(4) + (10_000_000).to_bytes(4)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"12 frames present, .* declared|Damaged video"):
        readers.palette_video(path)


@pytest.mark.parametrize(
    "content",
    [
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
    encoded(tmp_path / "a.mp4")
    (tmp_path / "list.mp4").write_bytes(content)
    with pytest.raises(ValueError, match=r"Invalid video 'list\.mp4'. Must be MP4, MOV"):
        readers.palette_video(tmp_path / "list.mp4")


@pytest.mark.parametrize(
    "name", ["http://localhost/a.mp4", "concat:a.mp4|a.mp4", "file:a.mp4", "%d.mp4", "pipe:0"]
)
def test_addresses_are_no_files(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """An address or a pattern is the name of a file that is missing, and of nothing else."""
    monkeypatch.chdir(tmp_path)
    encoded(tmp_path / "a.mp4")
    encoded(tmp_path / "1.mp4")
    with pytest.raises(FileNotFoundError):
        readers.palette_video(name)
    with pytest.raises(ValueError, match="Must be a regular file"):
        readers.palette_video(tmp_path)
    with pytest.raises(ValueError, match="Must be a regular file"):
        readers.palette_video("/dev/zero")


def test_what_a_file_names_is_not_opened(tmp_path: Path) -> None:
    """A QuickTime file whose data lie in another file does not open that one."""
    path = encoded(tmp_path / "a.mov")
    content = path.read_bytes().replace(b"url \x00\x00\x00\x01", b"url \x00\x00\x00\x00")
    path.write_bytes(content)
    found, plain = decoded(path), decoded(encoded(tmp_path / "b.mov"))
    assert isinstance(plain, decoding.Film)
    if isinstance(found, decoding.Film):  # its data are in itself, whatever it says
        assert_array_equal(found.codes, plain.codes)
    with pytest.raises(PermissionError, match=r"Refused to open 'b\.mov'"):
        decoding._refuse_to_open("b.mov", 1, {})
