"""The default way through a capture: all steps of the separation, in one call."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from itertools import product
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
from dbthermal.separation._solve import get_method, separated, solve
from dbthermal.separation._subspace.reflection_ratio import HIGHEST_ORDER
from dbthermal.separation._tiles import Array, Material

if TYPE_CHECKING:
    from dbthermal.separation._subspace.method import SubspaceSettings

# Pixels, about, from which it is told whether bands are apart.
_LOOKED_AT: Final = 2000
# Share of the pixels with moving reflections whose bands are apart, from which a shift is sought,
# if it is that by more than so many of its standard deviations.
_APART, _SIGMAS = 0.02, 3.0
# Bits of pixels around an object, which a registration leaves without samples.
_UNMEASURED: Final = np.uint32(schema.UNMEASURED)
# Frames, windows along either side, their sides [pixel], at least so many, and the blur in which a
# displacement is looked for [pixel]; chance below and pixels from which it is one, and by how many
# times a window's changes have to exceed the noise, in variance.
_FRAMES, _ALONG, _SIDES, _FEWEST, _BLUR = 400, 8, (8, 24), 4, 2.0
_CHANCE, _LEAST, _STRONG = 1e-3, 0.3, 3.0
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

    Each pixel alone (`solve`); where bands are apart in more than 2 % of the pixels whose
    reflections move, or show slow changes displaced, with the shift between the cameras'
    reflections (`alignment.reflection_shift`) if fewer are apart with it, or more have no flag;
    then with the pixels of each material pooled (`materials`), held to what they tell alone; last,
    what is still unknown is completed (`complete`).

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
    known = check(corrected, response, get_method("subspace"), "subspace", settings=settings)
    response = known.response  # with one noise for all steps
    unlike = against_response(corrected, response) + of_one_camera(corrected, response)
    one = partial(solve, corrected, response, settings=settings, workers=workers, progress=progress)
    if alone is not None:
        made = {"method": "subspace", "pooled": 0, "settings": repr(known.settings)}
        if any(alone.attrs.get(name) != value for name, value in made.items()):
            raise ValueError(
                "Invalid result alone. Must be of 'subspace', without materials, with "
                f"{made['settings']}."
            )
        alone = laid_on(alone, corrected, "the result alone", "the capture")
    given = alone
    if reflection_shift is None:
        alone, reflection_shift, doubts = _apart(one, corrected, response, workers, alone)
        source = "none" if reflection_shift is None else "found"
    else:
        alone = one(reflection_shift=reflection_shift) if alone is None else alone
        source, doubts = "given", _unexplained(alone)
    result = alone
    if reflection_shift is not None:
        shift = displaced.check(reflection_shift, corrected, known.bands[0])
        known = replace(known, displacement=shift)
    again = partial(separated, alone=alone, workers=workers, progress=progress)
    if materials is not None:
        result = again(replace(known, labels=numbered(corrected, materials)))
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


def _over_found_materials(
    again: Callable[..., xr.Dataset], known: Inputs, corrected: xr.Dataset, alone: xr.Dataset
) -> tuple[xr.Dataset, xr.DataArray]:
    """Separate over materials that are found in a result of each pixel alone, and these."""
    found = pooling.materials(alone, corrected, known.response, borders=True)
    regions = pooling.others(found, alone)
    groups = [pooling.without_borders(regions, alone, known.response)]

    def joined(told: Material | None) -> Labels:
        wider = pooling.joined(regions, alone, told, known.response)
        groups.append(pooling.without_borders(wider, alone, known.response))
        return numbered(corrected, groups[-1])

    result = again(replace(known, labels=numbered(corrected, groups[0])), regroup=joined)
    return result, groups[-1]


def _apart(
    one: Callable[..., xr.Dataset],
    corrected: xr.Dataset,
    response: xr.Dataset,
    workers: int,
    known: xr.Dataset | None,
) -> tuple[xr.Dataset, xr.Dataset | None, list[str]]:
    """First separation, the shift of the reflections if it needs one, and what is not explained."""
    apart, good = 0.0, 0.0
    if min(corrected.sizes.get(name, 0) for name in ("y", "x")) >= SMALLEST:  # solve refuses others
        apart, good = cameras_apart(corrected, response, workers)
    if apart > 0.0:
        try:
            shift = alignment.reflection_shift(corrected, response)
        except ValueError:  # no shift explains it: the pixels keep the flag
            shift = None
        if shift is not None and seen_apart(shift):
            alone = one(reflection_shift=shift)
            # An object that heats rapidly is apart in pixels that are paired by their reflections.
            left, moving = _pixels_apart(alone, shift)
            if left / moving < apart or _unflagged(alone) > good + _APART:
                return alone, shift, _unexplained(alone)
    first = one() if known is None else known
    return first, None, [_UNEXPLAINED.format(apart)] if apart > 0.0 else []


def _unexplained(alone: xr.Dataset) -> list[str]:
    """Doubt about a shift of the reflections with which bands are apart in many pixels."""
    apart, moving = _pixels_apart(alone)
    return [_UNEXPLAINED.format(apart / moving)] if apart > _MANY * moving else []


def cameras_apart(
    corrected: xr.Dataset, response: xr.Dataset, workers: int = 2
) -> tuple[float, float]:
    """Share of pixels with moving reflections whose bands are apart, 0 if that may be chance.

    Of some pixels, for all would take long; and the share of them without a flag. Slow reflections
    are simultaneous within a frame though they are apart: then the share of windows displaced.
    """
    corrected, some = _measured(corrected)
    some = solve(some, response, workers=workers)
    apart, moving = _pixels_apart(some)
    chance = _SIGMAS * np.sqrt(_APART * (1.0 - _APART) / moving)  # binomial
    share = apart / moving if apart / moving > _APART + chance else 0.0
    return share or _displaced(corrected, response), _unflagged(some)


def _measured(corrected: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """Rows and columns with samples, as of an object in a part of the image; some pixels of it."""
    step = _step(corrected)
    some = corrected.isel(y=slice(None, None, step), x=slice(None, None, step)).load()
    known = schema.measured(some["counts"].values).all(axis=0).any(axis=0)
    if not known.any():
        return corrected, some
    places = [np.flatnonzero(known.any(axis=axis)) for axis in (1, 0)]
    (top, left), (bottom, right) = ([one[0] for one in places], [one[-1] + 1 for one in places])
    inside = corrected.isel(y=slice(top * step, bottom * step), x=slice(left * step, right * step))
    if (finer := _step(inside)) == step:
        return inside, some.isel(y=slice(top, bottom), x=slice(left, right))
    every = slice(None, None, finer)
    return inside, inside.isel(y=every, x=every).load()


def _step(corrected: xr.Dataset) -> int:
    """Rows and columns from one to the next of some pixels that are looked at."""
    pixels = corrected.sizes["y"] * corrected.sizes["x"]
    return max(1, int(np.sqrt(pixels / _LOOKED_AT)))


def _displaced(corrected: xr.Dataset, response: xr.Dataset) -> float:
    """Share of windows of the image in which the bands show rapid changes displaced; 0 if none do.

    Their common displacement is seen if it is more than that of a poor registration, and beyond
    chance by what it changes without one window after another (Hotelling's T-squared of the
    jackknife): an object's own rapid changes displace a window, and so does a border of materials.
    """
    each = _displacements(corrected, response)
    windows, whole = len(each), each.sum(axis=0)
    # All windows, and those without one after another, have to tell a displacement.
    told = np.concatenate([whole[np.newaxis], whole - each])
    if windows < _FEWEST or np.linalg.eigvalsh(told[:, :2]).min() <= 0.0:
        return 0.0
    shift, *without = (np.linalg.solve(one[:2], one[2]) for one in told)
    covariance = (windows - 1) ** 2 / windows * np.cov(np.transpose(without))
    square = shift @ np.linalg.solve(covariance, shift)
    chance = fdtrc(2, windows - 2, 0.5 * (windows - 2) / (windows - 1) * square)
    if chance > _CHANCE or np.hypot(*shift) < _LEAST:
        return 0.0
    # Windows whose residual is smaller with it: 2 d g - d A d > 0.
    return float(np.mean((2.0 * each[:, 2] - each[:, :2] @ shift) @ shift > 0.0))


def _displacements(corrected: xr.Dataset, response: xr.Dataset) -> Array:
    r"""Normal equations A d = g (window, 3, 2) of the displacement of windows with rapid changes.

    Of the regression of one band on another and its gradient (Lucas and Kanade 1981), of both
    blurred, with a ratio of each window that is eliminated, less what noise adds to them:

    .. math:: z_2 = \kappa_w \, (z_1 + d \cdot \nabla z_1)
    """
    inputs = check(corrected, response, get_method("subspace"), "subspace")
    every = slice(None, None, max(1, corrected.sizes["time"] // _FRAMES))
    counts, time = corrected["counts"].isel(time=every), corrected["time"].values[every]
    functions = smooth.subspace(time, min(HIGHEST_ORDER, time.size // 4)).functions
    height, width = counts.shape[-2:]
    side = int(np.clip(min(height, width) // _ALONG, *_SIDES))
    tops, lefts = (
        np.linspace(0, size - side, min(_ALONG, size // side)).astype(int)
        for size in (height, width)
    )
    found = []
    for top, left in product(tops, lefts):
        part = counts.isel(y=slice(top, top + side), x=slice(left, left + side)).values
        rapid = []
        for band in inputs.bands[:2]:
            signal = inputs.curves[band].linearise(part[band].astype(np.float64))
            signal = np.where(schema.measured(signal).all(axis=0), signal, 0.0)
            signal -= np.tensordot(functions, np.tensordot(functions.T, signal, 1), 1)
            rapid.append(gaussian_filter(signal, (0.0, _BLUR, _BLUR)))
        design = np.stack([rapid[0], *np.gradient(rapid[0], axis=(1, 2))]).reshape(3, -1)
        normal, right = design @ design.T, design @ rapid[1].ravel()
        # Noise of variance s^2, blurred by b: s^2 / (4 pi b^2), of a gradient 1 / (2 b^2) of that.
        white = design.shape[1] * inputs.noise[inputs.bands[0]] ** 2 / (4.0 * np.pi * _BLUR**2)
        normal -= white * np.diag([1.0, *[0.5 / _BLUR**2] * 2])
        if normal[0, 0] > _STRONG * white:
            ratio, cross = right[0] / normal[0, 0], normal[0, 1:]
            tensor = normal[1:, 1:] - np.outer(cross, cross) / normal[0, 0]
            found.append([*ratio**2 * tensor, ratio * (right[1:] - ratio * cross)])
    return np.array(found).reshape(-1, 3, 2)


def _unflagged(result: xr.Dataset) -> float:
    """Share of the pixels with samples that have no flag."""
    status = result["status"].values
    measured = (status & _UNMEASURED) == 0
    return float((status == 0).sum() / max(int(measured.sum()), 1))


def _pixels_apart(result: xr.Dataset, shift: xr.Dataset | None = None) -> tuple[int, int]:
    """Pixels with moving reflections whose bands are not simultaneous, and all such, at least 1.

    With a shift of the reflections also those that have no pair, though not by the image's end.
    """
    status = result["status"].values
    moving = (status & (_UNMEASURED | np.uint32(Status.NO_BACKGROUND_MOTION))) == 0
    apart = (status & np.uint32(Status.BANDS_APART)) != 0
    if shift is not None:
        reach = np.nanmax(np.abs(shift["shift"].where(shift["known"]).values), axis=(1, 2))
        down, right = np.minimum(np.ceil(reach).astype(int), np.array(status.shape) // 2)
        inside = np.zeros(status.shape, dtype=bool)
        inside[down : status.shape[0] - down, right : status.shape[1] - right] = True
        apart |= inside & ((status & np.uint32(Status.NO_REFLECTION_PAIR)) != 0)
    return int((apart & moving).sum()), max(int(moving.sum()), 1)
