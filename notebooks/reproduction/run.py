"""Results of a notebook: one object keeps their paths, figures, numbers and provenance.

In a notebook with the parameter `results`, the name of the run::

    run = Run("05_methods", globals())
    response = run.open("01_calibration", "_response")
    run.save(comparison)
    run.figure(figures.error_over_noise(error), "_noise")
    run.finish(numbers)
"""

import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import joblib
import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import readers, store
from reproduction import cache, integrity, manifest, parameters, paths
from reproduction import numbers as headline

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Numbers = Mapping[str, headline.Number | np.generic]


class Run:
    """One run of a notebook, with its results in ``results/<name>/<stem>*``.

    Each result is saved with the provenance: the notebook's parameters, versions, commit, and the
    checksums of the inputs that were opened before. The namespace is ``globals()`` of the notebook,
    with a value for each parameter in its YAML file, `results` among them; else KeyError. What
    papermill injected is checked as by `parameters.check`.
    """

    def __init__(self, stem: str, namespace: Mapping[str, Any]) -> None:
        """Read the parameters' names from the YAML file, and their values from `namespace`."""
        names = readers.read_yaml(paths.params(stem))
        if values := parameters.injected(namespace):
            parameters.check(values, parameters.defaults(stem), f"what '{stem}' was run with")
        missing = [name for name in names if name not in namespace]
        if missing:
            raise KeyError(f"Missing parameter '{missing[0]}' of '{stem}'. Must have a value.")
        values = {name: namespace[name] for name in names}
        self.stem, self.name = stem, str(values["results"])
        self.provenance = store.provenance(values)

    def input(self, name: str, path: Path) -> Path:
        """Path of an input, of which the provenance then holds the checksum; see `read`."""
        self.provenance["inputs"][name] = self.read(store.checksum, path)
        return path

    def read(self, function: Callable[..., Any], path: Path, *args: Any, **options: Any) -> Any:
        """What a function reads from a path; an error names the notebook that made it, if any."""
        with integrity.reading(path):
            return function(path, *args, **options)

    def open(self, stem: str, ending: str = "") -> xr.Dataset:
        """Dataset of this run that another notebook saved.

        RuntimeError if that is unfinished, or has left less: it names the target of make.
        """
        path = paths.result(self.name, paths.finished(self.name, stem), f"{ending}.zarr")
        self.input(f"{stem}{ending}", path)
        dataset: xr.Dataset = self.read(lambda place: store.open_dataset(place).load(), path)
        return dataset

    def data(self, collection: str) -> dict[str, Path]:
        """Verified outside files of a collection, name to path; empty if it is not available."""
        if not manifest.available(collection):
            return {}
        sums = manifest.provenance(collection)
        self.provenance["inputs"] |= {f"{collection}/{name}": sums[name] for name in sums}
        return manifest.local(collection)

    def save(self, dataset: xr.Dataset, ending: str = "") -> None:
        """Save a dataset as ``<stem><ending>.zarr``."""
        store.save(dataset, self._path(f"{ending}.zarr"), self.provenance)

    def figure(self, figure: "Figure", ending: str) -> "Figure":
        """Save a figure as ``<stem><ending>.png``, and hand it back for display.

        ValueError if the label of an axis with ticks has no unit.
        """
        for axis in figure.axes:
            for axle in (axis.xaxis, axis.yaxis):
                label = axle.get_label_text()
                if label and len(axle.get_ticklocs()) and not re.search(r"\[.+\]", label):
                    raise ValueError(f"Invalid label '{label}' of a figure. Must have a unit: [K].")
        store.save_figure(figure, self._path(f"{ending}.png"), self.provenance)
        return figure

    def film(self, frames: Iterable[npt.NDArray[np.uint8]], ending: str, rate: float) -> None:
        """Save a film of `rate` [Hz] as ``<stem><ending>.mp4``."""
        store.save_video(frames, self._path(f"{ending}.mp4"), self.provenance, rate=rate)

    def text(self, text: str, ending: str) -> None:
        """Save a text in Markdown as ``<stem><ending>.md``."""
        store.save_text(text, self._path(f"{ending}.md"), self.provenance)

    def cached(self, experiment: Callable[..., Any]) -> Callable[..., Any]:
        """Experiment whose results are kept, delayed for `joblib.Parallel`."""
        delayed: Callable[..., Any] = joblib.delayed(cache.kept(experiment, paths.cells(self.stem)))
        return delayed

    def finish(self, numbers: Numbers) -> Numbers:
        """Save the headline numbers as ``<stem>.json``, and hand them back for display."""
        headline.save(numbers, self._path(".json"), self.provenance)
        return numbers

    def _path(self, ending: str) -> Path:
        return paths.result(self.name, self.stem, ending)
