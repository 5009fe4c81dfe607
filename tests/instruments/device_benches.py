"""Emulated devices and their drivers on a simulated clock, for several tests."""

from collections.abc import Callable

import numpy as np
from faulty_devices import FaultyApt, FaultyBoson, FaultyTC08

from dbthermal.instruments.boson import Boson
from dbthermal.instruments.clock import EmulatedClock
from dbthermal.instruments.emulated import World
from dbthermal.instruments.filterwheel import FilterWheel, Settings
from dbthermal.instruments.tc08 import TC08

FILTERS = {1: "open", 3: "9.5", 5: "LW"}
QUICK = Settings(velocity=50.0, home_velocity=20.0, acceleration=1e3)
"""A wheel that turns in no time."""


class Clock(EmulatedClock):
    """Emulated time from a start [s], with things to do at some times [s]."""

    def __init__(self, now: float = 100.0) -> None:
        super().__init__()
        super().sleep(now)
        self.events: list[tuple[float, Callable[[], None]]] = []

    @property
    def now(self) -> float:
        """The time [s]."""
        return self()

    def sleep(self, seconds: float) -> None:
        """Let time pass [s], and do what is due."""
        super().sleep(seconds)
        due = [event for event in self.events if event[0] <= self()]
        for event in due:
            self.events.remove(event)
            event[1]()


class BosonBench:
    """An emulated camera and its driver, on one clock."""

    def __init__(self, serial_number: int = 93588) -> None:
        self.clock = Clock()
        self.world = World(clock=self.clock)
        self.state = self.world.add_camera("boson", serial_number)
        self.device = FaultyBoson(self.world, "boson")
        self.camera = Boson(self.device, first_sequence=1)

    def exchange(self, request: bytes) -> bytes:
        """Send bytes without the driver, and return the answer."""
        self.device.write(request)
        return self.device.read(4096, 0.1)


class WheelBench:
    """An emulated wheel and its driver, on one simulated clock."""

    def __init__(self, model: str = "BSC201", slot_offset: float = 0.0, **options: object) -> None:
        self.clock = Clock(0.0)
        self.world = World(clock=self.clock, filters=FILTERS, wheel_position=4)
        self.device = FaultyApt(self.world, model=model, slot_offset=slot_offset)
        chosen = Settings(**options)  # type: ignore[arg-type]
        self.wheel = FilterWheel(self.device, FILTERS, chosen)

    def homed(self) -> FilterWheel:
        """Connect and home the wheel."""
        self.wheel.connect()
        self.wheel.home()
        return self.wheel

    def move(self, position: int) -> None:
        """Move the motor without the driver."""
        self.device.turn_to(position)


class LoggerBench:
    """A driver on an emulated unit, a clock, and tips whose temperatures a test sets."""

    def __init__(self) -> None:
        self.clock = Clock(1000.0)
        self.tips = {1: 350.0, 2: 300.0}
        self.unit = FaultyTC08(lambda channel: self.tips.get(channel, np.nan), self.clock)
        self.driver = TC08(self.unit)

    def ready(self) -> TC08:
        """Open the unit with two thermocouples of type T."""
        self.driver.open().set_channels({1: "plate", 2: "room"})
        return self.driver
