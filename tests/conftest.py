"""What all tests share: the mirror of the outside files, and what a skip without it means."""

import os
from collections.abc import Generator
from pathlib import Path

import pytest

os.environ["MPLBACKEND"] = "agg"  # a test opens no window


@pytest.fixture(scope="session")
def mirror() -> Path:
    """Folder of the outside files, for tests marked `data`; without it they are skipped."""
    folder = os.environ.get("DBTHERMAL_DATA")
    if not folder:
        pytest.skip("DBTHERMAL_DATA is not set: it names the folder of the outside files")
    if not Path(folder).is_dir():
        pytest.fail(f"Invalid DBTHERMAL_DATA {folder!r}. Must name a folder.")
    return Path(folder)


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
