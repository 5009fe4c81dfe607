"""Separation while the cameras run: frames in, temperatures and reflections out a second later."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _numbers, schema
from dbthermal import response as responses
from dbthermal.schema import Status
from dbthermal.separation import _quality as quality
from dbthermal.separation import _stream_kernels as kernels
from dbthermal.separation import _tiles as tiles
from dbthermal.separation._apart import displaced
from dbthermal.separation._inputs import Inputs, check
from dbthermal.separation._quality import Bits
from dbthermal.separation._solve import require_whole, separated_dataset
from dbthermal.separation._stream_kernels import Planes
from dbthermal.separation._subspace.fused import FILMS
from dbthermal.separation._subspace.method import METHOD, separate_smooth
from dbthermal.separation._tiles import Array, Whole

if TYPE_CHECKING:
    from dbthermal.separation._subspace.method import SubspaceSettings

_MEANS: Final = 5  # means over the latency
_GAP: Final = 1.5  # intervals between frames, from which some are lost
_GLANCE: Final = 24  # pixels along the shorter side, by which a frame is told from another
_RATES, _SECONDS = (1e-3, 1e5), (1e-5, 1e3)  # frame rates [Hz] and times [s] that are taken
_ROWS: Final = 16  # that a thread takes at once
_SAMPLES: Final = 128  # of the history at most; once reached, half of them at least
_TILES: Final = 4  # tiles of pixels that a thread separates at once


class Stream:
    r"""Live separation of two bands: frames in as they come, temperatures out a fixed time later.

    A history of 64 to 128 samples of each pixel, means of more and more frames, is separated by the
    method "subspace" without its pieces for rapid objects, some rows of the image at a time: it
    gives reflection ratios, emissivities and `status`. With these the object is the combination of
    bands without background (eq. 5 and 6 of "subspace"), smoothed by a parabola over four latencies
    before and one after, or over less where that does not agree; the background is that of every
    frame (eq. 9). The first object compiles, which takes some seconds.

    TypeError or ValueError as from `solve`; if the bands are not two, the response has no noise, or
    a number is not positive.

    With weights :math:`a_i` of the means in the parabola, the object's variance is that through
    the ratio, as in `solve`, and :math:`\sum_i a_i^2 \, \mathrm{var}(q_i) / h'^2`. A change of the
    reflection must last longer than a sample of the history, saturated or frozen samples for three.

    Parameters
    ----------
    template : Dataset
        Stage `corrected` of `schema`, one frame or more: bands, sizes, coordinates, and where
        present `status`, `pattern_std` and `noise_factor` are those of the stream.
    response : Dataset
        From `calibration.fit_response`, with `noise`.
    frame_rate : float
        Frames of each band in a second [Hz].
    latency : float
        Age of a frame when its temperatures are known, about [s].
    memory : float
        Shortest time that is remembered; the longest is four times as long [s].
    refresh : float
        Time in which all rows are separated anew [s].
    reflection_shift : Dataset, optional
        From `alignment.reflection_shift`: the second camera's frames are resampled. The object is
        taken to be as warm in both places.
    settings, response_kind, workers
        As for `solve` by the method "subspace".

    Attributes
    ----------
    bands : tuple of str
        Names of the bands, as in the template.
    lost_frames : int
        Frames that did not come, by the times of the others, or were of no use.

    Examples
    --------
    Plate glass that warms up while people walk by, simulated, a frame at a time:

    >>> import numpy as np, xarray as xr
    >>> from dbthermal import simulation
    >>> rig, rng = simulation.Rig(), np.random.default_rng(1)
    >>> glass = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(rig.bands)})
    >>> scene = simulation.walkers(np.arange(300) / 10, (4, 6), glass, rng)
    >>> capture = simulation.observe(scene, rig.response(), rng)
    >>> stream = Stream(capture.isel(time=[0]), rig.response(), frame_rate=10.0)
    >>> for time, frame in zip(capture["time"], capture["counts"].transpose("time", ...)):
    ...     live = stream.update(float(time), frame.values)
    >>> live = stream.result()
    >>> error = live["object_temperature"] - scene["object_temperature"]
    >>> bool(abs(error).where(live["status"] == 0).median() < 0.3)  # K
    True
    """

    def __init__(  # noqa: PLR0913 - all but the first two by name
        self,
        template: xr.Dataset,
        response: xr.Dataset,
        *,
        frame_rate: float,
        latency: float = 1.25,
        memory: float = 30.0,
        refresh: float = 15.0,
        settings: "SubspaceSettings | None" = None,
        reflection_shift: xr.Dataset | None = None,
        response_kind: str = "exact",
        workers: int = 2,
    ) -> None:
        _numbers.real_number("frame_rate [Hz]", frame_rate, _RATES)
        for name, value in (("latency", latency), ("memory", memory), ("refresh", refresh)):
            _numbers.real_number(f"{name} [s]", value, _SECONDS)
        require_whole("number of workers", workers, 1)
        options: dict[str, Any] = {"settings": settings, "response_kind": response_kind}
        options["reflection_shift"] = reflection_shift
        options["method"] = replace(METHOD, name="stream", minimum_frames=1, any_bands=False)
        inputs = check(template, response, **options)
        self.bands = tuple(curve.band for curve in inputs.curves)
        responses.noise(response, list(self.bands))
        # From here on the quietest band is the first one.
        self._order, template = inputs.bands, template.isel(band=inputs.bands)
        inputs = check(template, inputs.response, **options)
        self._template, self._kind = template.isel(time=0, drop=True), response_kind
        self._shape = shape = (template.sizes["y"], template.sizes["x"])
        height = shape[0]
        self._rows = [slice(y, min(y + _ROWS, height)) for y in range(0, height, _ROWS)]
        self._camera = kernels.camera(inputs)
        self._status = schema.pixel_status(template).copy()
        self._gain = np.ones(shape, np.float32)
        self._resample = list[Any]()
        if inputs.displacement is not None:
            self._pair(inputs.displacement)
        self._rate, self._block = frame_rate, max(1, round(frame_rate * latency / _MEANS))
        self._half = half = max(1, int(frame_rate * latency / self._block) - 1)
        timing = self._block / frame_rate, memory, refresh
        inputs = replace(inputs, displacement=None)
        self._history = History(inputs, self._status, self._gain, self._block, timing)
        # The frames that wait, and the means around [count]; times [s], and segments of the means.
        self._frames = np.empty((half + 1, 2, self._block, *shape), np.float32)
        self._means = np.empty((int(kernels.WINDOWS[-1][0] + 1) * half + 1, 2, *shape), np.float32)
        self._frame_times = np.empty((half + 1, self._block))
        self._mean_times = np.empty((2, 0))
        self._blocks, self._filled, self._now, self._segment = 0, 0, -np.inf, 0
        self._glance: Planes = np.empty(0, np.float32)
        self.lost_frames = 0
        self._threads = ThreadPoolExecutor(workers)
        self._result = self._dataset([], [], self._history.status)
        self._warm()

    @property
    def is_ready(self) -> bool:
        """True once temperatures are known."""
        return self._result.sizes["time"] > 0

    @property
    def latency(self) -> float:
        """Age of a frame when its temperatures become known, at most [s]."""
        return (self._half + 1) * self._block / self._rate

    @property
    def nbytes(self) -> int:
        """Memory of the state, which does not grow [byte]."""
        frames, history = (self._frames, self._means, self._gain, self._status), self._history
        arrays = *frames, history.samples, history.maps, history.status
        return sum(array.nbytes for array in arrays)

    def update(
        self, time: npt.ArrayLike, frames: npt.NDArray[np.floating], *, segment: int = 0
    ) -> xr.Dataset:
        """Take one frame of both bands, or several, and return the temperatures that became known.

        TypeError or ValueError if the frames are not floating or of another shape, a time does not
        rise, or the segment falls.

        Parameters
        ----------
        time : array_like
            When the frame was exposed, or each of the frames (time) [s].
        frames : ndarray
            Corrected counts (band, y, x) or (band, time, y, x) [count], the bands as in the
            template, NaN for no sample. A frame without a number in a band, or that repeats the one
            before, is lost.
        segment : int
            Number of shutter events before the frames.

        Returns
        -------
        Dataset
            Stage `separated` of `schema`, of the frames a `latency` ago, with
            `emissivity_covariance`; of no frames while none became known. Emissivities and
            `status` are those of now, and attribute `lost_frames` counts all that were lost.
        """
        times, counts = self._checked(time, frames, segment)
        emitted, films, status = [], [], self._history.status
        for now, frame in zip(times.tolist(), counts.swapaxes(0, 1), strict=True):
            if not self._take(now, frame):
                continue
            self._absorb()
            self._history.refresh(self._apply)
            if self._history.solved and self._blocks > self._half:
                time, block, status = self._emit()
                emitted.append(time)
                films.append(block)
        if emitted:
            self._result = self._dataset(emitted, films, status)
            return self._result
        return self._result.isel(time=slice(0)).assign_attrs(lost_frames=self.lost_frames)

    def result(self) -> xr.Dataset:
        """Return what the last `update` returned that made any temperatures known.

        ValueError if none are known yet.
        """
        if not self.is_ready:
            count, minimum = self._blocks * self._block, METHOD.minimum_frames * self._block
            state = f"Missing frames: {count} came, and no temperatures are known"
            raise ValueError(f"{state}. Must be at least {minimum}.")
        return self._result

    def _checked(self, time: npt.ArrayLike, frames: Any, segment: int) -> tuple[Array, Planes]:
        """Times (time) and frames (band, time, y, x), the quietest band first."""
        if isinstance(frames, xr.DataArray):
            if "band" in frames.coords:
                places = schema.band_positions(frames, [*self.bands], "the frames")
                frames = frames.isel(band=places)
            schema.check_numbers(frames, "the frames", "count")
            frames = frames.transpose("band", ..., "y", "x").values
        times, counts = _numbers.real_numbers("time [s] of frames", time), np.ma.asarray(frames)
        segment = _numbers.whole_number("segment", segment, (-(2**31), 2**31))
        if counts.dtype.kind != "f":
            rule = "Must be floating: corrected by correction.correct"
            raise TypeError(f"Invalid dtype {counts.dtype} of the frames: raw counts. {rule}.")
        expected = (2, *times.shape, *self._shape)
        if times.ndim > 1 or counts.shape != expected:
            label = f"Invalid shape {counts.shape} of the frames, at times of shape {times.shape}"
            rule = f"Must be {expected}: bands, times if they are several, rows and columns"
            raise ValueError(f"{label}. {rule}.")
        times = times.reshape(-1)
        before = np.concatenate([[self._now], times[:-1]])
        bad = ~((times > before) & np.isfinite(times))
        if np.any(bad):
            now, last = times[bad][0], before[bad][0]
            raise ValueError(f"Invalid time {now} s of a frame, after {last} s. Must rise.")
        if segment < self._segment:
            raise ValueError(f"Invalid segment {segment} after {self._segment}. Must not fall.")
        if segment > self._segment:  # a mean is of one segment
            self._segment, self._filled = segment, 0
        planes = counts.filled(np.nan).reshape(2, -1, *self._shape)
        return times, planes[:: 1 if self._order[0] == 0 else -1]

    def _take(self, now: float, frame: Planes) -> bool:
        """Take a frame (band, y, x) into the block that is being filled; true if it is full."""
        since = (now - self._now) * self._rate
        if _GAP < since < np.inf:
            self.lost_frames += round(since) - 1
        if since > kernels.APART * self._block:
            self._filled = 0
        self._now = now
        step = max(1, min(self._shape) // _GLANCE)
        glance = frame[:, ::step, ::step].copy()
        same = any(map(np.array_equal, glance, self._glance))
        self._glance = glance
        if same or not np.isfinite(glance).any(axis=(1, 2)).all():
            self.lost_frames += 1
            return False
        slot = self._blocks % len(self._frames)
        self._frame_times[slot, self._filled] = now
        target = self._frames[slot, :, self._filled]
        target[...] = frame
        if self._resample:
            second = np.where(quality.unusable(self._status), 0.0, frame[1]).ravel()
            rows = self._threads.map(lambda weights: weights @ second, self._resample)
            target[1] = np.concatenate([*rows]).reshape(self._shape)
        self._filled = (self._filled + 1) % self._block
        return self._filled == 0

    def _absorb(self) -> None:
        """Add the mean of the full block to the current means and to the history."""
        slot, place = self._blocks % len(self._frames), self._blocks % len(self._means)
        frames, mean, time = self._frames[slot], self._means[place], self._frame_times[slot].mean()
        self._apply(lambda rows: kernels.absorb(frames, mean, rows.start, rows.stop), self._rows)
        self._mean_times = np.column_stack([self._mean_times, (time, self._segment)])
        self._mean_times = self._mean_times[:, -len(self._means) :]
        self._history.add(mean, float(time), self._segment)
        self._blocks += 1

    def _emit(self) -> tuple[Array, Planes, Bits]:
        """Times, films (film, frame, y, x) and status of the block that has its latency now."""
        slot = (self._blocks - 1 - self._half) % len(self._frames)
        times, means = self._frame_times[slot].copy(), self._mean_times.shape[1]
        order = np.arange(self._blocks - means, self._blocks) % len(self._means)
        interval, centre = self._block / self._rate, means - 1 - self._half
        fit = kernels.fit(self._mean_times, centre, self._half, interval, times)
        block = self._as_block(slot, order)
        self._apply(partial(self._temperatures, block, fit), self._rows)
        return times, block.films, block.status

    def _as_block(self, slot: int, order: Whole) -> kernels.Block:
        """Frames of a slot, the means around the frames, the current maps, and empty films."""
        films = np.empty((4, self._block, *self._shape), np.float32)
        pixels = self._history.maps, self._gain, self._history.status.copy(), films
        return kernels.Block(self._frames[slot], self._means, order, *pixels)

    def _temperatures(self, block: kernels.Block, fit: kernels.Fit, rows: slice) -> None:
        """Films and status of some rows of a block, in place."""
        scratch = tuple(tuple(np.empty((n, self._shape[1]), np.float32)) for n in kernels.ROWS)
        kernels.emit(block, fit, *self._camera, scratch, rows.start, rows.stop)

    def _warm(self) -> None:
        """Compile all that frames need, before the first one comes."""
        kernels.absorb(self._frames[0], self._means[0], 0, 0)
        fit = kernels.fit(np.zeros((2, 1)), 0, 1, 1.0, np.zeros(self._block))
        self._temperatures(self._as_block(0, np.arange(1)), fit, slice(0, 0))
        self._history.warm()

    def _dataset(self, times: list[Array], films: list[Planes], status: Bits) -> xr.Dataset:
        """Stage `separated` of the films (film, frame, y, x) at the times, and the maps of now."""
        ratio, variance, *emissivity, a, b, d = self._history.maps
        zero = np.float32(0.0) * ratio
        maps = {
            "emissivity": np.stack(emissivity),
            "emissivity_std": np.sqrt([a, d]),
            "emissivity_covariance": np.array([[a, b], [b, d]]),
            "reflection_ratio": np.stack([zero + 1.0, ratio]),
            "reflection_ratio_std": np.stack([zero, np.sqrt(variance)]),
            "status": status,
        }
        if len(films) != 1:
            films = [np.concatenate([np.empty((4, 0, *self._shape), np.float32), *films], axis=1)]
        maps |= zip(FILMS, films[0], strict=True)
        time = ("time", np.concatenate([[], *times]), schema.COORDINATES["time"].attrs)
        result = separated_dataset(self._template.assign_coords(time=time), maps)
        back = np.argsort(self._order)
        return result.isel(band=back, other_band=back).assign_attrs(
            method="stream",
            response_kind=self._kind,
            reference_band=str(self._template["band"].values[0]),
            lost_frames=self.lost_frames,
        )

    def _apply(self, function: Callable[[Any], None], rows: Iterable[Any]) -> None:
        """Apply a function to rows of the image, in threads."""
        list(self._threads.map(function, rows))

    def _pair(self, displacement: displaced.Displacement) -> None:
        """Resample the second camera by the shift of what is reflected; see `_apart.displaced`."""
        dead, width = quality.unusable(self._status), self._shape[1]
        weights = displaced.without(displacement.resample, dead.ravel(), width).astype(np.float32)
        self._gain[:] = np.sqrt((weights**2).sum(axis=1)).reshape(self._shape)
        unpaired = (np.diff(weights.indptr) == 0).reshape(self._shape)
        self._status |= quality.status_bits({Status.NO_REFLECTION_PAIR: unpaired})
        self._resample = [weights[rows.start * width : rows.stop * width] for rows in self._rows]


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
        sample = self.samples[:, self._times.shape[1] - 1]
        self._times[0, -1] += (time - self._times[0, -1]) / self._held
        added = np.where(np.isnan(mean), 0.0, mean - sample) / np.float32(self._held)
        sample[...] = np.where(np.isnan(sample), mean, sample + added)

    def _make_room(self) -> None:
        """Forget the older half of the samples if the newer is long enough, else join pairs."""
        half, samples, length = _SAMPLES // 2, self.samples, self._each * self._length
        if half * length >= self._memory:
            samples[:, :half], self._times = samples[:, half:], self._times[:, half:]
            return
        step = np.diff(self._times, axis=1)[:, ::2]
        gap = (step[0] > kernels.APART * length) | (step[1] > 0)
        for i in range(half):
            earlier, later = samples[:, 2 * i], samples[:, 2 * i + 1]
            mean = np.where(np.isnan(later), earlier, 0.5 * (earlier + later))
            samples[:, i] = np.where(gap[i] | np.isnan(earlier), later, mean)
        self._times = self._times[:, 1::2] - np.where(gap, 0.0, 0.5 * step)
        self._each *= 2

    def refresh(self, apply: Callable[[Callable[[Any], None], Iterable[Any]], None]) -> None:
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
        tasks = 1 + number * width // (_TILES * tiles.PIXELS)
        blocks = np.array_split(np.arange(self._next, stop), min(number, tasks))
        apply(lambda rows: self._separate(inputs, rows), [rows for rows in blocks if rows.size])
        self._next, self.solved = stop % height, True

    def _separate(self, inputs: Inputs, rows: Whole) -> None:
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
