"""The reflector method of the standards: emissivity with a foil and a contact thermometer."""

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import planck
from dbthermal import response as responses
from dbthermal.calibration._bias import NO_BIAS, Bias
from dbthermal.calibration._contact import Mixture, check_measurements, fitted
from dbthermal.response import Curve, require_range

Array = npt.NDArray[np.float64]


def reflector_emissivity(
    measured: xr.Dataset,
    response: xr.Dataset,
    reading_std: tuple[float, float],
    bias: Bias = NO_BIAS,
) -> xr.Dataset:
    r"""
    Emissivity of a material per band by the reflector method.

    A crumpled foil in the object's place gives the reflected signal :math:`W_r`, a contact
    thermometer the object's own :math:`W_o = U(T_o)`, and the camera the object's W:

    .. math:: e = \frac{W - W_r}{W_o - W_r}, \qquad
              s_e = \frac{\sqrt{s_W^2 + e^2 s_{W_o}^2 + (1 - e)^2 s_{W_r}^2}}{|W_o - W_r|}

    Several measurements are combined by least squares with these weights. What the formula cannot
    know is its weak point: a foil reflects the whole surroundings, a smooth object one direction of
    them, and where the emissivity is low the difference is taken for emission.

    Parameters
    ----------
    measured : Dataset
        Stage `reflector`: `counts` of the object and `reflected_counts` of the foil
        (band, measurement) [count]; `object_temperature` by contact (measurement) [K], within the
        response's range.
    response : Dataset
        From `fit_response`, with its noise, which both counts have.
    reading_std : tuple of float
        Standard deviation of one reading of the contact thermometer, and of the reflected
        temperature beyond the camera's noise, as from one part of the foil to another [K].
    bias : Bias
        Errors that all contact readings have in common; by default none. What it says of the
        background is of a blackbody's, and is not used.

    Returns
    -------
    Dataset
        `emissivity`, `emissivity_std`, `reduced_chi2` (band) [1]; `residual` (band, measurement)
        [count]. With one measurement the reduced chi-square is NaN.

    Raises
    ------
    ValueError
        If dims or sizes differ, a temperature lies outside the response, the response has no
        noise, a deviation is not positive, or object and reflection never differ by more than
        three standard deviations of their difference.
    ArithmeticError
        If the fit does not converge.

    References
    ----------
    .. [1] ISO 18434-1:2008, Condition monitoring and diagnostics of machines, Thermography
    .. [2] ASTM E1862, reflected temperature; ASTM E1933, emissivity, using infrared imaging
       radiometers
    """
    check_measurements(measured, "reflector")
    stds = planck.require_positive("reading_std [K]", reading_std)
    warm = bias.corrected(measured["object_temperature"].values.astype(np.float64))
    names = [str(name) for name in measured["band"].values]
    noises = responses.noise(response, names)
    mixtures = []
    for index, name in enumerate(names):
        curve = responses.curve(response, name)
        require_range(warm, curve, "object temperature")
        counts, foil = (
            measured[part].values[index].astype(np.float64)
            for part in ("counts", "reflected_counts")
        )
        mixtures.append(_mixture(curve, (counts, foil), warm, stds, float(noises[index]), bias))
    return fitted(mixtures, names)


def _mixture(
    curve: Curve,
    counts: tuple[Array, Array],
    warm: Array,
    stds: Array,
    noise: float,
    bias: Bias,
) -> Mixture:
    """Signals of one band, with the errors of thermometer and foil."""
    of_object, of_foil = counts
    cold = curve.inverse(of_foil)
    contrast, least = np.abs(warm - cold).max(), 3.0 * float(np.hypot(*stds))
    if not contrast > least:  # a foil without a temperature fails it, too
        raise ValueError(
            f"Invalid contrast {contrast} K between object and reflection in band '{curve.band}'. "
            f"Must exceed {least} K, three standard deviations of the difference."
        )
    emitted_std, emitted_bias = bias.emitted(curve, warm, float(stds[0]))
    return Mixture(
        counts=of_object,
        emitted=curve.counts(warm),
        reflected=of_foil,
        noise=noise,
        emitted_std=emitted_std,
        reflected_std=np.hypot(noise, curve.count_slope(cold) * stds[1]),
        emitted_bias=emitted_bias,
        reflected_bias=np.zeros((0, warm.size)),
    )
