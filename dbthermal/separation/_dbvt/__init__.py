"""The paper's optimiser, algorithm DBVT: its settings."""

from dataclasses import dataclass
from typing import Final

from dbthermal import planck
from dbthermal.separation._inputs import check_fields, require

_CHOICES: Final = {
    "start": ("random", "subspace"),
    "temperatures_from": ("corrected", "measured"),
}


@dataclass(frozen=True)
class DbvtSettings:
    r"""Options of the paper's optimiser: losses, starts, homotopy, Newton's steps.

    None is published. A weight of 0 leaves a loss out.

    Attributes
    ----------
    smoothness, huber, reconstruction, noise, noise_mean : float
        Weights :math:`\gamma_1` to :math:`\gamma_5` [1] of the losses in `objective`: of the
        curvature, of the Huber loss over its threshold, of the reconstruction error, of the noise
        (with 0 it is held at zero), and of its mean.
    curvature : float
        Second derivative of a smooth signal that costs 1 [K/s^2].
    huber_threshold, deviation_floor : float
        Where the Huber loss turns linear, and the least deviation by which a signal is divided, in
        units of each band's noise [1].
    stages, stage_steps, first_share : int, int, float
        Homotopy: stages, steps in each but the last, and the weight of the normalised error of the
        reconstruction in the first over `reconstruction` [1]; the last counts it in units of the
        noise. One stage has all of it from the start.
    steps, tolerance, patience : int, float, int
        Most steps in the last stage; it ends when `patience` steps in a row lower the objective by
        less than this fraction [1].
    largest_step, margin : float
        Largest change of an emissivity in a step, and its least distance from 0 and 1 [1].
    start : {"random", "subspace"}
        Emissivities uniform in (0, 1), as published; or emissivities and object of the subspace
        separator, and at random where it has none.
    starts : int
        Starts, of which the lowest objective is kept; 1 as published. All but the first are random.
    smooth_from_zero : bool
        A random start's smooth signal is zero, as published, and not the signal itself.
    bend_updates : int
        Number of times that the nonlinearity of an exact response is taken out; 0 for the paper's
        linear identities.
    temperatures_from : {"corrected", "measured"}
        Signals without their estimated noise, or as measured.
    batch : int
        Pixels in a tile.
    """

    smoothness: float = 1.0
    huber: float = 0.5
    reconstruction: float = 10.0
    noise: float = 1.0
    noise_mean: float = 1.0
    curvature: float = 0.5
    huber_threshold: float = 1.0
    deviation_floor: float = 1.0
    stages: int = 9
    stage_steps: int = 9
    first_share: float = 1e-6
    steps: int = 80
    tolerance: float = 1e-5
    patience: int = 8
    largest_step: float = 0.2
    margin: float = 0.01
    start: str = "random"
    starts: int = 1
    smooth_from_zero: bool = False
    bend_updates: int = 1
    temperatures_from: str = "corrected"
    batch: int = 512

    def __post_init__(self) -> None:
        """Refuse unknown choices and numbers outside their range."""
        check_fields(self, "dbvt")
        for name, allowed in _CHOICES.items():
            if getattr(self, name) not in allowed:
                raise ValueError(
                    f"Unknown {name} '{getattr(self, name)}' of method 'dbvt'. "
                    f"Must be one of {allowed}."
                )
        weights = ("smoothness", "huber", "reconstruction", "noise", "noise_mean", "bend_updates")
        counts = ("stages", "stage_steps", "steps", "patience", "starts", "batch")
        for least, names in enumerate((weights, counts)):
            for name in names:
                holds = least <= getattr(self, name) < float("inf")
                require(self, "dbvt", name, holds, f"be at least {least}")
        positive = ("curvature", "huber_threshold", "deviation_floor")
        for name in (*positive, "first_share", "tolerance", "largest_step"):
            planck.require_positive(f"{name} of method 'dbvt'", getattr(self, name))
        require(self, "dbvt", "margin", 0 < self.margin < 0.5, "lie in (0, 0.5)")
