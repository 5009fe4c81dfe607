"""What notebooks keep for one another: as it was written, or made anew by the next make.

With its results a notebook leaves their checksums, ``results/<run>/.<stem>.sums``. What is missing
or differs is named with its notebook and the target of make. That notebook then counts as
interrupted, so that make runs it again. `python -m reproduction.integrity RUN` does this for all.
"""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from dbthermal import store
from reproduction import paths


class DamagedError(RuntimeError):
    """A result that cannot be read, or is not as its notebook left it."""


def keep_sums(run: str, stem: str) -> None:
    """Keep the checksums of all files that a notebook wrote, but of the notebook itself."""
    tops = [path for path in paths.results(run).glob(f"{stem}*") if path.name != f"{stem}.ipynb"]
    files = [file for top in tops for file in ([top] if top.is_file() else top.rglob("*"))]
    names = {
        str(file.relative_to(paths.results(run))): store.checksum(file)
        for file in files
        if file.is_file() and not file.name.startswith(".")
    }
    lines = [f"{names[name]}  {name}\n" for name in sorted(names)]
    paths.sums(run, stem).write_text("".join(lines), encoding="utf-8")


def files(run: str, stem: str) -> dict[Path, str]:
    """Files that a notebook wrote, and their checksums; none if it left no checksums."""
    path = paths.sums(run, stem)
    text = path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""
    lines = [line.split("  ", 1) for line in text.splitlines() if "  " in line]
    return {paths.results(run) / name: checksum for checksum, name in lines}


def maker(path: Path) -> tuple[str, str] | None:
    """Run and stem of the notebook that made a file or folder, None if it is no result."""
    results = paths.root() / "results"
    if not path.absolute().is_relative_to(results):
        return None
    run, *names = path.absolute().relative_to(results).parts
    stems = [file.stem for file in (paths.root() / "notebooks").glob("[0-9][0-9]_*.ipynb")]
    makers = [stem for stem in stems if names and names[0].startswith(stem)]
    return (run, max(makers)) if makers else None


@contextmanager
def reading(path: Path) -> Iterator[Path]:
    """Context in which a result of another notebook is read: a DamagedError names its maker.

    RuntimeError if that notebook is running, or was interrupted.
    """
    if not (made := maker(path)):
        yield path
        return
    paths.finished(*made)
    try:
        _compare(path, files(*made))
        yield path
    except (OSError, ValueError) as error:  # others are of the program, or of the machine
        run, stem = made
        withdraw(run, stem)
        raise DamagedError(
            f"Damaged or incomplete '{path}', made by notebook '{stem}': {error} It is made anew "
            f"by 'make results/{run}/{stem}.ipynb', and by the next 'make reproduce' of its run."
        ) from error


def withdraw(run: str, stem: str) -> None:
    """Take its name from an executed notebook: it counts as interrupted, and make runs it again."""
    path = paths.unfinished(run, stem).with_name(f"{stem}.ipynb")
    if path.exists():
        path.replace(paths.unfinished(run, stem))


def _compare(path: Path, sums: dict[Path, str]) -> None:
    """ValueError unless a file, or all in a folder, is as it was written."""
    for file, checksum in sums.items():
        if file != path and path not in file.parents:
            continue
        if not file.is_file():
            raise FileNotFoundError(f"Missing file '{file}'.")
        if store.checksum(file) != checksum:
            raise ValueError(f"Changed file '{file}'. Must be as it was written.")


def main(runs: Sequence[str]) -> int:
    """Compare all results of runs with their checksums; a line on each notebook to run again."""
    for run in runs:
        for path in sorted(paths.results(run).glob("[0-9][0-9]_*.ipynb")):
            try:
                if not paths.sums(run, path.stem).is_file():
                    raise FileNotFoundError("Missing checksums.")
                _compare(paths.results(run), files(run, path.stem))
            except (OSError, ValueError) as error:
                withdraw(run, path.stem)
                sys.stderr.write(f"{run}/{path.stem}: {error} The notebook is run again.\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
