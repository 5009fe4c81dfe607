"""One motion of the wheel, looked at until it is over, or until it is clear that it failed.

That a motion is over is what two things say together: the controller reports it or its moving bits
are clear, and the wheel is where it should be. Neither is enough alone. Bits were seen to stick,
the report of an earlier move may come late, and before a move starts the bits are clear too.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from dbthermal.instruments import apt
from dbthermal.instruments.filterwheel.controller import Controller
from dbthermal.instruments.filterwheel.link import StalledWheelError, WheelTimeoutError
from dbthermal.instruments.filterwheel.settings import Settings

MOVING: Final = (
    apt.StatusBits.MOVING_FORWARD | apt.StatusBits.MOVING_REVERSE | apt.StatusBits.HOMING
)
"""Bits of a wheel that moves. The jogging bits are left out: they were seen to stick."""

LOOKS: Final = 2
"""How many looks, one after the other, must show the same before it is believed."""


class Motion:
    """
    Follows a motion that was just started.

    Parameters
    ----------
    controller : Controller
        That moves.
    settings : Settings
        Tolerance, faults and limits of time.
    clock, sleep : callable
        Give the time and wait [s].
    """

    def __init__(
        self,
        controller: Controller,
        settings: Settings,
        clock: Callable[[], float],
        sleep: Callable[[float], None],
    ) -> None:
        self._controller = controller
        self._settings = settings
        self._clock = clock
        self._sleep = sleep

    def move(self, target: int) -> None:
        """
        Wait until the wheel is at its target.

        Parameters
        ----------
        target : int
            Where it must come to rest [count].

        Raises
        ------
        StalledWheelError
            If it does not start, stands still, comes to rest elsewhere, or the controller reports
            one of the settings' `faults`.
        WheelTimeoutError
            If it takes longer than the settings' `move_timeout`.
        WheelError
            If the controller reports an error or falls silent.
        TransportError
            If the device is gone.
        """
        scale, settings = self._controller.scale, self._settings

        def over(watch: _Watch, status: apt.Status) -> bool:
            away = abs(scale.degrees(status.position - target))
            return away <= settings.tolerance and (watch.reported or watch.rests > 0)

        name = f"Move to {scale.degrees(target):.2f} deg"
        limits = _Limits(name, settings.move_timeout, settings.stall_timeout)
        self._follow(apt.Id.MOT_MOVE_COMPLETED, over, limits)

    def home(self) -> None:
        """
        Wait until the home switch is found.

        That the controller was homed before is no sign: it must have moved, or say so.

        Raises
        ------
        StalledWheelError
            If the wheel does not start, comes to rest before the switch was found, or the
            controller reports one of the settings' `faults`.
        WheelTimeoutError
            If it takes longer than the settings' `home_timeout`.
        WheelError
            If the controller reports an error or falls silent.
        TransportError
            If the device is gone.
        """

        def over(watch: _Watch, status: apt.Status) -> bool:
            homed = status.bits & (apt.StatusBits.HOMED | apt.StatusBits.HOMING)
            done = watch.reported or (watch.moved and watch.rests > 0)
            return done and homed == apt.StatusBits.HOMED

        # The counter may stand while a controller looks for the switch: no limit for that.
        timeout = self._settings.home_timeout
        self._follow(apt.Id.MOT_MOVE_HOMED, over, _Limits("Search for home", timeout, timeout))

    def _follow(
        self,
        end: apt.Id,
        over: "Callable[[_Watch, apt.Status], bool]",
        limits: "_Limits",
    ) -> None:
        """Look until the motion is over; stop the wheel if it takes too long."""
        watch = _Watch(began=self._clock(), changed=self._clock())
        while watch.over < LOOKS:
            status = self._look(watch, end)
            watch.over = watch.over + 1 if over(watch, status) else 0
            if not watch.over:
                self._check(watch, status, limits)
            self._sleep(self._settings.poll_interval)

    def _look(self, watch: "_Watch", end: apt.Id) -> apt.Status:
        """Ask the motor, and note what is new."""
        controller = self._controller
        status = controller.status()
        controller.link.raise_notice()
        faults = status.bits & self._settings.faults
        if faults:
            controller.stop()
            raise StalledWheelError(
                f"The controller reports {faults.name}, and the wheel was stopped. Must be none."
            )
        watch.look(status, self._clock())
        watch.reported |= controller.link.take_event(end, controller.motor)
        return status

    def _check(self, watch: "_Watch", status: apt.Status, limits: "_Limits") -> None:
        """Raise if the wheel rests where it should not, stands still, or takes too long."""
        place = f"at {self._controller.scale.degrees(status.position):.2f} deg"
        now = self._clock()
        started = watch.moved or now - watch.began > self._settings.start_timeout
        if started and watch.rests >= LOOKS:
            action = "stopped" if watch.moved else "did not start and is"
            raise StalledWheelError(f"{limits.name}: the wheel {action} {place}. Must arrive.")
        if now - watch.began > limits.timeout:
            self._controller.stop()
            raise WheelTimeoutError(
                f"{limits.name}: the wheel was still {place} after {limits.timeout} s, and was "
                "stopped. Must arrive in this time."
            )
        if now - watch.changed > limits.stall:
            self._controller.stop()
            raise StalledWheelError(
                f"{limits.name}: the wheel stood {place} for {limits.stall} s while it should "
                "move, and was stopped. Must turn freely."
            )


@dataclass(frozen=True)
class _Limits:
    """What one motion is called in messages, and how long it and a standstill may last [s]."""

    name: str
    timeout: float
    stall: float


@dataclass
class _Watch:
    """What the looks at one motion have shown so far; times in s."""

    began: float
    changed: float
    last: int | None = None
    moved: bool = False
    reported: bool = False
    over: int = 0
    rests: int = 0

    def look(self, status: apt.Status, time: float) -> None:
        """Take in one look at the motor."""
        moving = bool(status.bits & MOVING)
        self.moved |= moving or (self.last is not None and status.position != self.last)
        if status.position != self.last:
            self.last, self.changed = status.position, time
        self.rests = 0 if moving else self.rests + 1
