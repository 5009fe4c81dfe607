r"""Damped Newton steps of the paper's objective, in all unknowns of a pixel at once.

The objective (`objective`) is convex in everything but the two emissivities, and its second
derivatives have a shape that is solved in a time proportional to the number of frames: a 2x2 block
of noise for each frame, a band of width five for the smooth signal (Whittaker's smoother), a border
of three columns for its second offset and the two ratios. A step solves for all of them.

Beyond its threshold the Huber loss has no curvature: a share of that of a parabola above it (Huber
1981, doi:10.1002/0471725250) is added, as much as it takes to lower the objective.
"""

import itertools
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor

from dbthermal._arrays import Array
from dbthermal._compiled import compiled
from dbthermal.separation._dbvt import DbvtSettings, objective
from dbthermal.separation._dbvt.objective import Columns, Images, Unknowns

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


class _System:
    r"""Newton's equations of each frame, the noise eliminated, in the changes of three forms.

    .. math:: x = d\tilde I_1, \quad y = d\tilde I_2, \quad z = p_1\, dk_2

    With the curvatures q of the noise, h of the Huber losses and w of the reconstruction, the
    noise has the block :math:`N = diag(q + h) + w v v^T, v = (k_2, -1)`. Curvatures and forces
    (negative gradients) are half the derivatives of the objective, times the number of frames.
    """

    def __init__(
        self, unknowns: Unknowns, share: Tensor, images: Images, settings: DbvtSettings
    ) -> None:
        self.emission, self._reflection = k1, k2 = objective.ratios(unknowns.emissivity)
        self.smooth = unknowns.smooth
        self.first, second, error = objective.departures(unknowns, images)
        variance = images.sigma**2
        self._weight = w = settings.reconstruction * images.share / variance[1]
        # Jensen: the square of a mean lies below a mean of squares that touches it here.
        square, mean = (settings.noise or _NO_NOISE) / variance, settings.noise_mean / variance
        self._noise = q1, q2 = square + mean
        own = [
            square[band] * noise + mean[band] * noise.mean(dim=0)
            for band, noise in enumerate(unknowns.noise)
        ]
        h1, pull1 = _huber(self.first, images, settings, 0, share)
        h2, pull2 = _huber(second, images, settings, 1, share)
        a, c = q1 + h1, q2 + h2
        # det N = a c + w (a + k_2^2 c)
        self._diagonal = a + w * k2**2, c + w
        self._inverse = 1 / (a * c + w * (a + k2**2 * c))
        error = w * error
        self._pull = own[0] - pull1 + k2 * error, own[1] - pull2 - error
        # What is left of the quadratic form: with K = N - diag(q), diag(q) N^-1 K in x and y.
        scaled = w * self._inverse
        self.yy = q2 * (h2 * self._diagonal[0] + w * a) * self._inverse
        xx = q1 * (h1 * self._diagonal[1] + w * k2**2 * c) * self._inverse
        xy = -q1 * q2 * k2 * scaled
        xz, self.yz, self.zz = -q1 * k2 * c * scaled, q2 * a * scaled, a * c * scaled
        # Of the smooth signal, x = ds and y = k_1 ds, and with y and z
        self.with_y = xy + k1 * self.yy
        self.with_z = xz + k1 * self.yz
        self.curvature = xx + k1 * (xy + self.with_y)
        n1, n2 = self._solve(*self._pull)
        self.force_y = own[1] - q2 * n2
        self.force_z = error - w * (k2 * n1 - n2)
        self.force = own[0] - q1 * n1 + k1 * self.force_y

    def _solve(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """Solve the 2x2 block of each frame's noise."""
        (a, c), across = self._diagonal, self._weight * self._reflection
        return (
            (c * first + across * second) * self._inverse,
            (across * first + a * second) * self._inverse,
        )

    def noise_step(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Step of the noise (2, time, column) that follows from those of the forms."""
        (q1, q2), (pull1, pull2), error = self._noise, self._pull, self._weight * z
        n1, n2 = self._solve(q1 * x + self._reflection * error - pull1, q2 * y - error - pull2)
        return torch.stack([n1 - x, n2 - y])


def _huber(
    part: Tensor, images: Images, settings: DbvtSettings, band: int, share: Tensor
) -> tuple[Tensor, Tensor]:
    """Curvature of a band, beyond the threshold a share of a parabola's, and gradient."""
    threshold = settings.huber_threshold * images.sigma[band]
    size = part.abs()
    parabola = 0.5 * settings.huber / images.deviation[band] / torch.maximum(size, threshold)
    return torch.where(size <= threshold, parabola, share * parabola), parabola * part


def _propose(
    unknowns: Unknowns, search: Search, images: Images, settings: DbvtSettings
) -> Unknowns:
    """Unknowns after a Newton step: noise, then smooth signal, then border are eliminated."""
    system = _System(unknowns, search.huber_share, images, settings)
    smooth, emission, first = system.smooth, system.emission, system.first
    # The smoothness loss is stiff (1 + k_1^2) |D s|^2 / 2, in the smooth signal s and in k_1.
    stiff = settings.smoothness / (settings.curvature * images.interval**2) ** 2
    bend, square = bending(smooth)
    # y = k_1 ds + dO + s dk_1, z = p_1 dk_2
    sides = [system.with_y, smooth * system.with_y, first * system.with_z]
    sides[1] = sides[1] + stiff * emission * bend
    force = system.force - stiff * (1 + emission**2) * bend
    # (diag(h) + lambda D^T D) [s, S] = [force, sides]
    solved = whittaker(
        system.curvature,
        stiff * (1 + emission**2),
        torch.stack([force, *sides], dim=1),
    )
    # Schur complement of the border (offset, k_1, k_2): B - sides^T S, f - sides^T s
    step, *responses = solved.unbind(dim=1)
    parts = [system.force_y, smooth * system.force_y, first * system.force_z]
    forces = torch.stack(
        [(part - side * step).sum(dim=0) for part, side in zip(parts, sides, strict=True)]
    )
    forces[1] = forces[1] - stiff * emission * square
    by_smooth, by_first = smooth * system.yy, first * system.yz
    pairs = [system.yy, by_smooth, by_first]
    pairs += [smooth * by_smooth, smooth * by_first, first**2 * system.zz]
    products = itertools.combinations_with_replacement(range(3), 2)
    sums = [
        (pair - sides[one] * responses[other]).sum(dim=0)
        for pair, (one, other) in zip(pairs, products, strict=True)
    ]
    border = torch.stack(sums)[_SYMMETRIC]
    border[1, 1] = border[1, 1] + stiff * square
    damping = search.damping * smooth.shape[0]
    emissivity = _emissivity(unknowns.emissivity, border, forces, damping, settings)
    # Back substitution: the ratios as they became, then the offset, the smooth signal, the noise.
    new_emission, _ = after = objective.ratios(emissivity)
    changes = torch.stack(after) - torch.stack(objective.ratios(unknowns.emissivity))
    offset = (forces[0] - (border[0, 1:] * changes).sum(dim=0)) / border[0, 0]
    moves = torch.stack([offset, *changes])
    for response, move in zip(responses, moves, strict=True):
        step = step - response * move
    second_step = emission * step + offset + smooth * changes[0]
    # The border's offset is that of the line between the smooth signals: back to the first frame.
    line = unknowns.offset - emission * smooth[0] + offset
    return Unknowns(
        smooth + step,
        line + new_emission * (smooth + step)[0],
        emissivity,
        unknowns.noise + system.noise_step(step, second_step, first * changes[1]),
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


@compiled
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
