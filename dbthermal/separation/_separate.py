"""The default way through a capture: all steps of the separation, in one call."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final
from warnings import catch_warnings

import numpy as np
import xarray as xr

from dbthermal import _numbers, _samples, alignment, schema
from dbthermal._arrays import Array, empty, release, without_blas_threads
from dbthermal.alignment._planes import Scale, displaced_windows
from dbthermal.alignment._reflections import seen_apart
from dbthermal.bands import FILTERS
from dbthermal.emissivity import Colour, colour_of
from dbthermal.schema import Status, warned
from dbthermal.separation import _budget as budget
from dbthermal.separation import _misfit as misfits
from dbthermal.separation._apart import displaced
from dbthermal.separation._blur import equalise, sharpness
from dbthermal.separation._budget import SKY
from dbthermal.separation._completion.complete import Beside, filled
from dbthermal.separation._completion.posterior import Mixture
from dbthermal.separation._doubts import against_response, of_one_camera
from dbthermal.separation._inputs import Inputs, Labels, check, numbered
from dbthermal.separation._misfit import Misfit
from dbthermal.separation._motion import drift, stabilise
from dbthermal.separation._overlay import overlay
from dbthermal.separation._pooling import materials as pooling
from dbthermal.separation._pooling.pool import hold
from dbthermal.separation._quality import MOST_BRIDGED
from dbthermal.separation._solve import get_method, require_whole, separate_again, separated
from dbthermal.separation._tiles import Material

if TYPE_CHECKING:
    from dbthermal.separation._subspace.method import SubspaceSettings

_UNEXPLAINED: Final = (
    "The bands do not show the same at the same time in {:.0%} of what mirrors motion, and no "
    "shift of the reflections explains it. If an object is heated in steps, or rows or columns "
    "share noise, the intervals held in simulations; if the cameras stand apart and a pixel "
    "mirrors several depths, or their clocks differ, those of pixels without a flag are too small."
)
_ROUNDS: Final = 3  # in which motion is undone
_RETENTION: Final = 0.9  # share of the pixels without a flag that a mended capture must keep
_NOT_COMPLETED: Final = (
    "Pixels that cannot be measured stay NaN: no library has emissivities of the bands {}. To be "
    f"completed, the bands must have names of {[*FILTERS]} when the capture is made, or a prior on "
    "their emissivities."
)
_SHIFT_SHARE: Final = 0.3  # share of asynchronous pixels from which a shift does not explain them
# Share of asynchronous pixels from which the clocks are compared: of scenes with one clock at most
# 0.003, beside reflections at several depths; and the part of it that one clock may leave.
_CLOCK_SHARE, _REDUCTION = 0.05, 0.5
# Delay beside a shift from which clocks are compared [frame], and in deviations: of cameras of one
# clock 0.012 at most, of clocks half a frame or more apart 0.4 to 0.9.
_DELAY, _SIGMAS = 0.05, 3.0
# Rounds in which scales of a reflection of a colour are found, and their change that moves no
# object: 0.05 % of 20 K are 0.01 K.
_SCALINGS, _SETTLED = 5, 5e-4


@without_blas_threads
def separate(  # noqa: PLR0913 - all but the first two by name
    corrected: xr.Dataset,
    response: xr.Dataset,
    *,
    reflection_shift: xr.Dataset | None = None,
    materials: xr.DataArray | None = None,
    surroundings: float | xr.DataArray | None = None,
    surroundings_std: float = 2.0,
    outdoors: bool = False,
    background_ratio: xr.Dataset | Sequence[float] | None = None,
    prior: str | xr.DataArray | xr.Dataset | None = None,
    settings: "SubspaceSettings | None" = None,
    workers: int = 2,
    progress: bool = False,
) -> xr.Dataset:
    """Separate emission and reflection in a capture, with an answer at every pixel.

    Each pixel alone (`solve`); where the bands show rapid changes displaced all over the image,
    with the shift between the cameras' reflections (`alignment.reflection_shift`); then with the
    pixels of each material pooled (`materials`), held to what they tell alone; last, what is still
    unknown is completed (`complete`). Before that, what the model leaves in the bands widens the
    deviations; if the bands' images lie off each other, their clocks differ, the cameras shake, or
    the bands are not equally sharp, that is mended first.

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
        As in `complete`. Without a prior, and of bands that no library has, nothing is completed.
    outdoors : bool
        The sky is mirrored, whose changes are not alike in two bands: the bars say so
        (`background_ratio_std` 0.4). Not needed where what is mirrored is below 5 degrees Celsius.
    background_ratio : Dataset or (float, float), optional
        Changes of what is mirrored in each band over those in the reference band, known or seen in
        foil (`emissivity.background_ratio`); or of two bands the second's over the first's, and its
        deviation. Changes are from the surroundings; if not stated, from where most rests.
    settings : SubspaceSettings, optional
        Options of the method "subspace".
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
        TypeError or ValueError as from `solve` and `complete`.

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
    # Check the inputs, before the work.
    context = Beside(materials, surroundings, prior, surroundings_std, reflection_shift)
    schema.check_corrected(corrected)
    names = [str(band) for band in corrected["band"].values]
    completable = check_options(names, workers, prior, surroundings)
    if _numbers.truth_value("outdoors", outdoors) and background_ratio is not None:
        raise ValueError("Invalid outdoors beside a background_ratio. State one of them.")
    response = response.assign(background_ratio_std=SKY) if outdoors else response
    inputs = check(corrected, response, get_method("subspace"), settings=settings)
    colour = None
    if background_ratio is not None:
        level = None if surroundings is None else float(np.mean(surroundings))
        colour = colour_of(background_ratio, names, inputs.bands[0], level, surroundings_std)
    response = inputs.response  # with one noise for all steps
    notes = against_response(corrected, response) + of_one_camera(corrected, response)

    # Lay the images on one another.
    laid = overlay(corrected, inputs)
    shift = laid.remaining_shift(reflection_shift) if laid else reflection_shift

    def trial(capture: xr.Dataset, field: xr.Dataset | None = shift) -> tuple[Measured, Misfit]:
        """Separate a capture, and measure what the model leaves in its bands."""
        scope = inputs
        if capture is not corrected:
            scope = check(capture, response, inputs.method, settings=settings)
        measured = _separated(capture, scope, field, materials, workers, progress)
        return measured, misfits.measure(
            measured.inputs, measured.result, workers, drift, sharpness
        )

    # Separate, and widen the bars by what is left.
    capture, (measured, misfit), mended = _mended(laid.capture if laid else corrected, trial)
    if laid:
        detail = laid.detail(measured.inputs, measured.result)
        misfit = replace(misfit, change=np.hypot(misfit.change, detail))
        mended = laid.sentences() + mended
    if colour is not None:
        capture, scale, (measured, misfit) = _as_gray(capture, trial, measured, colour)
    result, materials = measured.result, measured.materials
    misfits.widen(measured.inputs, result, misfit)
    # Complete what is still unknown.
    context = replace(context, materials=materials, reflection_shift=measured.reflection_shift)
    doubts = measured.doubts + mended
    if completable:
        result = filled(result, capture, response, context, workers)
    else:
        doubts.append(_NOT_COMPLETED.format(names))
        result = budget.added(result, measured.inputs)
    if colour is not None:
        result = _restored(result, scale, colour)
    if materials is not None:
        result["material"] = materials
    source = "none" if measured.reflection_shift is None else "found"
    source = source if reflection_shift is None else "given"
    return warned(result.assign_attrs(reflection_shift=source), *notes, *doubts)


def _on_one_clock(
    capture: xr.Dataset, trial: Callable[..., tuple["Measured", Misfit]]
) -> tuple[xr.Dataset, tuple["Measured", Misfit], list[str]]:
    """Separate, and again on one clock if the bands show the same at different times."""
    outcome = trial(capture)
    unchanged = capture, outcome, list[str]()
    names, share = capture["band"].values.tolist(), outcome[0].asynchronous
    if share <= _CLOCK_SHARE and not outcome[0].late:
        return unchanged
    try:
        with catch_warnings(record=True) as notes:  # said only if its clocks are taken
            aligned = alignment.align(capture, clock=names[0])
    except ValueError:  # nothing tells the clocks: the pixels keep the flag
        return unchanged
    # A delay too short to matter explains nothing: the clocks stay as they are.
    offsets, std = np.array(aligned.attrs["time_offset"]), aligned.attrs.get("time_offset_std")
    if np.abs(offsets).max() < _DELAY * np.median(np.diff(capture["time"].values)):
        return unchanged
    aligned = aligned.assign_coords(time=capture["time"])
    # Not if a band lacks more samples than can be bridged: at steps none is interpolated.
    lost = ~schema.measured(_samples.some_pixels(aligned["counts"]))
    retry = outcome if lost.mean(axis=(1, 2)).max() > MOST_BRIDGED else trial(aligned)
    # Nor if it leaves a delay, or a displacement that no shift explains.
    gain = retry[0].asynchronous <= max(_REDUCTION * share, _CLOCK_SHARE) and not retry[0].late
    if not gain or len(retry[0].doubts) > len(outcome[0].doubts):
        return unchanged
    place = int(np.abs(offsets).argmax())
    certainty = "" if std is None else f", known to {std:.4f} s"
    sentence = f"The clocks differ: band '{names[place]}' was taken {offsets[place]:+.4f} s after "
    sentence += f"'{names[0]}'{certainty}, and was interpolated."
    return aligned, retry, [*(str(note.message) for note in notes), sentence]


def _mended(
    original: xr.Dataset, trial: Callable[..., tuple["Measured", Misfit]]
) -> tuple[xr.Dataset, tuple["Measured", Misfit], list[str]]:
    """Separate, and again while what is left shows that clocks or blurs differ, or cameras move."""
    original, (measured, misfit), late = _on_one_clock(original, trial)
    capture, steady, sentences, remainder = original, None, list[str](), 0.0 * misfit.leak
    for _ in range(_ROUNDS):
        steady = stabilise(original, measured.inputs, measured.result, misfit, steady)
        if steady is None:
            break
        repeat = trial(steady.capture)
        # Of six worlds that move at most 0.003 of the misfit stays; before a lamp, at rest, 2.1.
        if not repeat[1].size < misfit.size:
            break
        undone = repeat[0].sound >= _RETENTION * measured.sound
        sentences = [steady.sentence(undone=undone)]
        if not undone:
            break
        capture, (measured, misfit) = steady.capture, repeat
        remainder = np.hypot(remainder, steady.detail(measured.inputs, measured.result))
    misfit = replace(misfit, change=np.hypot(misfit.change, remainder))
    outcome = measured, misfit
    repair = equalise(capture, measured.inputs, measured.result, misfit)
    # A blur leaves the shift as it is, but less of the texture that tells it.
    retry = None if repair is None else trial(repair.capture, measured.reflection_shift)
    if repair and retry and retry[0].sound > _RETENTION * measured.sound:
        measured, residual = retry
        # Noise that is not white is estimated before the blur, which lessens rapid noise alone.
        detail = np.hypot(remainder, repair.detail)
        residual = replace(residual, change=np.hypot(residual.change, detail), single=misfit.single)
        capture, outcome = repair.capture, (measured, residual)
        sentences.append(repair.sentence)
    return capture, outcome, late + sentences


@dataclass(frozen=True)
class Measured:
    """Separated capture, with the inputs, materials and shift that it was separated with."""

    result: xr.Dataset
    inputs: Inputs
    materials: xr.DataArray | None
    reflection_shift: xr.Dataset | None
    doubts: list[str]

    @property
    def sound(self) -> int:
        """Number of pixels without a flag."""
        return int(np.count_nonzero(self.result["status"].values == 0))

    @property
    def late(self) -> bool:
        """Tell whether the bands show displaced reflections at different times."""
        attrs = {} if self.reflection_shift is None else self.reflection_shift.attrs
        delay, std = (attrs.get(name, 0.0) for name in ("delay", "delay_std"))
        frame = np.median(np.diff(self.result["time"].values))
        return bool(abs(delay) > max(_DELAY * frame, _SIGMAS * std))

    @property
    def asynchronous(self) -> float:
        """Share of the pixels with moving reflections whose bands do not show the same."""
        status = self.result["status"].values
        moving = (status & np.uint32(schema.UNMEASURED | Status.NO_BACKGROUND_MOTION)) == 0
        flags = ((status & np.uint32(Status.BANDS_APART)) != 0) & moving
        return float(flags.sum() / max(moving.sum(), 1))


def _separated(
    corrected: xr.Dataset,
    inputs: Inputs,
    reflection_shift: xr.Dataset | None,
    materials: xr.DataArray | None,
    workers: int,
    progress: bool,  # noqa: FBT001 - passed on
) -> Measured:
    """Separate each pixel, with the shift of the reflections, and then over materials."""
    # Find the shift of the reflections, where cameras stand apart.
    share = 0.0
    if reflection_shift is None:
        reflection_shift, share = _shift(corrected, inputs.response)
    if reflection_shift is not None:
        shift = displaced.check(reflection_shift, corrected, inputs.bands[0])
        inputs = replace(inputs, displacement=shift)
    # Separate each pixel.
    per_pixel, surveys = separated(inputs, workers=workers, progress=progress)
    if reflection_shift is not None:
        share = Measured(per_pixel, inputs, None, reflection_shift, []).asynchronous
    unexplained = share > (0.0 if reflection_shift is None else _SHIFT_SHARE)
    doubts = [_UNEXPLAINED.format(share)] if unexplained else []
    # Pool the pixels of each material, and hold them to what each tells by itself.
    result = per_pixel
    pool = partial(separated, alone=per_pixel, surveys=surveys, workers=workers, progress=progress)
    if materials is not None:
        result, _ = pool(replace(inputs, labels=numbered(corrected, materials)))
    elif find_spec("skimage") is not None:
        result, materials = _over_found_materials(pool, inputs, corrected, per_pixel)
    if materials is not None:
        restore = partial(separate_again, inputs, result, workers)
        hold(per_pixel, result, materials, restore if reflection_shift is None else None)
    return Measured(result, inputs, materials, reflection_shift, doubts)


def _as_gray(
    corrected: xr.Dataset,
    trial: Callable[[xr.Dataset], tuple[Measured, Any]],
    measured: Measured,
    colour: Colour,
) -> tuple[xr.Dataset, Array, tuple[Measured, Any]]:
    """Scale a capture to a gray background; return it, the scales s, and the separation with it."""
    inputs, level, scale = measured.inputs, colour.level, colour.scale(measured.result)
    if level is None:
        films = measured.result["background_temperature"].values
        films = films[:, measured.result["status"].values == 0]
        level = float(np.nanmedian(films)) if films.size else inputs.curves[0].reference
    # The emissivities, from which s follows, are at first those of the signals as they are.
    for _ in range(_SCALINGS):
        counts = empty(corrected["counts"].shape, np.float32)
        for band, curve in enumerate(inputs.curves):
            base, share = np.float32(curve.counts(level)), np.float32(scale[band])
            for frame, image in zip(counts[band], corrected["counts"].values[band], strict=True):
                frame[:] = base + (image - base) / share
            release()
        # Noise and pattern are divided as in most pixels.
        capture = corrected.assign(counts=corrected["counts"].copy(data=counts))
        capture = capture.assign_attrs(background_colour=colour)
        for name in {"noise_factor", *({"pattern_std"} & {*corrected})}:
            before = corrected[name].values if name in corrected else 1.0
            capture[name] = "band", before / np.median(scale, axis=(1, 2))
        outcome = trial(capture)
        divisor, scale = scale, colour.scale(outcome[0].result, scale)
        if np.mean(np.abs(scale - divisor)) < _SETTLED:
            break
    return capture, divisor, outcome


def _restored(result: xr.Dataset, scale: Array, colour: Colour) -> xr.Dataset:
    """Result of scaled signals with the emissivities, ratios and noise of those before."""
    g = colour.ratio[:, np.newaxis, np.newaxis]
    of_std, of_ratio = (np.where(scale == 1.0, 1.0, s) for s in (scale**2 / g, scale / g))
    factors = {"emissivity": scale, "reflection_ratio": of_ratio, "reflection_ratio_std": of_ratio}
    factors |= dict.fromkeys(("emissivity_std", "emissivity_uncertainty"), of_std)
    factors["emissivity_covariance"] = of_std[:, np.newaxis] * of_std
    factors["noise"] = np.median(scale, axis=(1, 2))
    for name in factors.keys() & {*map(str, result.data_vars)}:
        result[name].values[...] *= factors[name].astype(result[name].dtype)
    return result


def check_options(
    names: list[str], workers: int = 1, prior: Any = None, surroundings: Any = None, **_: Any
) -> bool:
    """Tell whether a prior knows the bands; ValueError for what is stated and cannot be."""
    completable = prior is not None or FILTERS.keys() >= set(names)
    if completable:
        Mixture.of_prior(prior, names)
    if surroundings is not None:
        _numbers.real_numbers("surroundings [K]", surroundings, _numbers.KELVIN)
    require_whole("number of workers", workers, 1)
    return completable


def _over_found_materials(
    pool: Callable[..., tuple[xr.Dataset, object]],
    inputs: Inputs,
    corrected: xr.Dataset,
    per_pixel: xr.Dataset,
) -> tuple[xr.Dataset, xr.DataArray]:
    """Separate over materials that are found in a result of each pixel alone, and these."""
    labels = pooling.materials(per_pixel, corrected, inputs.response, borders=True)
    regions = pooling.others(labels, per_pixel)
    groups = [pooling.without_borders(regions, per_pixel, inputs.response)]

    def joined(material: Material | None) -> Labels:
        wider = pooling.joined(regions, per_pixel, material, inputs.response)
        groups.append(pooling.without_borders(wider, per_pixel, inputs.response))
        return numbered(corrected, groups[-1])

    result, _ = pool(replace(inputs, labels=numbered(corrected, groups[0])), regroup=joined)
    return result, groups[-1]


def _shift(corrected: xr.Dataset, response: xr.Dataset) -> tuple[xr.Dataset | None, float]:
    """Shift of the reflections where cameras stand apart, else how many windows are so for none."""
    names = [str(name) for name in corrected["band"].values]
    suspected, share = displaced_windows(corrected, Scale.of_response(response, names))
    if suspected:
        with suppress(ValueError):  # no shift explains it: the pixels keep the flag
            shift = alignment.reflection_shift(corrected, response)
            if seen_apart(shift):
                return shift, 0.0
    return None, share
