"""README: its example runs as printed, and it stays short."""

import re
from pathlib import Path

import numpy as np
import xarray as xr

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
NAMES = re.compile(r"BSD-3-Clause|CVPR 2026|Python 3\.11")
"""Names that have a number."""


def test_example_runs() -> None:
    """Six lines separate a simulated capture within a tenth of a kelvin."""
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    imports, _, lines = code.partition("\n\n")[2].partition("\n\n")
    assert "import dbthermal" in imports
    assert len(lines.splitlines()) == 6
    names: dict[str, xr.Dataset] = {}
    exec(code, names)
    error = names["result"]["object_temperature"] - names["scene"]["object_temperature"]
    assert float(np.sqrt((error**2).mean())) < 0.1  # [K]


def test_it_is_short() -> None:
    """It has at most 500 words, and at most four numbers in its sentences and tables."""
    assert len(README.split()) <= 500
    text = re.sub(r"```.*?```|<!--.*?-->|\]\(.*?\)", "", README, flags=re.DOTALL)
    text = NAMES.sub("", text.replace("arXiv:2509.11334", ""))
    assert len(re.findall(r"\d+(?:\.\d+)?", text)) <= 4


def test_links_lead_to_files() -> None:
    """Each link to a file of the project, and the picture, is there."""
    for target in re.findall(r"\]\(([^)#]+)", README):
        assert target.startswith("https://") or (ROOT / target).is_file(), target


def test_continuous_integration_runs_its_test_command() -> None:
    """The command that README prints for the tests is the one that .ci/run calls."""
    assert "\nmake test " in README
    if (script := ROOT / ".ci" / "run").exists():  # not in a source distribution
        assert "\nmake test " in script.read_text(encoding="utf-8")
