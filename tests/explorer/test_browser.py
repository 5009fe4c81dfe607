"""The explorer in a real JupyterLab and browser: keys, pointer and pixels, the network refused.

Skipped where there is no chromium.
"""

import os
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.request import urlopen

import nbformat
import numpy as np
import pytest
import xarray as xr
from captures import FILMS, GLASS, RIG, people
from PIL import Image

from dbthermal import separation, simulation, store
from dbthermal.explorer import Region, View
from dbthermal.response import counts as counts_of

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)
sync_api = pytest.importorskip("playwright.sync_api", reason="no Playwright (extra 'test')")
pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no chromium in PATH: the explorer is not tried in a browser"
)
ROOT = Path(__file__).parents[2]
CELL = """import dbthermal
explorer = dbthermal.explore({arguments})
explorer"""


EXPLORER = "document.querySelector('[data-testid=explorer]').explorer"
STEPS = """async () => {
    const explorer = document.querySelector('[data-testid=explorer]').explorer, times = [];
    for (let i = 1; i <= 60; i++) {
        const [begin, index] = [performance.now(), (i * 7) % 350];
        explorer.goTo(index);
        while (explorer.drawn !== index) await new Promise((done) => setTimeout(done, 1));
        times.push(performance.now() - begin);
    }
    return [explorer.shown.length, times];
}"""


SIDES = """async (level) => {
    const explorer = document.querySelector('[data-testid=explorer]').explorer;
    const picture = explorer.pictures.get('object_temperature');
    explorer.setIsotherm(level);
    for (let i = 0; !picture.sides; i++) {
        if (i > 600) throw new Error(explorer.message.textContent);
        await new Promise((done) => setTimeout(done, 5));
    }
    return Array.from(picture.sides);
}"""

BEYOND = f"{EXPLORER}.plot.getContext('2d').getImageData(70, 0, 300, 11).data.some(Boolean)"


class Lab:
    """JupyterLab on a free port in a folder, and a page of a browser that reaches nothing else."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.outside, self.errors = folder, list[str](), list[str]()
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.address = f"http://127.0.0.1:{free.getsockname()[1]}"
        settings = {
            "ServerApp.ip": "127.0.0.1",
            "ServerApp.port": self.address.rpartition(":")[2],
            "ServerApp.root_dir": str(folder),
            "IdentityProvider.token": "",
            "LabApp.expose_app_in_browser": "True",
            "LabApp.news_url": "",
            "LabApp.check_for_updates_class": "jupyterlab.NeverCheckForUpdate",
        }
        options = [f"--{name}={value}" for name, value in settings.items()]
        command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root", *options]
        own = {"JUPYTER_CONFIG_DIR": str(folder / "config"), "JUPYTER_RUNTIME_DIR": str(folder)}
        environment = {**os.environ, **own, "PYTHONPATH": str(ROOT), "HOME": str(folder)}
        environment.pop("PYTHONWARNINGS", None)
        with (folder / "lab.log").open("w") as log:
            self.server = subprocess.Popen(
                command, env=environment, stdout=log, stderr=log, cwd=folder
            )

    def await_answer(self) -> None:
        """Return when the server answers."""
        for _ in range(240):
            assert self.server.poll() is None, (self.folder / "lab.log").read_text()
            try:
                with urlopen(f"{self.address}/api/status", timeout=2):
                    return
            except (URLError, TimeoutError):
                time.sleep(0.25)
        raise TimeoutError((self.folder / "lab.log").read_text())

    def admit(self, route: Any) -> None:
        """Let requests to the server through, and refuse and note all others."""
        if route.request.url.startswith((self.address, "data:", "blob:")):
            route.continue_()
        else:
            self.outside.append(route.request.url)
            route.abort()

    def run(self, page: Any, *cells: str) -> None:
        """Open a notebook of some cells and run it until the explorer has drawn a frame."""
        notebook = nbformat.v4.new_notebook(
            cells=[nbformat.v4.new_code_cell(cell) for cell in cells],
            metadata={"kernelspec": {"name": "python3", "display_name": "Python 3"}},
        )
        nbformat.write(notebook, self.folder / "explore.ipynb")
        page.goto(f"{self.address}/lab/tree/explore.ipynb?reset")
        page.wait_for_selector(".jp-Notebook .cm-content")
        page.wait_for_function(
            "jupyterapp.shell.currentWidget?.sessionContext?.session?.kernel?.status === 'idle'"
        )
        page.evaluate("jupyterapp.commands.execute('notebook:run-all-cells')")
        page.wait_for_function(
            "document.querySelector('[data-testid=explorer]')?.explorer?.drawn >= 0", timeout=60_000
        )


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    """Server that ends with the module."""
    lab = Lab(tmp_path_factory.mktemp("lab"))
    try:
        lab.await_answer()
        yield lab
    finally:
        lab.server.terminate()
        lab.server.wait(30)


@pytest.fixture
def page(lab: Lab) -> Iterator[Any]:
    """Page of a browser, of which requests and errors are noted."""
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1500, "height": 1300})
        page.set_default_timeout(120_000)
        page.route("**/*", lab.admit)
        page.on("pageerror", lambda error: lab.errors.append(str(error)))
        yield page
        browser.close()


def drag(page: Any, canvas: Any, start: tuple[float, float], stop: tuple[float, float]) -> None:
    """Drag the pointer from one place of a picture to another one, as shares of its size."""
    box = canvas.bounding_box()
    (x0, y0), (x1, y1) = (
        (box["x"] + across * box["width"], box["y"] + down * box["height"])
        for across, down in (start, stop)
    )
    page.mouse.move(x0, y0)
    page.mouse.down()
    page.mouse.move((x0 + x1) / 2, (y0 + y1) / 2)
    page.mouse.move(x1, y1)
    page.mouse.up()


def read_curve(page: Any, name: str) -> np.ndarray:
    """Mean, least, greatest value and deviation (4, time) of a region, as the page has them."""
    page.wait_for_function(
        "name => { const e = document.querySelector('[data-testid=explorer]').explorer;"
        " return e.curves.has(name) && !e.link.busy && !e.link.wanted.size }",
        arg=name,
    )
    values = page.evaluate(
        "name => Array.from(document.querySelector('[data-testid=explorer]').explorer"
        ".curves.get(name).values, (one) => (Number.isFinite(one) ? one : null))",
        name,
    )
    return np.array(values, dtype=np.float64).reshape(4, -1)


def region_of(page: Any, name: str) -> Region:
    """Region as the page has it."""
    kind, points = page.evaluate(
        "name => { const r = document.querySelector('[data-testid=explorer]').explorer"
        ".regions.get(name); return [r.kind, r.points] }",
        name,
    )
    return Region(kind, tuple(map(tuple, points)))


def check_curve(page: Any, view: View, name: str) -> Region:
    """The curve in the page is that of the view, rounded to float32."""
    region = region_of(page, name)
    curve = view.curve("object_temperature", region)
    expected = [curve[part].values for part in ("mean", "minimum", "maximum", "std")]
    np.testing.assert_allclose(read_curve(page, name), expected, rtol=0, atol=5e-5)  # [K]
    return region


def check_tools(page: Any, view: View, region: Region, index: int) -> None:
    """Profile, hottest and coldest pixel, difference of two regions, undo and Delete at a frame."""
    canvas = page.locator("canvas[data-pane=object_temperature]")
    frame = view.frame("object_temperature", index)
    page.locator("[data-tool=line]").click()
    drag(page, canvas, (0.02, 0.52), (0.98, 0.52))
    page.wait_for_function(f"{EXPLORER}.profile?.length > 25")
    profile = np.float32(page.evaluate(f"Array.from({EXPLORER}.profile)"))
    assert np.isin(profile, frame[12]).all()
    spots = page.evaluate(f"{EXPLORER}.pictures.get('object_temperature').spots")
    measured = np.where(view.counted("measured"), frame, np.nan)
    expected = [np.nanmin(measured), np.nanmax(measured)]
    np.testing.assert_allclose([value for *_, value in spots], expected, rtol=0, atol=1e-4)  # [K]
    # All films less the frame of reference, and back.
    page.locator("[data-testid=time]").focus()
    for key in ("r", "Shift+ArrowRight"):
        page.keyboard.press(key)
    page.wait_for_function(f"{EXPLORER}.drawn === {index + 10} && !{EXPLORER}.link.busy")
    rise = view.frame("object_temperature", index + 10) - frame
    measured = np.where(view.counted("measured"), rise, np.nan)
    spots = page.evaluate(f"{EXPLORER}.pictures.get('object_temperature').spots")
    expected = [np.nanmin(measured), np.nanmax(measured)]
    np.testing.assert_allclose([value for *_, value in spots], expected, rtol=0, atol=1e-4)  # [K]
    titles = page.locator(".dbt-title").all_inner_texts()
    assert f"Object temperature, less that at {view.time[index]:.2f} s" in titles
    for key in ("r", "Shift+ArrowLeft"):
        page.keyboard.press(key)
    page.wait_for_function(f"{EXPLORER}.drawn === {index} && !{EXPLORER}.link.busy")
    # An animated picture of all films.
    with page.expect_download() as download:
        page.get_by_role("button", name="GIF").click()
    with Image.open(download.value.path()) as film:
        assert film.n_frames == view.time.size  # type: ignore[attr-defined]
    # The interval of an emissivity lies within the axes.
    titles = page.locator(".dbt-title:enabled")
    titles.get_by_text("9.5 \N{MICRO SIGN}m emissivity").click()
    page.wait_for_function(
        f"{EXPLORER}.plotted.name === 'emissivity 9.5' && !{EXPLORER}.changed.size"
    )
    assert not page.evaluate(BEYOND)
    titles.get_by_text("Object temperature", exact=True).click()
    # A second region, less the first.
    page.locator("[data-tool=rectangle]").click()
    drag(page, canvas, (0.7, 0.4), (0.9, 0.8))
    second = check_curve(page, view, "region 2")
    curves = [view.curve("object_temperature", place)["mean"] for place in (region, second)]
    difference = float(curves[1][index] - curves[0][index])  # [K]
    assert f"less region 1: {difference:.2f} K" in page.locator(".dbt-regions").inner_text()
    # Both are removed, and brought back step by step: drawn, moved, drawn, removed, removed.
    for key, left in {"Delete": (1, 0), "Control+z": (1, 2, 1, 1, 0)}.items():
        for number in left:
            page.keyboard.press(key)
            assert page.evaluate(f"{EXPLORER}.regions.size") == number


def check_narrow(page: Any) -> None:
    """In a narrow page all is within; an error is seen, and stays while the pointer moves."""
    page.set_viewport_size({"width": 550, "height": 500})
    explorer, error = page.locator("[data-testid=explorer]"), page.locator(".dbt-wrong")
    assert explorer.evaluate("it => it.scrollWidth <= it.clientWidth")
    page.get_by_role("button", name="CSV").click()
    box = error.bounding_box()
    assert box is not None
    assert 0 < box["y"] < 500 - box["height"]
    page.evaluate(f"{EXPLORER}.probed = null")
    page.locator("canvas[data-pane=object_temperature]").hover()
    page.wait_for_function(f"{EXPLORER}.probed")
    assert "Must have one: draw it first" in error.inner_text()


def test_region_is_dragged_and_its_curve_read_back(lab: Lab, page: Any) -> None:
    """Curves of a drawn and a moved region are the view's; keys step; no request goes outside."""
    response, (_, capture) = RIG.response(), people(4, 120, (24, 32))
    result = separation.solve(capture, response)
    parts = {"result.zarr": result, "capture.zarr": capture, "response.zarr": response}
    for name, part in parts.items():
        store.save(part, lab.folder / name, {})
    lab.run(page, CELL.format(arguments=", ".join(map(repr, parts))))
    view = View(result, capture, response)

    canvas = page.locator("canvas[data-pane=object_temperature]")
    page.locator("[data-tool=ellipse]").click()
    drag(page, canvas, (0.2, 0.2), (0.5, 0.6))
    before = check_curve(page, view, "region 1")
    assert before.mask(view.shape).sum() > 50
    page.locator("[data-tool=move]").click()
    drag(page, canvas, (0.35, 0.4), (0.6, 0.5))
    after = check_curve(page, view, "region 1")
    np.testing.assert_allclose(np.subtract(after.points, before.points)[:, 1], 8.0, atol=0.3)

    slider = page.locator("[data-testid=time]")
    start = int(slider.input_value())
    slider.focus()
    for key in ("ArrowRight", "ArrowRight", "ArrowLeft", "Shift+ArrowRight"):
        page.keyboard.press(key)
    page.wait_for_function(f"{EXPLORER}.drawn === {start + 11}")
    assert int(slider.input_value()) == start + 11
    frame = view.frame("object_temperature", start + 11)
    level = float(np.nanmedian(frame))
    sides = np.reshape(page.evaluate(SIDES, level - 273.15), view.shape)
    np.testing.assert_array_equal(sides, np.where(np.isnan(frame), 0, 1 + (frame > level)))
    check_tools(page, view, after, start + 11)
    if folder := os.environ.get("DBTHERMAL_SCREENSHOTS"):
        page.locator("[data-testid=explorer]").screenshot(path=f"{folder}/explorer.png")
    check_narrow(page)
    assert (lab.outside, lab.errors) == ([], [])


def large_store(folder: Path, shape: tuple[int, int, int]) -> None:
    """Result and capture of a size (time, y, x), of smooth films with noise, row by row."""
    frames, height, width = shape
    rng, response = np.random.default_rng(2), simulation.Rig().response()
    time, columns = np.arange(frames) / 30, np.linspace(0, 20, width)
    film = 295 + np.linspace(0, 10, frames)[:, None, None] + columns + np.zeros((1, 16, 1))
    maps = GLASS.expand_dims(y=16, x=width).transpose("band", "y", "x")

    def results() -> Iterator[xr.Dataset]:
        for _ in range(0, height, 16):
            noisy = (film + rng.normal(0, 0.1, film.shape)).astype(np.float32)
            films = dict.fromkeys(FILMS, noisy) | {f"{name}_std": noisy / 3000 for name in FILMS}
            arrays = {name: (("time", "y", "x"), one) for name, one in films.items()}
            status = ("y", "x"), np.zeros((16, width), np.uint32)
            yield xr.Dataset({**arrays, "status": status}, {"time": time}).assign(emissivity=maps)

    def captured() -> Iterator[xr.Dataset]:
        for part in results():
            counts = counts_of(response, part["object_temperature"])
            yield counts.astype(np.float32).to_dataset(name="counts")

    store.save_rows(results(), folder / "large.zarr", {})
    store.save_rows(captured(), folder / "large_capture.zarr", {})
    store.save(response, folder / "large_response.zarr", {})


@pytest.mark.bench
@pytest.mark.parametrize("inputs", [False, True], ids=["result", "result and capture"])
def test_step_of_a_large_store(
    lab: Lab, page: Any, inputs: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    """A step on 640 x 512 pixels and 350 frames from zarr takes 100 ms at most, in the median."""
    if not (lab.folder / "large_response.zarr").exists():
        large_store(lab.folder, (350, 512, 640))
    names = ["large.zarr", "large_capture.zarr", "large_response.zarr"][: 3 if inputs else 1]
    begin = time.perf_counter()
    lab.run(page, CELL.format(arguments=", ".join(map(repr, names))))
    opened = time.perf_counter() - begin
    panes, times = page.evaluate(STEPS)
    median, high = np.percentile(times, [50, 95])
    (kernel,) = (
        (Path("/proc") / f"{lab.server.pid}/task/{lab.server.pid}/children").read_text().split()
    )
    memory = re.findall(r"Rss(?:Anon|File):.*", Path(f"/proc/{kernel}/status").read_text())
    load = os.getloadavg()[0]
    with capsys.disabled():
        print(f"\n{panes} pictures: median {median:.0f} ms, 95 % {high:.0f} ms, load {load:.1f}")
        print(f"opened in {opened:.0f} s; kernel: {', '.join(memory)}")
    if median >= 100 and load > (os.cpu_count() or 1):
        pytest.skip(f"the machine is loaded: {load:.1f}")
    assert median < 100
