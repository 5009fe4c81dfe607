"""Rules of the notebooks that do not show when they run."""

import ast
import re
from pathlib import Path

import nbformat
import pytest
from nbformat import NotebookNode

from reproduction import parameters

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LONGEST_CELL = 12  # lines
MOST_PARAMETERS = 14  # lines of a cell of parameters, one each
BOOKKEEPING = re.compile(r"\b(run|paths|store|manifest)\.|\bRun\(|\brecord\b|\bsave\b")
LARGEST_SHARE = 0.15  # of bookkeeping in the code lines [1]

each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def read(path: Path) -> NotebookNode:
    """Notebook as stored, if it is a valid one."""
    notebook: NotebookNode = nbformat.read(path, nbformat.NO_CONVERT)
    nbformat.validate(notebook)
    return notebook


def cells(path: Path, kind: str) -> list[NotebookNode]:
    """Cells of one kind."""
    return [cell for cell in read(path).cells if cell.cell_type == kind]


def test_stems_are_equal() -> None:
    """Notebooks and parameter files have the same stems."""
    names = {path.stem for path in (ROOT / "params").glob("*.yaml")}
    assert names == {path.stem for path in NOTEBOOKS}


@each_notebook
def test_parameters_are_the_ones_in_yaml(path: Path) -> None:
    """The one cell tagged `parameters` sets plain values for the names that the YAML file has."""
    full = parameters.read(path.stem, [ROOT / "params" / f"{path.stem}.yaml"])
    assert parameters.defaults(path.stem).keys() == full.keys()


@pytest.mark.parametrize(
    "path", sorted((ROOT / "params/recorded").iterdir()), ids=lambda path: path.stem
)
def test_parameters_of_recordings(path: Path) -> None:
    """What differs for a recording is among the notebook's parameters, and of their kind."""
    assert parameters.read(path.stem, [path, path])


@each_notebook
def test_notebook_is_stored_as_a_question(path: Path) -> None:
    """The title asks, a last cell asserts, outputs are not stored; the kernel is named."""
    title, code = cells(path, "markdown")[0].source.splitlines()[0], cells(path, "code")
    assert title.startswith("# ")
    assert title.endswith("?")
    assert any("assert" in cell.source for cell in code[-2:])
    assert not [cell.source for cell in code if cell.outputs or cell.execution_count]
    kernel = read(path).metadata.kernelspec
    assert (kernel.name, kernel.language) == ("python3", "python")


@each_notebook
def test_cells_compose(path: Path) -> None:
    """A cell is short, and defines neither functions nor classes."""
    for cell in cells(path, "code"):
        definitions = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda)
        tree = ast.parse(cell.source)
        assert not [node for node in ast.walk(tree) if isinstance(node, definitions)], cell.source
        of_parameters = "parameters" in cell["metadata"].get("tags", [])
        longest = MOST_PARAMETERS if of_parameters else LONGEST_CELL
        assert len(cell.source.splitlines()) <= longest, cell.source


def test_bookkeeping_is_a_small_share() -> None:
    """Few code lines beside parameters and imports are about inputs' and results' paths."""
    code = [cell for path in NOTEBOOKS for cell in cells(path, "code")]
    plain = [cell for cell in code if "parameters" not in cell.metadata.get("tags", ())]
    lines = [line.strip() for cell in plain for line in cell.source.splitlines()]
    lines = [line for line in lines if line and not line.startswith(("#", "import ", "from "))]
    kept = sum(bool(BOOKKEEPING.search(line)) for line in lines)
    assert kept / len(lines) <= LARGEST_SHARE, f"{kept} of {len(lines)} lines"
