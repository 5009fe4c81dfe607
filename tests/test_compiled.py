"""Compiled code is kept from process to process, by the code alone; damaged, it is made anew."""

import os
import re
import runpy
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from dbthermal._compiled import compiled

ROOT = Path(__file__).parents[1]
# Functions of a module of its own; `smooth` calls `centre`.
KERNELS = """
from dbthermal._compiled import compiled


@compiled
def centre(signal):
    \"\"\"Mean.\"\"\"
    return signal.sum() / signal.size


@compiled
def smooth(signal):
    return signal - centre(signal)


@compiled
def largest(signal):
    return signal.max()


@compiled
def sum_up(signal):
    return signal.sum()
"""
# Prints what is logged, and the result; in a process of its own for each state.
CALL = """
import logging, os, sys
from pathlib import Path
import numpy as np
import kernels
logging.basicConfig(stream=sys.stdout, format="%(message)s")
logging.getLogger("dbthermal").setLevel("DEBUG")
signal = np.arange(9.0) ** 2
DAMAGES = [
    lambda content: b"",
    lambda content: content[: len(content) // 2],
    lambda content: content[:-99] + bytes([content[-99] ^ 1]) + content[-98:],
    lambda content: np.random.default_rng(0).bytes(len(content)),
]
for state in sys.argv[1:]:
    kept = sorted(Path(os.environ["NUMBA_CACHE_DIR"]).rglob("*.nb?"))
    for number, path in enumerate(kept if state == "damaged" else ()):
        path.write_bytes(DAMAGES[number % 4](path.read_bytes()))
    print("state:", state, flush=True)
    if not (process := os.fork()):
        result = kernels.smooth(signal), kernels.largest(signal), kernels.sum_up(signal)
        print("result:", *result[0], *result[1:], flush=True)
        os._exit(0)
    assert os.waitpid(process, 0)[1] == 0
"""


def started(folder: Path, *states: str) -> "subprocess.Popen[str]":
    """Process that calls the functions of a folder, where their compiled code is kept too."""
    paths = {"PYTHONPATH": f"{ROOT}:{folder}", "NUMBA_CACHE_DIR": f"{folder}/kept"}
    command = [sys.executable, "-c", CALL, *states]
    environment = {**os.environ, **paths}
    return subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True)


def test_functions_run_as_python_without_a_compiler() -> None:
    """With NUMBA_DISABLE_JIT, as debuggers and coverage need it, a separation gives the same."""
    script = """
import numpy as np, xarray as xr
from dbthermal import separation, simulation
rig, rng = simulation.Rig(bad_fraction=0.0), np.random.default_rng(1)
glass = xr.DataArray([0.86, 0.72], {"band": list(rig.bands)}, "band")
scene = simulation.walkers(np.arange(60) / 10, (1, 2), glass, rng)
result = separation.solve(simulation.observe(scene, rig.response(), rng), rig.response())
print(*result["object_temperature"].values.ravel().tolist())
"""
    answers = []
    for disabled in "01":
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_DISABLE_JIT": disabled}
        command = [sys.executable, "-c", script]
        answer = subprocess.run(
            command, env=environment, capture_output=True, text=True, check=True
        )
        answers.append([float(number) for number in answer.stdout.split()])
    assert len(answers[0]) == 120
    np.testing.assert_allclose(answers[0], answers[1], atol=1e-3)  # K, of sums in another order


def files(folder: Path) -> dict[str, int]:
    """Names of the functions whose code is kept, and when it was written [ns]."""
    kept = (folder / "kept").rglob("*.nbc")
    return {re.sub(r".*\.(\w+)-.*", r"\1", str(it)): it.stat().st_mtime_ns for it in sorted(kept)}


def called(folder: Path, *states: str) -> list[list[str]]:
    """Lines that are printed and logged in each state, in the end the result."""
    process = started(folder, *states)
    text = process.communicate()[0]
    assert process.returncode == 0
    return [part.splitlines()[1:] for part in text.split("state:")[1:]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Module of its own, whose code two processes have compiled at the same time: once."""
    folder = tmp_path_factory.mktemp("compiled")
    (folder / "kernels.py").write_text(KERNELS)
    processes = [started(folder, "whole") for _ in range(2)]
    texts = [process.communicate()[0] for process in processes]
    kept = [line for text in texts for line in text.splitlines() if "kept" in line]
    assert len(kept) == len(set(kept)) == 4
    assert len({text.splitlines()[-1] for text in texts}) == 1
    return folder


def test_damaged_code_is_compiled_again(folder: Path) -> None:
    """Empty, cut, flipped and foreign files give the same result, and a line in the log each."""
    whole, damaged, again = called(folder, "whole", "damaged", "whole")
    assert len(whole) == 1  # of what is whole nothing is said, or compiled
    assert damaged[-1] == whole[-1]
    said = [line for line in damaged if re.match("Damaged .*It is compiled again", line)]
    assert len({line for line in damaged if "is kept as" in line}) >= 4
    assert len(set(said)) >= 4
    assert again == whole


def test_only_changed_code_is_compiled_again(folder: Path) -> None:
    """Comments, docstrings, lines and other functions change nothing; a called function does."""
    module, before = folder / "kernels.py", files(folder)
    assert before.keys() == {"centre", "smooth", "largest", "sum_up"}
    lines = "# A comment.\ndef unused():\n    return 3\n\n\n"
    module.write_text(lines + KERNELS.replace("Mean.", "Arithmetic mean."))
    called(folder, "whole")
    assert files(folder) == before
    module.write_text(KERNELS.replace("/ signal.size", "/ (signal.size + 1)"))
    called(folder, "whole")
    after = files(folder)
    assert {name for name in before if after[name] != before[name]} == {"smooth", "centre"}


def test_threads_that_need_the_same_code_at_once(tmp_path: Path) -> None:
    """Each thread gets its result, whichever of them compiles."""
    text = "\n".join(f"def f{n}(x):\n    return x.sum() + {n}\n" for n in range(6))
    (tmp_path / "sums.py").write_text(text)
    functions = runpy.run_path(str(tmp_path / "sums.py"))
    arrays = [np.ones(3, kind) for kind in ("f4", "f8", "i4", "i8")] * 2
    with ThreadPoolExecutor(len(arrays)) as pool:
        for n in range(6):
            function = compiled(functions[f"f{n}"])
            assert [*pool.map(function, arrays)] == [3.0 + n] * len(arrays)
    assert len([*tmp_path.rglob("*.nbc")]) == 6 * 4
