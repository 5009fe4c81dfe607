"""Promises of docs/trust.md: their tests are there, and their counts are those of the attack."""

import re
from pathlib import Path

from attack.__main__ import counted
from attack.runner import CLASSES

ROOT = Path(__file__).parents[1]
PROMISES, ATTACKS = (
    (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8") for name in ("trust", "attack")
)


def test_tests_are_there() -> None:
    """Each test that the page names is a file or a folder."""
    kept, _, _ = PROMISES.partition("## What is not")
    named = re.findall(r"`((?:\w+/)+|(?:\w+/)*test_\w+\.py)`", kept)
    assert len(set(named)) > 30
    for name in named:
        assert (ROOT / "tests" / name).exists(), name


def test_counts_are_those_of_the_attack() -> None:
    """Each count of hostile inputs is that of docs/attack.md, of a class that is there."""
    assert counted(PROMISES, ATTACKS) == PROMISES
    assert set(re.findall(r"`(\w+)` \d+ of \d+", PROMISES)) <= set(CLASSES)
    assert counted("`bits` 1 of 2", "| `bits` | 9 | 1 |  | 3 | 5 |") == "`bits` 4 of 9"
