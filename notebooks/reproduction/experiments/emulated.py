"""Emulated rig and bench: frames of the cameras, from the simulation and with its truth.

The frames of `Views` are mixed, with noise, fixed pattern and 16 bits, one by one when a
camera takes them, from the temperatures that the emulated world has at that moment. The
thermometers of `Bench` err, its samples are heated. Everything here is simulated.
"""

import shutil
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import mixing, store
from dbthermal import response as responses
from dbthermal._arrays import Array
from dbthermal.instruments.emulated import World
from dbthermal.instruments.session import Session
from dbthermal.response import Curve
from dbthermal.simulation import Rig, digitise
from reproduction.twins.rays import Camera

Counts = npt.NDArray[np.uint16]
Picture = Callable[[float], Counts]
Look = Callable[[float], Array]
Places = Mapping[str, tuple[slice, slice]]

_TRUTH: Final = "truth_"


class Views:
    """Views of the cameras of a simulated rig.

    Of a rig, a detector from `simulation.pattern`, and the seed of the noise, of which each
    recording has its own: that of a calibration would else cancel against the scene's.
    """

    def __init__(self, rig: Rig, detector: xr.Dataset, seed: int) -> None:
        self.rig, self.detector, self.response = rig, detector, rig.response()
        self._noise = np.random.SeedSequence(seed)

    def blackbody(self, world: World) -> dict[str, Picture]:
        """Frames, by band, of the world's blackbody, which fills the view."""
        return self.samples(world, xr.DataArray(), {})

    def samples(self, world: World, emissivity: xr.DataArray, places: Places) -> dict[str, Picture]:
        """
        Frames, by band, of samples that reflect the world's blackbody, as on the emissivity bench.

        The world has a temperature for each material; emissivity is (material, band) [1]; `places`
        are the rows and columns of each material, elsewhere is the blackbody itself.
        """
        looks, shape = {}, (self.detector.sizes["y"], self.detector.sizes["x"])
        for band in self.rig.bands:
            curve = responses.curve(self.response, band)
            values = {name: float(emissivity.sel(material=name, band=band)) for name in places}
            looks[band] = _bench(world, curve, values, places, shape)
        return self._pictures(looks)

    def movie(self, scene: xr.Dataset) -> dict[str, Picture]:
        """Frames, by band, of an evenly sampled scene from time 0 on, linear between its frames."""
        names, curve = scene["band"].values.tolist(), partial(responses.curve, self.response)
        looks = {name: _shown(scene, curve(name), name) for name in names}
        return self._pictures(looks)

    def _pictures(self, looks: Mapping[str, Look]) -> dict[str, Picture]:
        """Counts of each view with noise, fixed pattern and 16 bits."""
        pictures: dict[str, Picture] = {}
        for band, look in looks.items():
            rng = np.random.default_rng(self._noise.spawn(1)[0])
            noise, detector = self.response["noise"].sel(band=band), self.detector.sel(band=band)
            pictures[band] = partial(_taken, look, float(noise), detector, rng)
        return pictures


def _taken(
    look: Look, noise: float, detector: xr.Dataset, rng: np.random.Generator, time: float
) -> Counts:
    """Frame of a view at a time [s]."""
    clean = look(time)
    return digitise(clean + rng.normal(0.0, noise, clean.shape), detector)


def _bench(
    world: World,
    curve: Curve,
    emissivity: Mapping[str, float],
    places: Places,
    shape: tuple[int, int],
) -> Look:
    """Counts of samples before a blackbody, at the temperatures that the world has now."""

    def look(_: float) -> Array:
        temperatures = world.scene_temperatures()
        reflected = curve.counts(np.array(temperatures["blackbody"]))
        counts = np.full(shape, float(reflected))
        for name, place in places.items():
            emitted = curve.counts(np.array(temperatures[name]))
            counts[place] = mixing.leaving(emissivity[name], emitted, reflected)
        return counts

    return look


def parallax(places: Mapping[str, float], shape: tuple[int, int]) -> Array:
    r"""Shift (2, y, x) [pixel] between what two cameras see mirrored in a flat plate.

    .. math:: d = f b \left( \frac{1}{z} - \frac{1}{z + L} \right)

    The places [m] are the `baseline` b between the cameras, the distance z from them to the
    `plate`, and L from there to the `people`; f is the focal length of `rays.Camera` [pixel].
    """
    baseline, plate, people = (places[name] for name in ("baseline", "plate", "people"))
    camera = Camera((0.0, -plate, 0.0), (0.0, 0.0, 0.0), shape)
    points = np.array([[0.0, 0.0, 0.0], [0.0, people, 0.0]]) - (baseline, 0.0, 0.0)
    seen = camera.project(points)[:, 1]
    return np.stack([np.zeros(shape), np.full(shape, seen[1] - seen[0])])


def _shown(scene: xr.Dataset, curve: Curve, band: str) -> Look:
    """Counts of a movie at a time, on the line between the frames before and after."""
    emitted = curve.counts(scene["object_temperature"].values)
    background = scene["background_temperature"]
    if "band" in background.dims:  # of cameras side by side
        background = background.sel(band=band)
    reflected = curve.counts(background.values)
    emissivity = scene["emissivity"].sel(band=band).values
    movie = mixing.leaving(emissivity, emitted, reflected).astype(np.float32)
    rate = 1.0 / float(scene["time"][1] - scene["time"][0])

    def look(time: float) -> Array:
        place = time * rate
        number = int(place)
        if not 0 <= place <= len(movie) - 1:
            rule = f"Must lie in [0, {(len(movie) - 1) / rate}] s"
            raise ValueError(f"Invalid time {time} s of a scene. {rule}.")
        after = movie[min(number + 1, len(movie) - 1)]
        return np.asarray(movie[number] + (place - number) * (after - movie[number]))

    return look


def shown(scene: xr.Dataset, capture: xr.Dataset) -> xr.Dataset:
    """Truth of a scene at the times of a capture, linear between its frames.

    The scene as for `Views.movie`, with attribute ``began``, its time 0 on the host's clock [s]; of
    cameras side by side, as the first one sees it.
    Raises a ValueError if the capture begins before the scene, or goes on after it.
    """
    times = capture["time"] + (capture.attrs["clock_origin"] - scene.attrs["began"])
    truth = scene.interp(time=times.values, assume_sorted=True).assign_coords(time=capture["time"])
    if bool(truth["object_temperature"].isnull().any()):
        raise ValueError(
            f"Invalid times {float(times[0])} to {float(times[-1])} s of the scene. "
            f"Must lie in {float(scene['time'][0])} to {float(scene['time'][-1])} s."
        )
    if "band" in truth["background_temperature"].dims:
        truth["background_temperature"] = truth["background_temperature"].isel(band=0, drop=True)
    return truth


def keep_truth(folder: Path, record: Mapping[str, Any], **truth: xr.Dataset) -> None:
    """Keep the truth, by name, beside recordings in their folder, with its provenance."""
    for name, dataset in truth.items():
        store.save(dataset, folder / f"{_TRUTH}{name}.zarr", record)


def truth(folder: Path) -> dict[str, xr.Dataset]:
    """Open the truth that `keep_truth` left, by name; empty for recordings of hardware."""
    paths = sorted(folder.glob(f"{_TRUTH}*.zarr"))
    return {path.stem.removeprefix(_TRUTH): store.open_dataset(path).load() for path in paths}


def clear(folder: Path) -> None:
    """Remove emulated recordings with their truth, so that they can be made anew.

    Raises a FileExistsError, and removes nothing, if the folder has anything that was not
    simulated.
    """
    for path in sorted(folder.glob("*")):
        attrs = store.open_dataset(path).attrs if path.suffix == ".zarr" else {"is_simulated": 0}
        if not attrs.get("is_simulated", path.name.startswith(_TRUTH)):
            raise FileExistsError(f"Invalid folder '{folder}' with '{path.name}', not emulated.")
    if folder.exists():
        shutil.rmtree(folder)


class Bench(World):
    """An emulated bench whose thermometers have errors, and whose samples are heated.

    By name: standard deviations of one reading [K], 0 for others; lowest and highest temperature to
    which a sample is heated [K]; temperature (time) [K], over the scene's time [s], of other
    objects that a thermocouple touches. The rest as for `World`.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        reading_std: Mapping[str, float],
        samples: Mapping[str, tuple[float, float]] | None = None,
        touched: Mapping[str, xr.DataArray] | None = None,
        **world: Any,
    ) -> None:
        super().__init__(scene=self._warmth, **world)
        self._rng, self._std, self._samples = rng, dict(reading_std), dict(samples or {})
        self._touched = dict(touched or {})
        self._temperatures = {name: low for name, (low, _) in self._samples.items()}

    @classmethod
    def of(
        cls, session: Session, rng: np.random.Generator, errors: Mapping[str, float], **objects: Any
    ) -> Self:
        """
        Bench of an emulated session with its cameras, filters and thermocouples; waits for `begin`.

        The errors are standard deviations of one reading of the ``blackbody`` and of any other
        ``thermocouple`` [K]; objects are the samples and what is touched, as for `Bench`.
        """
        std = dict.fromkeys(session.thermocouples.values(), errors["thermocouple"])
        std["blackbody"] = errors["blackbody"]
        bench = cls(rng, std, filters=session.filters, waits=True, **objects)
        bench.furnish(session)
        return bench

    def step(self, temperature: float) -> None:
        """Set the blackbody [K], and heat every sample to a temperature of its own."""
        self.blackbody_temperature = temperature
        samples = self._samples.items()
        self._temperatures = {name: float(self._rng.uniform(*ends)) for name, ends in samples}

    def thermocouple_temperature(self, channel: int) -> float:
        """Temperature of one thermocouple's tip with the error of one reading [K]; NaN if open."""
        std = self._std.get(self.thermocouples.get(channel, "open"), 0.0)
        with self.lock:
            return super().thermocouple_temperature(channel) + std * float(self._rng.normal())

    def _warmth(self, time: float) -> Mapping[str, float]:
        courses = self._touched.items()
        touched = {name: float(np.interp(time, it["time"], it)) for name, it in courses}
        return {**self._temperatures, **touched}
