"""Hostile inputs of every class end well, and the oracle tells when they do not."""

import os
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
from hostile_files import seed_of_week
from marks import long

from attack import oracle
from attack.containers import BOMBS, FALSE, TRUE, container
from attack.oracle import Attack, Verdict, carry_out
from attack.runner import CLASSES, Worker, attack_all, bad, table

SHORT, WEEKLY, LONG = 200, 1500, 6000
"""Inputs of the quick tests, and of the long ones, of which some are others every week."""


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    """A process for the attacks."""
    made = Worker()
    yield made
    made.pool.shutdown()


@pytest.mark.parametrize("name", CLASSES)
def test_short_attack(worker: Worker, name: str) -> None:
    """No input of a class ends badly."""
    total = sum(share for _, share in CLASSES.values())
    number = 2 if name == "kills" else max(3, SHORT * CLASSES[name][1] // total)
    assert not bad(name, 1, [worker.run(name, seed) for seed in range(1, number + 1)])


@pytest.mark.parametrize("name", [*BOMBS, *FALSE, *TRUE])
def test_each_container(name: str) -> None:
    """No container ends badly, at three sizes of each."""
    for seed in range(3):
        verdict = carry_out(container(np.random.default_rng(seed), name))
        assert verdict.kind in oracle.GOOD, verdict


@pytest.mark.parametrize(
    ("number", "seed"),
    long((WEEKLY, 1000 * seed_of_week()), (LONG, 1001)),
    ids=["of this week", "long"],
)
def test_many_attacks(number: int, seed: int) -> None:
    """99 % of the inputs end well, and of the pixels without a flag at most 0.1 % are wrong.

    Of 1,500 inputs, which are too few for the second, at most 0.5 % are silent, and the share of
    pixels is not surely above it: wrong pixels come by inputs, so the sum of their squares is the
    variance of their number.
    """
    found = dict(attack_all(list(CLASSES), number, seed))
    print(f"DBTHERMAL_SEED={seed_of_week()}, first seed {seed}", *table(found), sep="\n")
    print(*(line for name, some in found.items() for line in bad(name, seed, some)), sep="\n")
    outcomes = [one for some in found.values() for one in some]
    assert sum(one.kind in oracle.BAD for one in outcomes) <= 0.01 * len(outcomes)
    assert sum(one.kind == "silent" for one in outcomes) <= 0.005 * len(outcomes)
    judged = [one for one in outcomes if one.unflagged > 1]  # pixels; of others, one is the whole
    wrong, total = (sum(getattr(one, n) for one in judged) for n in ("wrong", "unflagged"))
    whole = sum(one.kind == "silent" for one in outcomes if one.unflagged <= 1)
    if number < LONG:
        wrong -= 1.64 * sum(one.wrong**2 for one in judged) ** 0.5
        whole = 0
    assert wrong <= 0.001 * total
    assert whole <= 0.001 * len(outcomes)


def _raise(error: Exception) -> None:
    raise error


@pytest.mark.parametrize(
    ("act", "kind"),
    [
        (lambda: None, "right"),
        (partial(_raise, KeyError("counts")), "traceback"),
        (partial(_raise, IndexError("counts")), "traceback"),
        (partial(_raise, ValueError("Invalid time. Must rise.")), "traceback"),
        (partial(_raise, ValueError("Invalid counts.")), "traceback"),  # not raised by the package
        (partial(_raise, FileNotFoundError(2, "none", "counts.zarr")), "refused"),
        (partial(_raise, MemoryError("counts")), "memory"),
        (partial(_raise, RuntimeWarning("counts")), "warning"),
        (partial(warnings.warn, "a library's own"), "warning"),
        (lambda: bytearray(b"1") * 10**9, "memory"),
    ],
)
def test_oracle(act: Callable[[], Any], kind: str) -> None:
    """Each outcome is told, and an error that names nothing is no refusal."""
    attack = Attack("", act, lambda _: Verdict("right"), ("counts",))
    assert carry_out(attack).kind == kind


def test_dead_process_is_told(worker: Worker) -> None:
    """A process that an attack kills is told as a crash, and made anew."""
    os.kill(worker.pool.submit(os.getpid).result(), 9)
    assert worker.run("bits", 1).kind == "crash"
    assert worker.run("bits", 1).kind != "crash"


def test_time_of_the_processor_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """What works without end is a hang; what waits for a while, as on a busy machine, is not."""
    monkeypatch.setattr(oracle, "SECONDS", 0.1)
    works, waits = (lambda: [one for one in iter(int, 1) if one]), partial(time.sleep, 0.3)
    for act, kind in ((works, "hang"), (waits, "right")):
        assert carry_out(Attack("", act, lambda _: Verdict("right"))).kind == kind
