"""An emulated bench as a laboratory has one: its thermometers err, its samples are heated."""

from collections.abc import Mapping
from typing import Any, Self

import numpy as np
import xarray as xr

from dbthermal.instruments.emulated import World
from dbthermal.instruments.session import Session


class Bench(World):
    """An emulated bench whose thermometers have errors, and whose samples are heated.

    By name: standard deviations of one reading [K], 0 for others; lowest and highest temperature to
    which a sample is heated [K]; temperature (time) [K], over the scene's time [s], of other
    objects that a thermocouple touches. The rest as for `World`.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        reading_std: Mapping[str, float],
        samples: Mapping[str, tuple[float, float]] | None = None,
        touched: Mapping[str, xr.DataArray] | None = None,
        **world: Any,
    ) -> None:
        super().__init__(scene=self._warmth, **world)
        self._rng, self._std, self._samples = rng, dict(reading_std), dict(samples or {})
        self._touched = dict(touched or {})
        self._temperatures = {name: low for name, (low, _) in self._samples.items()}

    @classmethod
    def of(
        cls,
        session: Session,
        rng: np.random.Generator,
        errors: Mapping[str, float],
        *,
        samples: Mapping[str, tuple[float, float]] | None = None,
        touched: Mapping[str, xr.DataArray] | None = None,
    ) -> Self:
        """
        Bench of an emulated session with its cameras, filters and thermocouples; waits for `begin`.

        The errors are standard deviations of one reading of the ``blackbody`` and of any other
        ``thermocouple`` [K]; samples and touched as for `Bench`.
        """
        std = dict.fromkeys(session.thermocouples.values(), errors["thermocouple"])
        std["blackbody"] = errors["blackbody"]
        bench = cls(rng, std, samples, touched, filters=session.filters, waits=True)
        bench.furnish(session)
        return bench

    def step(self, temperature: float) -> None:
        """Set the blackbody [K], and heat every sample to a temperature of its own."""
        self.blackbody_temperature = temperature
        self._temperatures = {
            name: float(self._rng.uniform(*ends)) for name, ends in self._samples.items()
        }

    def thermocouple_temperature(self, channel: int) -> float:
        """Temperature of one thermocouple's tip with the error of one reading [K]; NaN if open."""
        std = self._std.get(self.thermocouples.get(channel, "open"), 0.0)
        with self.lock:
            return super().thermocouple_temperature(channel) + std * float(self._rng.normal())

    def _warmth(self, time: float) -> Mapping[str, float]:
        touched = {
            name: float(np.interp(time, course["time"], course))
            for name, course in self._touched.items()
        }
        return {**self._temperatures, **touched}
