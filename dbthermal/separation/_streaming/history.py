"""Means over time of the frames of a stream, and the maps of each pixel found from them."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal.schema import Status
from dbthermal.separation import _tiles as tiles
from dbthermal.separation._inputs import Inputs
from dbthermal.separation._quality import Bits
from dbthermal.separation._streaming.kernels import APART, Planes
from dbthermal.separation._subspace.method import METHOD, separate_smooth

Threads = Callable[[Callable[[Any], None], Iterable[Any]], None]

_SAMPLES: Final = 128  # at most; once reached, half of them at least
_TOGETHER: Final = 4  # tiles of pixels that a thread separates at once


class History:
    """Samples of both bands, each a mean of frames, and the maps of each pixel from the samples."""

    def __init__(
        self, inputs: Inputs, status: Bits, gain: Planes, frames: int, timing: tuple[float, ...]
    ) -> None:
        self._inputs, self._status, self._gain, self._frames = inputs, status, gain, frames
        # Of a mean of so many frames; to be remembered; and of a round through all rows [s].
        self._length, self._memory, self._round = timing
        self.samples = np.empty((2, _SAMPLES, *status.shape), np.float32)  # [count]
        # Ratio, its variance, emissivities and the elements of their covariance.
        self.maps = np.full((7, *status.shape), np.nan, np.float32)
        self.status = status | np.uint32(Status.INVALID_SAMPLES)
        self.solved = False
        # Times [s] and segments (2, sample); means in a sample, and in the last; next row.
        self._times = np.empty((2, 0))
        self._each, self._held, self._next = 1, 1, 0

    def add(self, mean: Planes, time: float, segment: int) -> None:
        """Take the mean (band, y, x) [count] of the next frames, NaN where a pixel has none."""
        fresh = self._held == self._each or self._times[1, -1] != segment
        if fresh and self._times.shape[1] == _SAMPLES:
            self._make_room()
        if fresh:
            self._times = np.column_stack([self._times, (time, segment)])
            self.samples[:, self._times.shape[1] - 1] = mean
            self._held = 1
            return
        self._held += 1
        last = self.samples[:, self._times.shape[1] - 1]
        self._times[0, -1] += (time - self._times[0, -1]) / self._held
        added = np.where(np.isnan(mean), 0.0, mean - last) / np.float32(self._held)
        last[...] = np.where(np.isnan(last), mean, last + added)

    def _make_room(self) -> None:
        """Forget the older half of the samples if the newer is long enough, else join pairs."""
        half, samples, length = _SAMPLES // 2, self.samples, self._each * self._length
        if half * length >= self._memory:
            samples[:, :half], self._times = samples[:, half:], self._times[:, half:]
            return
        step = np.diff(self._times, axis=1)[:, ::2]
        gap = (step[0] > APART * length) | (step[1] > 0)
        for i in range(half):
            earlier, later = samples[:, 2 * i], samples[:, 2 * i + 1]
            mean = np.where(np.isnan(later), earlier, 0.5 * (earlier + later))
            samples[:, i] = np.where(gap[i] | np.isnan(earlier), later, mean)
        self._times = self._times[:, 1::2] - np.where(gap, 0.0, 0.5 * step)
        self._each *= 2

    def refresh(self, apply: Threads) -> None:
        """Separate the samples of the next rows, so that all rows are done in a round."""
        complete = self._times.shape[1] - (self._held < self._each)
        if complete < METHOD.minimum_frames:
            return
        height, width = self.status.shape
        number = int(np.ceil(height * self._length / self._round))
        stop = min(self._next + number, height)
        counts = ("band", "time", "y", "x"), self.samples[:, :complete]
        segment = "time", self._times[1, :complete].astype(np.int32)
        status = ("y", "x"), self._status
        inputs = replace(
            self._inputs,
            noise=self._inputs.noise / np.sqrt(self._frames * self._each),
            capture=xr.Dataset(
                {"counts": counts, "segment": segment, "status": status},
                {"time": self._times[0, :complete]},
            ),
        )
        tasks = 1 + number * width // (_TOGETHER * tiles.PIXELS)
        blocks = np.array_split(np.arange(self._next, stop), min(number, tasks))
        apply(lambda rows: self._separate(inputs, rows), [rows for rows in blocks if rows.size])
        self._next, self.solved = stop % height, True

    def _separate(self, inputs: Inputs, rows: npt.NDArray[np.intp]) -> None:
        """Maps and status of some rows, as by the method "subspace" without its last step."""
        for cut in tiles.cut(inputs, slice(rows[0], rows[-1] + 1)):
            maps = np.full((7, cut.status.size), np.nan, np.float32)
            second = self._gain[cut.window].ravel().astype(np.float64)
            for _, pixels, tile in cut.sections:
                estimate: Any = separate_smooth(replace(tile, gain=second[pixels]), inputs.settings)
                (a, b), (_, d) = estimate.emissivity_covariance
                ratio = estimate.reflection_ratio[1], estimate.reflection_ratio_std[1] ** 2
                maps[:, pixels] = [*ratio, *estimate.emissivity, a, b, d]
                cut.status[pixels] |= estimate.status
            shape = self.status[cut.window].shape
            self.maps[(slice(None), *cut.window)] = maps.reshape(7, *shape)
            self.status[cut.window] = cut.status.reshape(shape)

    def warm(self) -> None:
        """Compile the separation, before the first frame comes."""
        rng, frames = np.random.default_rng(0), METHOD.minimum_frames
        signals, time = rng.standard_normal((2, frames, 1)), np.arange(1.0 * frames)
        curves = tuple(self._inputs.curves)
        tile = tiles.Tile(signals, time, curves, (1.0, 1.0), (1, 1), rng)
        separate_smooth(tile, self._inputs.settings)
