"""Strict reading of text from other programs: files, numbers, tables and YAML.

`read_text` opens regular files of a limited size, `number` takes decimal numbers alone,
`table_rows` and `numbers` whole tables, `parse_yaml` mappings that mean the same in YAML 1.1 and
1.2. Nothing is guessed; errors name the line and the rule.
"""

import csv
import math
import os
import re
import stat
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np
from numpy.typing import NDArray

Row = tuple[int, list[str]]  # row of a table and its line in the file, from 1

TEXT_LIMIT: Final = 2**26  # largest table that is read [byte]; public libraries have 0.7 MB
YAML_LIMIT: Final = 2**20  # largest YAML file that is read [byte]
SHOWN: Final = 60  # longest value in a message [character]

_DEPTH: Final = 50  # of nested lists and mappings in YAML
_LARGEST: Final = 2**53  # up to here whole numbers are exact also as float
_CONTROL: Final = re.compile(r"[\x00-\x08\x0b-\x1f\x7f]")
_DECIMAL: Final = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")
# Numbers that YAML 1.1 and 1.2 read alike: 012, 1e3 and 1_000 are not among them.
_WHOLE: Final = re.compile(r"[-+]?(0|[1-9][0-9]{,15})")
_REAL: Final = re.compile(r"([-+]?(0|[1-9][0-9]*)\.[0-9]*|\.[0-9]+)([eE][-+][0-9]+)?")


def as_path(path: Any) -> Path:
    """Path of text or of a path; TypeError for anything else, FileNotFoundError for an address."""
    if not isinstance(path, str | os.PathLike):
        kind = type(path).__name__
        raise TypeError(f"Invalid path {shown(path)}, a {kind}. Must be text or a path.")
    if "://" in os.fspath(path):
        raise FileNotFoundError(f"No file or folder '{path}', an address. Must be on this machine.")
    if "\0" in os.fsdecode(path):
        raise ValueError(f"Invalid path {shown(path)}. Must have no zero byte.")
    return Path(path)


def regular_file(path: str | Path, limit: int) -> Path:
    """Path of a regular file of at most `limit` bytes; others are refused without being opened."""
    if not (path := as_path(path)).exists():
        raise FileNotFoundError(f"No file or folder '{path}'. Must exist, without '*' or '~'.")
    state = path.stat()
    if not stat.S_ISREG(state.st_mode):
        kind = "folder" if stat.S_ISDIR(state.st_mode) else "pipe, socket or device"
        raise ValueError(f"Invalid file '{path}', a {kind}. Must be a regular file.")
    if (size := state.st_size) > limit:
        raise ValueError(f"Invalid size {size} bytes of '{path}'. Must be at most {limit}.")
    return path


def tree_files(root: Path) -> Iterator[str]:
    """Yield relative names of a folder's files; ValueError for links, pipes and devices in it."""
    folders = [os.fspath(root)]
    while folders:
        with os.scandir(folders.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    folders.append(entry.path)
                elif entry.is_file(follow_symlinks=False):
                    yield Path(entry.path).relative_to(root).as_posix()
                elif os.path.lexists(entry.path):  # a draft may have got its name meanwhile
                    kind = "link" if entry.is_symlink() else "pipe, socket or device"
                    label = f"Invalid '{Path(entry.path).relative_to(root)}' in '{root}', a {kind}"
                    raise ValueError(f"{label}. Must be a regular file in it.")


def read_text(path: str | Path, *, encoding: str = "utf-8", limit: int = TEXT_LIMIT) -> str:
    """Text of a `regular_file` with newlines, without byte-order mark; ValueError by line."""
    content = regular_file(path, limit).read_bytes()
    try:
        text = content.decode(encoding).removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        place = _after(os.fspath(path), content[: error.start].decode("latin-1"))
        byte = f"0x{content[error.start]:02x}"
        raise ValueError(f"{place}: Invalid byte {byte}. Must be text in {encoding}.") from error
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if control := _CONTROL.search(text):
        place = _after(os.fspath(path), text[: control.start()])
        raise ValueError(f"{place}: Invalid control character {control.group()!r}. Must be text.")
    return text


def _after(source: str, before: str) -> str:
    """Place of the character that follows a piece of text."""
    return at(source, before.count("\n") + 1, len(before) - before.rfind("\n"))


def at(source: str, line: int, column: int | None = None) -> str:
    """Place in a text, for the beginning of a message; lines and columns count from 1."""
    return f"{source}, line {line}" + ("" if column is None else f", column {column}")


def shown(value: object) -> str:
    """Value as a message shows it: in one line, and cut where it is long."""
    text = repr(value).replace("\n", " ")  # of arrays and datasets
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}... ({len(text)} characters)"


def missing_library(name: str | None, extra: str) -> str:
    """Message that a library is not installed, with the command that installs its extra."""
    rule = f"Must be installed, in a clone: python -m pip install '.[{extra}]'"
    return f"Missing library '{name}', of the extra '{extra}'. {rule}."


def repeated(values: Iterable[Any]) -> list[Any]:
    """Values that occur more than once, in their order."""
    return [value for value, count in Counter(values).items() if count > 1]


def check_listed(label: str, value: Any, listed: Iterable[Any], error: Any = ValueError) -> None:
    """Raise an error for a value that is not among those of a list, with these."""
    if value not in (allowed := [*listed]):
        raise error(f"{label} {shown(value)}. Must be one of {allowed}.")


def number(text: str, place: str) -> float:
    """Finite number written in decimal digits; ValueError with its `place` if it is not one."""
    text = text.strip(" \t")
    value = float(text) if _DECIMAL.fullmatch(text) else math.nan
    if not math.isfinite(value):
        rule = "Must be finite, and written in digits with a decimal point"
        raise ValueError(f"{place}: Invalid number {shown(text)}. {rule}.")
    return value


def table_rows(text: str, source: str, *, comment: str | None = None) -> list[Row]:
    """Rows of comma-separated values without comments; ValueError if a row or the file was cut."""
    rows: list[Row] = []
    for i, line in enumerate(whole_lines(text, source), 1):
        if comment is None or not line.startswith(comment):
            try:
                rows.extend((i, row) for row in csv.reader([line], strict=True))
            except csv.Error as error:
                rule = "Must be comma-separated values"
                raise ValueError(f"{at(source, i)}: {rule}: {error}.") from error
    return rows


def whole_lines(text: str, source: str) -> list[str]:
    """Lines of a text; ValueError if the last one has no end."""
    *lines, remainder = text.split("\n")
    if remainder:
        message = f"Truncated line {shown(remainder)}. Must end with a line end."
        raise ValueError(f"{at(source, len(lines) + 1)}: {message}")
    return lines


def numbers(rows: Sequence[Row], width: int, source: str) -> NDArray[np.float64]:
    """Values (row, column) of rows that must all be `width` numbers; see `number`."""
    if not rows:
        raise ValueError(f"Empty table in '{source}'. Must hold at least one row.")
    values = list[list[float]]()
    for line, row in rows:
        if len(row) != width:
            place = at(source, line)
            raise ValueError(f"{place}: Invalid row {shown(row)}. Must be {width} numbers.")
        values.append([number(text, at(source, line, n)) for n, text in enumerate(row, 1)])
    return np.array(values)


def read_yaml(path: str | Path) -> dict[Any, Any]:
    """Mapping in a YAML file, whose values mean the same in YAML 1.1 and 1.2.

    Keys are text or numbers; values are mappings, lists, text, finite numbers, bool or None. A
    ValueError names file, line, column and rule for: text that is no YAML, or no mapping; repeated
    keys (also ``1`` beside ``"1"``); anchors, aliases, tags, several documents, deep nesting;
    numbers that are not finite; and plain values that the versions of YAML read differently, such
    as ``on``, ``012``, ``12:30``, ``1e3`` or a date. In quotes they are text.

    Parameters
    ----------
    path : str or Path
        Regular file in UTF-8 of at most `YAML_LIMIT` bytes; OSError if it cannot be opened.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "a.yaml")
    ...     size = path.write_text("{name: plate, shape: [4, 6], 9.5: true}")
    ...     read_yaml(path)
    {'name': 'plate', 'shape': [4, 6], 9.5: True}
    """
    return parse_yaml(read_text(path, limit=YAML_LIMIT), os.fspath(path))


def parse_yaml(text: str, source: str) -> dict[Any, Any]:
    """Mapping in a text, as `read_yaml` has it of a file; `source` is its name in messages."""
    import yaml  # noqa: PLC0415 - of the extra `instruments`; most of the package does without

    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # of C ten times as fast
    try:
        content = _Document(yaml.parse(text, loader), source).content()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = at(source, mark.line + 1, mark.column + 1) if mark else source
        raise ValueError(f"{place}: Must be YAML: {error.problem}.") from error
    except (yaml.YAMLError, UnicodeError) as error:
        raise ValueError(f"{source}: Must be YAML: {' '.join(str(error).split())}.") from error
    if not isinstance(content, dict):
        raise ValueError(f"{source}: Invalid content {shown(content)}. Must be a mapping.")
    return content


class _Document:
    """YAML document, read from the events of its parser, so that depth and aliases cost nothing."""

    def __init__(self, events: Iterator[Any], source: str) -> None:
        import yaml  # noqa: PLC0415

        self.events, self.source, self.yaml = events, source, yaml
        self.resolver: Any = yaml.resolver.Resolver()

    def content(self) -> Any:
        """Value of the document; None without one."""
        values: list[Any] = []
        for event in self.events:
            if isinstance(event, self.yaml.DocumentStartEvent):
                if values:
                    self._refuse(event, "Invalid second document. Must be one")
                values.append(self._value(next(self.events), 0))
        return values[0] if values else None

    def _value(self, event: Any, depth: int) -> Any:
        """Value that begins with an event; takes the events up to its end."""
        if event.anchor is not None:
            self._refuse(event, f"Invalid anchor or alias '{event.anchor}'. Must be written out")
        if event.tag not in {None, "!"}:
            self._refuse(event, f"Invalid tag '{event.tag}'. Must be left out")
        if isinstance(event, self.yaml.ScalarEvent):
            return self._plain(event) if event.implicit[0] else event.value
        if depth >= _DEPTH:
            self._refuse(event, f"Invalid nesting deeper than {_DEPTH}. Must be less deep")
        entries = takewhile(lambda e: not isinstance(e, self.yaml.CollectionEndEvent), self.events)
        if isinstance(event, self.yaml.SequenceStartEvent):
            return [self._value(entry, depth + 1) for entry in entries]
        pairs: dict[str, tuple[Any, Any]] = {}  # by the key as text: 1 and "1" are the same
        for entry in entries:
            key = self._value(entry, depth + 1)
            if isinstance(key, bool) or not isinstance(key, str | int | float):
                self._refuse(entry, f"Invalid key {shown(key)}. Must be text or a number")
            if str(key) in pairs:
                self._refuse(entry, f"Repeated key {shown(key)}. Must be listed once")
            pairs[str(key)] = key, self._value(next(self.events), depth + 1)
        return dict(pairs.values())

    def _plain(self, event: Any) -> Any:
        """Value of a plain scalar, if all versions of YAML read it alike."""
        text = event.value
        tag = self.resolver.resolve(self.yaml.ScalarNode, text, (True, False)).split(":")[-1]
        if tag == "null":
            return None
        if tag == "bool" and text.lower() in {"true", "false"}:
            return text.lower() == "true"
        if tag == "int" and _WHOLE.fullmatch(text) and abs(int(text)) <= _LARGEST:
            return int(text)
        if tag == "float" and _REAL.fullmatch(text) and math.isfinite(float(text)):
            return float(text)
        if tag != "str" or _DECIMAL.fullmatch(text) or re.fullmatch("0o[0-7]+", text):
            rule = "Must be a finite decimal number, true, false, or in quotes if it is text"
            self._refuse(event, f"Invalid value {text[:SHOWN]}. {rule}")
        return text

    def _refuse(self, event: Any, message: str) -> NoReturn:
        place = at(self.source, event.start_mark.line + 1, event.start_mark.column + 1)
        raise ValueError(f"{place}: {message}.")
