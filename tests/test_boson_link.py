"""The Boson's commands against the published tables, and its line: threads, ends, stale replies."""

import struct
import threading
import time
from collections.abc import Callable
from enum import IntEnum

import pytest
from rig_devices import BosonBench, Clock

from dbthermal.instruments import fslp
from dbthermal.instruments.boson import Boson, BosonError, BosonStatusError, commands
from dbthermal.instruments.boson.commands import Action, FfcStatus, Reading, Setting, SyncMode
from dbthermal.instruments.boson.link import REPLY_TIMEOUT, Link
from dbthermal.instruments.dialogue import Dialogue, Pair
from dbthermal.instruments.emulated.boson_faults import Fault
from dbthermal.instruments.transport import Closing, TransportError

# Identifiers and layouts of openmv/openmv, drivers/boson (commit cbbb877): to read; to set and to
# read, and the values; to do.
READINGS = {
    "SERIAL_NUMBER": (0x00050002, ">I"),
    "PART_NUMBER": (0x00050004, ">20s"),
    "SENSOR_SERIAL_NUMBER": (0x00050006, ">I"),
    "SENSOR_PART_NUMBER": (0x0005003F, ">32s"),
    "SOFTWARE_REVISION": (0x00050022, ">III"),
    "FPA_TEMPERATURE": (0x00050030, ">h"),
    "FPA_TEMPERATURE_KELVIN": (0x00050031, ">H"),
    "FPA_COUNTS": (0x00020001, ">H"),
    "FFC_IN_PROGRESS": (0x0005000C, ">h"),
    "FFC_STATUS": (0x00050054, ">i"),
    "FFC_DESIRED": (0x00050055, ">I"),
    "LAST_FFC_FRAME": (0x0005005D, ">I"),
    "LAST_FFC_TEMPERATURE": (0x0005005E, ">H"),
    "TABLE_SWITCH_DESIRED": (0x0005005F, ">H"),
    "RADIOMETRY_CAPABLE": (0x0042007D, ">i"),
    "FRAME_COUNT": (0x00020002, ">I"),
    "ISP_FRAME_COUNT": (0x000500AC, ">I"),
    "FRAME_RATE": (0x000E0007, ">I"),
    "UPTIME": (0x000E0008, ">I"),
}
SWITCH = ("OFF", "ON")
SETTINGS = {
    "FFC_MODE": (0x00050012, 0x00050013, ">i", ("MANUAL", "AUTO", "EXTERNAL", "SHUTTER_TEST")),
    "APPLY_FFC": (0x00000003, 0x00000004, ">i", SWITCH),
    "GAIN_MODE": (0x00050014, 0x00050015, ">i", ("HIGH", "LOW", "AUTO", "DUAL", "MANUAL")),
    "AVERAGER": (0x0000000B, 0x0000000C, ">i", SWITCH),
    "SYNC_MODE": (0x00050098, 0x00050099, ">i", ("DISABLED", "MASTER", "SLAVE")),
    "TELEMETRY": (0x00040001, 0x00040002, ">i", SWITCH),
    "TELEMETRY_LOCATION": (0x00040003, 0x00040004, ">i", ("TOP", "BOTTOM")),
    "TELEMETRY_PACKING": (0x00040005, 0x00040006, ">i", ("WORDS_16", "Y", "BYTES")),
    "TELEMETRY_ORDER": (0x00040007, 0x00040008, ">i", ("DEFAULT", "SWAPPED")),
    "IR16_MODE": (0x000E000D, 0x000E000E, ">i", ("COUNTS_16", "COUNTS_14", "TLINEAR")),
    "TLINEAR": (0x003E0001, 0x003E0002, ">i", SWITCH),
    "TEMPERATURE_STABLE": (0x00420000, 0x00420001, ">i", SWITCH),
    "FFC_FRAMES": (0x0000000D, 0x0000000E, ">H", ()),
    "FFC_TEMPERATURE_STEP": (0x00050008, 0x00050009, ">H", ()),
    "FFC_FRAME_STEP": (0x0005000A, 0x0005000B, ">I", ()),
}
ACTIONS = {"RUN_FFC": 0x00050007, "REBOOT": 0x00050010, "SAVE_DEFAULTS": 0x00050018}
STATUSES = [
    *(0x000, 0x161, 0x162, 0x17D, 0x17E, 0x17F, 0x180, 0x181, 0x1B0, 0x201, 0x202, 0x203, 0x204),
    *(0x205, 0x206, 0x207, 0x208, 0x20B, 0x26D, 0x26E, 0x26F, 0x281, 0x283),
]


def of_kind(kind: type) -> dict[str, object]:
    """All commands of a kind, by name."""
    return {name: value for name, value in vars(commands).items() if isinstance(value, kind)}


def reply(sequence: int, command: int, data: bytes = b"") -> bytes:
    """Bytes of a reply."""
    return fslp.encode(sequence, command, data, 0)


def in_thread(work: Callable[[], object]) -> threading.Thread:
    """Start a thread."""
    thread = threading.Thread(target=work)
    thread.start()
    return thread


def test_readings_are_the_published_ones() -> None:
    """Each reading has the published identifier and layout."""
    found = {
        name: (reading.command, reading.layout)
        for name, reading in of_kind(Reading).items()
        if isinstance(reading, Reading)
    }
    assert found == READINGS


def test_settings_are_the_published_ones() -> None:
    """Each setting has the published identifiers, layout and values, numbered from 0."""
    found = {}
    for name, setting in of_kind(Setting).items():
        assert isinstance(setting, Setting)
        members = [*setting.kind] if issubclass(setting.kind, IntEnum) else []
        assert [member.value for member in members] == [*range(len(members))]
        values = tuple(member.name for member in members)
        found[name] = (setting.set_command, setting.command, setting.layout, values)
    assert found == SETTINGS


def test_actions_and_states_are_the_published_ones() -> None:
    """What can be done has the published identifiers, the shutter's states their numbers."""
    actions = of_kind(Action)
    assert {name: vars(action)["command"] for name, action in actions.items()} == ACTIONS
    assert [state.name for state in FfcStatus] == [
        *("NONE_PERFORMED", "IMMINENT", "IN_PROGRESS", "COMPLETE")
    ]
    assert [state.value for state in FfcStatus] == [0, 1, 2, 3]


def test_statuses_are_the_published_ones() -> None:
    """Each published status has a meaning, flash errors are 6A4 to 6AD, all else is unknown."""
    assert [*commands.STATUSES] == STATUSES
    assert len({*commands.STATUSES.values()}) == len(STATUSES)
    assert {commands.meaning(status) for status in range(0x6A4, 0x6AE)} == {"flash error"}
    assert {commands.meaning(status) for status in (0x6A3, 0x6AE, 3)} == {"unknown status"}


@pytest.mark.parametrize(
    ("reading", "data", "kelvin"),
    [
        (commands.FPA_TEMPERATURE, b"\x80\x00", -3276.8 + 273.15),
        (commands.FPA_TEMPERATURE_KELVIN, b"\xff\xff", 6553.5),
        (commands.FPA_TEMPERATURE_KELVIN, b"\x0c\x28", 311.2),
        (commands.LAST_FFC_TEMPERATURE, b"\x0c\x28", 311.2),
    ],
)
def test_only_celsius_has_a_sign(reading: Reading[float], data: bytes, kelvin: float) -> None:
    """Tenths of a degree Celsius are signed, tenths of a kelvin are not; both give kelvin."""
    assert reading.value(data) == pytest.approx(kelvin, abs=1e-9)


def test_a_correction_that_is_slow_to_start_is_waited_for() -> None:
    """The camera still says that the last correction is complete: not that of this one."""
    asked: list[tuple[int, bytes]] = [
        (commands.LAST_FFC_FRAME.command, struct.pack(">I", 700)),
        (commands.FFC_STATUS.command, struct.pack(">i", FfcStatus.COMPLETE)),
        (commands.RUN_FFC.command, b""),
    ]
    for frame in (700, 700, 1234):
        asked += [
            (commands.FFC_IN_PROGRESS.command, b"\x00\x00"),
            (commands.FFC_STATUS.command, struct.pack(">i", FfcStatus.COMPLETE)),
            (commands.LAST_FFC_FRAME.command, struct.pack(">I", frame)),
        ]
    pairs: list[Pair] = [
        (fslp.encode(number, command), reply(number, command, data))
        for number, (command, data) in enumerate(asked, start=1)
    ]
    clock = Clock()
    with Dialogue(pairs) as line:
        camera = Boson(line, first_sequence=1, clock=clock, sleep=clock.sleep)
        assert camera.run_ffc() == 1234


def test_slave_mode_that_is_not_acknowledged_is_undone() -> None:
    """The camera may wait for pulses although its reply was lost: the mode is set back."""
    bench = BosonBench()
    bench.spoil(Fault.DROP)
    with pytest.raises(BosonError, match=r"No external pulses: No reply to .* disabled again"):
        bench.camera.follow_pulses()
    assert bench.camera.get(commands.SYNC_MODE) is SyncMode.DISABLED


def test_a_refusal_among_the_pulses_undoes_the_mode() -> None:
    """A camera that refuses to count its frames does not stay in slave mode."""
    bench = BosonBench()
    bench.spoil(None, Fault.BUSY)
    with pytest.raises(BosonError, match="camera busy") as error:
        bench.camera.follow_pulses()
    assert isinstance(error.value.__cause__, BosonStatusError)
    assert bench.camera.get(commands.SYNC_MODE) is SyncMode.DISABLED


def test_a_mute_camera_ends_a_wait_in_time() -> None:
    """A wait for a correction outlasts its limit by one reply at most, not by three repeated."""
    bench = BosonBench()
    bench.camera.run_ffc()
    bench.spoil(None, None, None, *[Fault.DROP] * 99)
    start = bench.clock.now
    with pytest.raises(BosonError, match="No flat-field correction within 3 s"):
        bench.camera.run_ffc(timeout=3.0)
    assert bench.clock.now - start <= 3.0 + REPLY_TIMEOUT + 0.2


def test_each_program_begins_at_another_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first request's number comes from the time of day, so that old replies are told."""
    first = []
    for microseconds in (1_700_000_000_000_001, 1_700_000_000_100_001):
        monkeypatch.setattr(time, "time_ns", lambda now=microseconds: 1000 * now)
        bench = BosonBench()
        bench.camera = Boson(bench.loop, clock=bench.clock, sleep=bench.clock.sleep)
        bench.camera.serial_number()
        first.append(bench.camera._link._sequence)
        assert first[-1] == fslp.next_sequence((microseconds - 1) % 2**32)
    assert first[0] != first[1]


class Slow(Closing):
    """
    A camera that answers after a while, and notices who speaks before it did.

    Attributes
    ----------
    overlaps : int
        Requests that came before the last was answered, or after the line was closed.
    """

    is_simulated = True

    def __init__(self) -> None:
        self.overlaps = 0
        self.reading = threading.Event()
        self._answers: list[bytes] = []
        self._closed = False

    def write(self, data: bytes) -> None:
        """Take one request."""
        if self._closed:
            raise TransportError("closed")
        self.overlaps += bool(self._answers)
        (frame,) = fslp.Decoder().feed(data)
        self._answers.append(reply(frame.sequence, frame.command, bytes(4)))

    def read(self, size: int, timeout: float) -> bytes:  # noqa: ARG002 - as a line has
        """Answer."""
        self.reading.set()
        time.sleep(0.002)
        self.overlaps += self._closed
        return self._answers.pop(0)

    def close(self) -> None:
        """End."""
        self._closed = True


def test_threads_take_turns() -> None:
    """Two threads that ask at once each get their reply, one exchange after the other."""
    line = Slow()
    camera = Boson(line)
    threads = [
        in_thread(lambda: [camera.serial_number() for _ in range(20)]),
        in_thread(lambda: [camera.frame_count() for _ in range(20)]),
    ]
    for thread in threads:
        thread.join()
    assert line.overlaps == 0
    assert (camera.statistics.discarded, camera.statistics.timeouts) == (0, 0)


def test_closing_waits_for_an_exchange_of_another_thread() -> None:
    """The line is closed between two exchanges, and the next one is an error that is documented."""
    line = Slow()
    errors: list[TransportError] = []

    def ask() -> None:
        try:
            while True:
                camera.serial_number()
                time.sleep(0.001)
        except TransportError as error:
            errors.append(error)

    camera = Boson(line)
    thread = in_thread(ask)
    line.reading.wait()
    camera.close()
    thread.join()
    assert (len(errors), line.overlaps) == (1, 0)


def test_a_link_may_be_closed_twice() -> None:
    """A second time does nothing."""
    link = Link(Slow())
    for _ in range(2):
        link.close()
    with pytest.raises(TransportError):
        link.ask("serial number", commands.SERIAL_NUMBER.command)
