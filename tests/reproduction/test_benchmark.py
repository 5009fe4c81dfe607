"""The benchmark's tables: costs are those of the times that were measured."""

from dataclasses import replace
from pathlib import Path

import pytest

from reproduction import benchmark, methods, paths, verify


def test_the_table_says_what_was_measured() -> None:
    """Times linear over pixels, square over frames; each method takes twice the one before."""
    times: benchmark.Times = {}
    for number, method in enumerate(methods.METHODS):
        times[method, "pixels"] = {n: 1e-6 * 2.0**number * n for n in (128, 512, 2048)}
        times[method, "frames"] = {n: 1.28e-7 * n**2 for n in (100, 1000)}
        times[method, "bands"] = {2: 1.0, 3: 1.5}
    text = benchmark.table("the default call", times, 0.5)
    assert verify.enclosed(text, benchmark.MARKS, "the default call", "the page") == text
    assert "| `calibrated` | 2 | 2 | 2048 | 1.5 |" in text
    assert text.endswith("by the number of frames: 100: 100, 1000: 1000.\n")


def test_the_default_call_is_on_its_pages() -> None:
    """Its figures stand first in docs/benchmarks.md, between their marks; memory if measured."""
    call = benchmark.Call(pixel=7e-5, rmse=0.0312, cover=0.951, frame_rate=31.0, peak=4.2e9)
    calls = {("separate", "one place"): call}
    text = benchmark.default_figures(calls, 0.5)
    line = "| `separate` | one place | 70 | 31 | 31 | 4.2 GB | 0.031 K | 95.1 % |"
    assert line in text.splitlines()
    unmeasured = replace(call, frame_rate=float("nan"), peak=float("nan"))
    text = benchmark.default_figures({("separate", "one place"): unmeasured}, 0.5)
    assert "| `separate` | one place | 70 | 31 | 0.031 K | 95.1 % |" in text.splitlines()
    page = (paths.root() / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    assert text in verify.enclosed(page, benchmark.MARKS, text, "docs/benchmarks.md")


@pytest.mark.slow
def test_the_default_call_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On small captures at one place, of both functions and of a whole frame; and a method."""
    cameras = {name: benchmark.CAMERAS[name] for name in ("one place",)}
    monkeypatch.setattr(benchmark, "CAMERAS", cameras)
    monkeypatch.setattr(benchmark, "whole_frame", lambda *_: (10.0, 1e9))
    calls = dict(benchmark.measured(tmp_path, (28, 40)))
    assert list(calls) == [("separate", "one place"), ("solve", "one place")]
    assert calls["separate", "one place"].frame_rate == 35.0
    for call in calls.values():
        assert 0 < call.pixel < 0.1  # s
        assert 0 < call.rmse < 0.2  # K
        assert call.cover > 0.9
    assert benchmark.seconds_of("apparent", {"pixels": 32, "frames": 40, "bands": 2}) > 0
