"""The command line, on two TIFF stacks of a simulated scene."""

import csv
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any
from warnings import catch_warnings

import flir_files
import h5py
import nbformat
import numpy as np
import pytest
import tifffile
import xarray as xr
import zarr
from captures import GLASS, emissivity_of
from PIL import Image

from dbthermal import __main__ as command_line
from dbthermal import __version__, schema, simulation, store

FRAMES = 200
LABELS = ("mean [degC]", "std [K]", "status")
ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "own_captures.md").read_text(encoding="utf-8")
STATED = ["--bands", "8-14", "9.5", "--unit", "count", "--clock", "10"]
Scene = tuple[xr.Dataset, xr.Dataset, xr.Dataset]
COMMANDS = re.findall(r"(?m)^(\w+) \w+\.\w+", command_line._COMMANDS)


def run(folder: Path, *arguments: str, before: str = "") -> subprocess.CompletedProcess[str]:
    """Run a command in a folder, in a process of its own."""
    code = f"import sys; {before}from dbthermal.__main__ import main; sys.exit(main())"
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )


def said(folder: Path, *arguments: str, action: Any = "error") -> tuple[int, str, str]:
    """Exit status, output and error of a command, here, which has imported all; of its warnings."""
    out, error = StringIO(), StringIO()
    with catch_warnings(action=action), chdir(folder), redirect_stdout(out), redirect_stderr(error):
        try:
            status = command_line.main(arguments)
        except SystemExit as usage:
            status = int(usage.code or 0)
    return status, out.getvalue(), error.getvalue()


def done(folder: Path, *arguments: str) -> dict[str, Any]:
    """Summary of a command that ends well, as JSON."""
    status, out, error = said(folder, *arguments, "--json")
    assert status == 0, error
    summary: dict[str, Any] = json.loads(out)
    return summary


def refused(folder: Path, *arguments: str) -> str:
    """Reason of a command that is refused: one line without a traceback."""
    status, out, error = said(folder, *arguments)
    assert (status, out) == (1, ""), error
    (line,) = error.splitlines()
    assert line.startswith(f"dbthermal {arguments[0]}: ")
    return line


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Truth of a plate of glass, its raw counts, and those of a blackbody."""
    rig, rng, shape = simulation.Rig(), np.random.default_rng(1), (24, 32)
    truth = simulation.walkers(np.arange(FRAMES) / 10, shape, GLASS, rng)
    detector = simulation.pattern(rig, shape, rng)
    kelvin = np.array([278.15, 298.15, 318.15, 343.15])
    movies = simulation.blackbody_movies(rig, kelvin, 16, detector, rng)
    raw = simulation.capture(simulation.observe(truth, rig.response(), rng), detector)
    return truth, raw, movies


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, scene: Scene) -> Path:
    """Folder of what the user has: TIFF stacks, as another program writes them."""
    folder, (_, raw, movies) = tmp_path_factory.mktemp("user"), scene
    for camera, stack in zip("ab", raw["counts"].values, strict=True):
        tifffile.imwrite(folder / f"{camera}.tif", stack, photometric="minisblack")
    for camera, steps in zip("ab", movies["counts"].values, strict=True):
        for celsius, stack in zip((5, 25, 45, 70), steps, strict=True):
            tifffile.imwrite(folder / f"{camera}{celsius}.tif", stack, photometric="minisblack")
    return folder


@pytest.fixture(scope="module")
def results(files: Path) -> Path:
    """Folder in which the commands of docs/own_captures.md have been carried out as written."""
    (block,) = re.findall(r"```sh\n(dbthermal import .*?)```", PAGE, re.DOTALL)
    commands = shlex.split(block.replace("\n", " ; ").replace("\\ ; ", ""))
    while commands:
        end = commands.index(";")
        program, *arguments = commands[:end]
        commands = commands[end + 1 :]
        assert program == "dbthermal"
        status, _, error = said(files, *arguments, action="always")
        assert status == 0, error
    return files


def test_two_stacks_to_temperatures(results: Path, scene: Scene) -> None:
    """By at most ten commands of the page the object is known to a quarter of a kelvin."""
    assert 5 < PAGE.count("\ndbthermal ") <= 10
    result = store.open_dataset(results / "result.zarr")
    error = result["object_temperature"].values - scene[0]["object_temperature"].values
    print(f"median error {np.nanmedian(abs(error)):.3f} K")
    assert np.nanmedian(abs(error)) < 0.25  # [K]
    provenance = result.attrs["provenance"]
    assert provenance["parameters"]["command"] == "separate"
    assert not provenance["parameters"].keys() & {"register", "place", "json"}
    assert provenance["inputs"]["capture 0"] == store.checksum(results / "aligned.zarr")


def test_three_bands(tmp_path: Path) -> None:
    """Three cameras, with the offset of each, go the whole way; a wrong number of offsets not."""
    bands, rng, shape = ("8-14", "9.5", "10.6"), np.random.default_rng(1), (8, 10)
    rig = simulation.Rig(bands=bands, noise=(0.03, 0.3, 0.3), bad_fraction=0.0)
    glass = emissivity_of(0.86, 0.72, 0.82, bands=bands)
    truth = simulation.walkers(np.arange(FRAMES) / 10, shape, glass, rng)
    detector = simulation.pattern(rig, shape, rng)
    raw = simulation.capture(simulation.observe(truth, rig.response(), rng), detector)
    sweep = simulation.blackbody_movies(rig, np.linspace(278.15, 343.15, 4), 16, detector, rng)
    for camera, film, steps in zip("abc", raw["counts"], sweep["counts"], strict=True):
        np.save(tmp_path / f"{camera}.npy", film)
        for step, still in zip("0123", steps, strict=True):
            np.save(tmp_path / f"{camera}{step}.npy", still)
    stated = ["--bands", *bands, "--clock", "10"]
    offsets = ["--offset", "0", "--offset", "0"]
    done(tmp_path, "import", "a.npy", "b.npy", "c.npy", *stated, *offsets, "-o", "scene.zarr")
    kelvin = [f"{value}K" for value in sweep["temperature"].values]
    at = [f"--at {k} a{n}.npy b{n}.npy c{n}.npy" for n, k in enumerate(kelvin)]
    fitted = ["-o", "r.zarr", "--correction-output", "nuc.zarr", "--offset-std", "0.5", "0.5", "1"]
    done(tmp_path, "calibrate", *" ".join(at).split(), *stated, *fitted)
    names = ["scene.zarr", "r.zarr", "--correction", "nuc.zarr", "--register", "none"]
    done(tmp_path, "separate", *names, *offsets, "-o", "result.zarr")
    result = store.open_dataset(tmp_path / "result.zarr")
    error = result["object_temperature"].values - truth["object_temperature"].values
    assert np.nanmedian(abs(error)) < 0.25  # [K]
    assert "result.zarr" in done(tmp_path, "info", "result.zarr")
    done(tmp_path, "export", "result.zarr", "--pixel", "3", "4", "-o", "curve.csv")
    done(tmp_path, "report", "result.zarr", "scene.zarr", "r.zarr", "-o", "page.html")
    reason = refused(tmp_path, "separate", *names, "--offset", "0", "-o", "other.zarr")
    assert "Must be 2, one for each of the bands ['9.5', '10.6']" in reason


def test_a_terminal_is_told_the_stage(results: Path) -> None:
    """On a terminal a command says what it does, and ends with a line of its own."""
    reading, writing = os.openpty()
    code = "import sys; from dbthermal.__main__ import main; sys.exit(main())"
    names = ["scene.zarr", "response.zarr", "--correction", "nuc.zarr", "-o", "terminal.zarr"]
    command = [sys.executable, "-c", code, "separate", *names]
    subprocess.run(command, cwd=results, stderr=writing, stdout=subprocess.PIPE, check=True)
    os.close(writing)
    text, piece = b"", b" "
    while piece:
        try:
            piece = os.read(reading, 4096)
        except OSError:  # the terminal is closed, and read to its end
            break
        text += piece
    os.close(reading)
    lines = text.decode().replace("\r\n", "\n").split("\r")
    assert any(re.match(r"separate: [a-z, ]+, \d+ s\x1b\[K", line) for line in lines), lines
    assert re.fullmatch(r"\x1b\[Kseparate: \d+\.\d s\n", lines[-1]), lines[-1]


def test_raw_capture_in_one_command(results: Path) -> None:
    """All steps of a raw capture by rows give what the steps one by one give."""
    names = ["separate", "scene.zarr", "response.zarr", "--correction", "nuc.zarr"]
    done(results, *names, "-o", "whole.zarr")
    whole, steps = (store.open_dataset(results / f"{name}.zarr") for name in ("whole", "result"))
    difference = whole["object_temperature"].values - steps["object_temperature"].values
    assert np.nanmedian(abs(difference)) < 0.02  # [K]


def test_one_method_and_its_completion(results: Path) -> None:
    """A method by name with known emissivities, and its completion."""
    known = ["--method", "calibrated", "--emissivity", "0.86", "0.72"]
    made = done(results, "separate", "aligned.zarr", "response.zarr", *known, "-o", "one.zarr")
    assert made["one.zarr"]["stage"] == "separated"
    names = ["complete", "one.zarr", "aligned.zarr", "response.zarr", "--surroundings", "22C"]
    done(results, *names, "-o", "completed.zarr")
    completed = store.open_dataset(results / "completed.zarr")
    assert completed.attrs["surroundings"] == pytest.approx(295.15)
    emissivity = store.open_dataset(results / "one.zarr")["emissivity"]
    assert np.nanmax(abs(emissivity.values - [[[0.86]], [[0.72]]])) < 1e-6


def test_info_of_stores_and_files(results: Path) -> None:
    """A store says its stage, sizes, clock, bands, status and provenance; a file what it tells."""
    found = done(results, "info", "result.zarr")["result.zarr"]
    assert found["stage"] == "separated"
    assert found["sizes"]["time"] == FRAMES
    assert found["bands"] == ["8-14", "9.5"]
    assert found["frame_rate_Hz"] == pytest.approx(10, abs=0.01)
    status = store.open_dataset(results / "result.zarr")["status"].values
    assert found["status_shares"]["no_flag"] == pytest.approx((status == 0).mean(), abs=1e-6)
    assert found["provenance"]["parameters"]["command"] == "separate"
    made = done(results, "info", "a.tif")["a.tif"]
    assert made["sizes"] == {"time": FRAMES, "y": 24, "x": 32}
    assert "seconds" not in made
    assert "--clock" in made["clock"]
    film = tifffile.imread(results / "a.tif")
    with h5py.File(results / "timed.h5", "w") as file:
        file["counts"], file["time"] = film, np.arange(FRAMES) / 10  # [s]
        file["time"].make_scale("time")
        file["counts"].dims[0].attach_scale(file["time"])
    assert done(results, "info", "timed.h5")["timed.h5"]["frame_rate_Hz"] == pytest.approx(10)
    with h5py.File(results / "whole.h5", "w") as file:  # times in whole milliseconds
        file["counts"], file["time_ms"] = film, np.arange(FRAMES) * 1000 // 30
    whole = done(results, "info", "whole.h5")["whole.h5"]
    assert whole["frame_rate_Hz"] == pytest.approx(30, rel=1e-3)
    with h5py.File(results / "stated.h5", "w") as file:  # a rate that is stated is no clock
        file["counts"], file.attrs["fps"] = film, 30.0
    stated = done(results, "info", "stated.h5")["stated.h5"]
    assert "--clock" in stated["clock"]
    (note,) = stated["attributes"]["warnings"]
    assert note.startswith("'stated.h5' states 30 frames a second. Must be the rate of recording;")
    for number in range(3):
        path = results / f"dated_20241027_15595{number}.tif"
        tifffile.imwrite(path, film[number], photometric="minisblack")
    (dated,) = done(results, "info", "dated*.tif").values()
    assert "are 1 s apart. Must be the rate of recording." in dated["attributes"]["warnings"][0]
    one = done(results, "info", "a.tif", "--unit", "count", "--clock", "10")["a.tif"]
    assert one["stage"] == "recording"
    assert one["attributes"]["byte_order"] == "little"
    # Two cameras' files as the other commands name them, and two stores.
    for names in (["a.tif", "b.tif"], ["a.tif", "+", "b.tif"]):
        cameras = done(results, "info", *names, "--clock", "10", "12")
        assert [*cameras] == ["a.tif", "b.tif"]
        assert cameras["b.tif"]["frame_rate_Hz"] == pytest.approx(12)
    assert len(done(results, "info", "scene.zarr", "scene.zarr")) == 2  # none is left out
    for names in (["nuc.zarr", "scene.zarr"], ["nuc.zarr", "scene.zarr", "response.zarr"]):
        stages = [it["stage"] for it in done(results, "info", *names).values()]
        assert stages == ["correction", "capture", "response"][: len(names)]


@pytest.mark.parametrize("option", [[], ["--side-by-side"]])
def test_the_demonstration_runs_as_it_is_printed(tmp_path: Path, option: list[str]) -> None:
    """At most five printed commands take its files to a report and the explorer, near the truth."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert "\ndbthermal demo try-it   # or --side-by-side\n" in readme
    folder = tmp_path / ("try it" if option else "try-it")
    _, out, _ = said(tmp_path, "demo", folder.name, *option)
    assert f"\ncd {shlex.quote(folder.name)}\n" in out
    commands = [line for line in out.splitlines() if line.startswith("dbthermal ")]
    assert "simulated" in out
    assert len(commands) <= 5
    assert len([*folder.glob("*.tif")]) == 10
    assert "There is something at" in refused(tmp_path, "demo", folder.name, *option)
    texts = []
    for command in commands:
        status, out, error = said(folder, *shlex.split(command)[1:], action="always")
        assert status == 0, error
        texts.append(out)
    assert {"report.html", "look.ipynb"} <= {path.name for path in folder.iterdir()}
    result = store.open_dataset(folder / "result.zarr")
    assert result.attrs["origin"] == "simulated"  # as the stacks say by themselves
    assert store.open_dataset(folder / "response.zarr").attrs["origin"] == "simulated"
    # The answer comes first, and holds the truth: 22 to 60 degC, a third of it measured or more.
    answer = r"Object from (\S+) to (\S+) degC \(98 % of .*\), typically \+- (\S+) K \(noise"
    head = re.search(answer, texts[2])
    assert head, texts[2]
    low, high, std = map(float, head.groups())
    assert abs(low - 22) < 1
    assert 45 < high < 60.5
    assert std < 0.3
    (level,) = re.findall(r"Reflected surroundings at (\S+) degC; a calibration is", texts[2])
    assert abs(float(level) - 22) < 1
    assert float(re.findall(r"Measured: (\d+)% of the pixels", texts[2])[0]) > 35
    assert re.search(r"Emissivity at \d+ pixels, like .*plate window glass.*: 0\.8[56]", texts[2])
    assert "Watch out:" in texts[2]
    if option:  # displaced by the 2 rows and 4 columns, and 3 columns, that were put in
        made = done(folder, "info", "result.zarr")["result.zarr"]
        np.testing.assert_allclose(made["view_shift_pixel"]["9.5"], [-2, -4], rtol=0, atol=0.2)
        assert abs(abs(made["reflection_shift_pixel"]["columns"]) - 3) < 0.2  # [pixel]


def test_cameras_of_two_rates_and_a_part_of_them(results: Path) -> None:
    """A clock for each camera; frames, every so many of them, and rows alone."""
    form = ["--bands", "8-14", "9.5", "--offset", "0"]
    rates = ["--clock", "12", "10", "-o", "rates.zarr"]
    status, _, error = said(results, "import", "a.tif", "b.tif", *form, *rates, action="always")
    assert status == 0
    assert "Warning: The cameras recorded 16.6 s and 19.9 s. Must be the same time" in error
    times = store.open_dataset(results / "rates.zarr")["exposure_time"]
    np.testing.assert_allclose(times[:, -1], [199 / 12, 19.9], rtol=0, atol=1e-9)  # [s]
    part = ["--frames", "20", "120", "--every", "3", "--rows", "4", "10", "--clock", "10"]
    done(results, "import", "a.tif", "b.tif", *form, *part, "-o", "part.zarr")
    done(results, "import", "scene.zarr", *part[:-2], "-o", "part2.zarr")
    whole = store.open_dataset(results / "scene.zarr")["counts"][:, 20:120:3, 4:10]
    for name in ("part", "part2"):
        np.testing.assert_array_equal(store.open_dataset(results / f"{name}.zarr")["counts"], whole)
    # Rows of rows take the gain and offset of these rows of the detector.
    done(results, "import", "scene.zarr", "--rows", "2", "12", "-o", "rows.zarr")
    done(results, "import", "rows.zarr", "--rows", "2", "8", "-o", "rows2.zarr")
    done(results, "correct", "rows2.zarr", "nuc.zarr", "-o", "rows3.zarr")
    corrected, rows = (store.open_dataset(results / f"{it}.zarr") for it in ("corrected", "rows3"))
    np.testing.assert_array_equal(rows["counts"], corrected["counts"][:, :, 4:10])


def test_selected_frames_have_the_times_of_all_formats(tmp_path: Path) -> None:
    """Frames of FLIR's files count from the first of the file, by its times or by the clock."""
    counts = flir_files.scene(80)
    seconds = [1.5e9 + number / 8 for number in range(80)]
    (tmp_path / "a.seq").write_bytes(flir_files.sequence(counts, seconds=seconds))
    (tmp_path / "b.seq").write_bytes(flir_files.sequence(counts + 1, seconds=seconds))
    np.save(tmp_path / "c.npy", counts + np.uint16(2))
    form = ["--bands", "8-14", "9.5", "--frames", "8", "80", "--every", "2", "-o", "s.zarr"]
    clock = ["--clock", "8", "--offset", "0"]
    for options in (["a.seq", "b.seq"], ["a.seq", "c.npy", *clock], ["a.seq", "b.seq", *clock]):
        done(tmp_path, "import", *options, *form, "--overwrite")
        capture = store.open_dataset(tmp_path / "s.zarr")
        np.testing.assert_allclose(
            capture["exposure_time"], [np.arange(1.0, 10.0, 0.25)] * 2
        )  # [s]
        assert str(capture.attrs["files"]["8-14"]["start"]).startswith("2017-07-14T02:40:00")


@pytest.mark.slow
def test_long_recordings_are_read_without_their_memory(tmp_path: Path) -> None:
    """More than a gigabyte is imported and looked at by some frames at a time, via files."""
    shape, sizes = (1700, 512, 640), np.random.default_rng(1)
    frame = sizes.integers(18000, 18500, shape[1:], dtype=np.uint16)
    for name in "ab":
        film = np.lib.format.open_memmap(tmp_path / f"{name}.npy", "w+", np.uint16, shape)
        for number in range(shape[0]):
            film[number] = frame + number % 200 + (name == "b")
        del film
    limit = "import resource; resource.setrlimit(resource.RLIMIT_DATA, (3 * 2**29,) * 2); "
    form = ["--bands", "8-14", "9.5", "--clock", "30", "--offset", "0", "-o", "scene.zarr"]
    for command in (["info", "a.npy"], ["import", "a.npy", "b.npy", *form]):
        found = run(tmp_path, *command, before=limit)
        assert found.returncode == 0, found.stderr
        assert "time 1700, y 512, x 640" in found.stdout


def test_simulated_files_make_simulated_results(results: Path) -> None:
    """What no camera has recorded is said to be simulated, in all that is made of it."""
    form = [*STATED, "--simulated", "--offset", "0", "-o", "simulated.zarr"]
    done(results, "import", "a.tif", "b.tif", *form)
    done(results, "correct", "simulated.zarr", "nuc.zarr", "-o", "simulated_corrected.zarr")
    for name in ("simulated", "simulated_corrected"):
        assert store.open_dataset(results / f"{name}.zarr").attrs["origin"] == "simulated"
    assert store.open_dataset(results / "scene.zarr").attrs["origin"] == schema.MEASURED
    _, told, _ = said(results, "info", "a.tif", "--unit", "count", "--clock", "10", "--simulated")
    assert "simulated" in told


def test_raw_files_need_their_form(results: Path) -> None:
    """Raw numbers of a stated form, and lists with a '+', give the same capture."""
    stack = tifffile.imread(results / "a.tif")[:40]
    for name, part in {"a": stack, "c": stack + 1}.items():
        part.astype(">u2").tofile(results / f"{name}.raw")
        np.save(results / f"{name}.npy", part)
    for place in (0, 1):
        tifffile.imwrite(results / f"part{place}.tif", stack[20 * place : 20 * place + 20])
    form = ["--shape", "24", "32", "--byte-order", "big", "--offset", "0", *STATED]
    done(results, "import", "a.raw", "c.raw", *form, "-o", "numbers.zarr")
    parts = ["part0.tif", "part1.tif", "+", "c.npy"]
    done(results, "import", *parts, "--offset", "0", *STATED, "-o", "parts.zarr")
    for name in ("numbers", "parts"):
        counts = store.open_dataset(results / f"{name}.zarr")["counts"]
        np.testing.assert_array_equal(counts.values, [stack, stack + 1])
    np.savez(results / "both.npz", wide=stack, narrow=stack + 1)
    arrays = ["--variable", "narrow", "--variable", "wide", "--offset", "0", *STATED]
    done(results, "import", "both.npz", "both.npz", *arrays, "-o", "arrays.zarr")
    counts = store.open_dataset(results / "arrays.zarr")["counts"]
    np.testing.assert_array_equal(counts.values, [stack + 1, stack])
    line = refused(results, "import", "a.raw", "b.tif", *form[:3], *STATED, "-o", "x.zarr")
    assert "Missing --byte-order: 'a.raw' does not tell" in line


def test_blackbody_in_a_store(results: Path, scene: Scene) -> None:
    """Movies in a store give the response that the files give; a second source is refused."""
    store.save(scene[2], results / "blackbody.zarr", store.provenance({}))
    names = ["calibrate", "--blackbody", "blackbody.zarr"]
    done(results, *names, "-o", "response2.zarr")
    first, second = (store.open_dataset(results / f"response{n}.zarr") for n in ("", "2"))
    np.testing.assert_allclose(second["offset"], first["offset"], rtol=0, atol=1e-6)
    # What is known of the accuracy is stated, the rest is what is usual.
    known = "--offset-std 0.2 0.3 --blackbody-accuracy 0.05 --room-temperature 25\N{DEGREE SIGN}C"
    done(results, *names, *known.split(), "-o", "accurate.zarr")
    third = store.open_dataset(results / "accurate.zarr")
    assert third["offset_std"].values.tolist() == [0.2, 0.3]
    assert (float(third["blackbody_accuracy"]), float(third["room_temperature"])) == (0.05, 298.15)
    assert float(third["blackbody_emissivity"]) == float(first["blackbody_emissivity"]) == 0.97
    assert "of all 0.05 K, emissivity 0.97" in third.attrs["blackbody"]
    line = refused(results, *names, "--maker", "scene.zarr", "-o", "response3.zarr")
    assert "Invalid sources ['blackbody', 'maker']" in line
    line = refused(results, "calibrate", "--maker", "scene.zarr", "-o", "response3.zarr")
    assert "Missing range_min of band '8-14'" in line


def test_curves_films_pictures(results: Path) -> None:
    """Exports hold the values of the store."""
    result = store.open_dataset(results / "result.zarr")
    object_ = result["object_temperature"].values
    with (results / "curve.csv").open(encoding="utf-8", newline="") as stream:
        rows = [*csv.reader(stream)]
    assert rows[0][0] == "time [s]"
    assert {f"pixel 12 16 {label}" for label in LABELS} <= {*rows[0]}
    assert not any("imum" in label for label in rows[0])  # of one pixel
    assert len(rows) == FRAMES + 1
    assert float(rows[-1][1]) == pytest.approx(object_[-1, 12, 16] - 273.15, abs=1e-3)  # [degC]
    assert [row[0] for row in rows[1:4]] == ["0.0", "0.1", "0.2"]
    assert max(len(cell) for row in rows[1:] for cell in row[:3]) < 9
    assert {row[-1] for row in rows[1:]} == {"no_flag"}
    status = result["status"].values
    worst = np.argwhere(status & schema.Status.DEAD_PIXEL)[0].tolist()
    places = ["--pixel", *map(str, worst), "--region", "0", "24", "0", "32"]
    done(results, "export", "result.zarr", *places, "-o", "places.csv")
    with (results / "places.csv").open(encoding="utf-8", newline="") as stream:
        last = [*csv.DictReader(stream)][-1]
    assert "dead_pixel" in last[f"pixel {worst[0]} {worst[1]} status"]
    whole = "rows 0 to 23 columns 0 to 31 measured"
    assert last[f"{whole} status"] == "no_flag"
    assert float(last[f"{whole} pixels [1]"]) == (status == 0).sum()
    for suffix in ("tif", "png", "nc", "gif"):
        done(results, "export", "result.zarr", "-o", f"out.{suffix}")
    np.testing.assert_array_equal(tifffile.imread(results / "out.tif"), object_)
    np.testing.assert_array_equal(tifffile.imread(results / "out_status.tif"), status)
    done(results, "export", "result.zarr", "--variable", "emissivity", "-o", "maps.tif")
    with tifffile.TiffFile(results / "maps.tif") as stack:
        assert json.loads(stack.pages.first.description)["band"] == ["8-14", "9.5"]
    with Image.open(results / "out.gif") as film:
        assert film.n_frames == FRAMES // 2  # type: ignore[attr-defined]
    assert (results / "out_status.png").read_bytes().startswith(b"\x89PNG")
    for variable, first in {"uncertainty": "cause noise", "emissivity": "band 8-14"}.items():
        drawn = done(results, "export", "result.zarr", "--variable", variable, "-o", f"{first}.svg")
        assert drawn[f"{first}.svg"]["images"][0] == f"{variable}, {first}"
        assert "\N{DEGREE SIGN}C" not in (results / f"{first}.svg").read_text("utf-8")
    (results / "out.tif").unlink()
    line = refused(results, "export", "result.zarr", "-o", "out.tif")
    assert "There is something at 'out_status.tif'" in line
    assert not (results / "out.tif").exists()
    with xr.open_dataset(results / "out.nc", engine="scipy") as opened:
        np.testing.assert_array_equal(opened["object_temperature"], object_)
        np.testing.assert_array_equal(opened["status"], result["status"])
    assert (results / "out.png").read_bytes().startswith(b"\x89PNG")


def test_a_capture_is_exported_as_netcdf(results: Path) -> None:
    """Counts from 32768 on, which the 16 bits of the format do not hold, are in it, too."""
    scene = store.open_dataset(results / "scene.zarr")
    store.save(scene.assign(counts=scene["counts"] | 32768), results / "bright.zarr", {})
    done(results, "export", "bright.zarr", "-o", "bright.nc")
    with xr.open_dataset(results / "bright.nc", engine="scipy") as opened:
        np.testing.assert_array_equal(opened["counts"], scene["counts"] | 32768)
        assert opened["counts"].attrs["units"] == "count"


def test_curves_of_pixels_copy_no_film(results: Path) -> None:
    """A curve of few pixels is written where no file may be as large as a film of the result."""
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (10**5,) * 2); "
    places = ["--pixel", "3", "4", "--region", "2", "6", "10", "30", "-o", "few.csv"]
    found = run(results, "export", "result.zarr", *places, before=limit)
    assert found.returncode == 0, found.stderr


def test_report_and_explorer(results: Path) -> None:
    """A report is a page with the region's name; the explorer's notebook has one valid cell."""
    shown = ["result.zarr", "aligned.zarr", "response.zarr"]
    short = store.open_dataset(results / "result.zarr").isel(time=slice(0, 20))
    store.save(short, results / "short.zarr", {})
    done(results, "report", "short.zarr", "--region", "2", "8", "2", "8", "-o", "out.html")
    assert "rows 2 to 7, columns 2 to 7" in (results / "out.html").read_text(encoding="utf-8")
    done(results, "explore", *shown, "-o", "look.ipynb")
    for name in ("scene", "aligned"):
        done(results, "explore", f"{name}.zarr", "-o", f"{name}.ipynb")
    notebook = nbformat.read(results / "look.ipynb", as_version=4)
    nbformat.validate(notebook)
    paths = ", ".join(repr(str(results / name)) for name in shown)
    assert f"dbthermal.explore({paths})" in notebook.cells[0].source


def test_plan_and_data(tmp_path: Path) -> None:
    """The plan names the filter for glass; the list has it; an unknown material is refused."""
    _, out, _ = said(tmp_path, "plan", "plate window glass", "brass plate", "--noise", "0.03")
    assert "Assumed: 35 s at 10 Hz; the object rises by 25 K" in out
    assert re.search(r"8-14 and a filter .*\n.*\nplate window glass  9.5 +0\.706 +0\.173 ", out)
    assert re.search(r"(?m)^brass plate +none .*\n.*Best none: no filter", out)
    still = done(tmp_path, "plan", "brass plate", "--noise", "0.03", "--span", "0")["numbers"]
    assert None in still["brass plate"]["object_temperature_std_K"].values()  # JSON has no infinity
    listed = done(tmp_path, "data")
    assert listed["filters_um"]["9.5"] == [9.25, 9.75]
    assert listed["emissivity"]["plate window glass"]["9.5"] == 0.718


def test_nothing_is_overwritten(results: Path) -> None:
    """A dry run writes nothing; an output that is there is kept, unless it may be replaced."""
    command = ["correct", "scene.zarr", "nuc.zarr", "-o", "again.zarr"]
    planned = done(results, *command, "--dry-run")
    assert planned["would_write"] == ["again.zarr"]
    assert planned["would_read"]["scene.zarr"]["sizes"]["time"] == FRAMES
    assert planned["would_read"]["nuc.zarr"]["stage"] == "correction"
    assert not (results / "again.zarr").exists()
    shutil.copytree(results / "response.zarr", results / "again.zarr")
    before = store.checksum(results / "again.zarr")
    assert "Must be new, or --overwrite" in refused(results, *command)
    assert store.checksum(results / "again.zarr") == before
    done(results, *command, "--overwrite", "--no-shutter")
    assert store.open_dataset(results / "again.zarr").attrs["gain_offset_corrected"] == 1
    line = refused(results, "correct", "scene.zarr", "-o", "scene.zarr", "--overwrite")
    assert "lies there. Must be another place" in line
    line = refused(results, "correct", "scene.zarr", "nuc.zarr", "-o", "scene.zarr/inner.zarr")
    assert "lies there. Must be another place" in line
    (results / "foreign.zarr").write_text("notes")
    wrong = ["correct", "nuc.zarr", "nuc.zarr", "--overwrite", "-o", "foreign.zarr"]
    assert "Foreign file 'foreign.zarr'" in refused(results, *wrong)  # before any work
    twice = ["-o", "new.zarr", "--correction-output", "./new.zarr"]
    line = refused(results, "calibrate", "--blackbody", "scene.zarr", *twice)
    assert "Invalid output 'new.zarr': an input or another output lies there" in line
    assert not (results / "new.zarr").exists()


def test_no_correction_must_be_stated(results: Path) -> None:
    """Raw counts without a file of gain and offset need an option, and the pattern is warned of."""
    command = ["correct", "scene.zarr", "-o", "uncorrected.zarr"]
    assert "only if the cameras correct gain and offset themselves" in refused(results, *command)
    command.append("--corrected-by-camera")
    assert "both a file and" in refused(results, *command[:2], "nuc.zarr", *command[2:])
    _, _, error = said(results, *command, action="always")
    assert "Warning: Fixed pattern of " in error
    made = store.open_dataset(results / "uncorrected.zarr")
    assert made.attrs["gain_offset_corrected"] == 0
    assert made.attrs["gain_offset_by_camera"] == 1
    assert min(made.attrs["fixed_pattern"]) > 20
    assert max(store.open_dataset(results / "corrected.zarr").attrs["fixed_pattern"]) < 0.5
    raw = store.open_dataset(results / "scene.zarr")["counts"][:, 0]
    np.testing.assert_allclose(made["counts"][:, 0], raw)


def test_a_dry_run_says_what_is_at_hand(results: Path) -> None:
    """Stages, bands and frames of what is read, and a separation's memory; nothing is made."""
    command = ["separate", "aligned.zarr", "response.zarr", "-o", "dry.zarr", "--dry-run"]
    planned = done(results, *command)
    stages = {path: one["stage"] for path, one in planned["would_read"].items()}
    assert stages == {"aligned.zarr": "corrected", "response.zarr": "response"}
    assert 0.45 < planned["memory_at_most_GB"] < 1
    made = done(results, "import", "a.tif", "b.tif", *STATED, "--offset", "0", *command[-3:])
    assert made["would_read"]["a.tif"] == {"bytes": (results / "a.tif").stat().st_size}
    assert made["would_be"]["bands"] == ["8-14", "9.5"]
    assert made["would_be"]["sizes"]["time"] == FRAMES
    assert not (results / "dry.zarr").exists()


def test_refusals_are_one_line(results: Path) -> None:
    """An error of the library is its message, or with --traceback all of it; usage has status 2."""
    command = ["import", "a.tif", "b.tif", *STATED, "-o", "no.zarr"]
    dates = r"Unknown dates of the recordings.* --offset \[s\]."
    assert re.search(dates, refused(results, *command))
    with pytest.raises(ValueError, match="Unknown dates"):
        said(results, *command, "--traceback")
    for wrong in (["separate", "scene.zarr"], ["complete", *"abc", "--surroundings", "22"], ["no"]):
        assert said(results, *wrong)[0] == 2
    assert run(results, "nothing").returncode == 2


@pytest.mark.parametrize(
    ("library", "extra", "command"),
    [
        ("tifffile", "recordings", "info a.tif --unit count --clock 10"),
        ("matplotlib", "figures", "export result.zarr -o no.png"),
        ("jinja2", "report", "report result.zarr -o no.html"),
        ("pydantic", "instruments", "record a.tif folder"),
    ],
)
def test_missing_extras_are_named(results: Path, library: str, extra: str, command: str) -> None:
    """A part whose library is not installed says in one line which extra to install."""
    found = run(results, *command.split(), before=f"sys.modules['{library}'] = None; ")
    assert found.returncode == 1
    (line,) = found.stderr.splitlines()
    assert f"in a clone: python -m pip install '.[{extra}]'" in line
    assert "'dbthermal[" not in line  # which an index might have of somebody else


ONE = f"import a.tif b.tif {' '.join(STATED)}"
EXCHANGED = f"""{ONE.replace("a.tif b.tif", "b.tif a.tif")} --offset 0 -o ba.zarr; separate ba.zarr
 response.zarr --correction nuc.zarr --register none --offset 0 -o no.zarr""".replace("\n", "")
SWEEP = f"calibrate {' '.join(STATED)} --at 5C a5.tif b5.tif --at 70C a70.tif b70.tif -o x.zarr"
STORES = "result.zarr aligned.zarr response.zarr"
ROWS = f"""
{ONE.replace("a.", "warm.").replace("b.", "cold.")} --offset 0 -o h.zarr -> Warning: The medians
{ONE.replace("a.", "five.").replace("b.", "few.")} -o 5.zarr --offset 0 -> Warning: Too few frames
{SWEEP} --at 278C a25.tif b25.tif -> Invalid levels .* Must rise with its temperature
{ONE} --offset 3 -o later.zarr; correct later.zarr nuc.zarr -o late.zarr; align late.zarr
 --register none -o x.zarr -> Missing time offset .* no rapid change that both bands see
separate scene.zarr response.zarr -o x.zarr -> 'separate --correction' takes raw counts
separate response.zarr aligned.zarr -o x.zarr -> Exchanged with the response
separate scene.zarr response.zarr --correction response.zarr -o x.zarr -> calibrate --corr\\S+$
import other.zarr -o x.zarr -> Invalid 1 files .'other.zarr'.: .* twice, with --variable
import two.npz --bands a b -o x.zarr -> Invalid 1 files .* twice, with --variable for each
import two.npz two.npz --bands a b -o x.zarr -> one of the arrays .--variable. .* one of .'a', 'b'.
separate a.tif response.zarr -o x.zarr -> No dataset 'a.tif'. Must be a zarr folder, as from: dbth
import response.zarr -o x.zarr -> of stage 'response'. Must be of stage 'capture'
info two.npz two.npz two.npz --clock 9 -> Invalid list of 3 arrays. Must be joined in a file
info a.tif b.tif five.tif --clock 10 -> Unordered files: .* Must be of one camera, and rise
record a.tif new -> Invalid session 'a.tif'. Must be YAML, as params/sessions/scene.yaml.
record folder new -> Invalid session 'folder'. Must be YAML
align scene.zarr -o x.zarr -> Invalid capture .* of stage 'capture'. Must be of stage 'corrected'
correct scene.zarr response.zarr -o x.zarr -> of stage 'response'. Must be of stage 'corr
separate aligned.zarr response.zarr --offset 0 -o x.zarr -> Unused option --offset.
info result.zarr/status -> an array. Must be the store that it is in: 'result.zarr'.
report result.zarr -o x.html --region 0 900 0 4 -> Invalid region 0 900 0 4. Must lie in
report {STORES} nuc.zarr -o x.html -> Invalid 3 stores beside 'result.zarr'. Must be its capture
explore response.zarr -o x.ipynb -> Invalid result 'response.zarr' of stage 'response'.
explore result.zarr nuc.zarr -o x.ipynb -> Invalid capture 'nuc.zarr' of stage 'correction'
report result.zarr response.zarr aligned.zarr -o x.html -> Exchanged with the response
report result.zarr -o x.pdf -> Invalid output 'x.pdf'. Must end in '.html'
separate aligned.zarr response.zarr -o result2 -> Invalid output 'result2'. Must end in '.zarr'
export aligned.zarr -o x.csv -> No variable with times .* in 'aligned.zarr'.* .*nc takes any store
export result.zarr --variable emissivity -o x.csv -> 'emissivity' for .csv. Must be one of
export result.zarr --variable bridged -o x.csv -> 'bridged' for .csv. Must be one of .'back
export result.zarr --variable noise -o x.tif -> 'noise' for .tif. Must be one of
separate aligned.zarr response.zarr --method calibrated --emissivity 1 -o x.zarr
 -> Must be one for each
separate aligned.zarr response.zarr --offset nan -o x.zarr -> --offset: Invalid number 'nan'
plan --noise {"9" * 400} -> argument --noise: Invalid number '999
plan --noise 30mK -> argument --noise: Invalid number '30mK'. Must be digits
plan --noise -0.03 -> Invalid noise .K. -0.03. Must be finite and positive
plan --noise 30 -> Invalid noise .K. 30.0. .*, at most 5.0: in kelvin, not in millikelvin
calibrate a5.tif b5.tif -o x.zarr -> arguments: a5.tif b5.tif. .* dbthermal calibrate --at 10C a
calibrate a5.tif b5.tif -> required: -o/--output. .* dbthermal calibrate --at 10C a10.tif
separate scene.zarr response.zarr --corrected-by-camera --register none --offset 0 -o camera.zarr
 -> Warning: Fixed pattern of
separate scene.zarr response.zarr --correction nuc.zarr --corrected-by-camera -o x.zarr
 -> Invalid correction of gain and offset: both
{EXCHANGED} -> Warning: Counts of bands .* are files of the bands exchanged
calibrate --at 5C --clock 10 -o x.zarr -> Blackbody at 5C: Invalid 0 files
calibrate --at 5C a5.tif --clock 10 -o x.zarr -> Blackbody at 5C: Invalid 1 files .'a5.tif'.
export scene.zarr -o x.tif -> .object_temperature. for .tif. 'scene.zarr' has no result. Must be
separate aligned.zarr response.zarr --method calibrated -o x.zarr -> Missing --emissivity for method
info a.tif --clock times.csv -> argument --clock: Invalid number 'times.csv'.* go to clock= in Pyth
{ONE} --offset -3e+3 -o x.zarr -> Invalid offset -3000 s: the recordings of .* do not overlap
info folder/* --clock 10 -> No file or folder 'folder/.'
calibrate --blackbody response.zarr -o x.zarr --correction-output y.zarr
 -> Unused option --correction-output. Must be left out: 'response.zarr' has no pixels
info a*.tif --clock 10 -> Warning: 'a.tif to a70.tif' have .200, 16, 16, 16, 16. frames. Must be
calibrate -o x.zarr -> Missing source. Must be one of --at, --blackbody
calibrate --at 5C a5.tif + b5.tif --bands a b --clock 9 -o x.zarr -> Invalid blackbody frames of 1
demo x --side -> unrecognized arguments: --side Did you mean '--side-by-side'
demo noise.tif -> There is something at 'noise.tif'. Must be new, or a folder.
import a.tif b.tif --bands a b --clock 9 --offset 0 -o folder -> Invalid output 'folder'. Must end
info noise.tif -> Damaged TIFF 'noise.tif': not a TIFF file: header=b'
import folder --bands a b --clock 10 -o x.zarr -> Invalid folder .* Must be files: folder/
info folder -> Invalid folder 'folder', no whole zarr. Must be files: folder/.*.tif
{ONE} --offset 0 --rows 5 2 -o x.zarr -> Invalid --rows 5 2. Must be first and end, which is larger
info a.tif --clock 30 25 -> Invalid --clock of 2 values. Must be one, or one for each camera, here 1
info nothing*.zarr -> No file or folder 'nothing.*.zarr'
info 1714*.tif --clock 30 -> Warning: The dates of .* are 1 s apart, by --clock 0.0333 s. Must be
info ../user?/gap[0-9]*.tif --clock 9 -> Warning: The times or numbers of 'gap8.tif to gap11.*leave
plan gold --noise 0.03 -> Unknown material 'gold'
export result.zarr -o out.xyz -> Must end in one of .'.csv', '.tif', '.nc', '.png'
export result.zarr --pixel 1 1 -o curve.txt -> Must end in one of .'.csv'
export result.zarr --pixel 24 0 -o x.csv -> Must lie in the image of 24 x 32
import a.tif b.tif --bands 8-14 9.5 -o x.zarr -> Missing --clock for 'a.tif', which tells no times
import a.tif b.tif --bands 8-14 9.5 10.6 -o x.zarr -> --bands of 3 names.* Must be 2, one for each
import a.tif b.tif --bands 8-14 9.5 --clock 1 2 3 -o x.zarr -> Invalid --clock of 3 values
export result.zarr --variable noise --variable status -o x.csv -> variable 'noise status' for .csv
{ONE} --offset 0 --frames 0 -o x.zarr -> Invalid --frames .* first and end
{ONE} --offset 0 --frames 300 400 -o x.zarr -> --frames 300 400 of 'a.tif': it has 0 of these 100.
{ONE} --offset 0 --frames 300 -o x.zarr -> --frames 300 of 'a.tif': it has 200 of these 300.
{SWEEP} --frames 20 -> Invalid --frames 20 of the blackbody at 278.15 K: it has 16 of these 20.
{ONE} --offset 0 --rows 20 30 -o x.zarr -> --rows 20 30 of 'a.tif': it has 4 of these 10.
import scene.zarr --frames 150 300 --every 10 -o x.zarr -> of 'scene.zarr': it has 5 of these 15.
{ONE} --offset 0 --every 0 -o x.zarr -> Invalid --every 0
{ONE} --offset 0 --rows 9 3 -o x.zarr -> Invalid --rows 9 3
seperate a b -> invalid choice: 'seperate' .choose from .*Did you mean 'separate'
align corrected.zarr --register none --offset 12 -o x.zarr -> Invalid --offset .* 80 of 200 frames
align corrected.zarr --offset 0 --reference 8-15 -o x.zarr -> Unknown --reference '8-15'.* '8-14'
{SWEEP} --at 5C a5.tif b5.tif -> Repeated --at 278.15K .5C.. Must be stated once
calibrate --at \N{MINUS SIGN}5C a.tif b.tif -o x.zarr -> Invalid temperature '\N{MINUS SIGN}5C'
demo dangling -> There is something at 'dangling'
align corrected.zarr --offset 0 --overwrite -o link.zarr -> a link. Must be 'nowhere.zarr'
align a.zarr --ofset 0 -o x.zarr -> unrecognized arguments: --ofset 0 Did you mean '--offset'
align a.zarr --register homograph -o x.zarr -> 'homograph' .*Did you mean 'homography'
export result.zarr --variable object -o x.tif -> 'object' for .tif.*mean 'object_temperature'
plan plate_window_glas --noise 0.03 -> 'plate_window_glas'.*Did you mean 'plate window glass'
plan glass --noise 0.03 -> Did you mean 'plate window glass'
complete a b c --surroundings 278C -o d.zarr -> Warning: 278C is 551.15 K; kelvin are written 278K
complete a b c --surroundings 22K -o d.zarr -> 22K is -251.15 degrees .* are written 22C
calibrate --at 5c a.tif b.tif -o a.zarr -> temperature '5c'. Must be a number, with a decimal point
separate aligned.zarr response.zarr --surroundings -300C -o x.zarr -> surroundings .K. -26.85. Must
""".replace("\n -", " -").strip()
UNUSED = f"""
import scene.zarr --unit K -o x.zarr -> unit a store
import scene.zarr --offset 5 -o x.zarr --dry-run -> offset a store
{ONE} --shape 3 3 -o x.zarr -> shape TIFF
{ONE} --byte-order big -o x.zarr -> byte-order TIFF
import a.seq b.seq --bands a b --unit count -o x.zarr -> unit FLIR
import a.seq + b.npy --shape 9 9 -o x.zarr --variable q --header 3 ->
info scene.zarr --clock 10 -> clock a store
info a.tif --unit count --clock 10 --frame-header 3 -> frame-header TIFF
calibrate --blackbody scene.zarr --clock 10 -o x.zarr -> clock --blackbody
calibrate --blackbody scene.zarr --frames 64 -o x.zarr -> frames --blackbody
calibrate --sweep a b --bands a b -o x.zarr -> bands --sweep
calibrate --maker a --correction-output y -o x -> correction-output --maker
calibrate --maker a --gain-std 0.01 0.02 -o x -> gain-std --maker
calibrate --clock 10 -o x ->
{SWEEP.replace("--bands", "--variable q --bands")} -> variable TIFF
align corrected.zarr --offset 0 --search 5 -o x.zarr -> search --offset
separate aligned.zarr response.zarr --search 9 -o x -> search --correction
separate aligned.zarr response.zarr --method apparent --workers 2 -o x -> workers --met
separate aligned.zarr response.zarr --emissivity 1 1 -o x -> emissivity --method calibrated
separate scene.zarr response.zarr --corrected-by-camera --method subspace -o x -> method --corr
export result.zarr --pixel 1 1 -o x.tif -> pixel .tif
export result.zarr --variable emissivity -o x.nc -> variable .nc
""".strip()


@pytest.fixture(scope="module")
def mistaken(results: Path) -> Path:
    """Folder with files that are no recordings of counts, too."""
    stack = tifffile.imread(results / "b.tif")
    kelvin = np.linspace(29300, 29700, stack[0].size).reshape(stack[0].shape).astype("u2")
    warm = np.repeat(kelvin[np.newaxis], 40, axis=0)
    mistakes = {"warm": warm, "cold": warm - np.uint16(9), "five": stack[:5], "few": stack[5:10]}
    for name, wrong in mistakes.items():
        tifffile.imwrite(results / f"{name}.tif", wrong, photometric="minisblack")
    for place, number in enumerate((8, 9, 11)):
        for name in (f"gap{number}.tif", f"171456480{place}000.tif"):  # since 1970 [ms]
            tifffile.imwrite(results / name, stack[place], photometric="minisblack")
    (results / "noise.tif").write_bytes(bytes(range(50)))
    (results / "folder").mkdir()
    (results / "folder" / ".hidden").write_bytes(bytes(range(50)))  # which a shell does not expand
    (results / "dangling").symlink_to("nowhere")
    (results / "link.zarr").symlink_to("nowhere.zarr")
    np.savez(results / "two.npz", a=stack, b=stack + np.uint16(1))
    zarr.open_group(results / "other.zarr", mode="w").create_array("a", data=stack)
    return results


@pytest.mark.parametrize("row", ROWS.splitlines())
def test_mistakes_are_explained_in_words_of_the_commands(mistaken: Path, row: str) -> None:
    """What is wrong with files, stores, options and names is one line, with names to choose."""
    commands, _, reason = row.partition(" -> ")
    for command in commands.split("; "):
        status, _, error = said(mistaken, *command.split(), action="always")
    lines = error.splitlines()
    assert any(re.search(reason, line) for line in lines), error
    assert "Traceback" not in error
    assert status > 0 or "Warning" in reason


@pytest.mark.parametrize("row", UNUSED.splitlines())
def test_options_without_effect_are_refused(results: Path, row: str) -> None:
    """What the files, the output or another option leave without effect is named as such.

    Options that one of two cameras' files takes are taken.
    """
    arguments, _, expected = row.partition(" ->")
    option, _, why = expected.strip().partition(" ")
    line = refused(results, *arguments.split())
    rule = rf"Unused option --{option}\. Must be left out with(out)? {re.escape(why)}"
    assert re.search(rule, line) if option else "Unused" not in line


def test_the_explorer_says_what_it_lacks(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the explorer's extra, its notebook comes with the command that installs it."""
    command = ["explore", "result.zarr", "--overwrite", "-o", "a.ipynb"]
    for missing in ("anywidget", "jupyterlab"):
        with monkeypatch.context() as absent:
            absent.setitem(sys.modules, missing, None)
            _, out, _ = said(results, *command)
        assert "opened by, in a clone: python -m pip install '.[explorer]' jupyter" in out


def test_a_temperature_in_words_is_no_file(tmp_path: Path) -> None:
    """Units with a blank are explained; the name of a file that begins with digits is a name."""
    for text in ("5 degC", "5 degrees C", "5degC"):
        _, _, error = said(tmp_path, "calibrate", "--at", text, "a.tif", "b.tif", "-o", "x.zarr")
        assert f"Invalid temperature '{text}'. Must be a number, with a decimal point" in error
    line = refused(tmp_path, "calibrate", "--at", "5C", "25.csq", "25.tif", "-o", "x.zarr")
    assert "No file or folder '25.csq'" in line


def test_a_deleted_folder_is_named(tmp_path: Path) -> None:
    """The system gives no name for the folder that a command was started in, and that is gone."""
    (tmp_path / "gone").mkdir()
    answer = run(tmp_path / "gone", "demo", "out", before="import os; os.rmdir(os.getcwd()); ")
    assert answer.returncode == 1
    assert "No file or folder '. (current folder)'. Must exist." in answer.stderr


def test_a_material_named_twice_is_planned_once(tmp_path: Path) -> None:
    """Its numbers are those of the material named once."""
    command = ["plan", "--noise", "0.03"]
    assert done(tmp_path, *command, "water", "water") == done(tmp_path, *command, "water")


def test_a_warning_is_said_once(results: Path) -> None:
    """A border in the files of every temperature is one line for each band."""
    for name in ("a5", "b5", "a70", "b70"):
        stack = np.pad(tifffile.imread(results / f"{name}.tif"), ((0, 0), (3, 0), (0, 0)))
        tifffile.imwrite(results / f"padded_{name}.tif", stack, photometric="minisblack")
    at = "calibrate --at 5C padded_a5.tif padded_b5.tif --at 70C padded_a70.tif padded_b70.tif"
    _, _, error = said(results, *at.split(), *STATED, "-o", "border.zarr", action="always")
    assert error.count("Warning: Rows (3), columns (0) of band") == 2


def test_bash_completes_commands_and_options(tmp_path: Path) -> None:
    """Bash takes the completion over, and completes a command and an option of one."""
    (tmp_path / "completion").write_text(run(tmp_path, "completion").stdout, encoding="utf-8")
    for typed, completed in ((["al"], "align"), (["align", "--ref"], "--reference")):
        words = f"COMP_WORDS=(dbthermal {' '.join(typed)}); COMP_CWORD={len(typed)}"
        code = f"source completion; {words}; _dbthermal; echo ${{COMPREPLY[@]}}"
        command = ["bash", "-c", code]
        found = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        assert found.stdout.split() == [completed]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_examples(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The help of every command has examples that the parser takes."""
    with pytest.raises(SystemExit, match="0"):
        command_line.main([name, "--help"])
    lines = re.findall(r"(?m)^  dbthermal (.*)$", capsys.readouterr().out.partition("examples:")[2])
    assert lines
    for line in lines:
        assert command_line._parser().parse_args(shlex.split(line)).command == name


def test_help_is_quick_and_the_script_declared() -> None:
    """`dbthermal --help` imports nothing heavy."""
    assert said(ROOT, "--version") == (0, f"dbthermal {__version__}\n", "")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["scripts"] == {"dbthermal": "dbthermal.__main__:main"}
    loaded = "{'numpy', 'scipy', 'xarray', 'zarr', 'tqdm'} & {*sys.modules}"
    code = f"import sys, dbthermal.__main__ as m; m._parser(); sys.exit(bool({loaded}))"
    assert subprocess.run([sys.executable, "-c", code], check=False, cwd=ROOT).returncode == 0
