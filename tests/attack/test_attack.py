"""Hostile inputs of every class end well, and the oracle tells when they do not."""

import os
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from attack import oracle
from attack.oracle import Attack, Verdict, carry_out
from attack.runner import CLASSES, Worker, attack_all, table

SHORT, LONG = 300, 6000
"""Inputs of the run in the quick tests, and of the slow one."""

UNMENDED: dict[str, str] = {}
"""Class with inputs that still end badly -> why; none that does not is in it."""


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    """A process for the attacks."""
    made = Worker()
    yield made
    made.close()


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.xfail(reason=UNMENDED[name], strict=True))
        if name in UNMENDED
        else name
        for name in CLASSES
    ],
)
def test_short_attack(worker: Worker, name: str) -> None:
    """No input of a class ends badly."""
    total = sum(share for _, share in CLASSES.values())
    number = 2 if name == "kills" else max(3, SHORT * CLASSES[name][1] // total)
    outcomes = {seed: worker.run(name, seed) for seed in range(1, number + 1)}
    assert not {seed: one for seed, one in outcomes.items() if one.kind in oracle.BAD}


@pytest.mark.slow
def test_long_attack() -> None:
    """Of 6,000 inputs 99 % end well, and of the pixels without a flag at most 0.1 % are wrong."""
    tallies = dict(attack_all(list(CLASSES), LONG, 1001))
    print("", *table(tallies), sep="\n")
    for tally in tallies.values():
        print(*tally.bad_lines(), sep="\n")
    outcomes = [one for tally in tallies.values() for one in tally.outcomes.values()]
    assert sum(one.kind in oracle.BAD for one in outcomes) <= 0.01 * len(outcomes)
    judged = [one for one in outcomes if one.unflagged > 1]  # pixels; of others, one is the whole
    assert sum(one.wrong for one in judged) <= 0.001 * sum(one.unflagged for one in judged)
    whole = sum(one.kind == "silent" for one in outcomes if one.unflagged <= 1)
    assert whole <= 0.001 * len(outcomes)


def _raise(error: Exception) -> Callable[[], Any]:
    def act() -> None:
        raise error

    return act


def _warn() -> None:
    warnings.warn("a library's own", UserWarning, stacklevel=1)


@pytest.mark.parametrize(
    ("act", "kind"),
    [
        (lambda: None, "right"),
        (_raise(KeyError("counts")), "traceback"),
        (_raise(IndexError("counts")), "traceback"),
        (_raise(ValueError("Invalid time. Must rise.")), "traceback"),
        (_raise(ValueError("Invalid counts.")), "traceback"),  # not raised by the package
        (_raise(FileNotFoundError(2, "none", "counts.zarr")), "refused"),
        (_raise(MemoryError("counts")), "memory"),
        (_raise(RuntimeWarning("counts")), "warning"),
        (_warn, "warning"),
        (lambda: bytearray(b"1") * 10**9, "memory"),
    ],
)
def test_oracle(act: Callable[[], Any], kind: str) -> None:
    """Each outcome is told, and an error that names nothing is no refusal."""
    attack = Attack("", act, lambda _: Verdict("right"), ("counts",))
    assert carry_out(attack).kind == kind


def test_dead_process_is_told(worker: Worker) -> None:
    """A process that an attack kills is told as a crash, and made anew."""
    os.kill(worker.process.pid or 0, 9)
    assert worker.run("metrics", 1).kind == "crash"
    assert worker.run("metrics", 1).kind != "crash"
