"""Execute a notebook: its result has its name only when it is whole, and on the disk.

`python -m reproduction.execute RUN STEM -f FILE.yaml -p NAME TEXT` runs ``notebooks/STEM.ipynb``
with small values, those of the files over them, and those texts over both. With ``--check`` nbval
runs it as a test, with small values. The executed or checked notebook is ``results/RUN/STEM.ipynb``
and stands for all that the notebook wrote. Until its end it is a hidden file beside that (see
`paths.unfinished`), whatever ends the process. What an earlier run left goes first. A notebook that
fails is kept in ``results/failed/RUN``, to be read, and nothing else of it.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import nbformat
import papermill
from jupyter_client.manager import AsyncKernelManager

from dbthermal import store
from reproduction import integrity, locked, parameters, paths


class Kernel(AsyncKernelManager):
    """Kernel that holds the lock of make too, which is not free while a kernel still writes."""

    transport_encryption = "auto"  # of what passes between here and the kernel

    async def start_kernel(self, *arguments: Any, **options: Any) -> None:  # type: ignore[override]
        """Start the kernel with the lock's open file among its own."""
        options["pass_fds"] = (int(os.environ[locked.HELD]),)
        await super().start_kernel(*arguments, **options)


def run_papermill(stem: str, draft: Path, values: Mapping[str, Any]) -> None:
    """Execute a notebook; raises what papermill raises, RuntimeError if a cell did not run."""
    papermill.execute_notebook(
        paths.notebook(stem),
        draft,
        parameters=values,
        kernel_name="python3",
        kernel_manager_class=Kernel,
        progress_bar=False,
        cwd=paths.root() / "notebooks",
    )
    for number, cell in enumerate(nbformat.read(draft, nbformat.NO_CONVERT).cells):
        if cell.cell_type == "code" and cell.source.strip() and cell.execution_count is None:
            raise RuntimeError(f"Unfinished notebook '{draft}': cell {number} did not run.")


def run_nbval(stem: str, draft: Path, values: Mapping[str, Any]) -> None:
    """Run a notebook as a test, as it is stored; RuntimeError with a failing cell's report."""
    if values:
        raise ValueError(f"Invalid parameters {[*values]} of '{stem}'. Must be none in a check.")
    shutil.copyfile(paths.notebook(stem), draft)
    # The other plugins, of which a notebook needs none, take twice as long to load as this one.
    command = ["pytest", "--quiet", "--no-header", "-p", "nbval.plugin", "-p", "no:cacheprovider"]
    report = subprocess.run(
        [sys.executable, "-m", *command, "--nbval-lax", str(paths.notebook(stem))],
        env=os.environ | {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
        check=False,
        capture_output=True,
        text=True,
        cwd=paths.root(),
        pass_fds=(int(os.environ[locked.HELD]),),
    )
    if report.returncode:
        raise RuntimeError(f"The notebook fails as a test.\n{report.stdout}{report.stderr}")


def execute(
    run: str,
    stem: str,
    values: Mapping[str, Any],
    runner: Callable[[str, Path, Mapping[str, Any]], None] = run_papermill,
) -> Path:
    """Path of the executed notebook, when it and all that it wrote are whole and on the disk.

    It is as old as its start, so that whatever changed while it ran is newer. Raises what the
    runner raises for a cell that fails.
    """
    draft, start = paths.unfinished(run, stem), time.time()
    path = draft.with_name(f"{stem}.ipynb")
    failed = paths.root() / "results" / "failed" / run / path.name
    draft.parent.mkdir(parents=True, exist_ok=True)
    if path.exists():  # from here on no name says that it is whole
        path.replace(draft)
    draft.touch()
    store.to_disk([draft, draft.parent])
    failed.unlink(missing_ok=True)
    _remove(draft, stem)
    try:
        runner(stem, draft, values)
    except BaseException:
        _remove(draft, stem)
        failed.parent.mkdir(parents=True, exist_ok=True)
        draft.replace(failed)
        raise
    integrity.keep_sums(run, stem)
    os.utime(draft, (start, start))
    sums = paths.sums(run, stem)
    store.to_disk(
        [draft, sums, *draft.parent.glob(f"{stem}*"), *draft.parent.glob(f"{stem}*/**/*")]
    )
    draft.replace(path)
    store.to_disk([path.parent])
    return path


def _remove(draft: Path, stem: str) -> None:
    """Remove what a notebook wrote, but not the unfinished notebook itself."""
    for result in [*draft.parent.glob(f"{stem}*"), *draft.parent.glob(f".{stem}*")]:
        if result.is_dir() and not result.is_symlink():
            shutil.rmtree(result)
        elif result != draft:
            result.unlink()


def main(arguments: Sequence[str] | None = None) -> int:
    """Execute a notebook; exit status 1 if its parameters are refused, or it fails."""
    parser = argparse.ArgumentParser(prog="python -m reproduction.execute", description=__doc__)
    parser.add_argument("run", help="folder below results/")
    parser.add_argument("stem", help="name of the notebook, such as 03_simulation")
    parser.add_argument("-f", dest="files", action="append", default=[], type=Path, metavar="FILE")
    parser.add_argument("-p", dest="texts", action="append", default=[], nargs=2, metavar="TEXT")
    parser.add_argument("--check", action="store_true", help="run it as a test, with small values")
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        if os.environ.get(locked.LOCKED) == str(root := paths.root()):
            locked.end_with_parent(lambda: os.kill(os.getpid(), signal.SIGKILL))
        else:
            task = f"reproduction.execute {options.run} {options.stem}"
            os.environ[locked.HELD] = str(locked.lock(root, task))
        locked.mirror()
        texts = [*options.texts, ["results", options.run]]
        if options.check or "results" not in parameters.defaults(options.stem):
            texts.pop()
        values = parameters.read(options.stem, options.files, texts)
        runner = run_nbval if options.check else run_papermill
        path = execute(options.run, options.stem, values, runner)
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except (OSError, RuntimeError, ValueError, papermill.PapermillException) as error:
        sys.stderr.write(f"{options.run}/{options.stem}: {error}\n")
        return 1
    sys.stdout.write(f"{path}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
