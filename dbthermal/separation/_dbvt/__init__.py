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
        Weights :math:`\gamma_1` to :math:`\gamma_5` [1]: of the squared second differences in units
        of `curvature`; of the Huber loss over its threshold, so that its slope beyond is 1; of the
        squared reconstruction error in units of the second band's noise; of the noise's square in
        units of each band's own (with 0 the noise is held at zero); of the square of its mean.
    curvature : float
        Second derivative of a smooth signal that costs 1 [K/s^2].
    huber_threshold, deviation_floor : float
        Where the Huber loss turns from square to linear, and least deviation by which a signal is
        divided, in units of each band's noise [1].
    stages, stage_steps : int
        Stages of the homotopy, from a small share of the reconstruction's weight to all of it, and
        steps in each but the last; with 1 stage all of it counts from the first step on.
    first_share : float
        Weight of the normalised reconstruction error in the first stage, as a fraction of
        `reconstruction`; in the last it counts in units of the noise, not of the deviation [1].
    steps : int
        Most steps in the last stage.
    tolerance, patience : float, int
        A pixel is done when no step lowers its objective by more than this fraction [1], so many
        times in a row.
    largest_step, margin : float
        Largest change of an emissivity in a step, and its least distance from 0 and 1 [1].
    start : {"random", "subspace"}
        Emissivities uniform in (0, 1), as published; or emissivities and object of the subspace
        separator, and at random where it has none.
    starts : int
        Starts, of which the one of least objective is kept; 1 as published. All but a first one at
        the separator are random.
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
