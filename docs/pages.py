"""Pages of the site that are made: of each public module, and of each notebook; and its links."""

import ast
import importlib
import inspect
import json
import os
import pkgutil
import re
import shutil
import time
from functools import cache
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from urllib.parse import unquote, urlsplit

import dbthermal

HERE = Path(__file__).parent
RESULTS = HERE.parent / "results" / "full"
NOTEBOOKS = sorted((HERE.parent / "notebooks").glob("[0-9]*.ipynb"))
TOUR = "00_quickstart"


def public_modules() -> list[str]:
    """Names of the modules that a user may import; the emulated devices are for tests."""
    found = pkgutil.walk_packages(dbthermal.__path__, "dbthermal.", onerror=lambda _: None)
    names = [module.name for module in found]
    return ["dbthermal", *(name for name in names if not re.search(r"\.(_|emulated)", name))]


def of_module(name: str) -> str:
    """Page of a module: its own docstring, a table of its public names, and each of them."""
    module = importlib.import_module(name)
    names = [each for each in module.__all__ if not inspect.ismodule(getattr(module, each))]
    title = name.removeprefix("dbthermal.")
    lines = [title, "=" * len(title), "", f".. automodule:: {name}", "", ".. autosummary::"]
    lines += ["   :nosignatures:", "", *(f"   {each}" for each in names), ""]
    for each in names:
        value = getattr(module, each)
        is_class = inspect.isclass(value)
        kind = "class" if is_class else "function" if inspect.isfunction(value) else "data"
        lines += [f".. auto{kind}:: {name}.{each}", "   :members:" if is_class else "", ""]
    return "\n".join(lines)


def of_notebook(stem: str) -> str:
    """Page of a notebook: as `make reproduce` executed it; else as stored, and it says so."""
    made, values = RESULTS / f"{stem}.ipynb", f"`params/{stem}.yaml`"
    note = f"Not executed here: `make reproduce` runs it, with the values in {values}."
    if made.exists():
        day = time.strftime("%Y-%m-%d", time.gmtime(made.stat().st_mtime))
        note = f"Executed by `make reproduce` on {day} with the values in {values}, shown below."
    elif stem == TOUR:
        note = "Executed for this page with its small values, shown in the first cell."
    path = made if made.exists() else HERE.parent / "notebooks" / made.name
    content = json.loads(path.read_text(encoding="utf-8"))
    cell = {"cell_type": "markdown", "id": "note", "metadata": {}}
    content["cells"].insert(1, cell | {"source": f":::{{note}}\n{note}\n:::"})
    mode = "force" if stem == TOUR and not made.exists() else "off"
    content["metadata"]["mystnb"] = {"execution_mode": mode}
    return json.dumps(content)


def write() -> None:
    """Write the pages that are made, in place of earlier ones."""
    made = {f"api/{name}.rst": of_module(name) for name in public_modules()}
    made |= {f"notebooks/{path.name}": of_notebook(path.stem) for path in NOTEBOOKS}
    for folder in ("api", "notebooks"):
        shutil.rmtree(HERE / folder, ignore_errors=True)
        (HERE / folder).mkdir()
    for name, text in made.items():
        (HERE / name).write_text(text, encoding="utf-8")


@cache
def constants(module: str) -> dict[str, str]:
    """Docstrings of what is assigned in a module, or in one below it, by name."""
    path, found = Path(str(importlib.import_module(module).__file__)), {}
    files = path.parent.rglob("*.py") if path.stem == "__init__" else [path]
    for file in sorted(files, reverse=True):  # the package's own come last, and count
        for each, after in pairwise(ast.parse(file.read_text(encoding="utf-8")).body):
            match each, after:
                case (
                    ast.AnnAssign(target=ast.Name(name)) | ast.Assign(targets=[ast.Name(name)]),
                    ast.Expr(ast.Constant(str(text))),
                ):
                    found[name] = inspect.cleandoc(text)
    return found


class Page(HTMLParser):
    """Anchors of a page, where its links lead, and what it loads."""

    def __init__(self, text: str) -> None:
        """Read the page."""
        super().__init__()
        self.anchors, self.links, self.loads = {""}, set[str](), set[str]()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note anchor and addresses of an element."""
        values = {name: value for name, value in attrs if value}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        addresses = {values[name] for name in ("href", "src", "poster", "data") if name in values}
        (self.links if tag == "a" else self.loads).update(addresses)


def check_links(folder: Path) -> tuple[set[str], set[str]]:
    """Faults of a built site (dead links, what it loads from outside), and its outside links."""
    faults, outside = set[str](), set[str]()
    files = [path for path in folder.rglob("*.html") if "_static" not in path.parts]
    pages = {path: Page(path.read_text(encoding="utf-8")) for path in files}
    for path, page in pages.items():
        for address in page.links | page.loads:
            parts = urlsplit(address)
            target = Path(os.path.normpath(path.parent / unquote(parts.path)))
            target = target if parts.path else path
            if parts.netloc or parts.scheme not in {"", "data"}:
                outside.add(address)
                fault = address in page.loads
            else:
                dead = target in pages and unquote(parts.fragment) not in pages[target].anchors
                fault = not parts.scheme and (dead or not target.exists())
            if fault:
                faults.add(f"{path.relative_to(folder)} leads to {address}")
    for path in folder.rglob("*.css"):
        loaded = re.findall(r"url\(['\"]?(?:https?:)?//[^)]*", path.read_text(encoding="utf-8"))
        faults |= {f"{path.relative_to(folder)} leads to {address}" for address in loaded}
    return faults, outside
