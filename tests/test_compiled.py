"""Compiled code is kept from process to process, by the code alone; damaged, it is made anew."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from dbthermal._compiled import compiled

ROOT = Path(__file__).parents[1]
# Prints what is logged, and a digest of the result; in a process of its own for each state.
SOLVE = """
import hashlib, logging, os, sys
from pathlib import Path
import numpy as np, xarray as xr
from dbthermal import separation, simulation
logging.basicConfig(stream=sys.stdout, format="%(message)s")
logging.getLogger("dbthermal").setLevel("DEBUG")
rig, rng = simulation.Rig(), np.random.default_rng(1)
glass = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(rig.bands)})
scene = simulation.walkers(np.arange(40) / 10, (2, 3), glass, rng)
capture = simulation.observe(scene, rig.response(), rng)
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
        result = separation.solve(capture, rig.response(), "calibrated", emissivity=glass)
        print(hashlib.sha256(result.object_temperature.values.tobytes()).hexdigest(), flush=True)
        os._exit(0)
    assert os.waitpid(process, 0)[1] == 0
"""


def started(folder: Path, *states: str) -> "subprocess.Popen[str]":
    """Process that solves with the package in a folder, where its compiled code is kept too."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": f"{folder}/kept"}
    command = [sys.executable, "-c", SOLVE, *states]
    return subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=None, text=True
    )


def files(folder: Path) -> dict[str, int]:
    """Names of the functions whose code is kept, and when it was written [ns]."""
    kept = (folder / "kept").rglob("*.nbc")
    return {re.sub(r".*\.(\w+)-.*", r"\1", str(it)): it.stat().st_mtime_ns for it in sorted(kept)}


def solved(folder: Path, *states: str) -> list[list[str]]:
    """Lines that are printed and logged in each state, in the end the result's digest."""
    process = started(folder, *states)
    text = process.communicate()[0]
    assert process.returncode == 0
    return [part.splitlines()[1:] for part in text.split("state:")[1:]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Package of its own, whose code two processes have compiled at the same time: once."""
    folder = tmp_path_factory.mktemp("compiled")
    shutil.copytree(
        ROOT / "dbthermal", folder / "dbthermal", ignore=shutil.ignore_patterns("__pycache__")
    )
    processes = [started(folder, "whole") for _ in range(2)]
    texts = [process.communicate()[0] for process in processes]
    kept = [line for text in texts for line in text.splitlines() if "kept" in line]
    assert len(kept) == len(set(kept)) >= 3
    assert len({text.split()[-1] for text in texts}) == 1
    return folder


def test_damaged_code_is_compiled_again(folder: Path) -> None:
    """Empty, cut, flipped and foreign files give the same result, and a line in the log each."""
    whole, damaged, again = solved(folder, "whole", "damaged", "whole")
    assert len(whole) == 1  # of what is whole nothing is said, or compiled
    assert damaged[-1] == whole[-1]
    said = [line for line in damaged if re.match("Damaged .*It is compiled again", line)]
    assert len({line for line in damaged if "is kept as" in line}) >= 4
    assert len(set(said)) >= 4
    assert again == whole


def test_only_changed_code_is_compiled_again(folder: Path) -> None:
    """Comments, docstrings, lines and other functions change nothing; a called function does."""
    module, before = folder / "dbthermal/separation/_known_emissivity.py", files(folder)
    assert {"_smooth", "_sum_up", "_centre"} <= before.keys()
    text = module.read_text(encoding="utf-8")
    head, marker, rest = text.partition("@compiled\ndef _centre(")
    assert marker
    documented = re.sub('"""[A-Z]', '"""Or: ', rest, count=1)
    other = "\n\n# A comment.\ndef unused() -> int:\n    return 3\n\n\n"
    module.write_text(head + other + marker + documented, encoding="utf-8")
    solved(folder, "whole")
    assert files(folder) == before
    start, quotes, body = rest.partition('"""\n')
    changed = start + quotes + "    place = place + 0\n" + body
    module.write_text(head + marker + changed, encoding="utf-8")
    solved(folder, "whole")
    after = files(folder)
    assert {name for name in before if after[name] != before[name]} == {"_smooth", "_centre"}


def test_threads_that_need_the_same_code_at_once(tmp_path: Path) -> None:
    """Each thread gets its result, whichever of them compiles."""
    text = "\n".join(f"def f{n}(x):\n    return x.sum() + {n}\n" for n in range(6))
    (tmp_path / "sums.py").write_text(text)
    spec = importlib.util.spec_from_file_location("sums", tmp_path / "sums.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    arrays = [np.ones(3, kind) for kind in ("f4", "f8", "i4", "i8")] * 2
    with ThreadPoolExecutor(len(arrays)) as pool:
        for n in range(6):
            function = compiled(getattr(module, f"f{n}"))
            assert [*pool.map(function, arrays)] == [3.0 + n] * len(arrays)
    assert len([*tmp_path.rglob("*.nbc")]) == 6 * 4
