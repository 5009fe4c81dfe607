"""An emulated filter wheel FW103 on an emulated APT controller; no hardware is involved.

It answers below the real driver, byte for byte, and has the quirks that users report of real
ones: speeds near 0 and a motor without current when it gets power, silence if it is addressed
wrongly, reports of moves whenever they come, another model than on the label. What it does of its
own accord follows public descriptions only.

References
----------
As in `dbthermal.instruments.apt`; quirks from issues 6, 14, 17, 74 and 83 of
AlexShkarin/pyLabLib and from the documentation of thorlabs_apt_device.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final

from dbthermal.instruments import apt
from dbthermal.instruments.emulated.apt_faults import MODELS, Faults
from dbthermal.instruments.emulated.apt_motor import Drive, Motor
from dbthermal.instruments.emulated.port import EmulatedPort, number, require_known
from dbthermal.instruments.emulated.world import World

SERIAL_NUMBER: Final = 40_000_000
"""Number of a controller unless it is given another."""

UPDATE_INTERVAL: Final = 0.1
"""From one report to the next, where they are started [s]."""

UPDATE_PATIENCE: Final = 5.0
"""Time after which a controller that reports falls silent for want of an acknowledgement [s]."""

NOTES: Final = b"emulated, not hardware".ljust(60, b"\0")
"""What is in the notes of its `Info`."""


class EmulatedApt:
    """
    A controller and a wheel; a `Device` of `dbthermal.instruments.emulated.port`.

    Parameters
    ----------
    world : World
        Its clock is used, and its wheel is turned.
    model : str
        What it says it is: BSC201, BSC203 or SCC201, which are racks, BSC101, or KDC101, which
        drives no wheel.
    serial_number : int
        Of the controller.
    slot_offset : float
        From the wheel's home switch to its slot 1 [deg].

    Attributes
    ----------
    faults : Faults
        Knobs.
    motor : Motor
        Where the wheel really is.
    plugged : bool
        Set it to False to pull out the cable.
    received : list of Message
        All that came, also what was addressed to nobody.
    is_simulated : bool
        True.

    Raises
    ------
    ValueError
        If there is no such model.
    """

    is_simulated: Final = True

    def __init__(
        self,
        world: World,
        *,
        model: str = "BSC201",
        serial_number: int = SERIAL_NUMBER,
        slot_offset: float = 0.0,
    ) -> None:
        if model not in MODELS:
            raise ValueError(f"Invalid model '{model}'. Must be one of {sorted(MODELS)}.")
        self.faults = Faults()
        self.plugged = True
        self.received: list[apt.Message] = []
        self._world = world
        self._kind = MODELS[model]
        self._info = apt.Info(serial_number, model, 45, "1.0.0", 1, 0, 1, NOTES)
        self._unit = apt.RACK if self._kind.is_rack else apt.UNIT
        self._address = apt.BAY_1 if self._kind.is_rack else apt.UNIT
        self._slot_offset = slot_offset
        slot = 1 if world.wheel_position is None else world.wheel_position
        turn = self._kind.turn
        self.motor = Motor(turn, ((slot - 1) / 6 + slot_offset / 360.0) * turn)
        self._velocity = apt.VelocityParameters(1, 0, 0, 0)
        self._home = apt.HomeParameters(1, 2, 1, 0, 0)
        self._decoder = apt.Decoder(apt.CONTROLLERS, (apt.HOST,))
        self._waiting: list[tuple[float, bytes]] = []
        self._updates: float | None = None  # when the next report is due
        self._updates_began = 0.0

    def receive(self, data: bytes) -> None:
        """
        Take in bytes from the driver.

        Parameters
        ----------
        data : bytes
            Any number, of any value.
        """
        for message in self._decoder.feed(data):
            self.received.append(message)
            self._advance()
            mine = message.destination in {self._unit, self._address}
            if mine and not self.faults.silent and message.id not in self.faults.deaf_to:
                self._notice(message)
                self._obey(message)

    def poll(self) -> list[bytes]:
        """Give what is due to be sent now, each piece in a write of its own."""
        self._advance()
        now = self._world.clock()
        due = [data for time, data in self._waiting if time <= now]
        if not due or (self.faults.hold and len(due) < 2):
            return []
        self._waiting = [item for item in self._waiting if item[0] > now]
        joined = b"".join(due)
        if self.faults.single_bytes:
            return [joined[place : place + 1] for place in range(len(joined))]
        return [joined]

    def next_due(self) -> float:
        """Time until something may be due [s]; infinite if nothing will unless bytes come."""
        now = self._world.clock()
        times = [time for time, _ in self._waiting]
        if self.motor.drive is not None:
            times.append(self.motor.drive.end)
        if self._updates is not None:
            times.append(self._updates)
        return max(0.0, min(times, default=math.inf) - now)

    def _advance(self) -> None:
        """Go on to now: move the motor, report the end of a motion, turn the world's wheel."""
        now = self._world.clock()
        slip = self.faults.slips / 360.0 * self.motor.turn
        ended = self.motor.advance(now, slip=slip)
        self._world.wheel_position = self.motor.slot(self._slot_offset)
        if ended is not None and not self.faults.unreported:
            self._report(apt.Id.MOT_MOVE_HOMED if ended.homing else apt.Id.MOT_MOVE_COMPLETED)
        if self._updates is not None and now >= self._updates:
            self._update(now)

    def _update(self, now: float) -> None:
        """Report the status, or fall silent if nobody acknowledges it."""
        self._updates = now + UPDATE_INTERVAL
        if now - self._updates_began > UPDATE_PATIENCE:
            self.faults.silent, self._updates = True, None
            return
        self._answer(apt.Id.MOT_GET_STATUSUPDATE, self._status().pack())

    def _obey(self, message: apt.Message) -> None:
        """
        Do what a message asks for; one that is not known is ignored.

        So is the acknowledgement of reports, as by some of these controllers.
        """
        setters: Mapping[int, Callable[[apt.Message], None]] = {
            apt.Id.MOD_SET_CHANENABLESTATE: self._enable,
            apt.Id.MOT_SET_POSCOUNTER: self._set_position,
            apt.Id.MOT_SET_VELPARAMS: self._set_velocity,
            apt.Id.MOT_SET_HOMEPARAMS: self._set_home,
            apt.Id.MOT_MOVE_HOME: self._start_home,
            apt.Id.MOT_MOVE_ABSOLUTE: self._move_absolute,
            apt.Id.MOT_MOVE_RELATIVE: self._move_relative,
            apt.Id.MOT_MOVE_STOP: self._stop,
            apt.Id.HW_START_UPDATEMSGS: self._start_updates,
            apt.Id.HW_STOP_UPDATEMSGS: self._stop_updates,
        }
        if message.id in setters:
            setters[message.id](message)
        elif message.id == apt.Id.HW_REQ_INFO:
            self._answer(apt.Id.HW_GET_INFO, self._info.pack(), source=message.destination)
        else:
            self._tell(message)

    def _tell(self, message: apt.Message) -> None:
        """Answer a question about the motor."""
        counter = apt.Position(1, self.motor.counter)
        bits = self._status().bits
        answers = {
            apt.Id.MOT_REQ_POSCOUNTER: (apt.Id.MOT_GET_POSCOUNTER, counter.pack()),
            apt.Id.MOT_REQ_VELPARAMS: (apt.Id.MOT_GET_VELPARAMS, self._velocity.pack()),
            apt.Id.MOT_REQ_HOMEPARAMS: (apt.Id.MOT_GET_HOMEPARAMS, self._home.pack()),
            apt.Id.MOT_REQ_STATUSUPDATE: (apt.Id.MOT_GET_STATUSUPDATE, self._status().pack()),
            apt.Id.MOT_REQ_STATUSBITS: (
                apt.Id.MOT_GET_STATUSBITS,
                b"\x01\x00" + int(bits).to_bytes(4, "little"),
            ),
        }
        if message.id in answers:
            identifier, data = answers[apt.Id(message.id)]
            self._answer(identifier, data)
        elif message.id == apt.Id.MOD_REQ_CHANENABLESTATE:
            state = 1 if self.motor.enabled else 2
            self._answer(apt.Id.MOD_GET_CHANENABLESTATE, param1=1, param2=state)
        elif message.id == apt.Id.RACK_REQ_BAYUSED and self._kind.is_rack:
            used = 1 if message.param1 == 0 else 2
            answer = apt.Id.RACK_GET_BAYUSED
            self._answer(answer, param1=message.param1, param2=used, source=self._unit)

    def _answer(
        self,
        identifier: apt.Id,
        data: bytes = b"",
        *,
        param1: int = 0,
        param2: int = 0,
        source: int | None = None,
    ) -> None:
        """Send a message, with what the faults add to it."""
        if self.faults.drop > 0:
            self.faults.drop -= 1
            return
        address = self._address if source is None else source
        message = apt.Message(identifier, param1, param2, apt.HOST, address, data)
        stray = apt.Message(apt.Id.MOT_MOVE_COMPLETED, 1, 0, apt.HOST, self._address)
        before = apt.encode(stray) if self.faults.stray_completed else b""
        due = self._world.clock() + self.faults.late
        self._waiting.append((due, self.faults.noise + before + apt.encode(message)))

    def _report(self, identifier: apt.Id) -> None:
        """Report the end of a motion."""
        if self.faults.long_reports and identifier != apt.Id.MOT_MOVE_HOMED:
            self._answer(identifier, self._status().pack())
        else:
            self._answer(identifier, param1=1)

    def _notice(self, message: apt.Message) -> None:
        """Report an error, if the faults say so."""
        if self.faults.notice:
            notice = apt.Notice(message.id, 1, self.faults.notice)
            self.faults.notice = ""
            self._answer(apt.Id.HW_RICHRESPONSE, notice.pack())

    def _status(self) -> apt.Status:
        bits = self.motor.bits | self.faults.stuck
        if self._info.model == "SCC201":
            bits |= apt.StatusBits.JOGGING_FORWARD
        return apt.Status(1, self.motor.counter, 0, bits)

    def _enable(self, message: apt.Message) -> None:
        self.motor.enabled = message.param2 == 1

    def _set_position(self, message: apt.Message) -> None:
        self.motor.position = apt.Position.parse(message).position

    def _set_velocity(self, message: apt.Message) -> None:
        self._velocity = apt.VelocityParameters.parse(message)

    def _set_home(self, message: apt.Message) -> None:
        self._home = apt.HomeParameters.parse(message)

    def _start_updates(self, message: apt.Message) -> None:  # noqa: ARG002 - as the others
        self._updates = self._updates_began = self._world.clock()

    def _stop_updates(self, message: apt.Message) -> None:  # noqa: ARG002 - as the others
        self._updates = None

    def _start_home(self, message: apt.Message) -> None:  # noqa: ARG002 - as the others
        """Turn back to the home switch, and on by the controller's own offset."""
        turn = self.motor.turn
        way = -(self.motor.wheel % turn) if self._home.direction == 2 else 0.0
        if self._home.direction == 1:
            way = -self.motor.wheel % turn
        drive = self._drive(way + self._home.offset, self._home.velocity)
        self._start(replace(drive, homing=True))

    def _move_absolute(self, message: apt.Message) -> None:
        if message.data:  # else it means a place that was stored, which it has none of
            self._move(apt.Position.parse(message).position - self.motor.position)

    def _move_relative(self, message: apt.Message) -> None:
        if message.data:
            self._move(apt.Position.parse(message).position)

    def _move(self, way: float) -> None:
        """Begin a move; without current it runs away."""
        if not self.motor.enabled:
            way = math.inf
        short = self.faults.stops_short / 360.0 * self.motor.turn
        self._start(self._drive(way - math.copysign(min(short, abs(way)), way)))

    def _drive(self, way: float, velocity: int | None = None) -> Drive:
        """Plan a motion by the parameters that were set."""
        units = self._velocity.maximum if velocity is None else velocity
        speed = units / self._kind.velocity / self.faults.slow
        ramp = self._velocity.acceleration / self._kind.acceleration / self.faults.slow**2
        stands = self.faults.stands_after / 360.0 * self.motor.turn
        now, place = self._world.clock(), self.motor.position
        return Drive(now, place, way, speed, ramp, stands_after=stands)

    def _start(self, drive: Drive) -> None:
        self.motor.start(drive)
        self._advance()

    def _stop(self, message: apt.Message) -> None:  # noqa: ARG002 - at once, ramps are left out
        self.motor.drive = None
        self._report(apt.Id.MOT_MOVE_STOPPED)


def start(options: Mapping[str, str], world: World | None) -> EmulatedPort:
    """
    Start an emulated wheel for ``sim://apt``, on a pseudo-terminal of its own.

    Parameters
    ----------
    options : mapping
        ``model``, ``sn`` (serial number), ``offset`` (slot 1 from the home switch [deg]) and
        ``name``, which says nothing more: a world has one wheel.
    world : World or None
        What it is part of, or None for one of its own.

    Returns
    -------
    EmulatedPort
        Close it to end the wheel.

    Raises
    ------
    ValueError
        If an option is not known or is no number.
    """
    require_known(options, ("model", "sn", "offset", "name"))
    device = EmulatedApt(
        World() if world is None else world,
        model=options.get("model", "BSC201"),
        serial_number=number(options, "sn", SERIAL_NUMBER, (0, (1 << 32) - 1)),
        slot_offset=number(options, "offset", 0.0, (-360.0, 360.0)),
    )
    return EmulatedPort(device)
