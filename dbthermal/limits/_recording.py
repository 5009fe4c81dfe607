"""A film that is planned: what is known of it before it is made."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from dbthermal import planck
from dbthermal.limits._deviations import Truth

Array = npt.NDArray[np.float64]

# Time constant of the object's warming, as a share of the recording.
_TIME_CONSTANT: Final = 1.0 / 3.0


@dataclass(frozen=True)
class Recording:
    r"""
    A film that is planned, of a warming object before a background of regular pulses.

    The object warms exponentially, with a time constant of a third of the recording. The
    background rests, then is warmer for the end of each period, as if someone stood there; the
    standard deviation of its rapid change is :math:`A \sqrt{d (1 - d)}` with A the amplitude and
    d = duration / period.

    Attributes
    ----------
    seconds : float
        Length [s].
    rate : float
        Frames a second [1/s].
    start, span : float
        First temperature of the object, and by how much it rises until the last frame [K].
    level : float
        Temperature of the background at rest [K].
    amplitude : float
        Height of a pulse [K].
    period, duration : float
        From pulse to pulse, and of one pulse [s].
    """

    seconds: float = 35.0
    rate: float = 10.0
    start: float = 293.15
    span: float = 25.0
    level: float = 295.15
    amplitude: float = 3.0
    period: float = 5.0
    duration: float = 2.0

    def __post_init__(self) -> None:
        """Refuse numbers that are no recording."""
        for name in ("seconds", "rate", "start", "level", "period", "duration"):
            planck.require_positive(name, getattr(self, name))
        for name in ("span", "amplitude"):
            if not np.isfinite(getattr(self, name)):
                raise ValueError(f"Invalid {name} {getattr(self, name)} K. Must be finite.")
        if self.duration > self.period:
            raise ValueError(
                f"Invalid duration {self.duration} s of a pulse. Must be at most the period, "
                f"{self.period} s."
            )
        if round(self.seconds * self.rate) < 2:
            raise ValueError(
                f"Invalid recording of {self.seconds} s at {self.rate} 1/s. "
                "Must have at least two frames."
            )

    def truth(self, emissivity: Array) -> Truth:
        """
        What it films of some materials.

        Parameters
        ----------
        emissivity : ndarray, shape (band, material)
            Emissivity [1].

        Returns
        -------
        Truth
            One pixel of each material; the background rests between the pulses.
        """
        time = np.arange(round(self.seconds * self.rate)) / self.rate
        rise = np.expm1(-time / (_TIME_CONSTANT * time[-1])) / np.expm1(-1.0 / _TIME_CONSTANT)
        # Half a frame later than its stamp, so that rounding decides on no frame.
        phase = np.mod(time + 0.5 / self.rate, self.period)
        pulse = phase > self.period - self.duration
        many = np.ones(emissivity.shape[1])
        return Truth(
            time=time,
            warm=np.outer(self.start + self.span * rise, many),
            cold=np.outer(self.level + self.amplitude * pulse, many),
            emissivity=emissivity,
            resting=np.outer(~pulse, many.astype(bool)),
        )

    @property
    def range(self) -> float:
        """Difference of the highest and the lowest temperature in the film [K]."""
        truth = self.truth(np.full((1, 1), 0.5))
        return float(np.ptp(np.concatenate([truth.warm, truth.cold])))
