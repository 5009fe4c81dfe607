"""Reflections of a colour, as those of a sky: scaled to those of a gray background, and back."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import xarray as xr

from dbthermal._arrays import Array, empty, release
from dbthermal.emissivity import Colour

if TYPE_CHECKING:
    from dbthermal.separation._separate import Measured

# Rounds in which s is found, and its change that moves no object: 0.05 % of 20 K are 0.01 K.
_ROUNDS: Final = 5
_SETTLED: Final = 5e-4


def as_gray(
    corrected: xr.Dataset,
    once: Callable[[xr.Dataset], tuple["Measured", Any]],
    measured: "Measured",
    colour: Colour,
) -> tuple[xr.Dataset, Array, tuple["Measured", Any]]:
    """Scale a capture to a gray background; return it, the scales s, and the separation with it."""
    inputs, level, scale = measured.inputs, colour.level, colour.scale(measured.result)
    if level is None:
        films = measured.result["background_temperature"].values
        films = films[:, measured.result["status"].values == 0]
        level = float(np.nanmedian(films)) if films.size else inputs.curves[0].reference
    # The emissivities, from which s follows, are at first those of the signals as they are.
    for _ in range(_ROUNDS):
        counts = empty(corrected["counts"].shape, np.float32)
        for band, curve in enumerate(inputs.curves):
            rest, share = np.float32(curve.counts(level)), np.float32(scale[band])
            for frame, image in zip(counts[band], corrected["counts"].values[band], strict=True):
                frame[:] = rest + (image - rest) / share
            release()
        # Noise and pattern are divided as in most pixels.
        capture = corrected.assign(counts=corrected["counts"].copy(data=counts))
        capture = capture.assign_attrs(background_colour=colour)
        for name in {"noise_factor", *({"pattern_std"} & {*corrected})}:
            before = corrected[name].values if name in corrected else 1.0
            capture[name] = "band", before / np.median(scale, axis=(1, 2))
        outcome = once(capture)
        used, scale = scale, colour.scale(outcome[0].result, scale)
        if np.mean(np.abs(scale - used)) < _SETTLED:
            break
    return capture, used, outcome


def restored(result: xr.Dataset, scale: Array, colour: Colour) -> xr.Dataset:
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
