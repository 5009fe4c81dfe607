"""View of a result or a capture: panes, frames, ranges of colour, curves, and code for them."""

import warnings
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from pprint import pformat
from types import MappingProxyType
from typing import Any, Final, Literal, get_args

import numpy as np
import xarray as xr

from dbthermal import _numbers, _text, schema
from dbthermal import response as responses
from dbthermal._arrays import Array, Mask, quotient, stride
from dbthermal.explorer import _films
from dbthermal.explorer._films import FILMS, Pane, Progress, Region, Values, input_panes

Pixels = Literal["unflagged", "measured", "all"]

COMPLETED: Final = int(schema.COMPLETED)
_SAMPLES: Final = 2**22  # of a region's film that are read in one pass
_RANGE: Final = (12, 40_000)  # frames, and pixels of a frame, that give the range of colour


class View:
    """Frames, ranges of colour and curves of a result or a capture, as the explorer shows them.

    Films that are not in memory, or the small part of which a curve is asked, are copied into a
    temporary file (``TMPDIR``): 4 bytes a pixel and frame, and in memory a row of a store's chunks.

    TypeError or ValueError if the data are no Dataset or path, or have neither temperature nor
    counts, a variable is not as `schema` says, the capture has other frames, pixels or bands, or a
    time is infinite. UserWarning if the capture states another ``source``.

    Parameters
    ----------
    data : Dataset, str or Path
        Result of `separation` with `object_temperature` (time, y, x) [K] and what else it has, or a
        capture with `counts` (band, time, y, x) [count]; or the store of one.
    capture, response, events : optional
        As in `explore`.

    Attributes
    ----------
    panes : dict of str to Pane
        What can be shown: ``input 9.5`` for each band, ``object_temperature``,
        ``background_temperature``, ``emissivity 9.5``, each with ``_std``, and ``status``. What a
        method does not estimate is left out.
    time, shape : ndarray, tuple of int
        Time of each frame [s]; rows and columns.
    events : dict of str to float
        Name to time [s], with what segments and frame flags of the capture say.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> dims = ("time", "y", "x")
    >>> film = xr.DataArray(np.full((3, 4, 6), 300.0), {"time": [0.0, 0.1, 0.2]}, dims)
    >>> view = View(film.to_dataset(name="object_temperature"))
    >>> curve = view.curve("object_temperature", Region("rectangle", ((0, 0), (2, 2))))
    >>> curve["mean"].values, int(curve["pixels"][0])
    (array([300., 300., 300.]), 4)
    """

    def __init__(
        self,
        data: xr.Dataset | str | Path,
        capture: xr.Dataset | str | Path | None = None,
        response: xr.Dataset | str | Path | None = None,
        *,
        events: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        self.progress: Progress | None = None
        self.data = _films.opened(data, "data")
        # The data may be a capture alone, which is then its own input.
        is_capture = "object_temperature" not in self.data and "counts" in self.data
        self.capture = None if capture is None else _films.opened(capture, "capture")
        self.response = None if response is None else _films.opened(response, "response")
        sources = {"result": data, "capture": capture, "response": response}
        if is_capture and capture is not None:
            raise ValueError("Invalid second capture. The data are a capture: must be a result.")
        if is_capture:
            self.capture, sources = self.data, {"capture": data, "response": response}
        # Sources in copied code: a path, or the name of a dataset in memory.
        self.sources = {
            name: repr(str(source)) if isinstance(source, str | Path) else name
            for name, source in sources.items()
            if source is not None
        }
        reference = self.data if is_capture else self.data.get("object_temperature")
        inputs = [] if self.capture is None else input_panes(self.capture, self.response, reference)
        results = [] if is_capture else _films.result_panes(self.data)
        self.panes = {pane.name: pane for pane in (*inputs, *results)}
        film = next(iter(self.panes.values())).array
        self.time = film["time"].values.astype(np.float64)
        self.shape: tuple[int, int] = film.shape[1], film.shape[2]
        shown = self.data if self.capture is None else self.capture
        self.doubts = list[str]()
        recorded = [str(it.attrs.get("source", "")) for it in (self.data, shown)]
        if all(recorded) and recorded[0] != recorded[1]:
            label = "The result is of '{}', the capture beside it of '{}'".format(*recorded)
            self.doubts.append(f"{label}. Must be of the same recordings.")
            warnings.warn(self.doubts[0], stacklevel=2)
        schema.require(events, Mapping, "events")
        stated = {
            name: _numbers.real_number(f"time [s] of the event {name!r}", moment, _numbers.FINITE)
            for name, moment in events.items()
        }
        self.events = _films.marks(shown, self.time) | stated

    def pane(self, name: str, *box: slice) -> Pane:
        """Pane by its name, or of a box of it, copied to be read quickly; ValueError if unknown."""
        _text.check_listed("Unknown pane", name, self.panes)
        if box:
            return self.panes[name].cut(box, self.progress)
        self.panes[name].stage(self.progress)
        return self.panes[name]

    def frame(self, name: str, index: int) -> Values:
        """Values (y, x) of a pane at a frame, from 0; ValueError if there is no such frame."""
        _numbers.whole_number("frame", index, (0, self.time.size - 1))
        return np.asarray(self.pane(name).read(slice(index, index + 1))[0])

    @cached_property
    def status(self) -> Any:
        """Status (y, x), uint32; zeros where the data have none."""
        source = self.data if "status" in self.data else self.capture
        if source is None or "status" not in source:
            return np.zeros(self.shape, dtype=np.uint32)
        return source["status"].values.astype(np.uint32)

    def counted(self, pixels: Pixels = "unflagged") -> Mask:
        """Mask (y, x) of the pixels that count: "unflagged", "measured" or "all".

        Unflagged pixels are measured or completed; "measured" excludes samples bridged in time.
        """
        _text.check_listed("Unknown pixels", pixels, get_args(Pixels))
        if pixels == "all":
            return np.ones(self.shape, dtype=bool)
        good: Mask = self.status == 0
        return good | ((self.status & COMPLETED) != 0) if pixels == "unflagged" else good

    def limits(self, name: str) -> tuple[float, float]:
        """Range of colour of a pane: 1st and 99th percentile of some values, unflagged if any."""
        pane, times = self.pane(name), slice(0, None, -(-self.time.size // _RANGE[0]))
        every = slice(0, None, stride(self.shape, _RANGE[1]))
        values, good = pane.read(times, every, every), self.counted()[every, every]
        for shown in (values[:, good], values):
            finite = shown[np.isfinite(shown)]
            if finite.size:
                low, high = np.percentile(finite, [1, 99])
                low = 0.0 if "_std" in name else low
                if pane.std and not pane.absolute:  # emissivities within their bars are alike
                    bars = self.pane(pane.std).read(times, every, every)[np.isfinite(values)]
                    margin = np.median(np.nan_to_num(bars))  # a missing bar widens no range
                    low, high = low - margin, high + margin
                return float(low), float(high if high > low else low + (1e-3 * abs(low) or 1.0))
        return 0.0, 1.0

    def curve(self, name: str, region: Region, *, pixels: Pixels = "unflagged") -> xr.Dataset:
        r"""Mean, least and greatest value of a region over time, with the deviation of the mean.

        A common error is not reduced by the number of pixels (`std`): of object and reflected
        temperature the error by the emissivities, less the part by which neighbours differ; of
        emissivities, completed pixels and displaced cameras all of it. What the calibration is
        taken for, k, the whole image shares. The rest is independent,

        .. math:: s^2 = \left(\frac1n \sum_i k_i\right)^2 + \left(\frac1n \sum_i c_i\right)^2
                  + \frac1{n^2} \sum_i (s_i^2 - k_i^2 - c_i^2)

        The deviations exclude the correlation of neighbours by interpolation. That of the reflected
        temperature is mostly the prior of its drift (`SubspaceSettings.background_drift`): without
        a drift the mean is much closer.

        Parameters
        ----------
        name, region : str, Region
            One of `panes`, but "status"; region in the image, of a pixel or more; else ValueError.
        pixels : {"unflagged", "measured", "all"}
            Which pixels count; see `counted`.

        Returns
        -------
        Dataset
            `mean`, `minimum`, `maximum`, `std` in the pane's units, its part `calibration_std`, and
            `pixels`, the number that counts, over (time); without it for a map. NaN where no pixel
            counts. `std` is NaN where the result states no deviation.
        """
        if name == "status":
            raise ValueError("Invalid pane 'status'. Must be one with numbers.")
        schema.require(region, Region, "region")
        outline, mask = np.array(region.points), region.mask(self.shape)
        if outline.min() < 0 or np.any(outline > self.shape) or not mask.any():
            raise ValueError(f"Invalid {region}. Must lie in the image {self.shape}, with a pixel.")
        box = tuple(slice(places.min(), places.max() + 1) for places in np.nonzero(mask))
        pane, where = self.pane(name, *box), (mask & self.counted(pixels))[box]
        gain, base = self._common(pane, box, where), name.removesuffix("_std")
        contrast = [] if gain is None else [self.pane(film, *box) for film in FILMS]
        bars = self.pane(pane.std, *box) if pane.std else pane

        def statistics_of(frames: slice) -> dict[str, Array]:
            """Statistics of some frames of the region, at the pixels of its box that count."""
            values, *films = (film.read(frames)[:, where] for film in (pane, *contrast))
            if pixels == "measured" and "bridged" in self.data and base in FILMS:
                bridged = self.data["bridged"].isel(time=frames, y=box[0], x=box[1]).values
                values = np.where(bridged[:, where], np.float32(np.nan), values)
            result = _films.statistics(values)
            std = common = np.full(values.shape, np.nan)
            if pane.name.startswith("input "):
                std, common = self._noise(pane, values), np.zeros(values.shape)
            elif pane.std:
                std = bars.read(frames)[:, where].astype(np.float64)
            if gain is not None:
                common = gain * np.abs(films[0] - films[1])
            # The calibration's deviation is an error that all pixels share, besides the noise.
            finite, shared = np.isfinite(values), self._shared(pane, values, box, where)
            if pane.std:
                std = np.sqrt(np.maximum(std**2 - shared**2, 0.0))
            std = _films.mean_std(np.where(finite, std, np.nan), common)
            shared_std = quotient(np.sum(shared, axis=-1, where=finite), result["pixels"], np.nan)
            return {**result, "std": np.hypot(std, shared_std), "calibration_std": shared_std}

        count = max(1, _SAMPLES // max(1, where.size)) if pane.kind == "film" else 1
        starts = range(0, self.time.size if pane.kind == "film" else 1, count)
        chunks = [statistics_of(slice(at, at + count)) for at in starts]
        values = {key: np.concatenate([chunk[key] for chunk in chunks]) for key in chunks[0]}
        attrs = {"pane": name, "region": f"{region.kind} {region.points}", "selection": pixels}
        lines = {key: ("time", line, {"units": pane.units}) for key, line in values.items()}
        result = xr.Dataset(lines, attrs=attrs)
        result["pixels"].attrs.clear()
        if pane.kind == "map":
            return result.isel(time=0)
        return result.assign_coords(time=("time", self.time, schema.COORDINATES["time"].attrs))

    def _common(self, pane: Pane, box: tuple[slice, ...], where: Mask) -> Array | None:
        """Deviation (pixel) by the emissivities for a contrast of 1 K; None if all is common."""
        data, (rows, columns) = self.data, box
        displaced = data.attrs.get("reflection_shift", "none") != "none"
        displaced |= bool((self.status & int(schema.Status.NO_REFLECTION_PAIR)).any())
        estimated = {"emissivity", "emissivity_std"} <= set(data) and {*FILMS} <= set(self.panes)
        if pane.name not in FILMS or displaced or not estimated:
            return None
        # Without a covariance the bands' errors are independent.
        cut = data[[name for name in data if str(name).startswith("emissivity")]]
        cut = cut.isel(y=rows, x=columns)
        if "emissivity_covariance" in data:
            covariance = cut["emissivity_covariance"].values
        else:
            variance = cut["emissivity_std"].values ** 2
            covariance = np.eye(len(variance))[..., None, None] * variance
        # A completed pixel has its emissivities of other pixels.
        measured = where & ((self.status[box] & COMPLETED) == 0)
        gains = _films.common_gain(np.where(measured, cut["emissivity"].values, np.nan), covariance)
        return np.asarray(gains[list(FILMS).index(pane.name)][where])

    def _shared(self, pane: Pane, values: Values, box: tuple[slice, ...], where: Mask) -> Array:
        """Deviation of the samples of a pane by the calibration, which the whole image shares."""
        budget, response = schema.BUDGETS.get(pane.name.partition(" ")[0]), self.response
        if budget in self.data:
            stds = self.data[budget].isel(y=box[0], x=box[1]).sel(cause=[*schema.SHARED])
            if "band" in stds.dims:
                stds = stds.sel(band=pane.name.partition(" ")[2])
            squares = (stds.values[:, where].astype(np.float64) ** 2).sum(axis=0)
            return np.asarray(np.broadcast_to(np.sqrt(squares), values.shape))
        if response is None or pane.curve is None:
            return np.zeros(values.shape)
        assert self.capture is not None
        reference = self.capture.attrs.get("level_reference")
        return responses.accuracy(response, [pane.curve.band], reference).reading(0, values)

    def _noise(self, pane: Pane, values: Values) -> Array:
        """Noise of the samples of a band, with its residual fixed pattern; NaN if unknown."""
        assert self.capture is not None
        holders = [holder for holder in (self.response, self.data) if holder is not None]
        if not (stated := [holder["noise"] for holder in holders if "noise" in holder]):
            return np.full(values.shape, np.nan)
        band = pane.name.removeprefix("input ")

        def of(array: xr.DataArray) -> float:
            return float(array[schema.band_positions(array, [band], "the noise")[0]])

        factor = of(self.capture["noise_factor"]) if "noise_factor" in self.capture else 1.0
        pattern = of(self.capture["pattern_std"]) if "pattern_std" in self.capture else 0.0
        std = np.hypot(of(stated[0]) * factor, pattern)
        if pane.curve is None:
            return np.full(values.shape, std)
        # s_T = s_I / U'(T)
        return np.asarray(std / pane.curve.count_slope(values))

    def probe(self, names: Sequence[str], index: int, row: int, column: int) -> dict[str, Any]:
        """Values of some panes at a pixel and frame, with deviations, and its flags by name."""
        sizes = {"frame": self.time.size, "row": self.shape[0], "column": self.shape[1]}
        for (name, size), place in zip(sizes.items(), (index, row, column), strict=True):
            _numbers.whole_number(name, place, (0, size - 1))
        at = (slice(index, index + 1), slice(row, row + 1), slice(column, column + 1))

        def number(pane: str) -> float | None:
            value = float(self.pane(pane).read(*at)[0, 0, 0]) if pane else np.nan
            return value if np.isfinite(value) else None

        shown = [name for name in names if name != "status"]
        values = {name: (number(name), number(self.panes[name].std)) for name in shown}
        bits = int(self.status[row, column])
        return {"values": values, "flags": [bit.label for bit in schema.Status if bits & bit]}

    def code(
        self, name: str, index: int, regions: Mapping[str, Region], pixels: Pixels = "unflagged"
    ) -> str:
        """Python that gives the same frame and curves again, with the names `View` and `Region`."""
        _text.check_listed("Unknown pane", name, self.panes)
        _numbers.whole_number("frame", index, (0, self.time.size - 1))
        (_, first), *further = self.sources.items()
        arguments = ", ".join([first, *(f"{key}={value}" for key, value in further)])
        free = [key for key, value in self.sources.items() if key == value]
        lines = [f"# {', '.join(free)}: the data that were explored"] if free else []
        lines += [
            "from dbthermal.explorer import Region, View",
            "",
            f"view = View({arguments})",
            f"frame = view.frame({name!r}, {index})  # (y, x) at {self.time[index]:.3f} s",
        ]
        if name != "status" and regions:
            listed = pformat(dict(regions), width=88, sort_dicts=False)
            curve = f"view.curve({name!r}, region, pixels={pixels!r})"
            lines.append(f"regions = {listed}")
            lines.append(f"curves = {{key: {curve} for key, region in regions.items()}}")
        return "\n".join(lines) + "\n"
