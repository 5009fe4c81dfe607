"""The benchmark's table: exponents, ratios and costs are those of the times that were measured."""

from pathlib import Path

import pytest

from reproduction import benchmark, default_call, methods, paths, verify
from reproduction.benchmark import FRAME, Disk


def times() -> benchmark.Times:
    """Times, linear over pixels and square over frames; each method takes twice the one before."""
    found: benchmark.Times = {}
    for number, method in enumerate(methods.METHODS):
        found[method, "pixels"] = {n: 2.0**number * n for n in (128, 512, 2048)}
        found[method, "frames"] = {n: 1e-6 * n**2 for n in (100, 1000)}
        found[method, "bands"] = {2: 1.0, 3: 1.5}
    return found


def test_the_table_says_what_was_measured() -> None:
    """A rate of 60 full frames a second is the camera's, and a day of it takes a day."""
    disk = Disk(
        samples=600 * FRAME,
        read_write=5.0,
        seconds={1: 18.0, 2: 10.0},
        peak=8e8,
        allowed=1e9,
    )
    text = benchmark.table("the default call", times(), disk, 0.5)
    assert verify.enclosed(text, benchmark.MARKS, "the default call", "the page") == text
    for line in (
        "| `dbvt` over `subspace`, a pixel, 2048 over 2048 pixels | 8 |",
        "2 processes, over reading and writing alone | 2.0 |",
        "from disk to disk over a camera's 60 a second | 1.00 |",
        "| peak memory over `memory=1e+09` | 0.80 |",
        "| rate of 2 processes over one | 1.80 |",
        "| 2000000 | 2 | 1.00 (512 to 2048), 1.00 (128 to 2048) | 2.00 (100 to 1000) | 1.5 |",
    ):
        assert line in text, text


def test_the_default_call_is_on_its_pages() -> None:
    """Its figures stand first in docs/benchmarks.md, between their marks."""
    call = default_call.Call(pixel=7e-5, rmse=0.0312, cover=0.951, frame_rate=31.0, peak=4.2e9)
    calls = {("separate", "one place"): call}
    text = benchmark.default_figures(calls, 0.5)
    line = "| `separate` | one place | 70 | 31 | 31 | 4.2 GB | 0.031 K | 95.1 % |"
    assert line in text.splitlines()
    page = (paths.root() / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    assert text in verify.enclosed(page, benchmark.MARKS, text, "docs/benchmarks.md")


@pytest.mark.slow
def test_the_default_call_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On small captures at one place, of both functions and of a whole frame."""
    cameras = {name: default_call.CAMERAS[name] for name in ("one place",)}
    monkeypatch.setattr(default_call, "CAMERAS", cameras)
    monkeypatch.setattr(default_call, "whole_frame", lambda *_: (10.0, 1e9))
    calls = dict(default_call.measured(tmp_path, (28, 40)))
    assert list(calls) == [("separate", "one place"), ("solve", "one place")]
    assert calls["separate", "one place"].frame_rate == 35.0
    for call in calls.values():
        assert 0 < call.pixel < 0.1  # s
        assert 0 < call.rmse < 0.2  # K
        assert call.cover > 0.9


@pytest.mark.slow
def test_a_small_capture_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On disk and in memory: every figure is positive, and the processes' memory holds."""
    monkeypatch.setattr(benchmark, "full_frame", lambda: benchmark.capture(128, 64, 2))
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    assert benchmark.seconds_of("apparent", {"pixels": 32, "frames": 40, "bands": 2}) > 0
    disk = benchmark.from_disk(tmp_path)
    assert list(disk.seconds) == [1]
    assert min(disk.read_write, disk.seconds[1]) > 0
    assert not disk.peak > disk.allowed
