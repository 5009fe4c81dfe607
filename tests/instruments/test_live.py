"""The live view shows the state of a recording in one figure, without losing frames."""

import math
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import xarray as xr
from captures import people
from faulty_camera import BANDS
from rig_session import LEVELS, QUICK, from_yaml, rig, scene_text

from dbthermal import schema, simulation
from dbthermal.figures import Panel
from dbthermal.figures import live as draw
from dbthermal.instruments import live, protocols
from dbthermal.instruments.camera import GOOD, Counts, Frame, FrameFlag, Metadata
from dbthermal.instruments.recording import Preview
from dbthermal.separation import Stream
from dbthermal.simulation import Rig

DEGREE = "\N{DEGREE SIGN}C"
RAMP = (5000 + np.arange(384, dtype=np.uint16)).reshape(16, 24)


def frame(
    counts: Counts = RAMP, flags: FrameFlag = GOOD, metadata: Metadata | None = None
) -> Frame:
    """A frame whose clocks do not matter."""
    return Frame(counts, 0.0, 0.0, 0, flags, metadata=metadata)


def preview(
    at: float = 0.0, shown: Frame | None = None, *, ffc: float | None = None, **readings: float
) -> Preview:
    """Preview of a recording of 60 frames/s in one band at a time [s], maybe with its FFC state."""
    last = replace(shown or frame(), host_time=1000 + round(60 * at) / 60)
    totals = {"9.5": {"frames": round(60 * at) + 1, "lost": 2, "refused": 3, "damaged": 4}}
    state = {} if ffc is None else {"ffc 9.5": ffc}
    return Preview(at, {"9.5": last}, totals, {**readings, **state})


def status(*previews: Preview) -> live.Status:
    """Status of the band after the last of the previews."""
    watch = live.Watch()
    for item in previews:
        watch.note(item)
    return watch.status()["9.5"]


def texts(view: live.View) -> list[str]:
    """All texts in the figure of a view except tick labels."""
    figure = view.figure
    assert figure is not None
    below = [axis.get_xlabel() for axis in figure.axes]
    across = [text.get_text() for axis in figure.axes for text in axis.texts]
    return [figure.get_suptitle(), *below, *across, figure.get_supxlabel()]


def test_numbers_of_a_preview() -> None:
    """Totals are handed on, and the ramp's percentiles and ends are found."""
    result = status(preview())
    assert (result.frames, result.lost, result.refused, result.damaged) == (1, 2, 3, 4)
    assert (result.lowest, result.highest, result.dead, result.saturated) == (5000, 5383, 0, 0)
    expected = np.percentile(RAMP[::4, ::4], (1.0, 99.0))
    np.testing.assert_allclose(result.limits, expected, rtol=0, atol=1e-9)
    assert math.isnan(result.frame_rate)


def test_frame_rate_is_that_of_the_last_seconds() -> None:
    """The frame rate is over the last seconds of arrival times, and 0 without a frame in them."""
    running = [preview(at) for at in np.arange(0.0, 10.1, 0.5)]
    late = [replace(item, time=item.time + 0.4 * math.sin(item.time)) for item in running]
    stopped = [replace(running[-1], time=at) for at in (11.0, 12.0, 13.0)]
    for sample in (running, late, running + stopped[:2]):
        np.testing.assert_allclose(status(*sample).frame_rate, 60.0, rtol=0, atol=1e-9)
    slower = replace(running[-1].frames["9.5"], host_time=1012.0)
    half = replace(running[-1], time=12.0, frames={"9.5": slower})
    np.testing.assert_allclose(status(*running, half).frame_rate, 20.0, rtol=0, atol=1e-9)
    assert status(*running, *stopped).frame_rate == 0
    assert status(*running, *stopped).warning == "no new frames come"


def test_another_recording_begins_anew() -> None:
    """A time that goes back, fewer frames or other bands are another recording."""
    watch = live.Watch()
    first, reset = preview(5.0), {"11": dict.fromkeys(("frames", "lost", "refused", "damaged"), 0)}
    assert watch.status() == {}
    assert [watch.note(item) for item in (first, preview(6.0), preview(0.1))] == [True, False, True]
    assert math.isnan(watch.status()["9.5"].frame_rate)
    assert watch.note(replace(preview(0.0), time=7.0))
    assert watch.note(Preview(8.0, {}, reset, {}))
    assert watch.status()["11"].warning == "no frame has come"


CLOSED = frame(flags=FrameFlag.SHUTTER_CLOSED)
STATES = ("none performed", "imminent", "in progress", "complete")


@pytest.mark.parametrize(
    ("sample", "state"),
    [
        *((preview(ffc=float(number)), name) for number, name in enumerate(STATES)),
        (preview(ffc=math.nan), "no answer"),
        (preview(ffc=7.0), "state 7"),
        # A closed shutter is a correction, though the camera's answer is older or late.
        (preview(shown=CLOSED), "in progress"),
        (preview(shown=CLOSED, ffc=3.0), "in progress"),
        (preview(), "unknown"),
    ],
)
def test_state_of_the_correction(sample: Preview, state: str) -> None:
    """Known states have a name, unknown ones a number, failed readings "no answer"."""
    assert status(sample).ffc == state
    assert ("shutter closed: FFC" in status(sample).warning) is (state == "in progress")


def test_time_since_the_last_correction() -> None:
    """The time counts from the last correction in the readings or in the telemetry."""
    replies = [preview(at, ffc=state) for at, state in ((1.0, 3.0), (2.0, 2.0), (5.5, 3.0))]
    assert math.isnan(status(replies[0]).ffc_age)
    assert status(*replies).ffc_age == 3.5
    report = [
        preview(at, frame(metadata=Metadata(last_ffc_frame=number)))
        for at, number in ((1.0, 10), (2.0, 10), (3.0, 130), (7.0, 130))
    ]
    assert math.isnan(status(*report[:2]).ffc_age)
    assert status(*report).ffc_age == 4.0


def test_camera_temperature() -> None:
    """The reading counts, without an answer the telemetry, but not that of a damaged frame."""
    report = preview(shown=frame(metadata=Metadata(fpa_temperature=311.2)))
    for reading, temperature in ((308.15, 308.15), (math.nan, 311.2)):
        result = status(replace(report, readings={"fpa 9.5": reading}))
        np.testing.assert_allclose(result.fpa_temperature, temperature, rtol=0, atol=1e-9)
    damaged = frame(flags=FrameFlag.WRONG_SIZE)
    assert math.isnan(status(preview(shown=damaged)).fpa_temperature)


@pytest.mark.parametrize(
    ("value", "pixels", "warning"),
    [
        (0, 4, "1.0 % of the pixels at 0: dead"),
        (65535, 96, "25.0 % of the pixels at 65535: saturated"),
        (65535, 3, ""),
        (65534, 96, ""),
        (10_000, 384, "every pixel at 10000: nothing is seen"),
    ],
)
def test_bad_pictures_are_told(value: int, pixels: int, warning: str) -> None:
    """Saturation of more than one pixel in a hundred, and a uniform frame, give a warning."""
    counts = RAMP.copy()
    counts.flat[:pixels] = value
    assert status(preview(shown=frame(counts))).warning == warning


def test_title_and_readings() -> None:
    """An emulated rig is marked; readings have degrees Celsius, their unit, or no answer."""
    named = {"plate": 303.15, "air": 40.0, "room": math.nan, "ffc 11": 3.0, "fpa 9.5": 308.15}
    for is_simulated, title in ((True, "pot (emulated), 2.0 s"), (False, "pot, 2.0 s")):
        view = live.View(title="pot", is_simulated=is_simulated)
        view(replace(preview(2.0), readings=named, units={"air": "%"}))
        assert texts(view)[0] == title
        assert texts(view)[-1] == f"plate 30.0 {DEGREE}, air 40 %, room no answer, ffc 11 complete"


def test_pictures_of_the_bands() -> None:
    """Each band has its last counts between their percentiles, or none with a warning."""
    display = Mock()
    view = live.View(display, is_simulated=True)
    view(preview(2.0, frame(RAMP + 100)))
    assert view.figure is not None
    image = view.figure.axes[0].images[0]
    np.testing.assert_array_equal(image.get_array(), RAMP + 100)
    np.testing.assert_allclose(image.get_clim(), view.status["9.5"].limits, rtol=0, atol=1e-9)
    totals = dict.fromkeys(BANDS, preview().totals["9.5"])
    totals["9.5"] = dict.fromkeys(totals["9.5"], 0)
    view(Preview(0.0, {"8-14": frame()}, totals, {}))
    shown = view.figure.axes[1].images[0].get_array()
    assert np.isnan(np.asarray(shown, dtype=float)).all()
    assert texts(view)[-2] == "no frame has come"
    assert (display.display.call_count, display.update.call_count) == (1, 1)


def test_updates_keep_the_period() -> None:
    """A PNG and words for a terminal come at most once a period, or for another recording."""
    display, shown = Mock(), []
    view = live.View(display, title="pot", is_simulated=True)
    for at in (0.0, 0.4, 0.9, 1.0, 1.9, 2.1, 0.3, 0.5):
        before = len(display.method_calls)
        view(preview(at, plate=303.15))
        shown += [at] * (len(display.method_calls) - before)
    assert shown == [0.0, 1.0, 2.1, 0.3]
    view(replace(preview(0.1), frames={}))
    view(preview(0.2))
    assert "2 lost" in display.update.call_args[0][0]["text/plain"]
    assert display.update.call_count == 4
    assert display.update.call_args.kwargs == {"raw": True}
    formats = display.display.call_args[0][0]
    assert formats["image/png"].startswith(b"\x89PNG\r\n")
    assert formats["text/plain"].startswith("pot (emulated), 0.0 s\n9.5: - frames/s, 2 lost")
    assert formats["text/plain"].endswith(f"plate 30.0 {DEGREE}")


def test_labels_and_room() -> None:
    """Colour bars have their unit, and no text lies on another or outside, however long it is."""
    image = np.zeros((512, 640), np.uint16)
    empty, full = Panel(image, (0.0, 1.0), "one"), Panel(image, (20_000.0, 60_000.0), "one\ntwo")
    for panel, foot in ((empty, ""), (full, "plate 30.0"), (full, "plate 30.0, " * 40)):
        figure = draw(dict.fromkeys(BANDS, panel), title="pot", foot=foot)
        figure.draw_without_rendering()
        axes = figure.axes
        title, foot_box = (text.get_window_extent() for text in figure.texts)
        assert title.y0 > max(axis.title.get_window_extent().y1 for axis in axes[:2])
        assert foot_box.y1 < min(axis.xaxis.label.get_window_extent().y0 for axis in axes[:2])
        outer = figure.get_tightbbox()
        assert min(outer.x0, outer.y0) >= 0
        assert outer.x1 <= figure.get_figwidth()
        assert [axis.get_ylabel() for axis in axes[2:]] == ["raw signal [count]"] * 2


def test_a_separation_is_shown_beside_the_frames() -> None:
    """Previews of both bands go through the correction into a stream; what is known is drawn."""
    rig, rng, rate = Rig(), np.random.default_rng(1), 10.0
    scene, capture = people(rng, 150, (12, 16))
    detector = simulation.pattern(rig, (12, 16), rng)
    raw = simulation.capture(capture, detector)["counts"]
    gain = 1.0 / detector["gain"]
    dead = detector["dead"].any("band") * np.uint32(schema.Status.DEAD_PIXEL)
    template = capture.isel(time=[0]).assign(status=dead.astype(np.uint32))
    stream = Stream(template, rig.response(), frame_rate=rate, refresh=2.0)
    correction = xr.Dataset({"gain": gain, "offset": -detector["offset"] * gain})
    separation = live.Separation(stream, correction)
    view = live.View(is_simulated=True, separation=separation)
    for number, at in enumerate(capture["time"].values):
        images = {str(band): frame(raw.sel(band=band).values[number]) for band in rig.bands}
        frames = {band: replace(image, host_time=100.0 + at) for band, image in images.items()}
        totals = {"frames": number, "lost": 0, "refused": 0, "damaged": 0}
        shown = Preview(float(at), frames, dict.fromkeys(frames, totals), {})
        view(shown)
        separation(shown)  # the same frames once more are left out
        assert stream.is_ready or "not known yet" in texts(view)
        closed = {
            band: replace(item, host_time=100.01 + at, flags=FrameFlag.SHUTTER_CLOSED)
            for band, item in frames.items()
        }
        separation(replace(shown, frames=closed))
    assert stream.lost_frames == 0
    result = stream.result()
    truth = scene.sel(time=result["time"].values - 100.0, method="nearest")
    error = result["object_temperature"].values - truth["object_temperature"].values
    off = float(np.median(abs(error[:, result["status"].values == 0])))
    assert off < 0.3  # K
    assert any("of the pixels without a flag" in text for text in texts(view))
    assert view.figure is not None
    titles = [axis.get_title() for axis in view.figure.axes]
    assert titles[2:4] == ["object", "background"]
    low, high = view.figure.axes[2].images[0].get_clim()
    assert 20 < low < high < 65  # degrees Celsius


def test_recording_without_a_notebook(tmp_path: Path) -> None:
    """Two emulated cameras are watched from within a recording, each by its own frames."""
    view = live.View(title="test", is_simulated=True)
    with rig(from_yaml(scene_text().replace("0.15", "1.5")), prepared=True) as devices:
        protocols.record_scene(devices, tmp_path / "a.zarr", limits=QUICK, preview=view)
    for band, sample in view.status.items():
        assert (sample.lowest, sample.highest) == (LEVELS[band] + 2962, LEVELS[band] + 2963)
        np.testing.assert_allclose(sample.fpa_temperature, 308.15, rtol=0, atol=0.06)
        assert (sample.ffc, sample.lost) == ("complete", 0)
    assert texts(view)[-1].startswith(f"blackbody 23.0 {DEGREE}, plate 56.9 {DEGREE}")
