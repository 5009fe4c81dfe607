"""Imports point strictly down the layers; heavy and optional packages have one place each."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import dbthermal

PACKAGE = Path(dbthermal.__file__).parent
ARCHITECTURE = (PACKAGE.parent / "docs" / "architecture.md").read_text(encoding="utf-8")
# The page lists the layers from the top down.
(BLOCK,) = re.findall(r"```layers\n(.*?)```", ARCHITECTURE, re.DOTALL)
LAYERS = BLOCK.splitlines()[::-1]
LEVEL = {module: level for level, row in enumerate(LAYERS) for module in row.split()}
PLACES = {
    "zarr": {"readers", "store"},
    "h5py": {"readers"},
    "anywidget": {"explorer"},
    "av": {"readers", "store"},
    "skimage": {"separation"},
    "serial": {"instruments"},
    "usb": {"instruments"},
}


def imports() -> Iterator[tuple[str, str]]:
    """Yield (module, what it imports) for every import in the package, inside functions too."""
    for path in PACKAGE.rglob("*.py"):
        module = path.relative_to(PACKAGE).with_suffix("").parts[0]
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                yield from ((module, alias.name) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                yield from ((module, f"{node.module}.{alias.name}") for alias in node.names)


def inner_imports() -> set[tuple[str, str]]:
    """Pairs of two different modules of this package; those of one family count as one module."""
    names = ((module, target.split(".")) for module, target in imports())
    pairs = {(module, name[1]) for module, name in names if name[0] == "dbthermal" and name[1:]}
    return {(module, target) for module, target in pairs if target not in {module, "__version__"}}


def test_every_module_has_a_layer() -> None:
    """Every module has a place in the table of layers."""
    modules = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or path.is_dir()}
    assert modules - {"__init__", "__pycache__"} <= LEVEL.keys()


def test_imports_point_strictly_down() -> None:
    """No module imports from its own layer or from above; the package itself imports none."""
    wrong = {pair for pair in inner_imports() if LEVEL.get(pair[0], -1) <= LEVEL[pair[1]]}
    assert wrong == set()


def test_optional_packages_have_one_place() -> None:
    """Heavy and optional packages are imported only in their listed modules."""
    places = [(target.split(".")[0], module) for module, target in imports()]
    assert {pair for pair in places if pair[1] not in PLACES.get(pair[0], {pair[1]})} == set()


def test_what_is_named_in_one_place() -> None:
    """Only the store opens results in zarr's format; no driver imports the emulators."""
    texts = {path.relative_to(PACKAGE): path.read_text("utf-8") for path in PACKAGE.rglob("*.py")}
    assert {path.parts[0] for path, text in texts.items() if "_zarr(" in text} == {"store"}
    emulated = re.compile(r"(?m)^\s*(import|from) dbthermal\.instruments\.emulated")
    users = {path for path, text in texts.items() if emulated.search(text)}
    assert {path for path in users if path.parts[:1] == ("instruments",)} == {
        path for path in users if "emulated" in path.parts
    }


def test_the_rig_is_apart() -> None:
    """Only the command line imports the instruments; none of their modules imports in a circle."""
    assert {module for module, target in inner_imports() if target == "instruments"} == {"_cli"}
    modules = {
        ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
        for path in (PACKAGE / "instruments").rglob("*.py")
    }
    graph: dict[str, set[str]] = {}
    for module in modules:
        file = PACKAGE.parent.joinpath(*module.split("."))
        text = (file / "__init__.py" if file.is_dir() else file.with_suffix(".py")).read_text()
        nodes = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom)]
        names = {f"{node.module}.{alias.name}" for node in nodes for alias in node.names}
        graph[module] = modules & (names | {f"{node.module}" for node in nodes}) - {module}
    assert [*TopologicalSorter(graph).static_order()]
    assert len(modules) <= 24


def test_importing_the_package_is_light() -> None:
    """`import dbthermal`, and its readers, load neither optional nor heavy packages."""
    heavy = {"torch", "usb", "serial", "matplotlib", "anywidget", "av"}
    code = f"import sys, dbthermal.readers; print({heavy} & {{*sys.modules}})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
