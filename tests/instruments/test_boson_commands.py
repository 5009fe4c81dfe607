"""The Boson's commands against the published tables."""

from typing import Any

import pytest

from dbthermal.instruments.boson import commands
from dbthermal.instruments.boson.commands import Ir16Mode, Reading, Setting
from dbthermal.instruments.camera import FfcStatus

# Identifiers and layouts of openmv/openmv, drivers/boson (commit cbbb877): to read; to set and to
# read, and the values; to do.
READINGS = {
    "SERIAL_NUMBER": (0x00050002, ">I"),
    "PART_NUMBER": (0x00050004, ">20s"),
    "SENSOR_SERIAL_NUMBER": (0x00050006, ">I"),
    "SOFTWARE_REVISION": (0x00050022, ">III"),
    "FPA_TEMPERATURE": (0x00050030, ">h"),
    "FFC_IN_PROGRESS": (0x0005000C, ">h"),
    "FFC_STATUS": (0x00050054, ">i"),
    "LAST_FFC_FRAME": (0x0005005D, ">I"),
}
SETTINGS = {
    "FFC_MODE": (0x00050012, 0x00050013, ">i", ("MANUAL", "AUTO", "EXTERNAL", "SHUTTER_TEST")),
    "GAIN_MODE": (0x00050014, 0x00050015, ">i", ("HIGH", "LOW", "AUTO", "DUAL", "MANUAL")),
    "TELEMETRY": (0x00040001, 0x00040002, ">i", ("OFF", "ON")),
    "TELEMETRY_LOCATION": (0x00040003, 0x00040004, ">i", ("TOP", "BOTTOM")),
    "IR16_MODE": (0x000E000D, 0x000E000E, ">i", ("COUNTS_16", "COUNTS_14", "TLINEAR")),
}
STATUSES = [
    *(0x161, 0x162, 0x17D, 0x17E, 0x17F, 0x180, 0x181, 0x1B0, 0x201, 0x202, 0x203, 0x204),
    *(0x205, 0x206, 0x207, 0x208, 0x20B, 0x26D, 0x26E, 0x26F, 0x281, 0x283),
    *range(0x6A4, 0x6AE),
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
        kind: Any = setting.kind
        members = [*kind]
        assert [member.value for member in members] == [*range(len(members))]
        values = tuple(member.name for member in members)
        reading = setting.reading
        found[name] = (setting.set_command, reading.command, reading.layout, values)
    assert found == SETTINGS


def test_the_correction_is_the_published_one() -> None:
    """The command that starts it has the published identifier, its states their numbers."""
    assert commands.RUN_FFC == 0x00050007
    assert [state.name for state in FfcStatus] == [
        *("NONE_PERFORMED", "IMMINENT", "IN_PROGRESS", "COMPLETE")
    ]
    assert [state.value for state in FfcStatus] == [0, 1, 2, 3]


def test_statuses_are_the_published_ones() -> None:
    """Each published status has a meaning of its own, but those of the flash memory."""
    assert [*commands.STATUSES] == STATUSES
    assert len({*commands.STATUSES.values()}) == len(STATUSES) - 9


def test_a_temperature_in_celsius_has_a_sign() -> None:
    """Tenths of a degree Celsius are signed, and give kelvin."""
    assert commands.FPA_TEMPERATURE.value(b"\x80\x00") == pytest.approx(-3003.65, abs=1e-9)


def test_the_message_of_a_wrong_value_names_the_right_ones() -> None:
    """The error of an invalid value lists the valid ones."""
    choices = r"Invalid gain mode 7\. Must be one of 0 \(HIGH\), 1 \(LOW\), 2 \(AUTO\)"
    wrong: Any = 7
    with pytest.raises(ValueError, match=choices):
        commands.GAIN_MODE.data(wrong)


def test_no_identifier_is_used_twice() -> None:
    """All readings, settings and actions have different identifiers."""
    used = [identifier for identifier, _ in READINGS.values()]
    used += [number for s in commands.SETTINGS for number in (s.reading.command, s.set_command)]
    used.append(commands.RUN_FFC)
    assert len({*used}) == len(used)


def test_enumerations_travel_in_32_bits() -> None:
    """TLinear is mode 2 of the video."""
    assert commands.IR16_MODE.data(Ir16Mode.TLINEAR) == b"\x00\x00\x00\x02"
