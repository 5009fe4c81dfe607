"""One command records a session, from its file to movies that open, and says how it went."""

from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from rig_session import LEVELS, TEXT, from_yaml, replaced, rig, scene_text

from dbthermal import store
from dbthermal.__main__ import main
from dbthermal._cli import files
from dbthermal._cli import record as command
from dbthermal.instruments import inventory, protocols, recording
from dbthermal.instruments.devices import Devices, open_devices
from dbthermal.instruments.recording import open_capture
from dbthermal.instruments.session import Session

ONE = replaced(
    ("[300.0, 290.0, 310.0]", "[290.0]"),
    ("sweep: [9.5, 11]", "sweep: [11]"),
    ("window: 3", "window: 0.1"),
    ("0.15", "0.6"),  # a reading takes a third of it
)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Look at the blackbody more often, and let emulated cameras see `rig_session.LEVELS`."""
    monkeypatch.setattr(protocols, "STABILITY_PERIOD", 0.05)

    def opened(session: Session) -> AbstractContextManager[Devices]:
        is_known = session.simulated and "11" in session.filters.values()
        return rig(session) if is_known else open_devices(session)

    monkeypatch.setattr(command, "open_devices", opened)


def run(folder: Path, text: str, *options: str) -> int:
    """Exit status of a session that is written to a file, and recorded beside it."""
    (file := folder / "a.yaml").write_text(text, encoding="utf-8")
    return main(["record", str(file), str(folder / "recorded"), *options])


def test_sweep_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A sweep prints its emulated devices and its progress, and its movies open."""
    folder = tmp_path / "recorded"
    assert run(tmp_path, ONE) == 0
    said = capsys.readouterr().out
    assert said.startswith("Session 'plate': every device is emulated, nothing is measured.")
    for phrase in (
        "filter_wheel: model BSC201",
        "Setting the emulated blackbody to 16.85 degC.",
        "11: ",
        "FPA 35.0 \N{DEGREE SIGN}C, FFC complete",
        f"{folder / 'plate_00_11.zarr'}: duration",
    ):
        assert phrase in said
    movies = recording.open_sweep(folder, "plate", frames=8)
    levels = [LEVELS["8-14"] + 2900, LEVELS["11"] + 2900]
    np.testing.assert_array_equal(movies["counts"][:, 0, 0, 0, 0], levels)


def test_scene_of_a_simulated_blackbody(tmp_path: Path) -> None:
    """Told to simulate, a session of hardware is recorded from the simulation's blackbody."""
    text = scene_text().replace("simulated: true", "simulated: false")
    assert run(tmp_path, text.replace('3: "11"', "3: 10.6"), "--simulate") == 0
    capture = open_capture(tmp_path / "recorded" / "plate.zarr")
    assert capture.attrs["is_simulated"] is True
    assert float(capture["counts"].std("x").mean()) > 1
    assert float(capture["counts"].std("time").mean()) > 1  # noise of the frames


def test_a_recording_is_described(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`info` takes a recording, whose session leaves settings of its devices open."""
    assert run(tmp_path, scene_text()) == 0
    assert main(["info", str(tmp_path / "recorded" / "plate.zarr")]) == 0
    said = capsys.readouterr().out
    assert "stage: capture" in said
    assert "wheel: serial_number None, home_offset " in said


def test_what_is_made_of_a_recording_is_none(tmp_path: Path) -> None:
    """A capture without exposure times, as an aligned one, keeps its clock, and is not listed."""
    assert run(tmp_path, scene_text()) == 0
    capture = open_capture((folder := tmp_path / "recorded") / "plate.zarr")
    aligned = capture.isel(time=slice(2, None)).drop_vars("exposure_time")
    store.save(aligned, folder / "aligned.zarr", store.provenance({}))
    opened = files.opened(folder / "aligned.zarr")
    np.testing.assert_array_equal(opened["time"], aligned["time"])
    assert {*recording.overview(folder)["recording"].values} == {"plate"}
    with pytest.raises(ValueError, match=r"No recording .*aligned\.zarr'\. Must be"):
        open_capture(folder / "aligned.zarr")


def test_a_missing_device_has_a_status(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is named with the documented status, after the report of the bus."""
    monkeypatch.setattr(inventory, "find", lambda **_: [])
    real = TEXT.replace("simulated: true", "simulated: false").replace("/dev/", "/dev/none/")
    assert run(tmp_path, real) == 1
    said = capsys.readouterr()
    assert "/dev/none/" in said.err
    assert inventory.describe([]) in said.out


def test_what_is_refused_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A dry run names devices and records nothing; an existing scene and no file are errors."""
    folder, text = tmp_path / "recorded", scene_text()
    assert run(tmp_path, text, "--dry-run") == 0
    said = capsys.readouterr().out
    assert "9.5: device sim://boson/9.5" in said
    assert "Preparing" not in said
    assert not folder.exists()
    (folder / "plate.zarr").mkdir(parents=True)
    assert run(tmp_path, text, "--dry-run") == 0
    monkeypatch.setattr(command, "open_devices", lambda _: pytest.fail("a device was opened"))
    assert run(tmp_path, text) == 1
    assert "plate.zarr'. Must be a new recording." in capsys.readouterr().err
    assert main(["record", str(tmp_path / "b.yaml"), str(tmp_path)]) == 1
    assert "b.yaml" in capsys.readouterr().err


def test_interrupted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An interrupted recording keeps its frames, says so, and exits with status 130."""

    def interrupt(*_: object) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "_progress", interrupt)
    assert run(tmp_path, scene_text()) == 130
    assert "Interrupted: what was recorded is kept." in capsys.readouterr().err
    assert (tmp_path / "recorded" / "plate.zarr").is_dir()


def test_blackbody_is_set_by_the_user(monkeypatch: pytest.MonkeyPatch) -> None:
    """The user gets degrees Celsius; without a keyboard, the error says where to run it."""
    questions, devices = list[str](), Devices(from_yaml(), {})
    monkeypatch.setattr("builtins.input", questions.append)
    command._set_blackbody(devices, 300.0)
    text = "\nplate: set the blackbody to 26.85 degC and press Enter; then its rest is awaited. "
    assert questions == [text]
    for error in (EOFError, NotImplementedError):
        monkeypatch.setattr("builtins.input", Mock(side_effect=error))
        with pytest.raises(
            RuntimeError, match=r"26\.85 degC\. Must be run in a terminal, or in Jup"
        ):
            command._set_blackbody(devices, 300.0)


def test_bus_need_not_be_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """A missing libusb is reported, and the devices are opened by their nodes."""

    def missing(**_: object) -> list[inventory.Device]:
        raise inventory.LibusbMissingError("no libusb")

    monkeypatch.setattr(inventory, "find", missing)
    emulated = from_yaml()
    real = replace(emulated, simulated=False)
    assert inventory.plugged_in(real) == "The USB bus was not looked at: no libusb"
    assert "is emulated: the USB bus was not" in inventory.plugged_in(emulated)
