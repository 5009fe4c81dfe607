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
_PIXELS: Final = 512  # at once, in less than 100 MB at 350 frames


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

    def projection(self) -> Array:
        r"""Projection (band, band, time, pixel) that eliminates the free background of a frame.

        .. math:: W = 1 - v v^T / v^T v \qquad (2)

        with v the reflection, over the bands; the unit matrix in a frame at rest.
        """
        unit = np.eye(len(self.reflection))[..., np.newaxis, np.newaxis]
        return np.asarray(unit - self.reflection[:, np.newaxis] * self.reflection * self.free)


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

    .. math:: \sum_t r(t)^2 \, p(t)^T W(t) \, p(t) \le 0.1 \qquad (3)

    with p the emission. It shifts no quantity by more than the root, 0.32, of that quantity's own
    bound (Cauchy and Schwarz).
    """
    highest = min(_HIGHEST_ORDER, truth.time.size)
    functions = _smooth.polynomial_basis(truth.time, highest)
    order = np.full(truth.object_temperature.shape[1], highest + 1, dtype=np.intp)
    for pixels in _blocks(np.arange(order.size)):
        selected = sensitivity.select(pixels)
        p, projection = selected.emission, selected.projection()
        weight = np.einsum("itp,ijtp,jtp->tp", p, projection, p)
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
        for block in _blocks(np.flatnonzero(order == count)):
            stds = _deviations(sensitivity.select(block), functions, reference, prior)
            for name, values in stds.items():
                if "temperature" in name or not is_known:
                    result[name][:, block] = values
    return result


def _blocks(pixels: Indices) -> list[Indices]:
    """Pixels in blocks, for the memory that each takes."""
    return np.split(pixels, range(_PIXELS, pixels.size, _PIXELS))


def _deviations(
    sensitivity: Sensitivity, functions: Array, reference: int, prior: float
) -> dict[str, Array]:
    """Deviations of pixels of one order, for functions (time, order) and 1 / prior variance."""
    emissivity = sensitivity.emissivity
    bands, (frames, order) = len(emissivity), functions.shape
    variance = fisher_variance(sensitivity, functions, prior)
    # Gradients (pixel or 1, quantity, unknown): x(t) = Phi(t) c, d kappa_m = -d e_m / (1 - e_r)
    # + (1 - e_m) d e_r / (1 - e_r)^2.
    of_emissivity = np.eye(bands, bands + order + 1)[np.newaxis]
    of_object = np.zeros((1, frames, bands + order + 1))
    of_object[0, :, bands:-1] = functions
    of_background = _background(sensitivity, functions)
    of_ratio = np.zeros((emissivity.shape[1], bands, bands + order + 1))
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


def _background(sensitivity: Sensitivity, functions: Array) -> Array:
    """Gradient (pixel, time, unknown) of each frame's background."""
    # A free frame: dy = -v^T (g de + p dx) / v^T v, own variance 1 / v^T v; at rest: the level.
    along = sensitivity.reflection * sensitivity.free
    of_object = np.sum(along * sensitivity.emission, axis=0)
    derivatives = [
        -np.moveaxis(along * sensitivity.contrast, 0, -1),
        -of_object[..., np.newaxis] * functions[:, np.newaxis],
        sensitivity.resting[..., np.newaxis],
    ]
    return np.swapaxes(np.concatenate(derivatives, axis=-1), 0, 1)


def fisher_variance(
    sensitivity: Sensitivity, functions: Array, prior: float
) -> Callable[[Array], Array]:
    """Variances by gradients with emissivities (band), object (order) [K] and resting level [K]."""
    # Over the samples, g = dz/de, p = dz/dx, v = dz/dy and w = v in the frames at rest, else 0.
    g, p = sensitivity.contrast, sensitivity.emission
    w = sensitivity.reflection * sensitivity.resting
    projection = sensitivity.projection()
    projected = np.einsum("ijtp,jtp->itp", projection, p)
    products = functions[:, :, np.newaxis] * functions[:, np.newaxis]
    # F_ee = sum_t g^T W g + prior,  F_ec = sum_t g^T W p Phi^T,  F_cc = sum_t p^T W p Phi Phi^T
    ee = np.einsum("itp,ijtp,jtp->pij", g, projection, g) + prior * np.eye(len(g))
    ec = np.einsum("itp,tk->pik", g * projected, functions)
    cc = np.einsum("tp,tkl->pkl", np.sum(p * projected, axis=0), products)
    # F_el = sum_t g^T w,  F_cl = sum_t p^T w Phi,  F_ll = sum_t w^T w
    el = np.einsum("itp,itp->pi", g, w)[..., np.newaxis]
    cl = np.einsum("tp,tk->pk", np.sum(p * w, axis=0), functions)[..., np.newaxis]
    ll = np.sum(w**2, axis=(0, 1))[:, np.newaxis, np.newaxis]
    ce, le, lc = (np.swapaxes(block, 1, 2) for block in (ec, el, cl))
    fisher = np.block([[ee, ec, el], [ce, cc, cl], [le, lc, ll]])
    # Information about each unknown, were it the only one: no background to eliminate.
    diagonal = np.concatenate(
        [np.sum(g**2, axis=1).T + prior, np.sum(p**2, axis=0).T @ functions**2, ll[..., 0]], axis=1
    )
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
