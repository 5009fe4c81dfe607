"""The documentation site: its pages are there, its links lead somewhere, it asks for no network."""

import ast
import importlib.util
import inspect
import json
import re
import shlex
import shutil
import subprocess
import sys
from fnmatch import fnmatchcase
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from test_surface import MODULES

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
FORMULAS = "api/dbthermal.limits"
FORMULA = re.compile(r":math:`([^`]+)`|\.\. math::((?:.*(?:\n\n? +.*)*))")
BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")


def load(name: str) -> ModuleType:
    """Module of the folder of the site, which is not a package."""
    spec = importlib.util.spec_from_file_location(f"site_{name}", DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


pages = load("pages")


def test_settings_load() -> None:
    """Sphinx can read its settings, and each extension that they name is there."""
    pytest.importorskip("myst_nb", reason="the extra docs, which 'make docs' installs")
    for extension in load("conf").extensions:
        assert importlib.util.find_spec(extension), extension


def test_toctrees_name_pages() -> None:
    """Each entry of a table of contents is a page, and each page is in one, or is the first."""
    entries = {
        re.sub(r".*<(.*)>", r"\1", line)
        for page in DOCS.glob("*.md")
        for block in re.findall(r"```\{toctree\}\n(.*?)```", page.read_text("utf-8"), re.DOTALL)
        for line in block.splitlines()
        if line and not line.startswith(":")
    }
    made = {f"api/{name}" for name in pages.public_modules()}
    made |= {f"notebooks/{path.stem}" for path in pages.NOTEBOOKS}
    there = {path.stem for path in DOCS.glob("*.md")} | made
    held = {page for page in there if any(fnmatchcase(page, entry) for entry in entries)}
    assert held == there - {"index"}
    assert {entry for entry in entries if "*" not in entry} <= there


@pytest.mark.parametrize("name", MODULES)
def test_public_names_are_on_a_page(name: str) -> None:
    """All that a public module exports is on its page, by its kind."""
    assert name in pages.public_modules()
    shown = re.findall(r"^\.\. auto(\w+):: (\S+)$", pages.of_module(name), re.MULTILINE)
    public = {each: getattr(MODULES[name], each) for each in MODULES[name].__all__}
    expected = {f"{name}.{each}": v for each, v in public.items() if not inspect.ismodule(v)}
    kinds = {each: kind for kind, each in shown if kind not in {"module", "summary"}}
    assert kinds.keys() == expected.keys()
    for each, value in expected.items():
        assert (kinds[each] == "class") == inspect.isclass(value)


def test_formulas_are_drawn() -> None:
    """Every formula of a docstring or of a notebook is one that browsers draw, as MathML."""
    module = "docutils.utils.math.latex2mathml"
    to_mathml = pytest.importorskip(module, reason="the extra docs").tex2mathml
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = json.loads(path.read_text("utf-8"))["cells"]
        prose = "\n\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
        for formula in re.findall(r"\$\$?([^$]+)\$\$?", prose):
            to_mathml(formula.strip())
    for path in sorted((ROOT / "dbthermal").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            text = node.value if isinstance(node, ast.Constant) else None
            plain = inspect.cleandoc(text) if isinstance(text, str) else ""
            for line, block in FORMULA.findall(plain):
                to_mathml((line or block).strip(), as_block=bool(block))


def test_constants_have_their_own_docstring() -> None:
    """A constant that a package takes from a private module is described by what stands there."""
    assert pages.constants("dbthermal.separation")["METHODS"].startswith("Names of the methods")
    assert pages.constants("dbthermal.planck")["SECOND_RADIATION_CONSTANT"]


def test_links_are_followed(tmp_path: Path) -> None:
    """A page or an anchor that is not there is found, and what would be loaded from outside."""
    (tmp_path / "b.html").write_text('<p id="here">', encoding="utf-8")
    good = ('<a href="b.html#here">', '<a href="https://example.org">')
    bad = ('<a href="c.html">', '<a href="b.html#there">', '<img src="c.png">')
    loaded = ('<script src="https://example.org/a.js">', '<link href="//example.org/a.css">')
    for element in (*good, *bad, *loaded):
        (tmp_path / "a.html").write_text(element, encoding="utf-8")
        faults, outside = pages.check_links(tmp_path)
        assert bool(faults) == (element not in good), element
        assert bool(outside) == ("example" in element), element


@pytest.mark.slow
def test_site_is_built_and_needs_no_network(tmp_path: Path) -> None:
    """As `make docs` builds it, it has every public name, and is drawn without network."""
    pytest.importorskip("myst_nb", reason="the extra docs, which 'make docs' installs")
    makefile = (ROOT / "Makefile").read_text("utf-8")
    (command,) = re.findall(r"\ndocs:.*\n\t\$\(python\) (.*) results/docs/html\n", makefile)
    words = [sys.executable, *shlex.split(command), str(tmp_path / "html")]
    built = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    inventory = importlib.import_module("sphinx.util.inventory").InventoryFile
    listed = inventory.loads((tmp_path / "html/objects.inv").read_bytes(), uri="").data.values()
    public = {f"{name}.{each}" for name, module in MODULES.items() for each in module.__all__}
    assert public <= {name for names in listed for name in names}
    if BROWSER is None:
        pytest.skip("no chromium in PATH: the site is not tried in a browser")
    playwright, asked = pytest.importorskip("playwright.sync_api"), []

    def refuse(route: Any) -> None:
        """Note a request that is not for a file."""
        asked.append(route.request.url)
        route.abort()

    with playwright.sync_playwright() as run:
        browser = run.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 390, "height": 844})
        page.route(re.compile("^(?!file:|data:)"), refuse)
        page.on("pageerror", lambda error: asked.append(str(error)))
        for name in ("index", "own_captures", "status", "notebooks/00_quickstart", FORMULAS):
            page.goto(f"{(tmp_path / 'html' / name).as_uri()}.html", wait_until="load")
            assert page.evaluate("document.documentElement.scrollWidth") <= 390, name
            assert not page.locator(".output.stderr").count(), name
            assert page.evaluate("Array.from(document.images).every(i => i.naturalWidth)"), name
        assert page.locator("math").first.bounding_box()["height"] > 5  # [pixel]
        browser.close()
    assert not asked
