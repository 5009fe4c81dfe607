"""The house: what each room may weigh, and nouns for its names."""

import ast
from collections.abc import Iterator
from pathlib import Path

import dbthermal

HOUSE = Path(dbthermal.__file__).parent

# Lines and modules that a room may have. A room that grows takes from another; these only fall.
BUDGET = {
    "": (3462, 15),
    "_cli": (1253, 5),
    "alignment": (2786, 10),
    "calibration": (738, 2),
    "correction": (1717, 5),
    "emissivity": (402, 1),
    "explorer": (1250, 6),
    "figures": (582, 2),
    "instruments": (5183, 19),
    "limits": (657, 2),
    "readers": (2773, 10),
    "reporting": (357, 1),
    "separation": (12738, 45),
    "simulation": (522, 1),
    "store": (1358, 6),
}
INSTALLED = 35_778  # lines of all rooms

PRONOUNS = {
    *("one", "other", "others", "own", "part", "parts", "some", "here", "there", "told", "known"),
    *("both", "each", "found", "two", "rest", "left", "inside", "around", "again", "beside"),
    *("alone", "given"),
}
MOST = 0.005  # share of all names; in verde, ccdproc, suite2p and icepack 0.000 to 0.001


def modules() -> Iterator[Path]:
    """Yield the files of the package."""
    yield from sorted(HOUSE.rglob("*.py"))


def room_of(path: Path) -> str:
    """Package that a file is in; empty for the modules beside the packages."""
    return path.relative_to(HOUSE).parts[0] if path.parent != HOUSE else ""


def test_rooms_keep_to_their_budgets() -> None:
    """In lines and modules, each and together; and no room is without one."""
    weights = dict.fromkeys(BUDGET, (0, 0))
    for path in modules():
        lines, files = weights[room_of(path)]
        size = len(path.read_text(encoding="utf-8").splitlines())
        weights[room_of(path)] = lines + size, files + 1
    beyond = [
        "{}: {} lines, {} modules. Must be at most {}, {}: delete as many, or move some of BUDGET "
        "from another package, see CONTRIBUTING.md.".format(room or "base", *weights[room], *most)
        for room, most in BUDGET.items()
        if weights[room][0] > most[0] or weights[room][1] > most[1]
    ]
    assert not beyond, "\n".join(beyond)
    lines = sum(lines for lines, _ in weights.values())
    assert lines <= INSTALLED, f"{lines} lines of all. Must be at most {INSTALLED}: delete as many."


def test_names_are_nouns() -> None:
    """Pronouns and participles stand for no quantity: a reader asks which."""
    names = [
        node.id.strip("_")
        for path in modules()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Name)
    ]
    share = sum(name in PRONOUNS for name in names) / len(names)
    assert share <= MOST
