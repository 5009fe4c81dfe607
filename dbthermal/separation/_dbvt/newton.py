r"""Damped Newton steps of the paper's objective, in all unknowns of a pixel at once.

The objective (`objective`) is convex in everything but the two emissivities, and its second
derivatives have a shape that is solved in a time proportional to the number of frames: a 2x2 block
of noise for each frame, a band of width five for the smooth signal (Whittaker's smoother), a border
of three columns for its second offset and the two ratios. A step solves for all of them.

Beyond its threshold the Huber loss has no curvature: a share of that of a parabola above it (Huber
1981, doi:10.1002/0471725250) is added, as much as it takes to lower the objective.
"""

from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Final

import numpy as np
import torch
from numba import njit
from torch import Tensor

from dbthermal._arrays import Array
from dbthermal.separation._dbvt import DbvtSettings, objective
from dbthermal.separation._dbvt.objective import Columns, Images, Unknowns

# Unknowns of a step: noise of both bands, smooth signal, and the border.
_FIRST, _SECOND, _SMOOTH, _OFFSET, _EMISSION, _REFLECTION = range(6)
_BORDER: Final = (_OFFSET, _EMISSION, _REFLECTION)
_SYMMETRIC: Final = torch.tensor([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # places of the border's pairs
# Weight of the noise where it is not modelled.
_NO_NOISE: Final = 1e8
# Damping of the emissivities, per frame: first, range, and its factors after a step that lowers the
# objective and one that does not. The same for the share of the parabola's curvature.
_FIRST_DAMPING, _DAMPING, _EASIER, _HARDER = 1e-2, (1e-6, 1e12), 0.1, 10.0
_SHARE, _LESS, _MORE = (1e-4, 1.0), 0.3, 4.0


@dataclass(frozen=True)
class Search(Columns):
    """State of the minimisation, (column,) each."""

    damping: Tensor  # of the emissivities' step, per frame
    huber_share: Tensor  # share of the parabola's curvature in that of the Huber loss
    loss: Tensor  # the objective
    stalled: Tensor  # steps since the objective last fell by more than the tolerance


def begin(unknowns: Unknowns, images: Images, settings: DbvtSettings) -> Search:
    """Search at a start."""
    loss = objective.total(unknowns, images, settings)
    return Search(
        torch.full_like(loss, _FIRST_DAMPING),
        torch.full_like(loss, _SHARE[1]),
        loss,
        torch.zeros_like(loss, dtype=torch.int64),
    )


def step(
    unknowns: Unknowns, search: Search, images: Images, settings: DbvtSettings
) -> tuple[Unknowns, Search]:
    """One step of every column, taken where it lowers the objective."""
    proposal = _propose(unknowns, search, images, settings)
    loss = objective.total(proposal, images, settings)
    better = loss <= search.loss  # false where it is NaN
    least = torch.where(better, loss, search.loss)
    stalled = search.loss - least <= settings.tolerance * search.loss
    damping = search.damping * torch.where(better, _EASIER, _HARDER)
    share = search.huber_share * torch.where(better, _LESS, _MORE)
    count = torch.where(stalled, search.stalled + 1, 0)
    after = Search(damping.clamp(*_DAMPING), share.clamp(*_SHARE), least, count)
    pairs = zip(vars(proposal).values(), vars(unknowns).values(), strict=True)
    return Unknowns(*(torch.where(better, new, old) for new, old in pairs)), after


@dataclass(frozen=True)
class _Term:
    """Part of the objective that depends on one linear form of the unknowns, per frame."""

    slopes: dict[int, Tensor | float]  # of the form, by unknown
    gradient: Tensor  # with the form
    curvature: Tensor


def _terms(
    unknowns: Unknowns, share: Tensor, images: Images, settings: DbvtSettings
) -> list[_Term]:
    """Half the derivatives of the objective but its smoothness, times the number of frames."""
    emission, reflection = objective.ratios(unknowns.emissivity)
    first, second, error = objective.departures(unknowns, images)
    # p_2 = I_2 - n_2 - I2~, with I2~ of equation (1) of the objective
    of_second: dict[int, Tensor | float] = {
        _SECOND: -1.0,
        _SMOOTH: -emission,
        _OFFSET: -1.0,
        _EMISSION: -unknowns.smooth,
    }
    of_first: dict[int, Tensor | float] = {_FIRST: -1.0, _SMOOTH: -1.0}
    terms = []
    for band, (part, slopes) in enumerate(((first, of_first), (second, of_second))):
        variance = images.sigma[band] ** 2
        square = (settings.noise or _NO_NOISE) / variance
        # Jensen: the square of a mean lies below a mean of squares that touches it here.
        mean = settings.noise_mean / variance
        noise = unknowns.noise[band]
        gradient = square * noise + mean * noise.mean(dim=0)
        terms.append(_Term({band: 1.0}, gradient, square + mean))
        terms.append(_huber_term(part, slopes, images, settings, band, share))
    # r = p_2 - k_2 p_1
    weight = settings.reconstruction * images.share / images.sigma[1] ** 2
    of_error = of_second | {_FIRST: reflection, _SMOOTH: reflection - emission, _REFLECTION: -first}
    return [*terms, _Term(of_error, weight * error, weight)]


def _huber_term(
    part: Tensor,
    slopes: dict[int, Tensor | float],
    images: Images,
    settings: DbvtSettings,
    band: int,
    share: Tensor,
) -> _Term:
    """Huber loss of one band; beyond the threshold a share of the touching parabola's curvature."""
    threshold = settings.huber_threshold * images.sigma[band]
    size = part.abs()
    parabola = 0.5 * settings.huber / images.deviation[band] / torch.maximum(size, threshold)
    curvature = torch.where(size <= threshold, parabola, share * parabola)
    return _Term(slopes, parabola * part, curvature)


class _System:
    r"""Newton's equations of a step, the noise of each frame eliminated.

    With N the 2x2 block of a frame's noise, c its coupling to another unknown and f the forces
    (negative gradients), :math:`H - c^T N^{-1} c` and :math:`f - c^T N^{-1} f_n` are left.
    """

    def __init__(self, terms: list[_Term], like: Tensor) -> None:
        self._zero, self._terms = torch.zeros_like(like), terms
        a = self._curvature(_FIRST, _FIRST)
        b = self._curvature(_FIRST, _SECOND)
        c = self._curvature(_SECOND, _SECOND)
        self._block = (a, b, c, a * c - b * b)
        self._coupling = {
            name: (self._curvature(_FIRST, name), self._curvature(_SECOND, name))
            for name in (_SMOOTH, *_BORDER)
        }
        self._pull = self._solve(self._force(_FIRST), self._force(_SECOND))
        self._response = {name: self._solve(*pair) for name, pair in self._coupling.items()}

    def _curvature(self, one: int, other: int) -> Tensor:
        parts = [
            term.curvature * (term.slopes[one] * term.slopes[other])
            for term in self._terms
            if one in term.slopes and other in term.slopes
        ]
        return sum(parts[1:], parts[0]) if parts else self._zero

    def _force(self, name: int) -> Tensor:
        parts = [term.gradient * term.slopes[name] for term in self._terms if name in term.slopes]
        return -sum(parts[1:], parts[0])

    def _solve(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """Solve the 2x2 block of each frame's noise."""
        a, b, c, determinant = self._block
        return (c * first - b * second) / determinant, (a * second - b * first) / determinant

    def curvature(self, one: int, other: int) -> Tensor:
        """Curvature (time, column) with the noise eliminated."""
        (u, v), (f, s) = self._coupling[one], self._response[other]
        return self._curvature(one, other) - u * f - v * s

    def force(self, name: int) -> Tensor:
        """Force (time, column) with the noise eliminated."""
        u, v = self._coupling[name]
        return self._force(name) - u * self._pull[0] - v * self._pull[1]

    def noise_step(self, steps: dict[int, Tensor]) -> Tensor:
        """Step of the noise (2, time, column) that follows from those of the others."""
        parts = [
            self._pull[band] - sum(self._response[name][band] * by for name, by in steps.items())
            for band in (0, 1)
        ]
        return torch.stack(parts)


def _propose(
    unknowns: Unknowns, search: Search, images: Images, settings: DbvtSettings
) -> Unknowns:
    """Unknowns after a Newton step: noise, then smooth signal, then border are eliminated."""
    emission, reflection = objective.ratios(unknowns.emissivity)
    smooth = unknowns.smooth
    system = _System(_terms(unknowns, search.huber_share, images, settings), smooth)
    # The smoothness loss is stiff (1 + k_1^2) |D s|^2 / 2, in the smooth signal s and in k_1.
    stiff = settings.smoothness / (settings.curvature * images.interval**2) ** 2
    bend, square = bending(smooth)
    sides = [system.curvature(_SMOOTH, name) for name in _BORDER]
    sides[1] = sides[1] + stiff * emission * bend
    force = system.force(_SMOOTH) - stiff * (1 + emission**2) * bend
    # (diag(h) + lambda D^T D) [s, S] = [force, sides]
    solved = whittaker(
        system.curvature(_SMOOTH, _SMOOTH),
        stiff * (1 + emission**2),
        torch.stack([force, *sides], dim=1),
    )
    # Schur complement of the border (offset, k_1, k_2): B - sides^T S, f - sides^T s
    forces = torch.stack([system.force(name).sum(dim=0) for name in _BORDER])
    across = torch.stack(sides).transpose(0, 1)
    forces = forces - (across * solved[:, :1]).sum(dim=0)
    forces[1] = forces[1] - stiff * emission * square
    pairs = combinations_with_replacement(_BORDER, 2)
    sums = torch.stack([system.curvature(a, b).sum(dim=0) for a, b in pairs])
    border = sums[_SYMMETRIC] - (across[:, :, None] * solved[:, None, 1:]).sum(dim=0)
    border[1, 1] = border[1, 1] + stiff * square
    damping = search.damping * smooth.shape[0]
    emissivity = _emissivity(unknowns.emissivity, border, forces, damping, settings)
    # Back substitution: the ratios as they became, then the offset, the smooth signal, the noise.
    new_emission, new_reflection = objective.ratios(emissivity)
    changes = torch.stack([new_emission - emission, new_reflection - reflection])
    offset = (forces[0] - (border[0, 1:] * changes).sum(dim=0)) / border[0, 0]
    moves = torch.stack([offset, *changes])
    smooth_step = solved[:, 0] - (solved[:, 1:] * moves).sum(dim=1)
    steps = dict(zip(_BORDER, moves, strict=True)) | {_SMOOTH: smooth_step}
    # The border's offset is that of the line between the smooth signals: back to the first frame.
    line = unknowns.offset - emission * smooth[0] + offset
    return Unknowns(
        smooth + smooth_step,
        line + new_emission * (smooth + smooth_step)[0],
        emissivity,
        unknowns.noise + system.noise_step(steps),
    )


def _emissivity(
    emissivity: Tensor, border: Tensor, forces: Tensor, damping: Tensor, settings: DbvtSettings
) -> Tensor:
    """New emissivities (2, column): damped, of limited change, inside (0, 1)."""
    # The offset is eliminated: a system A in the two ratios.
    pair = border[1:, 1:] - border[1:, :1] * border[:1, 1:] / border[0, 0]
    force = forces[1:] - border[1:, 0] * forces[0] / border[0, 0]
    # With J = d(k_1, k_2) / d(e_1, e_2): (J^T A J + damping) de = J^T f
    first, second = emissivity
    of_emission = torch.stack([-second / first**2, 1 / first])
    of_reflection = torch.stack([(1 - second) / (1 - first) ** 2, -1 / (1 - first)])
    jacobian = torch.stack([of_emission, of_reflection])
    turned = (pair[:, :, None] * jacobian).sum(dim=1)
    square = (jacobian[:, :, None] * turned[:, None]).sum(dim=0)
    push = (jacobian * force[:, None]).sum(dim=0)
    a, b, c = square[0, 0] + damping, square[0, 1], square[1, 1] + damping
    change = torch.stack([c * push[0] - b * push[1], a * push[1] - b * push[0]]) / (a * c - b * b)
    change = change * (settings.largest_step / change.abs().amax(dim=0)).clamp(max=1.0)
    return (emissivity + change).clamp(settings.margin, 1.0 - settings.margin)


def bending(signal: Tensor) -> tuple[Tensor, Tensor]:
    r""":math:`D^T D x` (time, column) and :math:`|D x|^2` (column,), D the second differences."""
    second = torch.diff(signal, n=2, dim=0)
    result = torch.zeros_like(signal)
    result[2:] += second
    result[1:-1] -= 2 * second
    result[:-2] += second
    return result, (second**2).sum(dim=0)


def whittaker(diagonal: Tensor, stiffness: Tensor, right: Tensor) -> Tensor:
    r"""Solutions (time, side, column) of Whittaker's smoother for many pixels at once.

    .. math:: (\mathrm{diag}(d) + \lambda D^T D)\, x = b

    with d (time, column) positive, :math:`\lambda` (column,), b (time, side, column) of at least
    four times (Whittaker 1923, doi:10.1017/S0013091500077853): of bandwidth five, positive
    definite, solved by the factors :math:`L\,\mathrm{diag}(p)\,L^T` with a recursion over time,
    compiled: on the processor, wherever the tensors are.
    """
    solved = np.pad(right.numpy(force=True), ((2, 2), (0, 0), (0, 0)))
    _recursion(diagonal.numpy(force=True), stiffness.numpy(force=True), solved)
    return torch.as_tensor(solved[2:-2], device=right.device)


@njit(nogil=True, error_model="numpy")
def _recursion(diagonal: Array, stiffness: Array, solved: Array) -> None:
    """Factors from the first frame on, then the solution from the last one back, in place.

    Two rows of zeros before and behind take what the ends have not; so do pivots of infinity.
    """
    rows, sides, columns = solved.shape
    pivot = np.full((rows, columns), np.inf)
    below, further = np.zeros((rows, columns)), np.zeros((rows, columns))
    for t in range(2, rows - 2):
        # D^T D has the diagonal 1, 5, 6, ..., 6, 5, 1, beside it -2, -4, ..., -4, -2, and then 1.
        center = (1.0, 5.0, 6.0)[min(t - 2, rows - 3 - t, 2)]
        beside = -2.0 if t in (3, rows - 3) else -4.0
        for c in range(columns):
            near = stiffness[c] * (beside - below[t - 1, c])
            below[t, c], further[t, c] = near / pivot[t - 1, c], stiffness[c] / pivot[t - 2, c]
            less = below[t, c] * near + further[t, c] * stiffness[c]
            pivot[t, c] = diagonal[t - 2, c] + center * stiffness[c] - less
        for side in range(sides):
            for c in range(columns):
                before = below[t, c] * solved[t - 1, side, c]
                solved[t, side, c] -= before + further[t, c] * solved[t - 2, side, c]
    for t in range(rows - 3, 1, -1):
        for side in range(sides):
            for c in range(columns):
                after = below[t + 1, c] * solved[t + 1, side, c]
                after += further[t + 2, c] * solved[t + 2, side, c]
                solved[t, side, c] = solved[t, side, c] / pivot[t, c] - after


with suppress(RuntimeError):  # without a folder that may be written each process compiles
    _recursion.enable_caching()
