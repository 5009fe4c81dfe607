"""The report: its numbers against closed forms, hostile words, and the page in a browser."""

import base64
import json
import re
import shutil
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import xarray as xr
from captures import plain_capture

import dbthermal
from dbthermal import schema, store
from dbthermal.explorer import Region
from dbthermal.schema import Status

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)
COLORS = """() => {{
    const canvas = document.querySelector('[data-part={part}]');
    const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
    return new Set(new Uint32Array(data.buffer)).size;
}}"""
WIDTH = "document.querySelector('{part}').getBoundingClientRect().width"
HOSTILE = "</script><script>document.title = 'taken'</script><img src=x onerror=alert(1)>"


def scene(**attrs: Any) -> xr.Dataset:
    """Simulated result: glass that warms by 1 K/s from 300 K; a dead pixel, some of a material."""
    time, shape = np.arange(20) / 4.0, (12, 16)
    film = np.broadcast_to(300.0 + time[:, None, None], (20, *shape)).astype(np.float32).copy()
    film[:, 0, 0] = np.nan
    status = np.zeros(shape, np.uint32)
    status[0, 0] = Status.DEAD_PIXEL
    status[1, :8] = Status.COMPLETED_FROM_MATERIAL
    pair = np.array([0.861, 0.718])[:, None, None]
    movie, image, bands = ("time", "y", "x"), ("y", "x"), ("band", "y", "x")
    parts = {
        "object_temperature": (movie, film),
        "object_temperature_std": (movie, np.full_like(film, 0.03)),
        "background_temperature": (movie, np.full_like(film, 295.0)),
        "emissivity": (bands, np.broadcast_to(pair, (2, *shape)).copy()),
        "emissivity_std": (bands, np.full((2, *shape), 0.004)),
        "status": (image, status, Status.cf_attrs(schema.STATUS)),
    }
    attributes = {"origin": "simulated", "method": "subspace", **attrs}
    return xr.Dataset(parts, {"time": time, "band": ["8-14", "9.5"]}, attributes)


def numbers(page: str) -> dict[str, Any]:
    """Numbers that a page holds."""
    (text,) = re.findall(r'<script type="application/json" id="numbers">(.*?)</script>', page)
    found: dict[str, Any] = json.loads(text)
    return found


def test_numbers_are_those_of_the_scene(tmp_path: Path) -> None:
    """Shares, the mean over time of a warming of 1 K/s, and the material that was put in."""
    regions = {"corner": Region("rectangle", ((0, 0), (2, 4)))}
    dbthermal.report(scene(), tmp_path / "a" / "scene.html", regions=regions)
    page = (tmp_path / "a" / "scene.html").read_text("utf-8")
    found = numbers(page)
    assert found["scene"] == {"rows": 12, "columns": 16, "frames": 20, "duration_s": 4.75}
    assert found["validity"]["no_flag"] == pytest.approx(1 - 9 / 192)
    assert found["validity"]["completed"] == pytest.approx(8 / 192)
    assert found["validity"]["without_value"] == found["validity"]["dead_pixel"]
    corner = found["regions"]["corner"]
    assert corner["object_temperature"]["mean"] == pytest.approx(300 + 4.75 / 2, abs=1e-4)
    assert corner["emissivity"]["9.5"] == pytest.approx(0.718)
    assert corner["nearest"][0]["material"] == "plate window glass"
    assert "plate window glass" in page
    assert ">simulated<" in page
    sources = re.findall(r'(?:src|href)="([^"]{0,40})', page)  # all of the page is in it
    assert sources
    assert all(one.startswith(("data:", "#")) for one in sources)


def test_the_answer_of_a_black_body_and_of_flagged_pixels(tmp_path: Path) -> None:
    """What a method assumes stands beside the share; flagged pixels are not completed."""
    data = scene(method="apparent")
    data["status"].values[:] = schema.Status.GRAY
    dbthermal.report(data, tmp_path / "scene.html")
    head = (tmp_path / "scene.html").read_text("utf-8").partition("<h2")[0]
    assert "Object, flagged and not measured, from " in head
    assert "Measured, as of a black body: 0% of the pixels; completed, not measured: 0%." in head


def test_the_answer_and_the_author_come_first(tmp_path: Path) -> None:
    """How hot, how sure, how much, and emissivities of two materials each by its own pixels."""
    data = scene(source="a.tif and b.tif")
    data["emissivity"].values[:, :, 8:] = np.array([0.928, 0.871])[:, None, None]
    dbthermal.report(data, tmp_path / "scene.html", title="Wall", author="A. Tester")
    page = (tmp_path / "scene.html").read_text("utf-8")
    head = page.partition("<h2")[0]
    assert "A. Tester, a.tif and b.tif" in head
    assert "Object from 26.9 to 31.6 \N{DEGREE SIGN}C (98 % of the values), typically" in head
    assert "\N{PLUS-MINUS SIGN}\N{NO-BREAK SPACE}0.03 K" in head
    assert "Measured: 95% of the pixels; completed, not measured: 4%." in head
    found = numbers(page)["answer"]
    assert found["measured"] == pytest.approx(1 - 9 / 192)
    materials = {entry["nearest"][0]["material"]: entry for entry in found["materials"]}
    assert materials["construction concrete"]["pixels"] == 96
    assert materials["plate window glass"]["pixels"] == 87
    assert materials["plate window glass"]["emissivity"]["9.5"] == pytest.approx(0.718)
    assert "96 pixels alike" in page
    assert "construction concrete (0.0)" in page


def test_materials_in_one_line_differ_by_its_deviation(tmp_path: Path) -> None:
    """Two labels that are like the same material of the table widen the deviation of its line."""
    data = scene()
    data["emissivity"].values[1, :, 8:] += 0.03
    deviations = []
    for labels in (np.zeros((12, 16)), np.tile(np.arange(16) // 8, (12, 1))):
        data["material"] = ("y", "x"), labels.astype(np.int32)
        dbthermal.report(data, tmp_path / "scene.html")
        (line,) = numbers((tmp_path / "scene.html").read_text("utf-8"))["answer"]["materials"]
        deviations.append([*line["emissivity_std"].values()])
    first, second = np.sqrt(np.diff(np.square(deviations), axis=0)[0])
    assert first == pytest.approx(0.0, abs=1e-9)
    assert second == pytest.approx(0.015, rel=0.01)


def test_a_logo_is_in_the_page(tmp_path: Path) -> None:
    """A PNG stands beside the heading; any other file, or a large one, is refused by name."""
    png = b"\x89PNG\r\n\x1a\n" + b"picture"
    (tmp_path / "logo.png").write_bytes(png)
    dbthermal.report(scene(), tmp_path / "scene.html", logo=tmp_path / "logo.png")
    head = (tmp_path / "scene.html").read_text("utf-8").partition("<h1>")[0]
    assert f'src="data:image/png;base64,{base64.b64encode(png).decode()}"' in head
    for content, rule in ((b"<svg/>", "Must be a PNG"), (png * 99999, "Must be at most 1048576")):
        (tmp_path / "logo.png").write_bytes(content)
        with pytest.raises(ValueError, match=rf"logo\.png'.*{rule}"):
            dbthermal.report(scene(), tmp_path / "no.html", logo=tmp_path / "logo.png")


def test_only_measured_pixels_count(tmp_path: Path) -> None:
    """Completed emissivities, far off here, do not enter the mean; what was assumed is listed."""
    calibration = "4 temperatures of 20.00, 40.00, 60.00, 85.00 degC"
    data = scene(blackbody=calibration, reflection_shift="given", time_offset=[0.0, 0.25])
    data["reflection_shift"] = ("axis", "y", "x"), np.full((2, 12, 16), [[[0.0]], [[3.0]]])
    data["emissivity"].values[:, 1, :8] = 0.99
    data.attrs["warnings"] = ["Fixed pattern of 100."]
    dbthermal.report(data, tmp_path / "scene.html")
    page = (tmp_path / "scene.html").read_text("utf-8")
    found = numbers(page)["regions"]["measured pixels of the whole image"]
    assert found["emissivity"]["9.5"] == pytest.approx(0.718)
    texts = "<strong>Fixed pattern of 100.</strong>", calibration, "data:image/png"
    for text in (*texts, ">0.00 rows, 3.00 columns<", ">0.0, 0.25<"):
        assert text in page


def test_a_large_scene_fits_into_a_letter(tmp_path: Path) -> None:
    """A report of many pixels and frames of noise, with both inputs, has at most 8 MB."""
    rng = np.random.default_rng(1)
    place = {"time": np.arange(120) // 6, "y": np.arange(120) // 10, "x": np.arange(160) // 10}
    large = scene().isel(place).assign_coords(time=np.arange(120) / 4)
    for name in ("object_temperature", "background_temperature"):
        large[name] = large[name] + rng.normal(0, 0.1, large[name].shape).astype(np.float32)
    counts = rng.normal(20000, 10, (2, 120, 120, 160)) + 5.0 * np.arange(160)
    dbthermal.report(
        large, tmp_path / "scene.html", plain_capture(counts.astype("f4"), large["time"].values)
    )
    assert (tmp_path / "scene.html").stat().st_size < 8e6  # [byte]


def test_same_result_gives_same_bytes(tmp_path: Path) -> None:
    """A result in memory and its store give the same page, twice."""
    store.save(scene(), tmp_path / "scene.zarr", {"commit": "unknown"})
    for name in ("first", "second"):
        dbthermal.report(tmp_path / "scene.zarr", tmp_path / f"{name}.html")
    assert (tmp_path / "first.html").read_bytes() == (tmp_path / "second.html").read_bytes()


def test_the_capture_of_another_recording_is_noticed(tmp_path: Path) -> None:
    """It may have the same frames and pixels; the page and a warning name both sources."""
    result = scene()
    film = result["object_temperature"].expand_dims(band=["8-14", "9.5"]) * 100
    capture = film.assign_attrs(units="count").to_dataset(name="counts")
    path, sources = tmp_path / "a.html", {"source": "a.tif and b.tif"}
    dbthermal.report(result.assign_attrs(sources), path, capture.assign_attrs(sources))
    with pytest.warns(
        UserWarning, match="is of 'a.tif and b.tif', the capture beside it of 'c.tif"
    ):
        dbthermal.report(
            result.assign_attrs(sources), path, capture.assign_attrs(source="c.tif and d.tif")
        )
    assert "capture beside it" in path.read_text("utf-8")


def test_tall_images(tmp_path: Path) -> None:
    """The film and the figures of a row of pixels are not as tall as it is long."""
    values = np.full((3, 640, 1), 300.0)
    film = xr.DataArray(values, {"time": [0.0, 0.1, 0.2]}, ("time", "y", "x"))
    dbthermal.report(film.to_dataset(name="object_temperature"), tmp_path / "a.html")
    assert (tmp_path / "a.html").stat().st_size < 1e6


def test_words_stay_words(tmp_path: Path) -> None:
    """Title, regions, attributes and provenance that hold a program are shown, not run."""
    regions = {HOSTILE: Region("rectangle", ((2, 2), (6, 6)))}
    data = scene(origin=HOSTILE, calibration=HOSTILE, settings="-->" + HOSTILE)
    provenance = {"parameters": {"-->": HOSTILE}}
    path = tmp_path / "scene.html"
    dbthermal.report(data, path, regions=regions, title=HOSTILE, provenance=provenance)
    page = path.read_text("utf-8")
    assert "<script>document.title" not in page
    assert "<img src=x" not in page
    assert "--><" not in page
    assert HOSTILE in numbers(page)["regions"]


def test_bad_input_is_named(tmp_path: Path) -> None:
    """Another ending, and data without a temperature, are refused before anything is written."""
    with pytest.raises(ValueError, match=r"scene\.pdf'\. Must end in '\.html'"):
        dbthermal.report("nothing.zarr", tmp_path / "scene.pdf")  # looked at before the result
    with pytest.raises(ValueError, match="'object_temperature'"):
        dbthermal.report(scene().drop_vars("object_temperature"), tmp_path / "scene.html")
    regions: Any = {"left": (10, 40, 5, 30)}
    with pytest.raises(TypeError, match=r"region 'left', \(10, 40, 5, 30\)\. Must be an explorer"):
        dbthermal.report(scene(), tmp_path / "scene.html", regions=regions)
    with pytest.raises(TypeError, match=r"Invalid path <xarray\.Dataset>.* Must be text or a path"):
        dbthermal.report("scene.html", cast(Any, scene()))
    with pytest.raises(TypeError, match=r"Invalid celsius 'no'\. Must be True"):
        dbthermal.report(scene(), tmp_path / "scene.html", celsius=cast(Any, "no"))
    with pytest.raises(TypeError, match="regions of type list"):
        dbthermal.report(scene(), tmp_path / "scene.html", regions=cast(Any, [*regions]))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium: the report is not tried in a browser")
def test_page_works_without_a_network(tmp_path: Path) -> None:
    """In a browser that reaches nothing: the film is there, a click and a key answer."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="no Playwright (extra 'test')")
    path = tmp_path / "scene.html"
    dbthermal.report(scene(), path, celsius=False)
    errors: list[str] = []
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1100, "height": 900})
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("requestfailed", lambda request: errors.append(request.url[:80]))
        page.context.set_offline(True)
        page.goto(path.as_uri())
        page.wait_for_function("document.querySelector('video').readyState >= 1")
        readout = page.locator("[data-part=readout]")
        assert "302.50 \N{PLUS-MINUS SIGN} 0.03 K" in readout.inner_text()
        page.locator("[data-part=time]").press("End")
        assert "4.75 s" in readout.inner_text()
        page.locator("[data-part=picture]").click(position={"x": 3, "y": 3})
        assert "row 0, column 0: no value" in readout.inner_text()
        assert readout.inner_text().endswith(", flagged")
        page.locator("[data-part=picture]").click(position={"x": 50, "y": 50})  # of row 1
        assert readout.inner_text().endswith(", completed and not measured")
        # The object first, with colours by a bar, and round ticks without -0.0.
        assert page.locator("[data-part=quantity]").input_value() == "object_temperature"
        assert page.evaluate(COLORS.format(part="bar")) > 40
        assert page.evaluate(COLORS.format(part="picture")) > 2
        # A narrow page has no part outside; a printed one has the picture of the film.
        page.set_viewport_size({"width": 390, "height": 844})
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        for part in ("picture", "bar", "curve"):
            box = page.locator(f"[data-part={part}]").bounding_box()
            assert box is not None
            assert box["x"] + box["width"] <= 390
        assert page.evaluate(WIDTH.format(part="figure:not(.film) img")) == 600  # which scrolls
        assert page.locator("table").evaluate_all("all => all.every((it) => it.offsetWidth <= 350)")
        page.emulate_media(media="print")
        assert page.evaluate(WIDTH.format(part="figure:not(.film) img")) <= 390
        paper = (".scroll", "overflowX", "visible"), ("pre", "whiteSpace", "pre-wrap")
        for part, name, value in paper:
            style = f"getComputedStyle(document.querySelector('{part}')).{name}"
            assert page.evaluate(style) == value
        assert page.locator(".film img").is_visible()
        assert not page.locator("video").is_visible()
        browser.close()
    assert errors == []
