"""Small simulated scenes with their truth, what comes out of them, and how it is judged.

Each scene is a function of a seed. A `Shelf` keeps scenes and outcomes in a folder that all workers
of a session share, so that nothing is drawn or separated twice.
"""

import fcntl
import pickle
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import xarray as xr
from captures import emissivity_of
from scipy.ndimage import gaussian_filter

from dbthermal import separation, simulation
from dbthermal.schema import COMPLETED, Status
from reproduction.experiments.pictures import ROOM, Picture, smooth_shift

T = TypeVar("T")
Array = np.ndarray[Any, np.dtype[Any]]
RIG: Final = simulation.Rig()
THREE: Final = simulation.Rig(bands=("8-14", "9.5", "10.6"), noise=(0.03, 0.35, 0.15))
HOT: Final = simulation.Rig(noise=(0.05, 0.1), highest=403.0)
TIME: Final = np.arange(220) / 10.0  # s
SHAPE: Final = (28, 40)
ROWS, COLUMNS = np.indices(SHAPE)
GLASS: Final = (0.86, 0.72)
PLATE: Final = Picture(SHAPE, walkers=7)
SHIFT: Final = smooth_shift(SHAPE, 2.4, 1.2)  # pixel
TO_95: Final = 1.96  # deviations


@dataclass(frozen=True)
class Scene:
    """What there is, what the cameras see of it, and their response."""

    truth: xr.Dataset
    capture: xr.Dataset
    response: xr.Dataset


@dataclass(frozen=True)
class Outcome:
    """Result of a way through a scene, and the warnings that were said on it."""

    result: xr.Dataset
    said: tuple[str, ...]


def mosaic(*pairs: tuple[float, ...], of: Array) -> xr.DataArray:
    """Emissivities (band, y, x) of materials by their number (y, x)."""
    return xr.DataArray(np.array(pairs).T[:, of], {"band": list(RIG.bands)}, ("band", "y", "x"))


def painted(
    seed: int,
    emissivity: xr.DataArray | tuple[float, ...] = GLASS,
    picture: Picture = PLATE,
    shift: Array | None = None,
    rig: simulation.Rig = RIG,
    time: Array = TIME,
) -> Scene:
    """Scene of a picture, `pictures.Picture`, of emissivities (band) or (band, y, x)."""
    rng = np.random.default_rng(seed)
    if isinstance(emissivity, tuple):
        emissivity = emissivity_of(*emissivity, bands=rig.bands)
    truth = picture.draw(time, emissivity, rng, shift)
    return observed(truth, rng, rig)


def observed(truth: xr.Dataset, rng: np.random.Generator, rig: simulation.Rig = RIG) -> Scene:
    """Scene of its truth."""
    return Scene(truth, simulation.observe(truth, rig.response(), rng), rig.response())


def walked(
    seed: int,
    emissivity: xr.DataArray,
    temperatures: tuple[float, float, float] = (295.0, 305.0, 333.0),
    background: Callable[[Array, np.random.Generator], Array] | None = None,
) -> Scene:
    """Scene of upright people, whose background (time, y, x) [K] may be another."""
    rng = np.random.default_rng(seed)
    truth = simulation.walkers(TIME, SHAPE, emissivity, rng, temperatures=temperatures)
    if background is not None:
        cold = truth["background_temperature"]
        truth["background_temperature"] = cold.copy(data=background(cold.values, rng))
    return observed(truth, rng)


def of_two(*pairs: tuple[float, ...]) -> xr.DataArray:
    """A wavy border between two materials, one above the other."""
    return mosaic(*pairs, of=(13 + 2 * np.sin(COLUMNS / 6) < ROWS).astype(int))


def spoilt(scene: Scene) -> Scene:
    """The scene with frames lost in one band, samples missing, dead and frozen pixels."""
    rng, counts = np.random.default_rng(8), scene.capture["counts"].copy(deep=True)
    counts.values[1, [0, 50, 51, 52, 120, 219]] = np.nan
    counts.values[0, rng.random(counts.shape[1:]) < 0.01] = np.nan
    counts.values[1, 90:99, 10] = np.nan
    status = np.where(rng.random(SHAPE) < 0.02, np.uint32(Status.DEAD_PIXEL), np.uint32(0))
    counts.values[0, :, status != 0] = 60000.0
    counts.values[1, :, 3, 4] = 16000.0
    capture = scene.capture.assign(counts=counts, status=(("y", "x"), status))
    return replace(scene, capture=capture)


def stepped(scene: Scene) -> Scene:
    """The scene after two shutter events, each with an offset of its own for pixel and band."""
    segment = np.searchsorted([70, 150], np.arange(TIME.size), side="right")
    offset = np.random.default_rng(9).normal(0.0, 40.0, (2, 3, *SHAPE)).astype(np.float32)
    offset[:, 0] = 0.0
    counts = scene.capture["counts"].copy(data=scene.capture["counts"] + offset[:, segment])
    return replace(scene, capture=scene.capture.assign(counts=counts, segment=("time", segment)))


def late(scene: Scene) -> Scene:
    """The scene with the second band two frames late."""
    counts = scene.capture["counts"].copy(deep=True)
    counts.values[1, 2:] = scene.capture["counts"].values[1, :-2]
    return replace(scene, capture=scene.capture.assign(counts=counts))


def drifting(seed: int) -> Scene:
    """A room that warms by 5 K in the time."""
    rng = np.random.default_rng(seed)
    truth = PLATE.draw(TIME, emissivity_of(*GLASS), rng)
    ramp = xr.DataArray(5.0 * TIME / TIME[-1], dims="time")
    truth["background_temperature"] = (truth["background_temperature"] + ramp).assign_attrs(
        truth["background_temperature"].attrs
    )
    return observed(truth, rng)


def slow(of: float) -> Callable[[Array, np.random.Generator], Array]:
    """Background of weak changes over seconds [K]."""

    def background(cold: Array, rng: np.random.Generator) -> Array:
        film = gaussian_filter(rng.standard_normal(cold.shape), (8, 5, 5))
        return np.asarray(295.0 + of * film / film.std())

    return background


def slow_apart(seed: int) -> Scene:
    """Reflections that change over seconds, which the second camera sees by 4 pixels displaced."""
    rng = np.random.default_rng(seed)
    warm: Any = {"temperatures": (295.0, 302.0, 310.0)}
    truth = simulation.walkers(TIME, SHAPE, emissivity_of(0.92, 0.84), rng, **warm)
    wide = gaussian_filter(rng.standard_normal((TIME.size, SHAPE[0], SHAPE[1] + 8)), (6, 5, 5))
    wide = 296.0 + 2.0 * wide / wide.std()
    views = np.stack([wide[:, :, at : at + SHAPE[1]] for at in (0, 4)])
    attrs = truth["background_temperature"].attrs
    truth["background_temperature"] = ("band", *truth["object_temperature"].dims), views, attrs
    return observed(truth, rng)


def half_still(cold: Array, _: np.random.Generator) -> Array:
    """Background that rests on the left."""
    room = cold.min(axis=0)
    return np.asarray(room + 0.5 * (1.0 + np.tanh((COLUMNS - 20.0) / 2.0)) * (cold - room))


def hot(seed: int) -> Scene:
    """Two hot materials, one above the other, people mirrored on the right alone."""
    scene = walked(seed, of_two((0.95, 0.88), (0.6, 0.45)), (340.0, 348.0, 342.0))
    truth = scene.truth
    cold = truth["background_temperature"]
    truth["background_temperature"] = cold.copy(
        data=half_still(cold.values - 40.0, np.random.default_rng())
    )
    return observed(truth, np.random.default_rng(seed), HOT)


def thermostat(seed: int) -> Scene:
    """A plate that goes up and down by its thermostat before a room at rest."""
    heat, level, on = np.empty(TIME.size), 25.0, True
    for frame in range(TIME.size):
        level += ((40.0 if on else 0.0) - level) * 0.1 / 10.0
        on = level < 24.7 or (on and level < 25.3)
        heat[frame] = level
    profile = np.exp(-((COLUMNS / SHAPE[1] - 0.5) ** 2 + (ROWS / SHAPE[0] - 0.5) ** 2))
    plate = 295.0 + heat[:, np.newaxis, np.newaxis] * profile
    truth = simulation.scene(TIME, plate, np.full(plate.shape, 295.0), emissivity_of(*GLASS))
    return observed(truth, np.random.default_rng(seed))


def lamp(apart: float) -> Callable[[int], Scene]:
    """A lamp that is switched thrice, mirrored as a disc that the second camera sees displaced."""

    def scene(seed: int) -> Scene:
        lit = sum((begin < TIME) & (begin + 2.0 > TIME) for begin in (3.0, 8.0, 14.0))
        rows, columns = np.indices((40, 56))
        views = []
        for moved in (0.0, apart):
            disc = 1.0 / (1.0 + np.exp(np.hypot(rows - 19.0, columns + moved - 27.0) - 11.0))
            views.append(ROOM + 4.0 * np.multiply.outer(lit, disc))
        warm = ROOM + 15.0 * simulation.heating(TIME, 0.0, 1.0, 8.0)[:, None, None]
        warm = np.broadcast_to(warm, views[0].shape)
        truth = simulation.scene(TIME, warm, views[0], emissivity_of(*GLASS))
        attrs = truth["background_temperature"].attrs
        dims = ("band", *truth["object_temperature"].dims)
        truth["background_temperature"] = dims, np.array(views), attrs
        return observed(truth, np.random.default_rng(seed))

    return scene


def two_depths(seed: int) -> Scene:
    """A window before a wall: what one pixel mirrors is displaced by 1 and by 4 pixels."""
    mirrored = []
    for number, depth in enumerate((1.0, 4.0)):
        rng = np.random.default_rng(10 * seed + number)
        shift = np.stack([np.zeros(SHAPE), np.full(SHAPE, depth)])
        mirrored.append(PLATE.draw(TIME, emissivity_of(*GLASS), rng, shift))
    truth, other = mirrored
    truth["background_temperature"] += other["background_temperature"] - ROOM
    return observed(truth, np.random.default_rng(seed))


def undulating(seed: int) -> Scene:
    """Emissivities that undulate over some pixels, seen by slow and weak reflections."""
    wave = gaussian_filter(np.random.default_rng(seed).standard_normal(SHAPE), 4.0)
    wave *= 0.02 / wave.std()
    maps = mosaic((0.9, 0.8), of=np.zeros(SHAPE, int))
    maps = maps + xr.DataArray(np.stack([wave, 0.4 * wave]), dims=("band", "y", "x"))
    return walked(seed, maps, (295.0, 302.0, 310.0), background=slow(2.0))


def bowl(seed: int) -> Scene:
    """Emissivities that fall from the middle to the sides."""
    y, x = 2.0 * ROWS / SHAPE[0] - 1.0, 2.0 * COLUMNS / SHAPE[1] - 1.0
    maps = np.stack([0.88 - 0.04 * (x**2 + y**2), 0.74 - 0.06 * (x**2 + y**2)])
    return painted(seed, xr.DataArray(maps, {"band": list(RIG.bands)}, ("band", "y", "x")))


def dusty(seed: int) -> Scene:
    """Emissivities that differ from pixel to pixel, a third of which mirrors a still room."""
    rough = 0.01 * np.random.default_rng(seed).standard_normal((2, *SHAPE))
    maps = mosaic(GLASS, of=np.zeros(SHAPE, int))
    return painted(seed, maps + rough, replace(PLATE, still=0.3))


def hot_still(seed: int) -> Scene:
    """A hot plate whose left half does not change."""
    rng = np.random.default_rng(seed)
    pair = emissivity_of(0.93, 0.8)
    truth = simulation.walkers(TIME, SHAPE, pair, rng, temperatures=(295.0, 305.0, 366.0))
    warm = truth["object_temperature"]
    truth["object_temperature"] = warm.where(warm["x"] >= 20, 363.0).transpose(*warm.dims)
    return observed(truth, rng, replace(RIG, highest=403.0))


def metal(seed: int) -> Scene:
    """Glass beside a metal that is nearly gray."""
    of = (22.0 + 1.5 * np.sin(ROWS / 6.0) < COLUMNS).astype(int)
    return walked(seed, mosaic(GLASS, (0.1, 0.15), of=of), (295.0, 305.0, 325.0))


STILL: Final = replace(PLATE, still=0.5)
NOBODY: Final = replace(PLATE, walkers=1, warmer=(0.0, 0.0))
RAPID: Final = replace(PLATE, rise=(2.0, 6.0))
UNEVEN: Final = np.sort(np.random.default_rng(3).permutation(300)[:220]) / 10.0
PAIR: Final = ((0.8605, 0.7180), (0.9280, 0.8707))

SCENES: Final[Mapping[str, Callable[[int], Scene]]] = {
    "one place": painted,
    "apart": lambda seed: painted(seed, shift=SHIFT),
    "two materials": lambda seed: painted(seed, of_two(*PAIR)),
    "two materials, apart": lambda seed: painted(seed, of_two(*PAIR), shift=SHIFT),
    "still half": lambda seed: painted(seed, picture=STILL),
    "still half, apart": lambda seed: painted(seed, picture=STILL, shift=SHIFT),
    "rapid": lambda seed: painted(seed, picture=RAPID),
    "rapid, apart": lambda seed: painted(seed, picture=RAPID, shift=SHIFT),
    "rapid, nearly black, apart": lambda seed: painted(
        seed,
        (0.95, 0.88),
        Picture((40, 56), 6, rise=(0.5, 2.0), still=0.5),
        smooth_shift((40, 56), 4.2, 1.0),
        time=TIME[:200],
    ),
    "rapid before a still half": lambda seed: painted(seed, picture=replace(RAPID, still=0.5)),
    "samples lost": lambda seed: spoilt(painted(seed)),
    "gray": lambda seed: painted(seed, (0.86, 0.86)),
    "metal beside glass": metal,
    "nearly black": lambda seed: painted(seed, (0.98, 0.95)),
    "weak reflections": lambda seed: walked(
        seed, mosaic((0.95, 0.85), of=np.zeros(SHAPE, int)), (295.0, 297.0, 310.0)
    ),
    "swapped order": lambda seed: painted(seed, (0.72, 0.86)),
    "three bands": lambda seed: painted(seed, (0.86, 0.72, 0.8), rig=THREE),
    "shutter events": lambda seed: stepped(painted(seed)),
    "two frames late": lambda seed: late(painted(seed)),
    "uneven times": lambda seed: painted(seed, time=UNEVEN),
    "drift": drifting,
    "nobody": lambda seed: painted(seed, picture=NOBODY),
    "slow, apart": slow_apart,
    "hot, half still": hot,
    "hot, half constant": hot_still,
    "thermostat": thermostat,
    "undulating": undulating,
    "bowl": bowl,
    "dust": dusty,
    "lamp": lamp(0.0),
    "lamp, apart": lamp(-4.0),
    "two depths": two_depths,
}

WAYS: Final[Mapping[str, Callable[[Scene], xr.Dataset]]] = {
    "solve": lambda scene: separation.solve(scene.capture, scene.response),
    "separate": lambda scene: separation.separate(scene.capture, scene.response),
    "apparent": lambda scene: separation.solve(scene.capture, scene.response, "apparent"),
}


def field(shift: Array, std: float = 0.0, **attrs: object) -> xr.Dataset:
    """Field of the reflections' shift as `alignment.reflection_shift` gives it."""
    units = {"units": "pixel"}
    return xr.Dataset(
        {
            "shift": (("axis", "y", "x"), shift.astype(np.float32), units),
            "shift_std": (("axis", "y", "x"), np.full(shift.shape, std, np.float32), units),
            "known": (("y", "x"), np.all(np.isfinite(shift), axis=0)),
        },
        coords={"axis": ["y", "x"]},
        attrs={"reference_band": RIG.bands[0], "bands": list(RIG.bands[1:]), **attrs},
    )


class Shelf:
    """Scenes and outcomes of a session, each made by the first worker that asks for it."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder

    def scene(self, name: str, seed: int = 1) -> Scene:
        """Scene of a seed."""
        return self.kept(f"{name} {seed}", lambda: SCENES[name](seed))

    def outcome(self, name: str, way: str = "separate", seed: int = 1) -> Outcome:
        """What a way makes of a scene."""
        return self.kept(
            f"{name} {seed} {way}", lambda: heard(lambda: WAYS[way](self.scene(name, seed)))
        )

    def kept(self, name: str, make: Callable[[], T]) -> T:
        """A copy of what is kept under a name, made if nobody has made it."""
        path = self.folder / f"{name}.pickle"
        with path.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not path.exists():
                part = path.with_suffix(".part")
                part.write_bytes(pickle.dumps(make()))
                part.rename(path)
        found: T = pickle.loads(path.read_bytes())
        return found


def heard(make: Callable[[], xr.Dataset]) -> Outcome:
    """Outcome of a call, whose own warnings are kept; all others are errors as ever."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("error")
        warnings.simplefilter("always", UserWarning)
        result = make()
    return Outcome(result, tuple(str(one.message) for one in said))


def held(
    result: xr.Dataset,
    truth: xr.Dataset,
    name: str = "object_temperature",
    where: xr.DataArray | None = None,
) -> float:
    """Share of the samples, of some pixels, whose 95 % interval holds the truth; also printed."""
    error = abs(result[name] - truth[name])
    there = error.notnull() if where is None else error.notnull() & where
    share = float((error < TO_95 * result[f"{name}_std"]).where(there).mean())
    print(f"{name}: {share:.3f} of the 95 % intervals hold")
    return share


def judged(scene: Scene, result: xr.Dataset) -> dict[str, float]:
    """Figures of a result against the truth.

    Shares [1] of pixels `measured` (no flag, but for frames that are interpolated), `completed`
    and `empty` (without any number). Of those measured: `rmse` of the object, of a `typical` pixel
    (median) [K], `cover` of its 95 % intervals, share `silent` that is off by more than four
    deviations and 0.3 K, median error of `emissivity`. Of all pixels: `p90` of their RMSE [K],
    `whole` cover.
    """
    truth = scene.truth["object_temperature"].values
    error, std = (
        result[name].values.astype(float) - offset
        for name, offset in (("object_temperature", truth), ("object_temperature_std", 0.0))
    )
    status = result["status"].values
    good = (status & ~np.uint32(Status.COMPLETED_FRAMES)) == 0
    there = np.isfinite(error)
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # means of nothing
        size, bar = (np.sqrt(np.nanmean(part**2, axis=0)) for part in (error, std))
        held = np.abs(error) < TO_95 * std
        own = xr.broadcast(scene.truth["emissivity"], result["emissivity"])[0]
        own = own.transpose("band", "y", "x").sel(band=result["band"])
        off = np.abs(result["emissivity"].values - own.values)[:, good]
        typical = float(np.median(size[good])) if good.any() else np.nan
        return {
            "measured": float(good.mean()),
            "typical": typical,
            "completed": float(((status & np.uint32(COMPLETED)) != 0).mean()),
            "empty": float((~there).all(axis=0).mean()),
            "rmse": float(np.sqrt(np.nanmean(error[:, good] ** 2))),
            "cover": float(held[:, good][there[:, good]].mean()),
            "silent": float(((size > 4.0 * bar) & (size > 0.3))[good].mean()),
            "emissivity": float(np.nanmedian(off, axis=1).max()),
            "p90": float(np.nanquantile(size, 0.9)),
            "whole": float(held[there].mean()),
        }
