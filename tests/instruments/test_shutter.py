"""A shutter event from the serial command to the corrected capture, on the emulated Boson."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from test_y16 import SESSION

from dbthermal import correction
from dbthermal.instruments.camera import FrameFlag
from dbthermal.instruments.clock import Task
from dbthermal.instruments.devices import open_devices
from dbthermal.instruments.emulated.world import FFC_DURATION
from dbthermal.instruments.protocols import record_scene
from dbthermal.instruments.recording import Limits, Preview, notes, open_capture
from dbthermal.instruments.session import Session

RATE, SHAPE = 50.0, [16, 80]


def recorded(path: Path, telemetry_rows: int) -> xr.Dataset:
    """A scene during which the narrow camera corrects its offsets, once, by its command port."""
    ports = {"video": "v4l2:///dev/video0", "control": "serial:///dev/ttyACM0"}
    changes = {"cameras": {"8-14": ports, "9.5": ports}, "shape": SHAPE, "frame_rate": RATE}
    session = Session.load(SESSION, {**changes, "duration": 1.3, "telemetry_rows": telemetry_rows})
    with open_devices(session) as devices:
        task = Task(devices.clock, "corrector", devices.cameras["9.5"].run_ffc)

        def correct(preview: Preview) -> None:
            if preview.time > 0.3 and task.ident is None:
                task.start()

        limits = Limits(reserve=0, reading_period=0.05, preview_period=0.02)
        record_scene(devices, path, limits=limits, preview=correct)
        assert task.ended.is_set()
    capture = open_capture(path)
    padded = capture["frame_flags"] & int(FrameFlag.PADDED)
    return capture.isel(time=~padded.any("band").values)


@pytest.mark.filterwarnings("ignore:Fixed pattern")  # of an emulated detector without correction
@pytest.mark.parametrize("telemetry_rows", [2, 0])
def test_a_correction_is_taken_out_of_its_band(telemetry_rows: int, tmp_path: Path) -> None:
    """A correction is removed from its own band; telemetry marks its first frozen frame."""
    capture = recorded(tmp_path / "a.zarr", telemetry_rows)
    flags = capture["frame_flags"].values
    closed = (flags & int(FrameFlag.SHUTTER_CLOSED)) != 0
    frozen = np.count_nonzero(flags[1] & int(FrameFlag.IMAGE_REPEATED))
    assert 10 < frozen <= FFC_DURATION * RATE + 1
    assert not closed[0].any()
    late = frozen - np.count_nonzero(closed[1])
    assert (late == 0) if telemetry_rows else (0 <= late <= 2)
    kinds = [kind for _, kind, source, _ in notes(tmp_path / "a.zarr") if source == "9.5"]
    assert [kind for kind in kinds if "shutter" in kind] == ["shutter_closed", "shutter_open"]
    unity = xr.DataArray(np.ones((2, *SHAPE)), dims=("band", "y", "x"))
    maps = xr.Dataset({"gain": unity, "offset": 0 * unity, "bad": unity < 0})
    corrected = correction.correct_capture(capture, maps.assign_coords(band=capture["band"]))
    assert corrected.attrs["frames_taken_out"] == [0, frozen]
    assert (corrected.attrs["shutter_events"], int(corrected["segment"][-1])) == (1, 1)
