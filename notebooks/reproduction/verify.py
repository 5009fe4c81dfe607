"""Compare a run's headline numbers with the stored reference numbers.

The references are those of a run with the outside files at hand, and of one without; which of the
two a run is follows from its own numbers. Whole numbers and texts must be equal. Other numbers
must agree within `TOLERANCE`: processors round differently, and where a pixel's choice hangs on
the last digit, a median over pixels may move by a fraction of this.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from dbthermal import store
from reproduction import paper, paths

TOLERANCE: Final = 0.01
"""Largest difference of two numbers, relative to the larger of the two [1]."""

_SOURCE: Final = ("02_emissivity", "libraries", "embedded")

MARKS: Final = ("<!-- paper_vs_ours -->", "<!-- end of paper_vs_ours -->")
"""What encloses the comparison with the paper in the README."""

Numbers = dict[str, store.Number]


def reference_path() -> Path:
    """
    Return where the reference numbers are kept.

    Returns
    -------
    Path
        A JSON file: kind of run -> stem -> name -> number.
    """
    return paths.root() / "tests" / "reference_numbers.json"


def read_run(run: str) -> dict[str, Numbers]:
    """
    Headline numbers of every notebook of a run.

    Parameters
    ----------
    run : str
        Folder below results/.

    Returns
    -------
    dict
        Stem -> name -> number.

    Raises
    ------
    FileNotFoundError
        If the run has no numbers.
    """
    files = sorted(paths.results(run).glob("*.json"))
    if not files:
        raise FileNotFoundError(
            f"Missing numbers of run '{run}'. Must be made by 'make reproduce'."
        )
    return {path.stem: store.read_numbers(path) for path in files}


def kind_of(numbers: Mapping[str, Numbers]) -> str:
    """
    Return which reference a run is to be compared with.

    Parameters
    ----------
    numbers : mapping
        From `read_run`.

    Returns
    -------
    str
        "with data" or "without data".
    """
    stem, name, embedded = _SOURCE
    return "without data" if numbers.get(stem, {}).get(name) == embedded else "with data"


def compare(
    found: Mapping[str, Numbers], reference: Mapping[str, Numbers]
) -> Iterator[tuple[str, object, object, bool]]:
    """
    Compare number by number.

    Parameters
    ----------
    found, reference : mapping
        Stem -> name -> number.

    Yields
    ------
    tuple
        Name with its stem, number found, reference, and whether they agree. A number that only
        one of the two has is None in the other, and does not agree.
    """
    for stem in sorted({*found, *reference}):
        here, there = found.get(stem, {}), reference.get(stem, {})
        for name in sorted({*here, *there}):
            value, expected = here.get(name), there.get(name)
            yield f"{stem}: {name}", value, expected, agree(value, expected)


def agree(value: object, expected: object) -> bool:
    """
    Whether two numbers agree, see `TOLERANCE`.

    Parameters
    ----------
    value, expected : object
        Numbers, texts or None.

    Returns
    -------
    bool
        True if equal, or two floats within the tolerance.
    """
    if isinstance(value, float) and isinstance(expected, float):
        return abs(value - expected) <= TOLERANCE * max(abs(value), abs(expected))
    return value == expected and type(value) is type(expected)


def with_table(readme: str, numbers: Mapping[str, Numbers]) -> str:
    """
    Put the comparison with the paper into the README.

    Parameters
    ----------
    readme : str
        Its text, with the two marks that the table stands between.
    numbers : mapping
        From `read_run`.

    Returns
    -------
    str
        The text with the table of these numbers.

    Raises
    ------
    ValueError
        If a mark is missing.
    """
    head, start, rest = readme.partition(MARKS[0])
    _, stop, tail = rest.partition(MARKS[1])
    if not (start and stop):
        raise ValueError(f"Missing marks {MARKS} in the README. Must enclose its table.")
    return f"{head}{start}\n\n{paper.markdown(numbers)}\n{stop}{tail}"


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Print the comparison, or keep a run's numbers as the reference.

    Parameters
    ----------
    arguments : sequence of str, optional
        Command line; ``--run NAME``, ``--record``.

    Returns
    -------
    int
        0 if all numbers agree, else 1.
    """
    parser = argparse.ArgumentParser(prog="python -m reproduction.verify", description=__doc__)
    parser.add_argument("--run", default="full", help="folder below results/")
    parser.add_argument("--record", action="store_true", help="keep the numbers as the reference")
    options = parser.parse_args(arguments)
    found, path = read_run(options.run), reference_path()
    kind = kind_of(found)
    reference = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if options.record:
        text = json.dumps({**reference, kind: found}, indent=1, sort_keys=True)
        path.write_text(text + "\n", encoding="utf-8")
        if kind == "with data":
            readme = paths.root() / "README.md"
            shown = with_table(readme.read_text(encoding="utf-8"), found)
            readme.write_text(shown, encoding="utf-8")
        print(f"kept {sum(map(len, found.values()))} numbers, {kind}")
        return 0
    rows = list(compare(found, reference.get(kind, {})))
    for name, value, expected, fits in rows:
        print(
            f"{'ok  ' if fits else 'FAIL'}  {name} = {value}"
            + ("" if fits else f", not {expected}")
        )
    failed = sum(not fits for *_, fits in rows)
    print(f"{len(rows) - failed} of {len(rows)} numbers agree within {TOLERANCE:.0%}, {kind}")
    return 1 if failed or not rows else 0


if __name__ == "__main__":
    sys.exit(main())
