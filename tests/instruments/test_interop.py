"""Checks by other hands: independent programs against the codecs and the emulator.

Each test runs where its package can be imported: flirpy 0.6.2 (MIT) and thorlabs-apt-protocol
29.0.0 (MIT). Neither of them is needed by the package.
"""

import os
import pty
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

import pytest

from dbthermal.instruments import _apt as apt
from dbthermal.instruments.emulated.boson import EmulatedBoson
from dbthermal.instruments.emulated.world import World

Id, command = apt.Id, apt.command
TO = apt.BAY_1
SPEEDS = apt.VelocityParameters(1, minimum=0, acceleration=0x35B0, maximum=0x00CCCCCD)
HOME = apt.HomeParameters(1, 2, 1, 4_397_466, -50)
TARGET = apt.Position(1, 68_267)
# By the function of thorlabs-apt-protocol, in its spelling: what is built here, and its arguments.
REQUESTS: dict[str, tuple[bytes, dict[str, int]]] = {
    "hw_no_flash_programming": (command(Id.HW_NO_FLASH_PROGRAMMING, destination=TO), {}),
    "hw_req_info": (command(Id.HW_REQ_INFO, destination=TO), {}),
    "hw_stop_updatemsgs": (command(Id.HW_STOP_UPDATEMSGS, destination=TO), {}),
    "mod_set_chanenablestate": (
        command(Id.MOD_SET_CHANENABLESTATE, 1, apt.YES, destination=TO),
        {"chan_ident": 1, "enable_state": 1},
    ),
    "mod_req_chanenablestate": (
        command(Id.MOD_REQ_CHANENABLESTATE, 1, destination=TO),
        {"chan_ident": 1},
    ),
    "mot_set_velparams": (
        command(Id.MOT_SET_VELPARAMS, data=SPEEDS.pack(), destination=TO),
        {"chan_ident": 1, "min_velocity": 0, "acceleration": 0x35B0, "max_velocity": 0x00CCCCCD},
    ),
    "mot_req_velparams": (command(Id.MOT_REQ_VELPARAMS, 1, destination=TO), {"chan_ident": 1}),
    "mot_set_homeparams": (
        command(Id.MOT_SET_HOMEPARAMS, data=HOME.pack(), destination=TO),
        {
            "chan_ident": 1,
            "home_dir": 2,
            "limit_switch": 1,
            "home_velocity": 4_397_466,
            "offset_distance": -50,
        },
    ),
    "mot_req_homeparams": (command(Id.MOT_REQ_HOMEPARAMS, 1, destination=TO), {"chan_ident": 1}),
    "mot_move_home": (command(Id.MOT_MOVE_HOME, 1, destination=TO), {"chan_ident": 1}),
    "mot_move_absolute": (
        command(Id.MOT_MOVE_ABSOLUTE, data=TARGET.pack(), destination=TO),
        {"chan_ident": 1, "position": 68_267},
    ),
    "mot_move_stop": (
        command(Id.MOT_MOVE_STOP, 1, apt.NO, destination=TO),
        {"chan_ident": 1, "stop_mode": 2},
    ),
    "mot_req_statusupdate": (
        command(Id.MOT_REQ_STATUSUPDATE, 1, destination=TO),
        {"chan_ident": 1},
    ),
}


@pytest.fixture
def protocol() -> ModuleType:
    """Another implementation of APT."""
    module: ModuleType = pytest.importorskip("thorlabs_apt_protocol")
    return module


def test_requests_agree(protocol: ModuleType) -> None:
    """thorlabs-apt-protocol builds the same bytes, of every message that both know."""
    built = {name: request for name, (request, _) in REQUESTS.items()}
    assert built == {
        name: getattr(protocol, name)(dest=TO, source=apt.HOST, **arguments)
        for name, (_, arguments) in REQUESTS.items()
    }


def test_replies_agree(protocol: ModuleType) -> None:
    """thorlabs-apt-protocol reads the same out of what a controller answers."""
    unpacker = protocol.Unpacker()
    status = apt.Status(1, -68_267, 0, apt.StatusBits(2) | apt.StatusBits.HOMED)
    answers = [
        (Id.MOT_GET_STATUSUPDATE, status.pack()),
        (Id.HW_GET_INFO, apt.Info(94_000_009, "BSC201", "57.1.2").pack()),
        (Id.MOT_GET_HOMEPARAMS, HOME.pack()),
        (Id.MOT_GET_VELPARAMS, SPEEDS.pack()),
    ]
    for identifier, data in answers:
        unpacker.feed(apt.encode(apt.Message(identifier, 0, 0, apt.HOST, TO, data)))
    where, info, homes, speeds = list(unpacker)
    assert (where.position, where.reverse_limit_switch, where.homed) == (-68_267, True, True)
    assert (info.serial_number, info.nchs, list(info.firmware_version)) == (
        *(94_000_009, 1),
        [57, 1, 2],
    )
    assert (homes.home_velocity, homes.offset_distance) == (HOME.velocity, HOME.offset)
    assert (speeds.acceleration, speeds.max_velocity) == (SPEEDS.acceleration, SPEEDS.maximum)


@contextmanager
def terminal(device: EmulatedBoson) -> Iterator[str]:
    """Path of a raw pseudo-terminal on which an emulated camera answers."""
    far, near = pty.openpty()
    tty.setraw(near)

    def serve() -> None:
        while received := os.read(far, 4096):
            device.receive(received)
            os.write(far, b"".join(device.poll()))

    threading.Thread(target=serve, daemon=True).start()
    yield os.ttyname(near)


def test_flirpy_understands_the_emulated_boson() -> None:
    """Flirpy, unchanged, reads and sets; its known error of the sign is seen, too."""
    flirpy = pytest.importorskip("flirpy.camera.boson")
    world = World()
    state = world.add_camera("boson", 93588)
    state.fpa_temperature = state.last_ffc_temperature = 273.15 + 43.1  # its checksum is escaped
    with terminal(EmulatedBoson(world, "boson")) as path:
        camera = flirpy.Boson(port=path)
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
