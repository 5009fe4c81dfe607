"""Fixtures of all tests: a mirror of the outside files, and a simulated capture of glass."""

import os
import signal
import threading
from collections.abc import Generator
from pathlib import Path
from types import FrameType

import hypothesis
import numpy as np
import pytest
import xarray as xr
from captures import FILMS, GLASS
from scenes import Shelf

from dbthermal import simulation
from dbthermal.simulation import Background, Rig
from reproduction.experiments.cases import independent_pixels

hypothesis.settings.register_profile("untimed", deadline=None)  # a test measures no time
hypothesis.settings.load_profile("untimed")
os.environ["MPLBACKEND"] = "agg"  # a test opens no window


def pytest_sessionstart(session: pytest.Session) -> None:
    """End the session at SIGTERM or SIGHUP, also where a test takes it for its own interrupt."""

    def end(number: int, _: FrameType | None) -> None:
        session.shouldstop = f"ended by {signal.Signals(number).name}"
        raise KeyboardInterrupt(session.shouldstop)

    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, end)


@pytest.fixture(scope="session")
def mirror() -> Path:
    """Folder of the outside files, for tests marked `data`; without it they are skipped."""
    folder = os.environ.get("DBTHERMAL_DATA")
    if not folder:
        pytest.skip("DBTHERMAL_DATA is not set: it names the folder of the outside files")
    if not Path(folder).is_dir():
        pytest.fail(f"Invalid DBTHERMAL_DATA {folder!r}. Must name a folder.")
    return Path(folder)


@pytest.fixture
def rng() -> np.random.Generator:
    """Seeded random numbers."""
    return np.random.default_rng(11)


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Project without notebooks, which is the current folder."""
    for name in ("notebooks", "params", "tests"):
        (tmp_path / name).mkdir()
    (tmp_path / "data_manifest.yaml").touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def shelf(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Shelf:
    """Small scenes and what comes out of them, shared by all workers of the session."""
    folder = tmp_path_factory.getbasetemp()
    one_of_several = hasattr(request.config, "workerinput")
    return Shelf((folder.parent if one_of_several else folder) / "scenes")


@pytest.fixture(scope="module")
def glass() -> tuple[xr.Dataset, xr.Dataset, xr.Dataset]:
    """Scene, capture and response: glass 0.86/0.72, 20 pixels as an image of 4 by 5."""
    rig, time, rng = Rig(), np.arange(350) / 10.0, np.random.default_rng(11)
    make = independent_pixels
    flat = make(time, GLASS, Background(), 20, rng, start=293.15, stop=333.15)
    warm, cold = (flat[name].values.reshape(350, 4, 5) for name in FILMS)
    scene = simulation.scene(time, warm, cold, GLASS)
    response = rig.response()
    return scene, simulation.observe(scene, response, rng), response


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Turn the skip of a test marked `data` into a failure where DBTHERMAL_REQUIRE_DATA is set."""
    report = yield
    skipped = report.skipped and not hasattr(report, "wasxfail")
    required = item.get_closest_marker("data") and os.environ.get("DBTHERMAL_REQUIRE_DATA")
    if skipped and required:
        report.outcome = "failed"
        report.longrepr = f"Skipped, though DBTHERMAL_REQUIRE_DATA is set: {report.longreprtext}"
    return report
