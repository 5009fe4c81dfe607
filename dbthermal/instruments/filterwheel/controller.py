"""The controller that turns the wheel: who it is, its speeds, its motor.

A controller that is addressed wrongly says nothing, one that was just switched on may have speeds
near 0 and a motor without current, and one that was sold under one name may give another. So the
address is looked for, the model is checked, and what is set is read back.
"""

import time as system_time
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from dbthermal.instruments import apt
from dbthermal.instruments.filterwheel.link import Link, NoReplyError, WheelError, WrongDeviceError
from dbthermal.instruments.filterwheel.settings import Scale, Settings
from dbthermal.instruments.transport import Transport

ACCURACY: Final = 0.01
"""Largest relative difference of a speed from the one that was set [1]."""


class Controller:
    """
    One motor of a controller.

    Parameters
    ----------
    transport : Transport
        Open; who made the controller closes it.
    settings : Settings
        Of the wheel.
    clock : callable
        Gives the time [s].

    Attributes
    ----------
    link : Link
        To the controller.
    unit, motor : int
        Addresses: who tells who it is, and the motor. Certain after `find`.
    """

    def __init__(
        self,
        transport: Transport,
        settings: Settings,
        *,
        clock: Callable[[], float] = system_time.monotonic,
    ) -> None:
        self.link = Link(transport, reply_timeout=settings.reply_timeout, clock=clock)
        self.unit, self.motor = settings.addresses[0]
        self._settings = settings
        self._found: tuple[apt.Info, Scale] | None = None

    @property
    def info(self) -> apt.Info:
        """Who it is; `WheelError` before `find`."""
        return self._known()[0]

    @property
    def scale(self) -> Scale:
        """Its units; `WheelError` before `find`."""
        return self._known()[1]

    def find(self) -> apt.Info:
        """
        Look for a controller at each of the settings' addresses, and see whether it is the one.

        Returns
        -------
        Info
            Of the controller.

        Raises
        ------
        NoReplyError
            If nothing answers.
        WrongDeviceError
            If what answers speaks another language, is another model or has another number.
        TransportError
            If the device is gone.
        """
        for unit, motor in self._settings.addresses:
            try:
                info = self._greet(unit)
            except NoReplyError:
                continue
            self._found = info, self._scale_of(info)
            self.unit, self.motor = unit, motor
            self.link.forget_notices()  # it need not know all that it was greeted with
            return info
        dropped = self.link.decoder.dropped
        if dropped:
            raise WrongDeviceError(
                f"{dropped} bytes came that are no APT messages. Must be an APT controller."
            )
        tried = ", ".join(f"0x{unit:02X}" for unit, _ in self._settings.addresses)
        raise NoReplyError(f"No APT controller answered at {tried}. It must be on.")

    def prepare(self) -> None:
        """
        Set the speeds, see that they were taken, and give the motor current.

        Raises
        ------
        WheelError
            If the controller does not take the speeds, does not enable the motor, or reports an
            error.
        NoReplyError, TransportError
            If the motor does not answer, or the device is gone.
        """
        self._set_velocity()
        self._set_home()
        channel, to = self._settings.channel, self.motor
        self.link.send(apt.set_channel_enabled(channel, enabled=True, destination=to))
        request = apt.request_channel_enabled(channel, destination=to)
        answer = self._ask(request, apt.Id.MOD_GET_CHANENABLESTATE)
        try:
            enabled = apt.is_enabled(answer)
        except ValueError as error:
            raise WheelError(f"The controller does not say what the motor does: {error}") from error
        if not enabled:
            raise WheelError("The controller did not enable the motor. It must be connected.")
        self.link.raise_notice()

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
            If the motor does not answer, or the device is gone.
        """
        request = apt.request_status(self._settings.channel, destination=self.motor)
        return apt.Status.parse(self._ask(request, apt.Id.MOT_GET_STATUSUPDATE))

    def start_home(self) -> None:
        """Begin to look for the home switch; raises as `start_move`."""
        self._start(apt.home(self._settings.channel, destination=self.motor))

    def start_move(self, target: int) -> None:
        """
        Begin a move to an absolute place.

        Parameters
        ----------
        target : int
            The place [count].

        Raises
        ------
        ControllerError
            If the controller has reported an error; nothing is sent then.
        TransportError
            If the device is gone.
        """
        channel = self._settings.channel
        self._start(apt.move_absolute(channel, target, destination=self.motor))

    def stop(self, *, immediate: bool = False) -> None:
        """Stop by a ramp, or at once; `TransportError` if the device is gone."""
        channel = self._settings.channel
        self.link.send(apt.stop(channel, immediate=immediate, destination=self.motor))

    def _start(self, request: bytes) -> None:
        """Begin a motion whose end nothing has reported yet."""
        self.link.forget_events()
        self.link.raise_notice()
        self.link.send(request)

    def _greet(self, unit: int) -> apt.Info:
        """Begin as the maker's example does, and ask who is there."""
        self.link.send(apt.no_flash_programming(destination=unit))
        self.link.send(apt.stop_updates(destination=unit))
        request = apt.request_info(destination=unit)
        answer = self.link.ask(request, apt.Id.HW_GET_INFO, source=unit, attempts=1)
        return apt.Info.parse(answer)

    def _scale_of(self, info: apt.Info) -> Scale:
        """Return the scale of a controller, if it is one that drives this wheel."""
        wanted = self._settings.serial_number
        if wanted is not None and info.serial_number != wanted:
            raise WrongDeviceError(f"Wrong controller {info.serial_number}. Must be {wanted}.")
        for beginning, scale in self._settings.models.items():
            if info.model.startswith(beginning):
                return scale
        raise WrongDeviceError(
            f"Wrong device '{info.model}', number {info.serial_number}. "
            f"Its model must begin with one of {sorted(self._settings.models)}."
        )

    def _set_velocity(self) -> None:
        """Set the speeds of moves."""
        settings, scale = self._settings, self.scale
        wanted = apt.VelocityParameters(
            channel=settings.channel,
            minimum=0,
            acceleration=scale.device_acceleration(settings.acceleration),
            maximum=scale.device_velocity(settings.velocity),
        )
        self.link.send(apt.set_velocity_parameters(wanted, destination=self.motor))
        request = apt.request_velocity_parameters(settings.channel, destination=self.motor)
        taken = apt.VelocityParameters.parse(self._ask(request, apt.Id.MOT_GET_VELPARAMS))
        _must_agree("velocity", taken.maximum, wanted.maximum)
        _must_agree("acceleration", taken.acceleration, wanted.acceleration)

    def _set_home(self) -> None:
        """Set the speed of homing, and of the rest what the settings say."""
        settings = self._settings
        request = apt.request_home_parameters(settings.channel, destination=self.motor)
        given = apt.HomeParameters.parse(self._ask(request, apt.Id.MOT_GET_HOMEPARAMS))
        wanted = replace(
            given,
            direction=settings.home_direction or given.direction,
            limit_switch=settings.home_limit_switch or given.limit_switch,
            velocity=self.scale.device_velocity(settings.home_velocity),
        )
        self.link.send(apt.set_home_parameters(wanted, destination=self.motor))
        taken = apt.HomeParameters.parse(self._ask(request, apt.Id.MOT_GET_HOMEPARAMS))
        _must_agree("home velocity", taken.velocity, wanted.velocity)
        if replace(taken, velocity=wanted.velocity) != wanted:
            raise WheelError(f"The controller has {taken}. Must be {wanted}.")

    def _ask(self, request: bytes, reply: apt.Id) -> apt.Message:
        """Ask the motor."""
        return self.link.ask(request, reply, source=self.motor, channel=self._settings.channel)

    def _known(self) -> tuple[apt.Info, Scale]:
        if self._found is None:
            raise WheelError(
                "The wheel is not connected. Must be opened by `FilterWheel.from_url`."
            )
        return self._found


def _must_agree(name: str, taken: int, wanted: int) -> None:
    """Raise if a controller did not take a speed."""
    if abs(taken - wanted) > ACCURACY * wanted:
        raise WheelError(f"The controller has {name} {taken}. Must be {wanted} [device units].")
