"""Emissivity of a material by contact thermometry and a reflected blackbody."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import planck, schema
from dbthermal import response as responses
from dbthermal.calibration._bias import NO_BIAS, Bias
from dbthermal.response import Curve, require_range

Array = npt.NDArray[np.float64]

_ITERATIONS: Final = 50
_CONVERGED: Final = 1e-12


@dataclass(frozen=True)
class Mixture:
    r"""
    Signals of one band on the way from the reflected one to the object's own, and their errors.

    The model is :math:`I_i - W_{b,i} = e (W_{o,i} - W_{b,i})`.

    Attributes
    ----------
    counts, emitted, reflected : ndarray, shape (measurement,)
        :math:`I, W_o, W_b` [count].
    noise : float
        Standard deviation of the counts [count].
    emitted_std, reflected_std : ndarray, shape (measurement,)
        Deviations of the other two, independent from measurement to measurement [count].
    emitted_bias, reflected_bias : ndarray, shape (term, measurement)
        What one standard deviation of each common error does to them [count].
    """

    counts: Array
    emitted: Array
    reflected: Array
    noise: float
    emitted_std: Array
    reflected_std: Array
    emitted_bias: Array
    reflected_bias: Array

    def covariances(self, emissivity: float) -> tuple[Array, Array, Array]:
        r"""
        Covariance of :math:`I - W_b - e (W_o - W_b)`, and what its parts do to the model.

        Parameters
        ----------
        emissivity : float
            e [1].

        Returns
        -------
        tuple of ndarray, each (measurement, measurement)
            Covariance of the residual; e times that of the emitted, and 1 - e times that of the
            reflected signals [count^2].
        """
        own, other = (
            share * (np.diag(std**2) + bias.T @ bias)
            for share, std, bias in (
                (emissivity, self.emitted_std, self.emitted_bias),
                (1.0 - emissivity, self.reflected_std, self.reflected_bias),
            )
        )
        noise = self.noise**2 * np.eye(self.counts.size)
        return noise + emissivity * own + (1.0 - emissivity) * other, own, other


def fit_emissivity(
    measured: xr.Dataset,
    response: xr.Dataset,
    reading_std: tuple[float, float],
    bias: Bias = NO_BIAS,
) -> xr.Dataset:
    r"""
    Emissivity of a material per band, by contact thermometry and a reflected blackbody.

    Each measurement i has counts :math:`I_i`, the object's temperature by thermocouple and the
    reflected blackbody's temperature (equation 10 of the paper [1]_, by least squares):

    .. math:: I_i - U(T_{b,i}) = e \, (U(T_{o,i}) - U(T_{b,i}))

    weighted by the covariance of both sides, of which the independent part is
    :math:`s_i^2 = s_I^2 + (e U'(T_o) s_o)^2 + ((1-e) U'(T_b) s_b)^2` and every common error of the
    readings adds the outer product of its effects; iterated in e. As both sides have errors, the
    differences on the right are weighed as the fit adjusts them [3]_, or their scatter would pass
    for contrast, and e be too low. Where the object is near the air's temperature and the blackbody
    far from it, a thermocouple that conducts heat away does little harm: knowing the bias, the fit
    leans on such measurements.

    Parameters
    ----------
    measured : Dataset
        Stage `contact`: `counts` of the material (band, measurement) [count];
        `object_temperature` by the thermocouple and `background_temperature` of the blackbody
        (measurement) [K], within the response's range.
    response : Dataset
        From `fit_response`, with its noise.
    reading_std : tuple of float
        Standard deviation of one reading of the thermocouple and of the blackbody [K],
        independent from reading to reading.
    bias : Bias
        Errors that all readings have in common; by default none.

    Returns
    -------
    Dataset
        `emissivity`, `emissivity_std` (band) [1]; `reduced_chi2` (band) [1], near 1 if the
        uncertainties are honest; `residual` (band, measurement) [count].

    Raises
    ------
    ValueError
        If dims or sizes differ, a temperature lies outside the response, the response has no
        noise, a deviation is not positive, or object and background never differ by more than
        three standard deviations of their difference.
    ArithmeticError
        If the fit does not converge.

    References
    ----------
    .. [1] Narayanan, Ramanagopal, Narasimhan (2026), doi:10.48550/arXiv.2509.11334
    .. [2] Aitken (1936), On least squares and linear combination of observations, Proceedings of
       the Royal Society of Edinburgh 55, 42, doi:10.1017/S0370164600014346
    .. [3] York et al. (2004), Unified equations for the slope, intercept, and standard errors of
       the best straight line, American Journal of Physics 72, 367, doi:10.1119/1.1632486
    """
    check_measurements(measured, "contact")
    if measured.sizes["measurement"] < 2:
        raise ValueError("Invalid number of measurements 1. Must be at least 2.")
    stds = planck.require_positive("reading_std [K]", reading_std)
    warm = bias.corrected(measured["object_temperature"].values.astype(np.float64))
    cold = measured["background_temperature"].values.astype(np.float64)
    contrast, least = np.abs(warm - cold).max(), 3.0 * float(np.hypot(*stds))
    if not contrast > least:
        raise ValueError(
            f"Invalid contrast {contrast} K between object and background. Must exceed {least} K, "
            "three standard deviations of the difference, in some measurement."
        )
    names = [str(name) for name in measured["band"].values]
    noises = responses.noise(response, names)
    mixtures = []
    for index, name in enumerate(names):
        curve = responses.curve(response, name)
        require_range(warm, curve, "object temperature")
        require_range(cold, curve, "background temperature")
        counts = measured["counts"].values[index].astype(np.float64)
        mixtures.append(_contact(curve, counts, (warm, cold), stds, float(noises[index]), bias))
    return fitted(mixtures, names)


def check_measurements(measured: xr.Dataset, stage: str) -> None:
    """
    Hold measurements against their stage.

    Parameters
    ----------
    measured : Dataset
        The measurements.
    stage : str
        "contact" or "reflector".

    Raises
    ------
    TypeError, ValueError
        As `schema.check`; and if a value is not finite.
    """
    schema.check(measured, stage)
    for name, variable in measured.data_vars.items():
        if not np.all(np.isfinite(variable.values)):
            raise ValueError(f"Invalid {name}: NaN or infinite. Must be finite.")


def fitted(mixtures: list[Mixture], names: list[str]) -> xr.Dataset:
    """
    Emissivities of all bands by generalised least squares.

    Parameters
    ----------
    mixtures : list of Mixture
        One for each band.
    names : list of str
        Names of the bands.

    Returns
    -------
    Dataset
        As `fit_emissivity`; `reduced_chi2` is NaN where there is a single measurement.

    Raises
    ------
    ArithmeticError
        If the fit of a band does not converge.
    """
    fits = [_fit_one(mixture, name) for mixture, name in zip(mixtures, names, strict=True)]
    value, std, chi2, residual = (np.array(part) for part in zip(*fits, strict=True))
    unit = {"units": "1"}
    return xr.Dataset(
        {
            "emissivity": ("band", value, unit),
            "emissivity_std": ("band", std, unit),
            "reduced_chi2": ("band", chi2, unit),
            "residual": (("band", "measurement"), residual, {"units": "count"}),
        },
        coords={"band": names},
    )


def _contact(
    curve: Curve,
    counts: Array,
    temperatures: tuple[Array, Array],
    stds: Array,
    noise: float,
    bias: Bias,
) -> Mixture:
    """Signals of one band, with the errors of thermocouple and blackbody."""
    warm, cold = temperatures
    emitted_std, emitted_bias = bias.emitted(curve, warm, float(stds[0]))
    reflected_std, reflected_bias = bias.reflected(curve, cold, float(stds[1]))
    return Mixture(
        counts=counts,
        emitted=curve.counts(warm),
        reflected=bias.reflection(curve, cold),
        noise=noise,
        emitted_std=emitted_std,
        reflected_std=reflected_std,
        emitted_bias=emitted_bias,
        reflected_bias=reflected_bias,
    )


def _fit_one(mixture: Mixture, name: str) -> tuple[float, float, float, Array]:
    """Emissivity, its standard deviation, reduced chi-square and residuals of one band."""
    across, up = mixture.emitted - mixture.reflected, mixture.counts - mixture.reflected
    emissivity = float(across @ up / (across @ across))
    for _ in range(_ITERATIONS):
        covariance, own, other = mixture.covariances(emissivity)
        force = np.linalg.solve(covariance, up - emissivity * across)
        # Scatter of the readings would pass for contrast and pull the slope down: York et al.
        # (2004) weigh by the abscissa as the fit adjusts it.
        adjusted = across + own @ force - other @ force
        weights = np.linalg.solve(covariance, adjusted)
        previous, emissivity = emissivity, float((weights @ up) / (weights @ across))
        if abs(emissivity - previous) < _CONVERGED:
            break
    else:
        raise ArithmeticError(
            f"No convergence in band '{name}': emissivity {emissivity} after {_ITERATIONS} steps, "
            f"{previous} before. Must change by less than {_CONVERGED}; readings of more contrast "
            "converge."
        )
    residual = up - emissivity * across
    squares = residual @ np.linalg.solve(mixture.covariances(emissivity)[0], residual)
    freedom = mixture.counts.size - 1
    chi2 = float(squares / freedom) if freedom else float("nan")
    return emissivity, float((weights @ adjusted) ** -0.5), chi2, residual
