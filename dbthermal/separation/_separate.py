"""The default way through a capture: all steps of the separation, in one call."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Final

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter
from scipy.special import fdtrc

from dbthermal import _smooth as smooth
from dbthermal import alignment, schema
from dbthermal._coordinates import laid_on
from dbthermal._warnings import warned
from dbthermal.alignment._reflections import SMALLEST, seen_apart
from dbthermal.schema import Status
from dbthermal.separation._apart import displaced
from dbthermal.separation._completion.complete import Beside, filled
from dbthermal.separation._completion.prior import stated
from dbthermal.separation._doubts import against_response, of_one_camera
from dbthermal.separation._inputs import Inputs, Labels, check, numbered
from dbthermal.separation._pooling import materials as pooling
from dbthermal.separation._pooling.held import hold
from dbthermal.separation._solve import get_method, require_workers, separated
from dbthermal.separation._subspace.reflection_ratio import HIGHEST_ORDER
from dbthermal.separation._tiles import Array, Material

if TYPE_CHECKING:
    from dbthermal.separation._subspace.method import SubspaceSettings

# Frames, windows along either side, their sides [pixel], at least so many, and the blur in which a
# displacement is looked for [pixel]; chance below and pixels or frames from which it is one, and by
# how many times a window's changes have to exceed the noise, in variance.
_FRAMES, _ALONG, _SIDES, _FEWEST, _BLUR = 400, 8, (8, 16), 4, 2.0
_CHANCE, _LEAST, _LEAST_LATE, _STRONG = 1e-3, 0.3, 0.1, 3.0
# Functions of time, pixels that tell them, and samples of a pixel over those of others.
_PLANES, _TOLD_BY, _COMMON = 32, 100, 0.9
_UNEXPLAINED: Final = (
    "The bands of {:.0%} of the pixels with moving reflections do not show the same at the same "
    "time, and no shift of the reflections explains it. If the cameras stand apart and a pixel "
    "mirrors several depths, or their clocks differ, the intervals of the other pixels are too "
    "small."
)
_MANY: Final = 0.3  # share of them from which a shift does not explain it


def separate(  # noqa: PLR0913 - all but the first two by name
    corrected: xr.Dataset,
    response: xr.Dataset,
    *,
    reflection_shift: xr.Dataset | None = None,
    materials: xr.DataArray | None = None,
    surroundings: float | xr.DataArray | None = None,
    surroundings_std: float = 2.0,
    prior: str | xr.DataArray | xr.Dataset | None = None,
    settings: "SubspaceSettings | None" = None,
    alone: xr.Dataset | None = None,
    workers: int = 2,
    progress: bool = False,
) -> xr.Dataset:
    """Separate emission and reflection in a capture, with an answer at every pixel.

    Each pixel alone (`solve`); where the bands show rapid changes displaced all over the image,
    with the shift between the cameras' reflections (`alignment.reflection_shift`); then with the
    pixels of each material pooled (`materials`), held to what they tell alone; last, what is still
    unknown is completed (`complete`).

    Parameters
    ----------
    corrected, response : Dataset
        As in `solve`.
    reflection_shift : Dataset, optional
        From `alignment.reflection_shift`; found if it is needed and not given.
    materials : DataArray, optional
        Labels (y, x) of the materials, -1 for none; found if not given and scikit-image is
        installed (extra "materials").
    surroundings, surroundings_std, prior
        As in `complete`.
    settings : SubspaceSettings, optional
        Options of the method "subspace".
    alone : Dataset, optional
        Result of `solve` for the same arguments, if at hand: the first step is not done again.
    workers : int
        Number of threads.
    progress : bool
        Show a bar for each separation.

    Returns
    -------
    Dataset
        As from `complete`, and `material` (y, x). Attribute `reflection_shift` says whether one was
        "given", "found" or "none"; `warnings`, and a UserWarning, that bands are apart and no shift
        explains it, or that the counts lie outside the response, as those of another band.

    Raises
    ------
    TypeError, ValueError
        As `solve` and `complete`.

    Examples
    --------
    Plate glass that warms up while people walk by, simulated:

    >>> import numpy as np, xarray as xr
    >>> from dbthermal import simulation
    >>> rig, rng = simulation.Rig(), np.random.default_rng(1)
    >>> glass = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(rig.bands)})
    >>> scene = simulation.walkers(np.arange(200) / 10, (16, 24), glass, rng)
    >>> result = separate(simulation.observe(scene, rig.response(), rng), rig.response())
    >>> error = result["object_temperature"] - scene["object_temperature"]
    >>> bool(error.notnull().all()), bool(abs(error).median() < 0.1)  # K
    (True, True)
    """
    beside = Beside(materials, surroundings, prior, surroundings_std, reflection_shift)
    schema.band_positions(corrected, [], "the corrected")
    stated(prior, [str(band) for band in corrected["band"].values])  # refused before the work
    require_workers(workers)
    known = check(corrected, response, get_method("subspace"), "subspace", settings=settings)
    response = known.response  # with one noise for all steps
    unlike = against_response(corrected, response) + of_one_camera(corrected, response)
    alone = None if alone is None else _checked(alone, corrected, known)
    given, source, apart = alone, "given", 0.0
    if reflection_shift is None:
        reflection_shift, apart = _shift(corrected, response)
        source = "none" if reflection_shift is None else "found"
    if reflection_shift is not None:
        shift = displaced.check(reflection_shift, corrected, known.bands[0])
        known = replace(known, displacement=shift)
    surveys = None
    if alone is None or source == "found":
        alone, surveys = separated(known, workers=workers, progress=progress)
    doubts = [_UNEXPLAINED.format(apart)] if apart > 0.0 else []
    if reflection_shift is not None:
        doubts = _unexplained(alone)
    result = alone
    again = partial(separated, alone=alone, surveys=surveys, workers=workers, progress=progress)
    if materials is not None:
        result, _ = again(replace(known, labels=numbered(corrected, materials)))
    elif find_spec("skimage") is not None:
        result, materials = _over_found_materials(again, known, corrected, alone)
    if materials is not None:
        hold(alone, result, materials, apart=reflection_shift is not None)
    if result is given:  # which is the caller's
        result = result.copy(deep=True)
    beside = replace(beside, materials=materials, reflection_shift=reflection_shift)
    result = filled(result, corrected, response, beside, workers)
    if materials is not None:
        result["material"] = materials
    return warned(result.assign_attrs(reflection_shift=source), *unlike, *doubts)


def _checked(alone: xr.Dataset, corrected: xr.Dataset, known: Inputs) -> xr.Dataset:
    """Result of each pixel alone that is at hand, in the order of the capture."""
    made = {"method": "subspace", "pooled": 0, "settings": repr(known.settings)}
    if any(alone.attrs.get(name) != value for name, value in made.items()):
        raise ValueError(
            "Invalid result alone. Must be of 'subspace', without materials, with "
            f"{made['settings']}."
        )
    return laid_on(alone, corrected, "the result alone", "the capture")


def _over_found_materials(
    again: Callable[..., tuple[xr.Dataset, object]],
    known: Inputs,
    corrected: xr.Dataset,
    alone: xr.Dataset,
) -> tuple[xr.Dataset, xr.DataArray]:
    """Separate over materials that are found in a result of each pixel alone, and these."""
    found = pooling.materials(alone, corrected, known.response, borders=True)
    regions = pooling.others(found, alone)
    groups = [pooling.without_borders(regions, alone, known.response)]

    def joined(told: Material | None) -> Labels:
        wider = pooling.joined(regions, alone, told, known.response)
        groups.append(pooling.without_borders(wider, alone, known.response))
        return numbered(corrected, groups[-1])

    result, _ = again(replace(known, labels=numbered(corrected, groups[0])), regroup=joined)
    return result, groups[-1]


def _shift(corrected: xr.Dataset, response: xr.Dataset) -> tuple[xr.Dataset | None, float]:
    """Shift of the reflections where cameras stand apart, else how many windows are so for none."""
    apart = cameras_apart(corrected, response)
    if apart > 0.0:
        with suppress(ValueError):  # no shift explains it: the pixels keep the flag
            shift = alignment.reflection_shift(corrected, response)
            if seen_apart(shift):
                return shift, 0.0
    return None, apart


def _unexplained(alone: xr.Dataset) -> list[str]:
    """Doubt about a shift of the reflections with which bands are apart in many pixels."""
    status = alone["status"].values
    moving = (status & np.uint32(schema.UNMEASURED | Status.NO_BACKGROUND_MOTION)) == 0
    apart = ((status & np.uint32(Status.BANDS_APART)) != 0) & moving
    share = apart.sum() / max(moving.sum(), 1)
    return [_UNEXPLAINED.format(share)] if share > _MANY else []


def cameras_apart(corrected: xr.Dataset, response: xr.Dataset) -> float:
    """Share of windows of the image in which the bands show rapid changes apart; 0 if none do.

    Displaced in the image, or in time. Both are seen if one alone is more than that of a poor
    registration, and they are beyond chance by what they change without one window after another
    (Hotelling's T-squared of the jackknife): an object's rapid changes displace a window, and so
    does a border of materials, but not all windows alike.
    """
    if min(corrected.sizes.get(name, 0) for name in ("y", "x")) < SMALLEST:  # solve refuses others
        return 0.0
    return max(_share_apart(each) for each in _displacements(corrected, response))


def _share_apart(each: Array) -> float:
    """Share of windows whose bands are apart, from normal equations A d = g (window, 4, 3)."""
    windows, whole, size = len(each), each.sum(axis=0), each.shape[2]
    # All windows, and those without one after another, have to tell a displacement.
    told = np.concatenate([whole[np.newaxis], whole - each])
    if windows < _FEWEST or np.linalg.eigvalsh(told[:, :size]).min() <= 0.0:
        return 0.0
    shift, *without = (np.linalg.solve(one[:size], one[size]) for one in told)
    covariance = (windows - 1) ** 2 / windows * np.cov(np.transpose(without))
    square, free = shift @ np.linalg.solve(covariance, shift), windows - size
    chance = fdtrc(size, free, free / (windows - 1) / size * square)
    in_image = np.linalg.solve(whole[:2, :2], whole[size, :2])
    in_time = whole[size, 2] / whole[2, 2]
    if chance > _CHANCE or (np.hypot(*in_image) < _LEAST and abs(in_time) < _LEAST_LATE):
        return 0.0
    # Windows whose residual is smaller with it: 2 d g - d A d > 0.
    return float(np.mean((2.0 * each[:, size] - each[:, :size] @ shift) @ shift > 0.0))


def _displacements(corrected: xr.Dataset, response: xr.Dataset) -> list[Array]:
    r"""Normal equations A d = g (window, 4, 3) of the displacement of windows with rapid changes.

    Down and right in the image [pixel], and in time [frame]: of the regression of one band on
    another and its gradients (Lucas and Kanade 1981), of both blurred, with a ratio of each window
    that is eliminated, less what noise adds to them:

    .. math:: z_2 = \kappa_w \, (z_1 + d \cdot \nabla z_1)

    Compared are the functions of time that hold most of what no smooth object shows; and of what
    no object shows that heats within seconds, where reflections are as rapid.
    """
    inputs = check(corrected, response, get_method("subspace"), "subspace")
    every = slice(None, None, max(1, corrected.sizes["time"] // _FRAMES))
    bands, time = inputs.bands[:2], corrected["time"].values[every]
    counts, inside = corrected["counts"].variable[:, every], _measured(corrected)
    slopes = np.array([inputs.curves[band].reference_slope for band in bands], dtype=np.float32)

    def films(*places: tuple[slice, ...]) -> Array:
        """Films (band, time, pixel) [K] of the pixels at some rows and columns."""
        parts = (counts[:, :, *place].values[bands] for place in places)
        film = np.concatenate([part.reshape(2, time.size, -1) for part in parts], axis=2)
        return _filled(film / slopes[:, np.newaxis, np.newaxis])

    height, width = (one.stop - one.start for one in inside)
    step = max(1, int(np.sqrt(height * width / _TOLD_BY)))
    some = films(tuple(slice(one.start, one.stop, step) for one in inside))[0].T
    segment = inputs.capture["segment"].values[every] if "segment" in inputs.capture else None
    orders = min(HIGHEST_ORDER, time.size // 4), time.size // 4
    curves = [smooth.subspace(time, order, segment=segment).functions for order in orders]
    functions = [smooth.leading(some - some @ part @ part.T, _PLANES) for part in curves]
    rates = [part.T @ np.gradient(part, axis=0) for part in functions]
    together = np.concatenate(functions, axis=1).T.astype(np.float32)
    side = int(np.clip(min(height, width) // _ALONG, *_SIDES))
    tops, lefts = (
        one.start + np.linspace(0, size - side, min(_ALONG, size // side)).astype(int)
        for one, size in zip(inside, (height, width), strict=True)
    )
    # Noise of variance s^2, blurred by b: s^2 / (4 pi b^2), of a gradient 1 / (2 b^2) of that.
    noise = side**2 * inputs.noise[bands[0]] ** 2 / (4.0 * np.pi * _BLUR**2)
    found: list[list[Array]] = [[] for _ in functions]
    for top in tops:
        film = films(*((slice(top, top + side), slice(left, left + side)) for left in lefts))
        planes = (together @ film).reshape(2, -1, len(lefts), side, side)
        planes = gaussian_filter(planes, (0.0, 0.0, 0.0, _BLUR, _BLUR)).swapaxes(1, 2)
        parts = np.split(planes, len(functions), axis=2)
        for equations, (first, second), rate in zip(found, parts, rates, strict=True):
            late = np.einsum("ij,wjyx->wiyx", rate, first, optimize=True)
            design = np.stack([first, *np.gradient(first, axis=(2, 3)), late], axis=1)
            design, target = design.reshape(len(lefts), 4, -1), second.reshape(len(lefts), -1, 1)
            each = len(rate) * np.array([1.0, *[0.5 / _BLUR**2] * 2, np.mean(rate**2) * len(rate)])
            normal, right = design @ design.mT - np.diag(noise * each), design @ target
            strong = normal[:, 0, 0] > _STRONG * noise * len(rate)
            normal, right = normal[strong], right[strong]
            size, cross = normal[:, :1, :1], normal[:, :1, 1:]
            ratio = right[:, :1] / size
            tensor = ratio**2 * (normal[:, 1:, 1:] - cross.mT * cross / size)
            rest = ratio * (right[:, 1:].mT - ratio * cross)
            equations.append(np.concatenate([tensor, rest], axis=1))
    return [np.concatenate(equations) for equations in found]


def _measured(corrected: xr.Dataset) -> tuple[slice, slice]:
    """Rows and columns with samples in some frames, as of an object in a part of the image."""
    every = slice(None, None, max(1, corrected.sizes["time"] // _ALONG))
    known = schema.measured(corrected["counts"].isel(time=every).values).all(axis=0).any(axis=0)
    known |= not known.any()
    rows, columns = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def _filled(films: Array) -> Array:
    """Films (band, time, pixel) in which a sample that a band lacks is that before it.

    Zero of a pixel that has fewer than nine tenths of those that another has: a frame may be lost.
    """
    known = schema.measured(films).all(axis=0)
    if known.all():
        return films
    frame = np.maximum.accumulate(np.where(known, np.arange(len(known))[:, np.newaxis], -1))
    frame = np.where(frame < 0, known.argmax(axis=0), frame)
    filled = np.take_along_axis(films, frame[np.newaxis], axis=1)
    share = known.mean(axis=0)
    return np.where(share > _COMMON * share.max(), filled, np.float32(0.0))
