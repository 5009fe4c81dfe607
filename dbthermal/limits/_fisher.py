r"""Fisher information of one pixel's capture, the background eliminated frame by frame.

.. math:: z_m(t) = e_m u_m(x(t)) + (1 - e_m) u_m(y(t)) + s_m n_m(t), \quad x = \Phi c \qquad (1)

with n white noise of variance 1 and :math:`\Phi` a smooth subspace of time. All derivatives are
divided by the noise :math:`s_m`, so that the information is a sum of their products.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from dbthermal import _smooth, mixing
from dbthermal._arrays import Array, Mask
from dbthermal.bands import Band
from dbthermal.response import Curve

Indices = npt.NDArray[np.intp]

TEMPERATURES: Final = ("object_temperature", "background_temperature")
QUANTITIES: Final = (*TEMPERATURES, "emissivity", "reflection_ratio")
"""Quantities that have a bound: of every frame (temperatures), then of every band."""

_NEGLIGIBLE: Final = 0.1  # energy outside the smooth subspace, over the noise's variance
_HIGHEST_ORDER: Final = 30  # largest subspace that is tried
_ROUNDING: Final = 1e-12  # of information, relative to a parameter as the only unknown
_DEPENDENT: Final = 1e-8  # squared share of a gradient along directions without information
_NUMBERS: Final = 2**22  # of derivatives at once, in about 100 MB


@dataclass(frozen=True)
class TopHat:
    """Linearised signal u(T) [K] of a band by Planck's law, about a temperature [K]; its slope."""

    band: Band
    reference: float

    def signal(self, temperature: npt.ArrayLike) -> Array:
        excess = self.band.radiance(temperature) - self.band.radiance(self.reference)
        return np.asarray(self.reference + excess / self.band.slope(self.reference))

    def slope(self, temperature: npt.ArrayLike) -> Array:
        return np.asarray(self.band.slope(temperature) / self.band.slope(self.reference))


@dataclass(frozen=True)
class Sensitivity:
    """Derivatives of every sample with the unknowns, divided by the noise, at the truth."""

    emissivity: Array  # (band, pixel) [1]
    contrast: Array  # with the band's emissivity (band, time, pixel) [1]
    emission: Array  # with the object temperature (band, time, pixel) [1/K]
    reflection: Array  # with the background temperature (band, time, pixel) [1/K]
    resting: Mask  # frames with the background at its resting level (time, pixel)

    def select(self, pixels: Indices) -> "Sensitivity":
        """Sensitivity of some of the pixels."""
        return Sensitivity(*(getattr(self, field.name)[..., pixels] for field in fields(self)))

    @cached_property
    def free(self) -> Array:
        """Variance (time, pixel) [K2] of a frame's background, 1 / v^T v; 0 at rest."""
        return np.asarray(~self.resting / np.sum(self.reflection**2, axis=0))

    def jacobian(self, functions: Array) -> Array:
        """Derivatives (pixel, time, band, unknown) with emissivities, object and resting level."""
        derivatives = [
            np.einsum("btp,bm->ptbm", self.contrast, np.eye(len(self.contrast))),
            np.einsum("btp,tk->ptbk", self.emission, functions),
            np.einsum("btp,tp->ptb", self.reflection, self.resting)[..., np.newaxis],
        ]
        return np.concatenate(derivatives, axis=-1)


@dataclass(frozen=True)
class Truth:
    """True state of the pixels of a capture, at which its information is computed."""

    time: Array  # (time,) [s]
    object_temperature: Array  # (time, pixel) [K]
    background_temperature: Array  # (time, pixel) [K]
    emissivity: Array  # (band, pixel) [1]
    resting: Mask  # frames with the background at its resting level (time, pixel)

    def sensitivity(self, blackbodies: Sequence[Curve | TopHat], noise: Array) -> Sensitivity:
        """Derivatives of equation (1) for the bands' blackbodies and noise (band) [K]."""
        x, y = self.object_temperature, self.background_temperature
        bands = list(zip(blackbodies, noise, mixing.matrix(self.emissivity), strict=True))
        return Sensitivity(
            emissivity=self.emissivity,
            # dz/de = u(x) - u(y),  dz/dx = e u'(x),  dz/dy = (1 - e) u'(y)
            contrast=np.stack([(u.signal(x) - u.signal(y)) / s for u, s, _ in bands]),
            emission=np.stack([weight[:, 0] * u.slope(x) / s for u, s, weight in bands]),
            reflection=np.stack([weight[:, 1] * u.slope(y) / s for u, s, weight in bands]),
            resting=self.resting,
        )

    def smoothed(self, order: Indices) -> "Truth":
        """Truth with the object projected onto each pixel's smooth subspace."""
        smoothed = self.object_temperature.copy()
        for count in np.unique(order):
            functions = _smooth.polynomial_basis(self.time, int(count))
            smoothed[:, order == count] = functions @ (functions.T @ smoothed[:, order == count])
        return replace(self, object_temperature=smoothed)


def smallest_order(truth: Truth, sensitivity: Sensitivity) -> Indices:
    r"""Order (pixel) of the smallest smooth subspace that holds the object within the noise.

    A subspace leaves :math:`r = x - \Phi \Phi^T x`, whose energy must satisfy

    .. math:: \sum_t r(t)^2 \, | W(t) \, p(t) |^2 \le 0.1, \quad W = 1 - v v^T / v^T v \qquad (2)

    with p the emission and v the reflection, over the bands; W is 1 in a frame at rest. It shifts
    no quantity by more than the root, 0.32, of that quantity's own bound (Cauchy and Schwarz).
    """
    highest = min(_HIGHEST_ORDER, truth.time.size)
    functions = _smooth.polynomial_basis(truth.time, highest)
    order = np.full(truth.object_temperature.shape[1], highest + 1, dtype=np.intp)
    for pixels in _blocks(np.arange(order.size), truth.time.size):
        selected = sensitivity.select(pixels)
        p, v = selected.emission, selected.reflection
        weight = np.sum((p - v * selected.free * np.sum(v * p, axis=0)) ** 2, axis=0)
        residual = truth.object_temperature[:, pixels]
        for count, function in enumerate(functions.T, start=1):
            residual = residual - np.outer(function, function @ residual)
            enough = np.sum(weight * residual**2, axis=0) <= _NEGLIGIBLE
            order[pixels[enough & (order[pixels] > count)]] = count
    if np.any(order > highest):
        raise ValueError(
            f"Invalid object_temperature of pixel {int(np.argmax(order > highest))}: {highest} "
            f"smooth functions leave more than {_NEGLIGIBLE} of the noise's variance. "
            "Must be smooth; or give the order."
        )
    return order


def deviations(
    sensitivity: Sensitivity,
    time: Array,
    order: Indices,
    reference: int,
    emissivity_std: float = np.inf,
) -> dict[str, Array]:
    """Smallest deviations of `QUANTITIES`, (time, pixel) [K] or (band, pixel) [1]; or infinite."""
    frames, pixels = sensitivity.resting.shape
    bands = len(sensitivity.emissivity)
    # A prior deviation of 0 means known emissivities.
    is_known = emissivity_std == 0
    if is_known:
        sensitivity = replace(sensitivity, contrast=np.zeros_like(sensitivity.contrast))
    prior = 1.0 if is_known else 1.0 / emissivity_std**2
    rows = {name: frames if "temperature" in name else bands for name in QUANTITIES}
    result = {name: np.zeros((size, pixels)) for name, size in rows.items()}
    for count in np.unique(order):
        functions = _smooth.polynomial_basis(time, int(count))
        numbers = frames * bands * (bands + int(count) + 1)
        for block in _blocks(np.flatnonzero(order == count), numbers):
            stds = _deviations(sensitivity.select(block), functions, reference, prior)
            for name, values in stds.items():
                if "temperature" in name or not is_known:
                    result[name][:, block] = values
    return result


def _blocks(pixels: Indices, numbers: int) -> list[Indices]:
    """Pixels in blocks, for the memory that each takes, of so many numbers."""
    size = max(1, _NUMBERS // numbers)
    return np.split(pixels, range(size, pixels.size, size))


def _deviations(
    sensitivity: Sensitivity, functions: Array, reference: int, prior: float
) -> dict[str, Array]:
    """Deviations of pixels of one order, for functions (time, order) and 1 / prior variance."""
    emissivity, jacobian = sensitivity.emissivity, sensitivity.jacobian(functions)
    bands, unknowns = jacobian.shape[2:]
    # A free background follows the other unknowns, dy = -v^T J / v^T v, and leaves W J, see (2), of
    # its frame; at rest it is the level.
    along = sensitivity.reflection * sensitivity.free
    of_background = -np.einsum("btp,ptbk->ptk", along, jacobian)
    projected = jacobian + np.einsum("btp,ptk->ptbk", sensitivity.reflection, of_background)
    of_background[..., -1] += sensitivity.resting.T
    priors = np.where(np.arange(unknowns) < bands, prior, 0.0)
    variance = fisher_variance(jacobian, projected, priors)
    # Gradients (pixel or 1, quantity, unknown): x(t) = Phi(t) c, d kappa_m = -d e_m / (1 - e_r)
    # + (1 - e_m) d e_r / (1 - e_r)^2.
    of_emissivity = np.eye(bands, unknowns)[np.newaxis]
    of_object = np.pad(functions, ((0, 0), (bands, 1)))[np.newaxis]
    of_ratio = np.zeros((emissivity.shape[1], bands, unknowns))
    of_ratio[:, range(bands), range(bands)] = -1.0 / (1.0 - emissivity[reference])[:, np.newaxis]
    of_ratio[:, :, reference] += ((1.0 - emissivity) / (1.0 - emissivity[reference]) ** 2).T
    of_ratio[:, reference] = 0.0  # 1 by definition, not but for rounding
    variances = {
        "object_temperature": variance(of_object),
        "background_temperature": variance(of_background) + sensitivity.free.T,
        "emissivity": variance(of_emissivity),
        "reflection_ratio": variance(of_ratio),
    }
    return {name: np.sqrt(values.T) for name, values in variances.items()}


def fisher_variance(jacobian: Array, projected: Array, priors: Array) -> Callable[[Array], Array]:
    """Variances by gradients with the unknowns of J, see `_deviations`, of W J and 1 / priors."""
    pixels, *_, unknowns = jacobian.shape
    # F = sum_t J^T W J + prior
    samples = projected.reshape(pixels, -1, unknowns)
    fisher = np.swapaxes(samples, 1, 2) @ samples + np.diag(priors)
    # Information about each unknown, were it the only one: no background to eliminate.
    diagonal = np.sum(jacobian**2, axis=(1, 2)) + priors
    scale = np.sqrt(np.divide(1.0, diagonal, out=np.ones_like(diagonal), where=diagonal > 0))
    scaled = fisher * scale[:, np.newaxis] * scale[..., np.newaxis]
    information, directions = np.linalg.eigh(scaled)

    def variance(gradient: Array) -> Array:
        """Smallest variance (pixel, quantity) for gradients; infinite without information."""
        along = ((gradient * scale[:, np.newaxis]) @ directions) ** 2
        blind = information <= _ROUNDING
        dependent = along @ blind[..., np.newaxis] > _DEPENDENT * along.sum(axis=-1, keepdims=True)
        # var(q) = h^T F^-1 h = sum_i (h . d_i)^2 / lambda_i
        inverse = np.divide(1.0, information, out=np.zeros_like(blind, float), where=~blind)
        return np.where(dependent, np.inf, along @ inverse[..., np.newaxis])[..., 0]

    return variance
