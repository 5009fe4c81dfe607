"""The README's ten lines run as they stand."""

import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from dbthermal import simulation, store
from dbthermal.response import counts

README = Path(__file__).parents[1] / "README.md"


def test_the_ten_lines_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, glass: tuple[xr.Dataset, ...]
) -> None:
    """On a simulated capture of glass they give its temperature within a quarter of a kelvin."""
    scene, corrected, response = glass
    temperature = xr.DataArray(
        np.linspace(273.15, 343.15, 8), dims="temperature", attrs={"units": "K"}
    )
    temperature = temperature.assign_coords(temperature=temperature)
    store.save(counts(response, temperature).to_dataset(name="level"), tmp_path / "nuc.zarr", {})
    store.save(corrected, tmp_path / "aligned.zarr", {})
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    names: dict[str, xr.Dataset] = {}
    exec(code, names)
    error = names["result"]["object_temperature"] - scene["object_temperature"]
    assert float(abs(error).median()) < 0.25  # [K]
    assert simulation.Rig().bands == tuple(names["result"]["band"].values)
