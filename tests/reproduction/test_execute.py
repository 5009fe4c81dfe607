"""An executed notebook has its name only when it is whole; of one that is not, nothing counts."""

import time
from pathlib import Path
from typing import Any

import nbformat
import papermill
import pytest

from dbthermal import store
from reproduction import execute, locked, parameters
from reproduction.run import Run

CELL = 'results = "smoke"\nframes = 3\nrecorded = ""\nnoise = [0.1, 1]\ntime_constant = None\n'
CELL += 'plate = {"shape": [2, 3], "kind": "flat"}\nrate = 10.0\nknown = True\n'


@pytest.fixture
def project(project: Path) -> Path:
    """Project with a notebook of two cells."""
    (project / "params/03_tiny.yaml").write_text("results: full\nframes: 9\n")
    cells = [nbformat.v4.new_code_cell(text) for text in (CELL, "print(frames)")]
    cells[0].metadata["tags"] = ["parameters"]
    nbformat.write(nbformat.v4.new_notebook(cells=cells), project / "notebooks/03_tiny.ipynb")
    return project


@pytest.fixture
def folder(project: Path) -> Path:
    """Folder of a run, with what an earlier one left of this and of another notebook."""
    folder = project / "results" / "full"
    (folder / "03_tiny.zarr").mkdir(parents=True)
    for name in ("03_tiny.ipynb", "03_tiny.json", "03_tiny.zarr/zarr.json", "04_other.json"):
        (folder / name).write_text("{}")
    return folder


class Papermill:
    """Stand-in for papermill, which saves a notebook of which so many cells ran, and a number."""

    def __init__(self, cells: int, error: BaseException | None = None) -> None:
        self.cells, self.error = cells, error
        self.seen: list[str] = []

    def __call__(self, source: Path, part: Path, **_: Any) -> None:
        """Save what ran; raise the error."""
        self.seen = sorted(path.name for path in part.parent.iterdir())
        notebook = nbformat.read(source, 4)
        for number, cell in enumerate(notebook.cells[: self.cells], 1):
            cell.execution_count = number
        nbformat.write(notebook, part)
        part.with_name("03_tiny.json").write_text("new")
        if self.error:
            raise self.error


def test_a_name_stands_for_results_on_the_disk(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While a notebook runs nothing has the name of its results, nor before they are on the disk:
    a power loss leaves no name of what is only in the system's cache. They are as old as its
    beginning: a source that changed since is newer.
    """
    runner = Papermill(2)
    monkeypatch.setattr(papermill, "execute_notebook", runner)
    synced: list[tuple[Path, bool]] = []
    named = folder / "03_tiny.ipynb"
    monkeypatch.setattr(
        store, "to_disk", lambda places: synced.extend((place, named.exists()) for place in places)
    )
    monkeypatch.setattr(time, "time", lambda: 1000.0)
    assert execute.execute("full", "03_tiny", {}) == named
    assert named.stat().st_mtime == 1000
    assert runner.seen == [".03_tiny.part.ipynb", "04_other.json"]
    names = sorted(path.name for path in folder.iterdir())
    assert names == [".03_tiny.sums", "03_tiny.ipynb", "03_tiny.json", "04_other.json"]
    assert (folder / "03_tiny.json").read_text() == "new"
    for name in ("03_tiny.json", ".03_tiny.sums", ".03_tiny.part.ipynb"):
        assert (folder / name, False) in synced
    assert synced[-1] == (folder, True)


@pytest.mark.parametrize(
    "error",
    [
        papermill.PapermillExecutionError(1, 1, "", "ValueError", "wrong", []),
        KeyboardInterrupt(),
        OSError("no space left"),
        None,  # papermill takes the end of the kernel by `exit()` for success
    ],
)
def test_an_unfinished_notebook_leaves_nothing_whole(
    folder: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException | None
) -> None:
    """A notebook that does not reach its end is kept apart, and none of its results is."""
    monkeypatch.setattr(papermill, "execute_notebook", Papermill(1, error))
    with pytest.raises(type(error) if error else RuntimeError, match=None if error else "cell 1"):
        execute.execute("full", "03_tiny", {})
    assert [path.name for path in folder.iterdir()] == ["04_other.json"]
    assert (folder.parent / "failed/full/03_tiny.ipynb").is_file()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frmaes: 3", r"Unknown parameter 'frmaes' in '.*a\.yaml'\. Must be one of \['frames',"),
        ("frames: 3\nframes: 4", r"a\.yaml, line 2.*Repeated key 'frames'"),
        ("frames: '3'", r"Invalid parameter 'frames' in '.*': '3'. Must be a whole number, as 3"),
        ("frames: true", "Must be a whole number"),
        ("frames: -3", r"Invalid parameter 'frames' = -3 in '.*'. Must be >= 0"),
        ("frames:", "None. Must be a whole number"),
        ("rate: 1e3", "rate|number"),
        ("rate: .inf", "finite"),
        ("known: 1", "Must be true or false"),
        ("recorded: 3", "Must be text"),
        ("noise: 0.1", "Must be a list"),
        ("noise: [0.1, x]", "Invalid entry 1 of parameter 'noise' in .*: 'x'. Must be a number"),
        ("plate: [2, 3]", "Must be a mapping"),
        ("plate: {shape: 2}", "Invalid 'shape' of parameter 'plate'.*Must be a list"),
        ("plate: {shape: [2]}", r"Invalid names \['shape'\] of parameter 'plate' in .* 'kind'"),
    ],
)
def test_values_are_refused(project: Path, text: str, message: str) -> None:
    """A file with other names, kinds, or two of one name is refused before the notebook runs."""
    path = project / "a.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        parameters.read("03_tiny", [path])


def test_values_are_taken_in_order(project: Path) -> None:
    """Later files and texts replace earlier values; a cut file of full values is refused."""
    files = [project / "a.yaml", project / "b.yaml"]
    files[0].write_text("frames: 4\nrate: 3\nplate: {shape: [], kind: a}")
    files[1].write_text("frames: 5")
    values = parameters.read("03_tiny", files, [("recorded", "there")])
    plate = {"shape": [], "kind": "a"}
    assert values == {"frames": 5, "rate": 3, "plate": plate, "recorded": "there"}
    with pytest.raises(ValueError, match="Repeated parameter 'recorded' of '03_tiny'"):
        parameters.read("03_tiny", files, [("recorded", "a"), ("recorded", "b")])
    with pytest.raises(ValueError, match="Unknown parameter 'recordings' in the texts"):
        parameters.read("03_tiny", files, [("recordings", "a")])
    with pytest.raises(ValueError, match=r"Missing parameter 'known' in '.*03_tiny\.yaml'"):
        parameters.read("03_tiny", [Path("params/03_tiny.yaml")])


@pytest.mark.usefixtures("project")
def test_what_papermill_injects_is_checked() -> None:
    """A run that papermill started by itself, with a name that the notebook has not, is refused."""
    namespace = {"results": "smoke", "frames": 3, "frmaes": 4, "In": ["", CELL]}
    assert Run("03_tiny", namespace).name == "smoke"
    namespace["In"] = ["", CELL, "# Parameters\nfrmaes = 4\n"]
    with pytest.raises(ValueError, match="Unknown parameter 'frmaes' in what '03_tiny' was run"):
        Run("03_tiny", namespace)


def test_parameters_are_refused_before_the_notebook_runs(
    folder: Path, project: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command says what is wrong, fails, and leaves what is there."""
    (project / "a.yaml").write_text("frmaes: 3")
    monkeypatch.setenv(locked.HELD, "")  # which the command sets
    assert execute.main(["full", "03_tiny", "-f", "a.yaml"]) == 1
    assert "full/03_tiny: Unknown parameter 'frmaes' in 'a.yaml'" in capsys.readouterr().err
    assert (folder / "03_tiny.ipynb").is_file()


@pytest.mark.slow
def test_a_check_that_fails_leaves_nothing_whole(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The notebook is checked as it is stored, and the report names the cell that failed."""
    path = project / "notebooks/03_tiny.ipynb"
    notebook = nbformat.read(path, 4)
    notebook.cells[1].source = "assert frames == 4"
    nbformat.write(notebook, path)
    with (project / "held").open("w") as file:
        monkeypatch.setenv(locked.HELD, str(file.fileno()))
        with pytest.raises(RuntimeError, match="AssertionError"):
            execute.execute("smoke", "03_tiny", {}, execute.run_nbval)
    assert [path.name for path in (project / "results/smoke").iterdir()] == []
    assert (project / "results/failed/smoke/03_tiny.ipynb").exists()
