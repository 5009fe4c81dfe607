r"""From any start to a minimum of the paper's objective: continuation, and when to stop.

A random start lies on the wrong side of equal emissivities half of the time, and between the sides
is a ridge, but only as far as the reconstruction counts: the other losses know one valley, that of
the emission ratio. So its weight grows from stage to stage (Allgower, Georg 2003,
doi:10.1137/1.9780898719154), each stage from the end of the one before, up to the objective itself.
"""

from dataclasses import dataclass, replace
from typing import Final

import torch
from torch import Tensor

from dbthermal.separation._dbvt import newton as descent
from dbthermal.separation._dbvt import objective
from dbthermal.separation._dbvt.newton import Limits
from dbthermal.separation._dbvt.objective import Images, Unknowns, Weights

# Columns that are done are left behind every so many steps.
_SWEEP: Final = 10


@dataclass(frozen=True)
class Minimum:
    """
    Where a search ended.

    Attributes
    ----------
    unknowns : Unknowns
        Smooth signal, offset, emissivities, noise.
    loss : Tensor, shape (column,)
        The objective [1].
    converged : Tensor of bool, shape (column,)
        Whether it ended for want of progress, and not at its last step.
    """

    unknowns: Unknowns
    loss: Tensor
    converged: Tensor


def minimise(
    unknowns: Unknowns, given: Images, weights: Weights, limits: Limits, stages: int
) -> Minimum:
    """
    Minimise the objective from given starts.

    Parameters
    ----------
    unknowns : Unknowns
        The starts.
    given : Images
        The signals; its deviation and share are set here.
    weights : Weights
        The objective.
    limits : Limits
        The steps.
    stages : int
        Stages of the continuation; 1 for none.

    Returns
    -------
    Minimum
        Where each column ended.
    """
    for stage in range(stages - 1):
        given = _normalised(unknowns, given, weights, limits, stage / (stages - 1))
        search = descent.begin(unknowns, given, weights)
        for _ in range(limits.stage_steps):
            unknowns, search = descent.step(unknowns, search, given, weights, limits)
    return _finish(unknowns, _normalised(unknowns, given, weights, limits, 1.0), weights, limits)


def _normalised(
    unknowns: Unknowns, given: Images, weights: Weights, limits: Limits, progress: float
) -> Images:
    """Deviation of the signals less the noise found so far, and the reconstruction's share."""
    deviation = objective.deviation(
        given.signals, unknowns.noise, given.sigma, weights.deviation_floor
    )
    first = limits.first_share * (given.sigma[1] / deviation[1]) ** 2
    return replace(given, deviation=deviation, share=first.clamp(max=1.0) ** (1.0 - progress))


def _finish(unknowns: Unknowns, given: Images, weights: Weights, limits: Limits) -> Minimum:
    """The last stage; columns that are done are left out of the steps now and then."""
    search = descent.begin(unknowns, given, weights)
    columns = torch.arange(search.loss.numel(), device=search.loss.device)
    here = (unknowns, search, given)
    for count in range(limits.steps):
        moved, after = descent.step(*here, weights, limits)
        here = (moved, after, here[2])
        last = count + 1 == limits.steps
        going = after.quiet < limits.patience
        if last or (count + 1) % _SWEEP == 0:
            unknowns = unknowns.put(columns, moved)
            search = search.put(columns, after)
            columns = columns[going]
            if last or not bool(going.any()):
                break
            here = (moved.taken(going), after.taken(going), here[2].taken(going))
    converged = (search.quiet >= limits.patience) & torch.isfinite(search.loss)
    return Minimum(unknowns, search.loss, converged)
