"""Compare a run's headline numbers with the stored reference numbers.

There is a reference of a run with the outside files and one of a run without; the run's own numbers
decide which applies. Whole numbers and texts must be equal. Other numbers must agree within
`TOLERANCE`: processors round differently, and where a pixel's choice depends on the last digit, a
median over pixels may move by a fraction of this.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from reproduction import accuracy, integrity, paper, paths
from reproduction import numbers as headline

TOLERANCE: Final = 0.01  # largest difference of two numbers, relative to the larger of the two [1]

MARKS: Final = ("<!-- paper_vs_ours -->", "<!-- end of paper_vs_ours -->")
"""Marks around the comparison with the paper in docs/paper.md."""

Numbers = dict[str, headline.Number]


def reference_path() -> Path:
    """Reference numbers, a JSON file: kind of run -> stem -> name -> number."""
    return paths.root() / "tests" / "reference_numbers.json"


def read_run(run: str) -> dict[str, Numbers]:
    """Headline numbers of every notebook of a run, stem -> name -> number.

    RuntimeError if one of the notebooks is running, was interrupted, or has left other numbers,
    FileNotFoundError if all are missing.
    """
    stems = [path.stem for path in paths.results(run).glob("[0-9][0-9]_*.ipynb")]
    listed = {
        file for stem in stems for file in integrity.files(run, stem) if file.suffix == ".json"
    }
    top = paths.results(run)
    files = sorted({file for file in listed if file.parent == top} | {*top.glob("*.json")})
    if not files:
        rule = "Must be made by 'make reproduce'"
        raise FileNotFoundError(f"Missing numbers of run '{run}'. {rule}.")
    numbers = {}
    for path in files:
        with integrity.reading(path):
            numbers[paths.finished(run, path.stem)] = headline.read(path)
    return numbers


def kind_of(numbers: Mapping[str, Numbers]) -> str:
    """Reference of a run, "with data" or "without data", by the libraries that it read."""
    libraries = numbers.get("02_emissivity", {}).get("libraries")
    return "without data" if libraries == "embedded" else "with data"


def compare(
    numbers: Mapping[str, Numbers], reference: Mapping[str, Numbers]
) -> Iterator[tuple[str, object, object]]:
    """Yield name with stem, number and reference; None for a number that one of them lacks."""
    for stem in sorted({*numbers, *reference}):
        values, expected = numbers.get(stem, {}), reference.get(stem, {})
        for name in sorted({*values, *expected}):
            yield f"{stem}: {name}", values.get(name), expected.get(name)


def agree(value: object, expected: object) -> bool:
    """True if equal and of one type, or two floats within `TOLERANCE`."""
    if isinstance(value, float) and isinstance(expected, float):
        return abs(value - expected) <= TOLERANCE * max(abs(value), abs(expected))
    return value == expected and type(value) is type(expected)


def enclosed(page: str, marks: tuple[str, str], text: str, name: str) -> str:
    """Page with a text between two marks; `name` is the page's in an error."""
    head, start, after_start = page.partition(marks[0])
    _, stop, tail = after_start.partition(marks[1])
    if not (start and stop):
        raise ValueError(f"Missing marks {marks} in {name}. Must enclose its table.")
    return f"{head}{start}\n\n{text}\n{stop}{tail}"


def pages(numbers: Mapping[str, Numbers]) -> Iterator[tuple[Path, str]]:
    """Yield each page that holds reference numbers, with its text for these numbers."""
    for name, marks, text in (
        ("docs/paper.md", MARKS, paper.markdown(numbers)),
        ("docs/accuracy.md", accuracy.MARKS, accuracy.markdown(numbers)),
        ("README.md", accuracy.README_MARKS, accuracy.figure_6(numbers)),
    ):
        page = paths.root() / name
        yield page, enclosed(page.read_text(encoding="utf-8"), marks, text, name)


def record(numbers: Mapping[str, Numbers], reference: Mapping[str, object]) -> None:
    """Keep a run's numbers as the reference of its kind; with data, on the pages, too."""
    kind = kind_of(numbers)
    text = json.dumps({**reference, kind: numbers}, indent=1, sort_keys=True)
    reference_path().write_text(text + "\n", encoding="utf-8")
    if kind == "with data":
        for page, text in pages(numbers):
            page.write_text(text, encoding="utf-8")
    print(f"kept {sum(map(len, numbers.values()))} numbers, {kind}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the comparison, or record the reference; exit status 1 if any number disagrees."""
    parser = argparse.ArgumentParser(prog="python -m reproduction.verify", description=__doc__)
    parser.add_argument("--run", default="full", help="folder below results/")
    parser.add_argument("--record", action="store_true", help="keep the numbers as the reference")
    options = parser.parse_args(arguments)
    try:
        numbers, path = read_run(options.run), reference_path()
    except (OSError, RuntimeError, ValueError) as error:
        print(error, file=sys.stderr)
        return 1
    reference = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if options.record:
        record(numbers, reference)
        return 0
    kind, failed = kind_of(numbers), 0
    rows = list(compare(numbers, reference.get(kind, {})))
    for name, value, expected in rows:
        agrees = agree(value, expected)
        failed += not agrees
        print(f"ok    {name} = {value}" if agrees else f"FAIL  {name} = {value}, not {expected}")
    print(f"{len(rows) - failed} of {len(rows)} numbers agree within {TOLERANCE:.0%}, {kind}")
    return 1 if failed or not rows else 0


if __name__ == "__main__":
    sys.exit(main())
