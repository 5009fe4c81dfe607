"""Videos drawn in a palette: read as positions, or refused by name and rule, and never opened."""

import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import av
import hostile_files as hostile
import numpy as np
import pytest
from hostile_files import coloured, video, wave
from marks import long
from numpy.testing import assert_allclose, assert_array_equal
from refused import assert_refused, refused

from dbthermal import store
from reproduction import palettes


@pytest.fixture(scope="module")
def plasma(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Video of the wave in plasma."""
    return video(tmp_path_factory.mktemp("film") / "plasma.mp4")


def test_palette_video_gives_positions_and_times(plasma: Path) -> None:
    """The wave is recovered within 1 % of the palette, at 10 frames per second."""
    movie = palettes.palette_video(plasma)
    assert movie.dims == ("time", "y", "x")
    assert movie.dtype == np.float32
    assert_allclose(np.sqrt(np.mean((movie - wave()) ** 2)), 0, atol=0.01)
    assert_allclose(movie, wave(), rtol=0, atol=0.05)
    assert_allclose(movie["time"], np.arange(12) / 10, rtol=0, atol=1e-9)
    assert (movie.attrs["radiometric"], movie.attrs["palette"]) == (0, "plasma")
    assert 0 < movie.attrs["palette_residual"] < 10  # of 255
    assert movie.attrs["source"] == "plasma.mp4"
    assert "not radiometric" in movie.attrs["note"]


def test_masked_palette_video(tmp_path: Path) -> None:
    """The object's half is valid; wrong widths, palettes, and no object at all are refused."""
    frames = np.full((12, 48, 80, 3), 90, dtype=np.uint8)
    gray = video(tmp_path / "gray.mp4", frames)
    frames[:, :, :32] = coloured(wave(), "turbo")[:, :, :32]
    frames[:, :, 64:] = coloured(np.linspace(0, 1, 48), "turbo")[:, None]
    masked = video(tmp_path / "masked.mp4", frames)
    movie = palettes.masked_palette_video(masked, width=64)
    assert dict(movie.sizes) == {"time": 12, "y": 48, "x": 64}
    assert movie["valid"].isel(x=slice(30)).mean() > 0.99
    assert_array_equal(movie["valid"].isel(x=slice(34, 62)), False)  # 2 pixels of bleeding colour
    inside = movie["value"].isel(x=slice(30)) - wave()[:, :, :30]
    assert_allclose(np.sqrt(np.mean(inside**2)), 0, atol=0.01)
    assert movie["value"].attrs["radiometric"] == 0
    for width in (0, 81):
        with pytest.raises(ValueError, match=f"Invalid width {width} .* from 1 to 80 pixels"):
            palettes.masked_palette_video(masked, width=width)
    with pytest.raises(ValueError, match=r"Palette 'plasma' does not fit.*from 'turbo'"):
        palettes.masked_palette_video(masked, "plasma")
    assert_refused(r"No coloured pixel in 'gray\.mp4'", palettes.masked_palette_video, gray)


PALETTES = [(name, f"Palette '{name}' does not fit.*from 'plasma'") for name in ("turbo", "gray")]
PALETTES += [(name, f"Unknown palette '{name}'") for name in ("plasmatic", "tab10")]
test_another_palette_is_refused = refused(palettes.palette_video, PALETTES, "plasma")


@pytest.mark.data
def test_published_scene(mirror: Path) -> None:
    """The published coffee pot fits plasma closely, its separated video turbo on the object."""
    movie = palettes.palette_video(mirror / "scenes" / "coffeepot-0-bg.mp4")
    assert dict(movie.sizes) == {"time": 350, "y": 240, "x": 262}
    assert movie.attrs["palette_residual"] < 6  # of 255
    path = mirror / "scenes" / "coffeepot_uncalib_Totemp_video.mp4"
    separated = palettes.masked_palette_video(path, width=movie.sizes["x"])
    assert_allclose(separated["valid"].mean(), 0.356, rtol=0, atol=0.01)


@pytest.mark.parametrize("number", [30, *long(100, 1000)])
@pytest.mark.parametrize("ending", hostile.CODECS)
def test_videos(tmp_path: Path, ending: str, number: int) -> None:
    """No cut video passes with other frames; a codec without checksum hides some of the rest.

    Of VP8, the most patient, up to two in five pass; of the others one in five.
    """
    path = hostile.video(tmp_path / f"copy.{ending}")
    content, whole, counts = path.read_bytes(), palettes.palette_video(path), Counter[str]()
    first = 0 if number == 30 else 10_000 * hostile.seed_of_week()
    print(f"DBTHERMAL_SEED={hostile.seed_of_week()}, first seed {first}")
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
    hidden = counts["different, flip"] + counts["different, zero"]
    assert hidden <= {"mp4": 0.15, "mkv": 0.15, "webm": 0.4}.get(ending, 0.2) * number
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
            assert_refused(r"is marked corrupt|Truncated|Damaged", palettes.palette_video, path)
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
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2] / "notebooks")}
    done = subprocess.run(arguments, capture_output=True, text=True, check=True, env=env)
    message, taken = done.stdout.splitlines()
    assert "20 frames of 1080 x 1920 pixels take 3.73e+08 bytes. Must be at most" in message
    assert int(taken) < 250_000  # KiB


def test_declared_frames_are_counted(tmp_path: Path) -> None:
    """What a table or the container declares is compared with the frames in the file."""
    path = hostile.video(tmp_path / "a.mp4")
    whole = path.read_bytes()
    path.write_bytes(hostile.falsely_sized(whole))
    assert palettes.palette_video(path).shape == (12, 48, 64)  # as its stream says
    table, play, index = whole.index(b"stsz"), whole.index(b"elst") + 12, whole.index(b"moov") - 4
    millions = (1).to_bytes(4) + (10_000_000).to_bytes(4)
    for changed, message in (
        (whole[: table + 8] + millions + whole[table + 16 :], "12 frames present, .* declared|Dam"),
        (whole[:play] + (500).to_bytes(4) + whole[play + 4 :], "'a.mp4': 5 frames decoded, 12 pre"),
        # The encoder writes the index after the frames.
        (whole[: index - 900] + bytes(900) + whole[index:], "Damaged video 'a.mp4': .* Must deco"),
    ):
        path.write_bytes(changed)
        assert_refused(message, palettes.palette_video, path)


PLAYLISTS = (
    *(b"", b"no video", b"\0" * 5000, b"ffconcat version 1.0\nfile a.mp4\n", b"\x89PNG\r\n\x1a\n"),
    b"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile:///etc/passwd\n",
    b'<?xml version="1.0"?><MPD></MPD>',
    b"v=0\no=- 0 0 IN IP4 127.0.0.1\nm=video 1 RTP/AVP 96\n",
    b"YUV4MPEG2 W4 H4 F25:1\nFRAME\n",
)


@pytest.mark.parametrize("content", PLAYLISTS)
def test_playlists_are_no_videos(tmp_path: Path, content: bytes) -> None:
    """A file that names others, in whatever way, is refused by what it holds, not by its name."""
    hostile.video(tmp_path / "a.mp4")
    (tmp_path / "list.mp4").write_bytes(content)
    with pytest.raises(ValueError, match=r"Invalid video 'list\.mp4'. Must be MP4, MOV, Matroska"):
        palettes.palette_video(tmp_path / "list.mp4")


def test_addresses_are_no_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An address or a pattern is the name of a file that is missing, and of nothing else."""
    monkeypatch.chdir(tmp_path)
    hostile.video(tmp_path / "1.mp4")
    for name in ("http://localhost/a.mp4", "concat:a|a", "file:1.mp4", "%d.mp4", "pipe:0", "none"):
        with pytest.raises(FileNotFoundError, match=re.escape(name.split("/")[-1])):
            palettes.palette_video(name)
    for path in (tmp_path, "/dev/zero"):
        assert_refused("Must be a regular file", palettes.palette_video, path)


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
