"""Checks by other hands: independent programs against the codecs and the emulator.

Each test runs where its package can be imported: flirpy 0.6.2 (MIT) and thorlabs-apt-protocol
29.0.0 (MIT). Neither of them is needed by the package.
"""

import os
import pty
import threading
import tty

import pytest
from faulty_devices import FILTERS

from dbthermal.instruments.emulated import World
from dbthermal.instruments.emulated.devices import EmulatedApt, EmulatedBoson
from dbthermal.instruments.filterwheel import FilterWheel, Settings

RACK, CHANNEL = {"dest": 0x11}, {"dest": 0x21, "chan_ident": 1}
SPEEDS = {"min_velocity": 0, "acceleration": 4506, "max_velocity": 21_987_328}
HOME = {"home_dir": 2, "limit_switch": 1, "home_velocity": 4_397_466, "offset_distance": 0}
# What the driver sends, by the function of thorlabs-apt-protocol, in its spelling.
SENT: dict[str, dict[str, int]] = {
    **dict.fromkeys(("hw_no_flash_programming", "hw_stop_updatemsgs", "hw_req_info"), RACK),
    **dict.fromkeys(("mot_req_velparams", "mot_req_homeparams", "mot_req_statusupdate"), CHANNEL),
    **dict.fromkeys(("mod_req_chanenablestate", "mot_move_home"), CHANNEL),
    "mod_set_chanenablestate": {**CHANNEL, "enable_state": 1},
    "mot_set_velparams": {**CHANNEL, **SPEEDS},
    "mot_set_homeparams": {**CHANNEL, **HOME},
    "mot_move_absolute": {**CHANNEL, "position": -14_222},
    "mot_move_stop": {**CHANNEL, "stop_mode": 2},
}


class Tap(EmulatedApt):
    """An emulated wheel whose bytes are kept: `sent` by the driver, and its `answers`."""

    slot_offset = -12.5

    sent: frozenset[bytes] = frozenset()
    answers = b""

    def write(self, data: bytes) -> None:
        """Keep what is sent."""
        self.sent |= {data}
        super().write(data)

    def read(self, size: int, timeout: float) -> bytes:
        """Keep what comes."""
        piece = super().read(size, timeout)
        self.answers += piece
        return piece


def test_both_speak_the_same_to_a_wheel() -> None:
    """thorlabs-apt-protocol builds what the driver sends, and reads what the emulator answers."""
    protocol = pytest.importorskip("thorlabs_apt_protocol")
    tap = Tap(World(filters=FILTERS, wheel_position=4))
    wheel = FilterWheel(tap, FILTERS, Settings(home_offset=-12.5))
    wheel.connect()
    wheel.home()
    wheel.move_to(1)
    wheel.stop()
    built = {getattr(protocol, name)(source=1, **values) for name, values in SENT.items()}
    assert built == tap.sent
    unpacker = protocol.Unpacker()
    unpacker.feed(tap.answers)
    messages = {message.msg: message for message in unpacker}
    where, info = messages["mot_get_statusupdate"], messages["hw_get_info"]
    assert (where.position, where.homed) == (-14_222, True)
    assert (info.serial_number, info.nchs) == (40_000_000, 1)
    assert list(info.firmware_version) == [1, 0, 0]
    homes, speeds = messages["mot_get_homeparams"], messages["mot_get_velparams"]
    assert (homes.home_velocity, homes.offset_distance) == (4_397_466, 0)
    assert (speeds.acceleration, speeds.max_velocity) == (4506, 21_987_328)


def terminal(device: EmulatedBoson) -> str:
    """Path of a raw pseudo-terminal on which an emulated camera answers."""
    far, near = pty.openpty()
    tty.setraw(near)

    def serve() -> None:
        while received := os.read(far, 4096):
            device.receive(received)
            os.write(far, b"".join(device.poll()))

    threading.Thread(target=serve, daemon=True).start()
    return os.ttyname(near)


def test_flirpy_understands_the_emulated_boson() -> None:
    """Flirpy, unchanged, reads and sets; its known error of the sign is seen, too."""
    flirpy = pytest.importorskip("flirpy.camera.boson")
    world = World()
    state = world.add_camera("boson", 93588)
    state.fpa_temperature = state.last_ffc_temperature = 273.15 + 43.1  # its checksum is escaped
    camera = flirpy.Boson(port=terminal(EmulatedBoson(world, "boson")))
    assert (camera.get_camera_serial(), camera.get_fpa_temperature()) == (93588, 43.1)
    assert camera.get_part_number().strip("\0 ") == "EMULATED-BOSON-640"
    camera.set_ffc_manual()
    camera.do_ffc()
    assert (camera.get_ffc_mode(), camera.get_ffc_state(), state.ffc_count) == (0, 1, 1)
    camera.set_ffc_auto()
    assert camera.get_ffc_mode() == 1
    state.fpa_temperature = 260.85
    assert camera.get_fpa_temperature() == 6541.3
    camera.close()
