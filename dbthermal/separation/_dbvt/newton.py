r"""Minimising the paper's objective: damped Newton steps in all unknowns of a pixel at once.

The objective (`objective`) is convex in everything but the two emissivities, and its second
derivatives have a shape that is solved in a time proportional to the number of frames: a 2x2 block
of noise for each frame, a band of width five for the smooth signal, a border of three columns for
its second offset and the emissivities. A step solves for all of them. Away from its threshold the
Huber loss has no curvature; it is given between that and the one of a parabola that lies above
it (Huber 1981, doi:10.1002/0471725250), as much as it takes for the step to lower the objective.

From any start the emissivities find their valley by continuation: the reconstruction counts little
at first, so that the smooth signals settle and with them the emission ratio, then more and more.
"""

from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

from dbthermal import planck
from dbthermal.separation._dbvt import objective
from dbthermal.separation._dbvt import whittaker as banded
from dbthermal.separation._dbvt.objective import Columned, Images, Unknowns, Weights

# Unknowns of a step: noise of both bands, smooth signal, and the border.
_FIRST, _SECOND, _SMOOTH, _OFFSET, _EMISSION, _REFLECTION = range(6)
_BORDER: Final = (_OFFSET, _EMISSION, _REFLECTION)
# Weight of the noise where none is modelled.
_NO_NOISE: Final = 1e8
# Damping of the emissivities, per frame: first, least and most; what a good step divides it by, and
# a bad one multiplies it with. The same for the curvature that the Huber loss is lent.
_FIRST_DAMPING, _DAMPING, _EASIER, _HARDER = 1e-2, (1e-6, 1e12), 0.1, 10.0
_LENT, _LESS, _MORE = (1e-4, 1.0), 0.3, 4.0


@dataclass(frozen=True)
class Search(Columned):
    """
    Where the minimisation stands.

    Attributes
    ----------
    damping : Tensor, shape (column,)
        Of the emissivities' step, per frame.
    lent : Tensor, shape (column,)
        Share of the parabola's curvature that the Huber loss is lent.
    loss : Tensor, shape (column,)
        The objective.
    quiet : Tensor of int, shape (column,)
        Steps since the objective last fell by more than the tolerance.
    """

    damping: Tensor
    lent: Tensor
    loss: Tensor
    quiet: Tensor


@dataclass(frozen=True)
class Limits:
    """
    Bounds of the steps, stages, and when to stop.

    Attributes
    ----------
    stages : int
        Stages of the continuation, from a small share of the reconstruction's weight to all of it;
        with 1 all of it counts from the first step on.
    stage_steps : int
        Steps in each stage but the last.
    first_share : float
        Weight of the normalised reconstruction error in the first stage, as a fraction of
        `reconstruction`; in the last it counts in units of the noise, not of the deviation [1].
    steps : int
        Most steps in the last stage.
    tolerance : float
        A pixel is done when no step lowers its objective by more than this fraction [1] ...
    patience : int
        ... so many times in a row.
    largest_step : float
        Most that an emissivity changes in a step [1].
    margin : float
        Least distance of an emissivity from 0 and 1 [1].
    """

    stages: int = 9
    stage_steps: int = 9
    first_share: float = 1e-6
    steps: int = 80
    tolerance: float = 1e-5
    patience: int = 8
    largest_step: float = 0.2
    margin: float = 0.01

    def __post_init__(self) -> None:
        """Refuse numbers that are no descent."""
        for name in ("stages", "stage_steps", "steps", "patience"):
            if not getattr(self, name) >= 1:
                raise ValueError(
                    f"Invalid {name} {getattr(self, name)} of method 'dbvt'. Must be at least 1."
                )
        for name in ("first_share", "tolerance", "largest_step"):
            planck.require_positive(f"{name} of method 'dbvt'", getattr(self, name))
        if not 0 < self.margin < 0.5:
            raise ValueError(
                f"Invalid margin {self.margin} of method 'dbvt'. Must lie in (0, 0.5)."
            )


def begin(unknowns: Unknowns, images: Images, weights: Weights) -> Search:
    """
    Search at a start.

    Parameters
    ----------
    unknowns, images, weights
        See `objective`.

    Returns
    -------
    Search
        With the first damping.
    """
    loss = _total(unknowns, images, weights)
    return Search(
        torch.full_like(loss, _FIRST_DAMPING),
        torch.full_like(loss, _LENT[1]),
        loss,
        torch.zeros_like(loss, dtype=torch.int64),
    )


def step(
    unknowns: Unknowns, search: Search, images: Images, weights: Weights, limits: Limits
) -> tuple[Unknowns, Search]:
    """
    One step of every column, taken where it lowers the objective.

    Parameters
    ----------
    unknowns, search, images, weights, limits
        Where it stands, and the objective.

    Returns
    -------
    tuple of Unknowns, Search
        Where it stands then.
    """
    tried = _propose(unknowns, search, images, weights, limits)
    loss = _total(tried, images, weights)
    better = loss <= search.loss  # false where it is NaN
    kept = torch.where(better, loss, search.loss)
    still = search.loss - kept <= limits.tolerance * search.loss
    damping = search.damping * torch.where(better, _EASIER, _HARDER)
    lent = search.lent * torch.where(better, _LESS, _MORE)
    quiet = torch.where(still, search.quiet + 1, 0)
    following = Search(damping.clamp(*_DAMPING), lent.clamp(*_LENT), kept, quiet)
    return tried.chosen(unknowns, better), following


def _total(unknowns: Unknowns, images: Images, weights: Weights) -> Tensor:
    return torch.stack(list(objective.losses(unknowns, images, weights).values())).sum(dim=0)


@dataclass(frozen=True)
class _Row:
    """Terms of the objective that depend on one linear form: its slopes, force and stiffness."""

    slopes: dict[int, Tensor | float]
    force: Tensor
    stiffness: Tensor


def _rows(unknowns: Unknowns, lent: Tensor, images: Images, weights: Weights) -> list[_Row]:
    """Half the derivatives of the objective, times the number of frames, form by form."""
    emission, reflection = objective.ratios(unknowns.emissivity)
    first, second, rest = objective.departures(unknowns, images)
    rows = []
    for band, part in enumerate((first, second)):
        quiet = (weights.noise or _NO_NOISE) / images.sigma[band] ** 2
        # Jensen: the square of a mean lies below a mean of squares that touches it here.
        mean = weights.noise_mean / images.sigma[band] ** 2
        noise = unknowns.noise[band]
        rows.append(_Row({band: 1.0}, quiet * noise + mean * noise.mean(dim=0), quiet + mean))
        slopes: dict[int, Tensor | float] = {_FIRST: -1.0, _SMOOTH: -1.0}
        if band == 1:
            slopes = _second_slopes(unknowns, emission)
        rows.append(_far(part, slopes, images, weights, band, lent))
    stiff = weights.reconstruction * images.share / images.sigma[1] ** 2
    slopes = _second_slopes(unknowns, emission)
    slopes |= {_FIRST: reflection, _SMOOTH: reflection - emission, _REFLECTION: -first}
    return [*rows, _Row(slopes, stiff * rest, stiff)]


def _second_slopes(unknowns: Unknowns, emission: Tensor) -> dict[int, Tensor | float]:
    """Slopes of the second band's departure from its smooth signal."""
    return {_SECOND: -1.0, _SMOOTH: -emission, _OFFSET: -1.0, _EMISSION: -unknowns.smooth}


def _far(
    part: Tensor,
    slopes: dict[int, Tensor | float],
    images: Images,
    weights: Weights,
    band: int,
    lent: Tensor,
) -> _Row:
    """Huber loss of one band: the parabola that touches it, beyond the threshold only partly."""
    threshold = weights.huber_threshold * images.sigma[band]
    size = part.abs()
    parabola = 0.5 * weights.huber / images.deviation[band] / torch.maximum(size, threshold)
    stiffness = torch.where(size <= threshold, parabola, lent * parabola)
    return _Row(slopes, parabola * part, stiffness)


class _System:
    """Newton's equations of a step, the noise of each frame eliminated."""

    def __init__(self, rows: list[_Row], like: Tensor) -> None:
        self._like, self._rows = like, rows
        a, b, c = (
            self._curvature(*pair) for pair in ((_FIRST, _FIRST), (_FIRST, _SECOND), (_SECOND,) * 2)
        )
        self._block = (a, b, c, a * c - b * b)
        self._coupling = {
            name: (self._curvature(_FIRST, name), self._curvature(_SECOND, name))
            for name in (_SMOOTH, *_BORDER)
        }
        self._pull = self.noise(self._force(_FIRST), self._force(_SECOND))
        self._response = {name: self.noise(*pair) for name, pair in self._coupling.items()}

    def _curvature(self, one: int, other: int) -> Tensor:
        total = torch.zeros_like(self._like)
        for row in self._rows:
            if one in row.slopes and other in row.slopes:
                total = total + row.stiffness * row.slopes[one] * row.slopes[other]
        return total

    def _force(self, name: int) -> Tensor:
        total = torch.zeros_like(self._like)
        for row in self._rows:
            if name in row.slopes:
                total = total - row.force * row.slopes[name]
        return total

    def noise(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """Solve the frame's own 2x2 block."""
        a, b, c, determinant = self._block
        return (c * first - b * second) / determinant, (a * second - b * first) / determinant

    def reduced(self, one: int, other: int) -> Tensor:
        """Curvature with the noise following."""
        (u, v), (f, s) = self._coupling[one], self._response[other]
        return self._curvature(one, other) - u * f - v * s

    def force(self, name: int) -> Tensor:
        """Force with the noise following."""
        u, v = self._coupling[name]
        return self._force(name) - u * self._pull[0] - v * self._pull[1]

    def following(self, steps: dict[int, Tensor]) -> Tensor:
        """Step of the noise, (2, time, column), given those of the others."""
        parts = [
            self._pull[band] - sum(self._response[name][band] * by for name, by in steps.items())
            for band in (0, 1)
        ]
        return torch.stack(parts)


def _propose(
    unknowns: Unknowns, search: Search, images: Images, weights: Weights, limits: Limits
) -> Unknowns:
    """Solve for the step of all unknowns."""
    emission, reflection = objective.ratios(unknowns.emissivity)
    smooth = unknowns.smooth
    system = _System(_rows(unknowns, search.lent, images, weights), smooth)
    stiff = weights.smoothness / (weights.curvature * images.interval**2) ** 2
    bend, slack = banded.bending(smooth)
    sides = [system.reduced(_SMOOTH, name) for name in _BORDER]
    sides[1] = sides[1] + stiff * emission * bend
    right = system.force(_SMOOTH) - stiff * (1 + emission**2) * bend
    solved = banded.solve(
        system.reduced(_SMOOTH, _SMOOTH),
        stiff * (1 + emission**2),
        torch.stack([right, *sides], dim=1),
    )
    forces = torch.stack([system.force(name).sum(dim=0) for name in _BORDER])
    forces = forces - torch.einsum("btc,tc->bc", torch.stack(sides), solved[:, 0])
    forces[1] = forces[1] - stiff * emission * slack
    matrix = torch.stack(
        [torch.stack([system.reduced(a, b).sum(dim=0) for b in _BORDER]) for a in _BORDER]
    )
    matrix = matrix - torch.einsum("atc,tbc->abc", torch.stack(sides), solved[:, 1:])
    matrix[1, 1] = matrix[1, 1] + stiff * slack
    emissivity = _emissivity(unknowns.emissivity, matrix, forces, search, smooth.shape[0], limits)
    new_emission, new_reflection = objective.ratios(emissivity)
    changes = torch.stack([new_emission - emission, new_reflection - reflection])
    offset = (forces[0] - (matrix[0, 1:] * changes).sum(dim=0)) / matrix[0, 0]
    border = torch.stack([offset, *changes])
    moved = solved[:, 0] - (solved[:, 1:] * border).sum(dim=1)
    steps = dict(zip(_BORDER, border, strict=True)) | {_SMOOTH: moved}
    # The offset of the line between the smooth signals, back at the first frame.
    line = unknowns.offset - emission * smooth[0] + offset
    return Unknowns(
        smooth + moved,
        line + new_emission * (smooth + moved)[0],
        emissivity,
        unknowns.noise + system.following(steps),
    )


def _emissivity(
    emissivity: Tensor,
    matrix: Tensor,
    forces: Tensor,
    search: Search,
    frames: int,
    limits: Limits,
) -> Tensor:
    """New emissivities: damped, of limited change, inside (0, 1)."""
    # The offset follows; what is left is a system in the two ratios, then in the emissivities.
    pair = matrix[1:, 1:] - matrix[1:, :1] * matrix[:1, 1:] / matrix[0, 0]
    force = forces[1:] - matrix[1:, 0] * forces[0] / matrix[0, 0]
    first, second = emissivity
    zero = torch.zeros_like(first)
    emission = torch.stack([-second / first**2, 1 / first])
    reflection = torch.stack([(1 - second) / (1 - first) ** 2, zero - 1 / (1 - first)])
    slopes = torch.stack([emission, reflection])
    square = torch.einsum("aic,abc,bjc->ijc", slopes, pair, slopes)
    push = torch.einsum("aic,ac->ic", slopes, force)
    damping = search.damping * frames
    a, b, c = square[0, 0] + damping, square[0, 1], square[1, 1] + damping
    step = torch.stack([c * push[0] - b * push[1], a * push[1] - b * push[0]]) / (a * c - b * b)
    step = step * (limits.largest_step / step.abs().amax(dim=0)).clamp(max=1.0)
    return (emissivity + step).clamp(limits.margin, 1.0 - limits.margin)
