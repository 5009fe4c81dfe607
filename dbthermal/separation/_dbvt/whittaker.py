r"""Smoothing equations of many pixels: a diagonal plus squared second differences.

.. math:: (\mathrm{diag}(d) + \lambda D^T D)\, x = b

with D the second differences over time (Whittaker 1923, doi:10.1017/S0013091500077853): a matrix of
bandwidth five, positive definite where d is positive. Every pixel has its own d and
:math:`\lambda`; the recursion runs over time, for all pixels at once.
"""

import torch
from torch import Tensor


def bending(signal: Tensor) -> tuple[Tensor, Tensor]:
    r"""
    Second differences applied twice, and their sum of squares.

    Parameters
    ----------
    signal : Tensor, shape (time, column)
        Signal x [K].

    Returns
    -------
    tuple of Tensor, shapes (time, column) and (column,)
        :math:`D^T D x` [K] and :math:`|D x|^2` [K^2].
    """
    second = torch.diff(signal, n=2, dim=0)
    result = torch.zeros_like(signal)
    result[2:] += second
    result[1:-1] -= 2 * second
    result[:-2] += second
    return result, (second**2).sum(dim=0)


def solve(diagonal: Tensor, stiffness: Tensor, right: Tensor) -> Tensor:
    r"""
    Solve the smoothing equations by the factors :math:`L\,\mathrm{diag}(p)\,L^T`.

    Parameters
    ----------
    diagonal : Tensor, shape (time, column)
        d, positive.
    stiffness : Tensor, shape (column,)
        :math:`\lambda`, not negative.
    right : Tensor, shape (time, side, column)
        Right-hand sides b, of at least four times.

    Returns
    -------
    Tensor, shape (time, side, column)
        Solutions x.
    """
    frames = diagonal.shape[0]
    main = (diagonal + _ends(frames, (1.0, 5.0), 6.0, diagonal) * stiffness).unbind()
    near = (_ends(frames - 1, (-2.0,), -4.0, diagonal) * stiffness).unbind()
    solved, pivots = list(right.unbind()), [main[0]]
    below, further = [torch.zeros_like(stiffness)], [torch.zeros_like(stiffness)]
    for t in range(1, frames):
        # Rows t - 1 and t - 2 of the factor; the first rows have no further neighbour.
        far = stiffness / pivots[t - 2] if t > 1 else further[0]
        raw = near[t - 1] - far * pivots[t - 2] * below[t - 1] if t > 1 else near[0]
        close = raw / pivots[t - 1]
        pivot = main[t] - close * raw
        solved[t] = solved[t] - close * solved[t - 1]
        if t > 1:
            pivot = pivot - far * stiffness
            solved[t] = solved[t] - far * solved[t - 2]
        pivots.append(pivot)
        below.append(close)
        further.append(far)
    solved = [part / pivot for part, pivot in zip(solved, pivots, strict=True)]
    solved[-2] = solved[-2] - below[-1] * solved[-1]
    for t in range(frames - 3, -1, -1):
        solved[t] = solved[t] - below[t + 1] * solved[t + 1] - further[t + 2] * solved[t + 2]
    return torch.stack(solved)


def _ends(size: int, ends: tuple[float, ...], middle: float, like: Tensor) -> Tensor:
    """A column of one number but for its two ends."""
    column = torch.full((size, 1), middle, dtype=like.dtype, device=like.device)
    for place, value in enumerate(ends):
        column[place] = column[-1 - place] = value
    return column
