"""The Boson's commands against the published tables."""

from enum import IntEnum

import pytest

from dbthermal.instruments.boson import commands
from dbthermal.instruments.boson.commands import Action, Ir16Mode, Reading, Setting
from dbthermal.instruments.camera import FfcStatus

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


def test_the_message_of_a_wrong_value_names_the_right_ones() -> None:
    """The choices are in the message."""
    choices = r"Invalid gain mode 7\. Must be one of 0 \(HIGH\), 1 \(LOW\), 2 \(AUTO\)"
    with pytest.raises(ValueError, match=choices):
        commands.GAIN_MODE.data(7)


def test_no_identifier_is_used_twice() -> None:
    """Whatever is asked, set or done has an identifier of its own."""
    used = [reading.command for reading in commands.READINGS]
    used += [number for s in commands.SETTINGS for number in (s.command, s.set_command)]
    used += ACTIONS.values()
    assert len({*used}) == len(used)


def test_enumerations_travel_in_32_bits() -> None:
    """TLinear is mode 2 of the video."""
    assert commands.IR16_MODE.data(Ir16Mode.TLINEAR) == b"\x00\x00\x00\x02"
