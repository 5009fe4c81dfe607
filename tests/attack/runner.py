"""Classes of attacks, carried out in a process of their own, which may die of one."""

import multiprocessing
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Final

import numpy as np

from attack import arrays, files, mirrored, stages, steps
from attack.oracle import BAD, GOOD, LIMIT, SECONDS, Attack, Outcome, carry_out

Make = Callable[[np.random.Generator], Attack]

_SHARES: Final = {
    arrays: "clean 6 gray 10 dtypes 4 samples 12 clocks 10 shapes 4 responses 4 windows 5",
    mirrored: "shifts 6 completions 6",
    stages: "offset 6 align 6 register 3 correct_capture 5 fit_response 8",
    steps: "steps 17",
    files: "bits 8 kills 4",
}
CLASSES: Final[Mapping[str, tuple[Make, int]]] = {
    name: (getattr(module, name), int(share))
    for module, words in _SHARES.items()
    for name, share in zip(words.split()[::2], words.split()[1::2], strict=True)
}
"""Class -> its generator, and its share of the inputs."""


@dataclass
class Tally:
    """Outcomes of one class."""

    name: str
    outcomes: dict[int, Outcome] = field(default_factory=dict)
    seconds: float = 0.0

    def counts(self) -> dict[str, int]:
        """Number of each outcome."""
        return dict(Counter(outcome.kind for outcome in self.outcomes.values()))

    @property
    def bad(self) -> list[tuple[int, str, Outcome]]:
        """Seed, kind and outcome of the bad ones."""
        found = self.outcomes.items()
        return [(seed, one.kind, one) for seed, one in found if one.kind in BAD]

    def bad_lines(self) -> list[str]:
        """A line on each bad one."""
        return [f"{self.name}:{n} {kind} | {o.what} | {o.note}" for n, kind, o in self.bad]


def make(name: str, seed: int) -> Attack:
    """Attack of a class and a seed."""
    return CLASSES[name][0](np.random.default_rng([zlib.crc32(name.encode()), seed]))


def only(name: str, seed: int) -> Outcome:
    """Outcome of one attack, in this process."""
    return carry_out(make(name, seed))


def attack_all(names: Sequence[str], inputs: int, seed: int) -> Iterator[tuple[str, Tally]]:
    """Attack with a number of inputs, shared out among the classes, from a seed on."""
    total = sum(CLASSES[name][1] for name in names)
    worker = Worker()
    for name in names:
        number = max(1, round(inputs * CLASSES[name][1] / total))
        start = time.monotonic()
        tally = Tally(name, {n: worker.run(name, n) for n in range(seed, seed + number)})
        tally.seconds = time.monotonic() - start
        yield name, tally
    worker.close()


class Worker:
    """A process that carries out attacks; made anew when one of them kills it."""

    def __init__(self) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._start()

    def _start(self) -> None:
        self._pipe, theirs = self._context.Pipe()
        self.process = self._context.Process(target=_serve, args=(theirs,))
        self.process.start()
        theirs.close()

    def run(self, name: str, seed: int) -> Outcome:
        """Outcome of one attack."""
        self._pipe.send((name, seed))
        outcome = None
        try:
            if self._pipe.poll(20 * SECONDS):  # for what waits, and works not
                outcome = self._pipe.recv()
        except (EOFError, ConnectionError):
            self.process.join()
        if isinstance(outcome, Outcome):
            return outcome
        code = self.process.exitcode
        kind = "hang" if code is None else "crash"
        self.close()
        self._start()
        return Outcome(kind, f"{name}:{seed}", f"exit status {code}")

    def close(self) -> None:
        """End the process."""
        self._pipe.close()
        self.process.join(5)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


def _serve(pipe: Connection) -> None:
    """Carry out what comes, until the pipe is closed."""
    try:
        while True:
            pipe.send(only(*pipe.recv()))
    except EOFError:
        return
    finally:
        files.leave()


def table(tallies: Mapping[str, Tally]) -> list[str]:
    """Table in Markdown: class by outcome, with the sums and the pixels without a flag."""
    head = ["class", "inputs", *GOOD, LIMIT, *BAD, "wrong pixels without a flag"]
    rows = [_row(f"`{name}`", tally.outcomes.values()) for name, tally in tallies.items()]
    every = [one for tally in tallies.values() for one in tally.outcomes.values()]
    rows.append(_row("**all**", every))
    good = sum(one.kind in GOOD for one in every)
    share = f"{good} of {len(every)} handled well: {100 * good / len(every):.2f} %"
    lines = [" | ".join(part) for part in (head, ["---", *["--:"] * (len(head) - 1)], *rows)]
    return [share, "", *(f"| {line} |" for line in lines)]


def _row(name: str, outcomes: Iterable[Outcome]) -> list[str]:
    found = list(outcomes)
    counts = Counter(one.kind for one in found)
    unflagged, wrong = sum(o.unflagged for o in found), sum(o.wrong for o in found)
    pixels = f"{wrong} of {unflagged}" if unflagged > len(found) else ""
    numbers = [str(counts[kind] or "") for kind in (*GOOD, LIMIT, *BAD)]
    return [name, str(len(found)), *numbers, pixels]
