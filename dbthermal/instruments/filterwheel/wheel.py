"""The filter wheel itself: home, six absolute places, and which band is in the beam."""

import logging
import time as system_time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self

from dbthermal.instruments import apt
from dbthermal.instruments.filterwheel.controller import Controller
from dbthermal.instruments.filterwheel.link import NotHomedError, StalledWheelError, WheelError
from dbthermal.instruments.filterwheel.motion import MOVING, Motion
from dbthermal.instruments.filterwheel.settings import Settings
from dbthermal.instruments.transport import Closing, SerialTransport, Transport, open_serial

if TYPE_CHECKING:
    from dbthermal.instruments.emulated.world import World

BAUDRATE: Final = 115_200
"""Speed of the line [bit/s]."""

SETTLING: Final = 0.05
"""Wait between taking RTS down and up, as in the maker's example [s]."""

_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class Identity:
    """
    Which controller turns the wheel, for a capture's record.

    Attributes
    ----------
    model : str
        As it says, which is not always what is on the label.
    serial_number : int
        On its label.
    firmware : str
        Version.
    addresses : str
        Where it was found, and its motor.
    is_simulated : bool
        Whether it is an emulated one.
    """

    model: str
    serial_number: int
    firmware: str
    addresses: str
    is_simulated: bool


class FilterWheel(Closing):
    """
    A filter wheel whose line is open, for one thread at a time; see `from_url`.

    Parameters
    ----------
    transport : Transport
        Open; closed with the wheel.
    settings : Settings
        Of this wheel.
    clock, sleep : callable
        Give the time and wait [s]; replaced in tests.
    """

    def __init__(
        self,
        transport: Transport,
        settings: Settings,
        *,
        clock: Callable[[], float] = system_time.monotonic,
        sleep: Callable[[float], None] = system_time.sleep,
    ) -> None:
        self.settings = settings
        self._transport = transport
        self._controller = Controller(transport, settings, clock=clock)
        self._motion = Motion(self._controller, settings, clock, sleep)
        self._is_lost = False  # the counter may not be where the wheel is

    @classmethod
    def from_url(cls, url: str, settings: Settings, *, world: "World | None" = None) -> Self:
        """
        Open the line and `connect`; the wheel does not move.

        Parameters
        ----------
        url : str
            ``serial:///dev/ttyUSB0``, ``pty:///dev/pts/3`` or ``sim://apt``.
        settings : Settings
            Of this wheel.
        world : World, optional
            What a ``sim://`` wheel is part of.

        Returns
        -------
        FilterWheel
            Connected.

        Raises
        ------
        ValueError, TransportError
            As `dbthermal.instruments.transport.open_serial`.
        WheelError
            As `connect`; the line is closed again.
        """
        transport = open_serial(url, baudrate=BAUDRATE, rtscts=True, world=world)
        wheel = cls(transport, settings)
        try:
            _toggle_rts(transport)
            wheel.connect()
        except BaseException:
            wheel.close()
            raise
        return wheel

    def connect(self) -> apt.Info:
        """
        Find the controller, see who it is, set the speeds and give the motor current.

        Returns
        -------
        Info
            Of the controller.

        Raises
        ------
        NoReplyError
            If nothing answers, or a controller does and its motor does not.
        WrongDeviceError
            If what answers speaks another language, is another model or has another number.
        WheelError
            If the controller does not take the speeds, or does not enable the motor.
        TransportError
            If the device is gone.
        """
        info = self._controller.find()
        self._controller.prepare()
        return info

    @property
    def is_simulated(self) -> bool:
        """Whether no hardware is at the other end."""
        return self._transport.is_simulated

    def identity(self) -> Identity:
        """Which controller it is, for a capture's record; `WheelError` if it is not connected."""
        controller, info = self._controller, self._controller.info
        addresses = f"0x{controller.unit:02X}, 0x{controller.motor:02X}"
        return Identity(info.model, info.serial_number, info.firmware, addresses, self.is_simulated)

    def status(self) -> apt.Status:
        """
        Ask the motor where it is and what it does.

        Returns
        -------
        Status
            In counts.

        Raises
        ------
        NoReplyError, TransportError
            If it does not answer, or the device is gone.
        """
        return self._controller.status()

    def home(self) -> None:
        """
        Look for the home switch, from which all places count.

        The speeds are set before: where they are near 0, as in some controllers that were just
        switched on, homing does nothing and says nothing.

        Raises
        ------
        StalledWheelError
            If the wheel does not start, stops before the switch was found, or the controller
            reports one of the settings' `faults`.
        WheelTimeoutError
            If the switch is not found within the settings' `home_timeout`; the wheel was stopped.
        WheelError
            If it is still moving, or the controller reports an error or does not take the speeds.
        NoReplyError, TransportError
            If the controller falls silent, or the device is gone.
        """
        self._controller.prepare()
        self._must_rest()
        self._is_lost = True
        self._controller.start_home()
        self._motion.home()
        self._is_lost = False

    def move_to(self, position: int) -> None:
        """
        Turn a slot into the beam, and see that it is there.

        Parameters
        ----------
        position : int
            Slot, 1 to 6.

        Raises
        ------
        ValueError
            If there is no such slot.
        NotHomedError
            If the controller was not homed since it was switched on, or steps may be lost since.
        StalledWheelError
            If the wheel does not move, stops elsewhere, or the controller reports one of the
            settings' `faults`: steps may be lost, and it must be homed before the next move.
        WheelTimeoutError
            If it takes longer than the settings' `move_timeout`; the wheel was stopped.
        WheelError
            If it is still moving, or the controller reports an error.
        NoReplyError, TransportError
            If the controller falls silent, or the device is gone.
        """
        target = self._controller.scale.target(position, self.settings.home_offset)
        self._must_be_homed(self._must_rest())
        self._controller.start_move(target)
        try:
            self._motion.move(target)
        except StalledWheelError:
            self._is_lost = True
            raise

    def select(self, band: str) -> None:
        """
        Turn a band's filter into the beam, as `move_to`.

        Parameters
        ----------
        band : str
            One of the settings' `filters`.

        Raises
        ------
        ValueError
            If no filter is called so.
        WheelError, TransportError
            As `move_to`.
        """
        self.move_to(self.settings.position(band))

    def position(self) -> int:
        """
        Ask which slot is in the beam.

        Returns
        -------
        int
            1 to 6.

        Raises
        ------
        WheelError
            If the wheel is between two slots, or moving, or was not homed.
        TransportError
            If the device is gone.
        """
        status = self._must_rest()
        self._must_be_homed(status)
        scale, settings = self._controller.scale, self.settings
        position = scale.position(status.position, settings.tolerance, settings.home_offset)
        if position is None:
            raise WheelError(
                f"The wheel is between two slots, at {scale.degrees(status.position):.2f} deg. "
                f"Must be within {settings.tolerance} deg of one: move it."
            )
        return position

    def band(self) -> str:
        """
        Ask which filter is in the beam.

        Returns
        -------
        str
            Its name.

        Raises
        ------
        WheelError
            As `position`, or if there is no filter in this slot.
        TransportError
            If the device is gone.
        """
        position = self.position()
        if position not in self.settings.filters:
            known = dict(self.settings.filters)
            raise WheelError(f"No filter in slot {position}. Filters are in {known}.")
        return self.settings.filters[position]

    def stop(self, *, immediate: bool = False) -> None:
        """
        Stop the wheel.

        Parameters
        ----------
        immediate : bool
            Without a ramp. Steps may be lost: it must be homed before the next move.

        Raises
        ------
        TransportError
            If the device is gone.
        """
        self._is_lost |= immediate
        self._controller.stop(immediate=immediate)

    def close(self) -> None:
        """Give the line back; the wheel stays where it is. A second time does nothing."""
        self._transport.close()

    def _must_rest(self) -> apt.Status:
        """Return the status of a wheel that does not move."""
        status = self._controller.status()
        if status.bits & MOVING:
            raise WheelError("The wheel is still moving. Must be at rest: wait, or stop it.")
        return status

    def _must_be_homed(self, status: apt.Status) -> None:
        """Raise unless the controller knows where the wheel is."""
        if self._is_lost or not status.bits & apt.StatusBits.HOMED:
            raise NotHomedError(
                "The wheel was not homed since it was switched on, or has lost steps since. "
                "Must be homed."
            )


def _toggle_rts(transport: SerialTransport) -> None:
    """Take RTS down and up again, where the line has one; a pseudo-terminal has none."""
    transport.set_rts(level=False)
    system_time.sleep(SETTLING)
    if not transport.set_rts(level=True):
        _LOGGER.info("The line %s has no RTS.", transport.url)
