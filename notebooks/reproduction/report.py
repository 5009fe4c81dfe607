"""One page on the whole reproduction: paper against ours, and every table, figure and film."""

import sys
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import nbformat
from markupsafe import Markup

from dbthermal import store
from dbthermal.reporting import Section, film_tag, image_tag, save_page, table
from reproduction import numbers as headline
from reproduction import paths

_FIRST = "09_paper"  # paper against ours opens the page


def main() -> None:
    """Write ``results/report.html`` from what `make reproduce` left in ``results/full``."""
    results = paths.results("full")
    notebooks = sorted(
        results.glob("[0-9][0-9]_*.ipynb"), key=lambda one: (one.stem != _FIRST, one)
    )
    if not notebooks:
        raise SystemExit(f"No notebook in '{results}'. Must be made by: make reproduce")
    saved = {one.stem: one.with_suffix(".json") for one in notebooks}
    numbers = {name: headline.read(path) for name, path in saved.items() if path.exists()}
    sections = [Section(_title(one), list(_body(one))) for one in notebooks]
    target = results.parent / "report.html"
    save_page(
        target,
        "Dual-band thermal videography: the paper and this project",
        [section for section in sections if section.body],
        origin="simulated twins, an emulated rig, and the authors' published videos",
        numbers=numbers,
        provenance=store.provenance({"notebooks": list(saved)}),
    )
    sys.stdout.write(f"{target}\n")


def _title(notebook: Path) -> str:
    """First heading of a notebook."""
    cells = nbformat.read(notebook, as_version=4).cells
    texts = (cell.source for cell in cells if cell.cell_type == "markdown")
    lines = (line for text in texts for line in text.splitlines())
    return next((line.lstrip("# ") for line in lines if line.startswith("# ")), notebook.stem)


def _body(notebook: Path) -> Iterator[str]:
    """Yield the tables, figures and films that a notebook saved."""
    for path in sorted(notebook.parent.glob(f"{notebook.stem}_*")):
        words = path.stem.removeprefix(f"{notebook.stem}_").replace("_", " ")
        if path.suffix == ".md":
            yield from _markdown(path.read_text(encoding="utf-8"))
        elif path.suffix == ".png":
            yield image_tag(path, words)
        elif path.suffix == ".mp4":
            yield film_tag(path, words)


def _markdown(text: str) -> Iterator[str | Markup]:
    """Yield the paragraphs and tables of a text in Markdown as `store.save_text` writes it."""
    lines = [line for line in text.splitlines() if not line.startswith(("#", "<!--"))]
    for is_table, block in groupby(lines, lambda line: line.startswith("|")):
        if is_table:
            rows = [[cell.strip(" `*") for cell in line.strip("| ").split("|")] for line in block]
            yield table(rows[0], rows[2:], names=len(rows[0]))
        else:
            paragraph = "\n".join(block).strip()
            if paragraph:
                yield paragraph


if __name__ == "__main__":
    main()
