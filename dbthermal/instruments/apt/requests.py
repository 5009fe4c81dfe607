"""What a host sends: a function for each message, whose name is the maker's in plain words.

`channel` is that of the motor, from 1, and in a rack 1 in every bay. `destination` has no default:
a controller ignores in silence what is addressed to another. Positions are in counts, speeds in
the device's units. Every function returns the bytes of one message, and raises ValueError if a
number does not fit its field.

References
----------
See `dbthermal.instruments.apt`.
"""

from dbthermal.instruments.apt.codec import HOST, Id, Message, encode
from dbthermal.instruments.apt.replies import HomeParameters, Position, VelocityParameters

_YES, _NO = 1, 2


def disconnect(*, destination: int, source: int = HOST) -> bytes:
    """HW_DISCONNECT: the host is about to leave."""
    return _short(Id.HW_DISCONNECT, 0, 0, destination, source)


def no_flash_programming(*, destination: int, source: int = HOST) -> bytes:
    """HW_NO_FLASH_PROGRAMMING: the host does not mean to write firmware; first of all messages."""
    return _short(Id.HW_NO_FLASH_PROGRAMMING, 0, 0, destination, source)


def request_info(*, destination: int, source: int = HOST) -> bytes:
    """HW_REQ_INFO: ask for `Info`."""
    return _short(Id.HW_REQ_INFO, 0, 0, destination, source)


def start_updates(*, destination: int, source: int = HOST) -> bytes:
    """
    HW_START_UPDATEMSGS: let the controller report its status ten times a second.

    Not to be used with a BSC: some of them were reported (thorlabs_apt_device) not to know the
    acknowledgement that they then demand, and to stop answering after 5 s. Ask instead.
    """
    return _short(Id.HW_START_UPDATEMSGS, 0, 0, destination, source)


def stop_updates(*, destination: int, source: int = HOST) -> bytes:
    """HW_STOP_UPDATEMSGS: end what `start_updates`, or another program, began."""
    return _short(Id.HW_STOP_UPDATEMSGS, 0, 0, destination, source)


def request_bay_used(bay: int, *, destination: int, source: int = HOST) -> bytes:
    """RACK_REQ_BAYUSED: ask a rack whether something is in a bay, counted from 0."""
    return _short(Id.RACK_REQ_BAYUSED, bay, 0, destination, source)


def set_channel_enabled(
    channel: int, *, enabled: bool, destination: int, source: int = HOST
) -> bytes:
    """MOD_SET_CHANENABLESTATE: give the motor current, or take it."""
    state = _YES if enabled else _NO
    return _short(Id.MOD_SET_CHANENABLESTATE, channel, state, destination, source)


def request_channel_enabled(channel: int, *, destination: int, source: int = HOST) -> bytes:
    """MOD_REQ_CHANENABLESTATE: ask whether the motor has current; see `is_enabled`."""
    return _short(Id.MOD_REQ_CHANENABLESTATE, channel, 0, destination, source)


def identify(channel: int, *, destination: int, source: int = HOST) -> bytes:
    """MOD_IDENTIFY: let the controller flash a light, so that a person sees which it is."""
    return _short(Id.MOD_IDENTIFY, channel, 0, destination, source)


def set_position(channel: int, position: int, *, destination: int, source: int = HOST) -> bytes:
    """MOT_SET_POSCOUNTER: call the place where the motor is `position` [count]."""
    data = Position(channel, position).pack()
    return _long(Id.MOT_SET_POSCOUNTER, data, destination, source)


def request_position(channel: int, *, destination: int, source: int = HOST) -> bytes:
    """MOT_REQ_POSCOUNTER: ask for `Position`."""
    return _short(Id.MOT_REQ_POSCOUNTER, channel, 0, destination, source)


def set_velocity_parameters(
    parameters: VelocityParameters, *, destination: int, source: int = HOST
) -> bytes:
    """MOT_SET_VELPARAMS: set the speeds of moves."""
    return _long(Id.MOT_SET_VELPARAMS, parameters.pack(), destination, source)


def request_velocity_parameters(channel: int, *, destination: int, source: int = HOST) -> bytes:
    """MOT_REQ_VELPARAMS: ask for `VelocityParameters`."""
    return _short(Id.MOT_REQ_VELPARAMS, channel, 0, destination, source)


def set_home_parameters(
    parameters: HomeParameters, *, destination: int, source: int = HOST
) -> bytes:
    """MOT_SET_HOMEPARAMS: set how the motor looks for its home switch."""
    return _long(Id.MOT_SET_HOMEPARAMS, parameters.pack(), destination, source)


def request_home_parameters(channel: int, *, destination: int, source: int = HOST) -> bytes:
    """MOT_REQ_HOMEPARAMS: ask for `HomeParameters`."""
    return _short(Id.MOT_REQ_HOMEPARAMS, channel, 0, destination, source)


def home(channel: int, *, destination: int, source: int = HOST) -> bytes:
    """MOT_MOVE_HOME: look for the home switch; MOT_MOVE_HOMED follows when it is found."""
    return _short(Id.MOT_MOVE_HOME, channel, 0, destination, source)


def move_absolute(channel: int, position: int, *, destination: int, source: int = HOST) -> bytes:
    """
    MOT_MOVE_ABSOLUTE: move to `position` [count]; MOT_MOVE_COMPLETED follows at its end.

    The form without data, which moves to a place that was stored before, has no function.
    """
    data = Position(channel, position).pack()
    return _long(Id.MOT_MOVE_ABSOLUTE, data, destination, source)


def move_relative(channel: int, distance: int, *, destination: int, source: int = HOST) -> bytes:
    """MOT_MOVE_RELATIVE: move by `distance` [count]; no wheel is moved so, as errors add up."""
    data = Position(channel, distance).pack()
    return _long(Id.MOT_MOVE_RELATIVE, data, destination, source)


def stop(channel: int, *, immediate: bool = False, destination: int, source: int = HOST) -> bytes:
    """MOT_MOVE_STOP: stop by a ramp, or at once, which may lose steps; MOT_MOVE_STOPPED follows."""
    mode = _YES if immediate else _NO
    return _short(Id.MOT_MOVE_STOP, channel, mode, destination, source)


def request_status(channel: int, *, destination: int, source: int = HOST) -> bytes:
    """MOT_REQ_STATUSUPDATE: ask for `Status`."""
    return _short(Id.MOT_REQ_STATUSUPDATE, channel, 0, destination, source)


def request_status_bits(channel: int, *, destination: int, source: int = HOST) -> bytes:
    """MOT_REQ_STATUSBITS: ask for the bits alone; see `status_bits`."""
    return _short(Id.MOT_REQ_STATUSBITS, channel, 0, destination, source)


def request_dc_status(channel: int, *, destination: int, source: int = HOST) -> bytes:
    """MOT_REQ_DCSTATUSUPDATE: as `request_status`, for motors that are no steppers."""
    return _short(Id.MOT_REQ_DCSTATUSUPDATE, channel, 0, destination, source)


def acknowledge_status(*, destination: int, source: int = HOST) -> bytes:
    """MOT_ACK_DCSTATUSUPDATE: keep a controller reporting that `start_updates` set going."""
    return _short(Id.MOT_ACK_DCSTATUSUPDATE, 0, 0, destination, source)


def suspend_end_of_move(*, destination: int, source: int = HOST) -> bytes:
    """MOT_SUSPEND_ENDOFMOVEMSGS: no MOT_MOVE_COMPLETED from now on."""
    return _short(Id.MOT_SUSPEND_ENDOFMOVEMSGS, 0, 0, destination, source)


def resume_end_of_move(*, destination: int, source: int = HOST) -> bytes:
    """MOT_RESUME_ENDOFMOVEMSGS: MOT_MOVE_COMPLETED again."""
    return _short(Id.MOT_RESUME_ENDOFMOVEMSGS, 0, 0, destination, source)


def _short(identifier: Id, first: int, second: int, destination: int, source: int) -> bytes:
    return encode(Message(identifier, first, second, destination, source))


def _long(identifier: Id, data: bytes, destination: int, source: int) -> bytes:
    return encode(Message(identifier, 0, 0, destination, source, data))
