"""Classes of attacks, carried out in a process of their own, which may die of one."""

import multiprocessing
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Final

import numpy as np

from attack import arrays, containers, files, mirrored, stages, steps
from attack.oracle import BAD, GOOD, LIMIT, SECONDS, Attack, Verdict, carry_out

_SHARES: Final = {
    arrays: "clean 6 gray 10 dtypes 4 samples 12 clocks 10 shapes 4 responses 4 windows 5",
    mirrored: "shifts 6 completions 6",
    stages: "offset 6 align 6 register 3 correct_capture 5 fit_response 8",
    steps: "steps 17",
    files: "bits 8 kills 4 trees 3 shards 2 names 3",
    containers: "bombs 8 lies 6",
}
CLASSES: Final[Mapping[str, tuple[Callable[[np.random.Generator], Attack], int]]] = {
    name: (getattr(module, name), int(share))
    for module, words in _SHARES.items()
    for name, share in zip(words.split()[::2], words.split()[1::2], strict=True)
}
"""Class -> its generator, and its share of the inputs."""


def only(name: str, seed: int) -> Verdict:
    """Outcome of the attack of a class and a seed, in this process."""
    return carry_out(CLASSES[name][0](np.random.default_rng([zlib.crc32(name.encode()), seed])))


def attack_all(names: Sequence[str], inputs: int, seed: int) -> Iterator[tuple[str, list[Verdict]]]:
    """Attack with a number of inputs, shared out among the classes, from a seed on."""
    total, worker = sum(CLASSES[name][1] for name in names), Worker()
    for name in names:
        number = max(1, round(inputs * CLASSES[name][1] / total))
        yield name, [worker.run(name, n) for n in range(seed, seed + number)]
    worker.pool.shutdown()


class Worker:
    """A process that carries out attacks; made anew when one of them kills it."""

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        self.pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))

    def run(self, name: str, seed: int) -> Verdict:
        """Outcome of one attack."""
        try:
            return self.pool.submit(only, name, seed).result(20 * SECONDS)  # for what waits
        except Exception as error:  # noqa: BLE001 - every error is an outcome
            for process in multiprocessing.active_children():
                process.kill()
            self.pool.shutdown()
            self._start()
            return Verdict("hang" if isinstance(error, TimeoutError) else "crash", repr(error))


def bad(name: str, seed: int, verdicts: Sequence[Verdict]) -> list[str]:
    """A line on each bad one of a class, from a seed on."""
    numbered = enumerate(verdicts, seed)
    return [f"{name}:{n} {v.kind} | {v.what} | {v.note}" for n, v in numbered if v.kind in BAD]


def table(found: Mapping[str, Sequence[Verdict]]) -> list[str]:
    """Table in Markdown: class by outcome, with the sums and the pixels without a flag."""
    kinds, every = (*GOOD, LIMIT, *BAD), [one for some in found.values() for one in some]
    rows = [["class", "inputs", *kinds, "wrong pixels without a flag"], ["---", *["--:"] * 13]]
    for name, some in [*((f"`{name}`", some) for name, some in found.items()), ("**all**", every)]:
        counts = Counter(one.kind for one in some)
        unflagged, wrong = sum(one.unflagged for one in some), sum(one.wrong for one in some)
        pixels = f"{wrong} of {unflagged}" if unflagged > len(some) else ""
        rows.append([name, str(len(some)), *(str(counts[kind] or "") for kind in kinds), pixels])
    good = sum(one.kind in GOOD for one in every)
    share = f"{good} of {len(every)} handled well: {100 * good / len(every):.2f} %"
    return [share, "", *(f"| {' | '.join(row)} |" for row in rows)]
