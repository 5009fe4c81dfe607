"""Compile the methods here in a process of its own: `python -m reproduction.methods`.

Code that a process has just compiled and code that it reads from its cache may add in another
order. Where a search ends in another minimum by that, a number would hang on which notebook is
first.
"""

import numpy as np
import xarray as xr

from dbthermal import separation, simulation
from reproduction import methods

rig, rng = simulation.Rig(), np.random.default_rng(1)
glass = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(rig.bands)})
scene = simulation.walkers(np.arange(64) / 10, (4, 4), glass, rng)
capture = simulation.observe(scene, rig.response(), rng)
for method in methods.OUTSIDE.values():
    separation.solve(capture, rig.response(), method=method)
