"""Text from elsewhere is read strictly, or refused with file, line, column and rule."""

import json
import os
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dbthermal import _text as texts
from dbthermal.readers import read_yaml

WORDS = st.text(st.characters(exclude_categories=["C", "Zl", "Zp"]))
LEAVES = st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(0.001, 1e9) | WORDS


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a\nb\xffc", r"a\.txt, line 2, column 2: Invalid byte 0xff. Must be text in utf-8"),
        (b"a\r\nb\x00", r"a\.txt, line 2, column 2: Invalid control character '\\x00'"),
        (b"\xff\xfea\x00", r"a\.txt, line 1, column 1: Invalid byte 0xff"),
        (b"x" * 33, r"Invalid size 33 bytes of '.*a\.txt'. Must be at most 32"),
    ],
)
def test_text_is_refused_with_its_place(tmp_path: Path, content: bytes, message: str) -> None:
    """Bytes that are no text are named with line and column, a large file with its size."""
    path = tmp_path / "a.txt"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        texts.read_text(path, limit=32)


def test_only_regular_files_are_opened(tmp_path: Path) -> None:
    """A folder, a pipe and a device are refused; nothing waits for a pipe's other end."""
    os.mkfifo(tmp_path / "pipe")
    for path, kind in ((tmp_path, "folder"), (tmp_path / "pipe", "pipe"), ("/dev/zero", "pipe")):
        with pytest.raises(ValueError, match=f"a {kind}.* Must be a regular file"):
            texts.read_text(path)
    with pytest.raises(FileNotFoundError, match=r"absent\.txt"):
        texts.read_text(tmp_path / "absent.txt")


def test_marks_and_line_ends_are_no_content(tmp_path: Path) -> None:
    """A byte-order mark is taken off, and every kind of line end is a newline."""
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xef\xbb\xbfa\r\nb\rc\n")
    assert texts.read_text(path) == "a\nb\nc\n"


@pytest.mark.parametrize("text", ["1", "-1.5", ".5", "3.", "1e3", "1E-3", " 7\t"])
def test_decimal_numbers(text: str) -> None:
    """Decimal numbers have Python's value."""
    assert texts.number(text, "a") == float(text)


@pytest.mark.parametrize(
    "text", ["", "nan", "inf", "1e999", "1_000", "1,5", "1 000", "1,000.0", "0x10", "١٢", "1d3"]
)
def test_what_is_no_decimal_number(text: str) -> None:
    """Words, separators, other digits and what is beyond the floats are refused by place."""
    with pytest.raises(ValueError, match=f"^f, line 3: Invalid number {re.escape(repr(text))}"):
        texts.number(text, "f, line 3")


@given(st.dictionaries(WORDS, st.recursive(LEAVES, st.lists, max_leaves=20)))
def test_yaml_of_json_is_read_back(content: dict[str, object]) -> None:
    """What json writes, which is YAML, is read back as it was."""
    assert texts.parse_yaml(json.dumps(content, ensure_ascii=False), "a") == content


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: 2\na: 3", "line 3, column 1: Repeated key 'a'. Must be listed once"),
        ("a: {1: x, '1': y}", "line 1, column 11: Repeated key '1'"),
        ("a: {b: 1, c: {d: 1, d: 2}}", "line 1, column 21: Repeated key 'd'"),
        ("null: 1", "line 1, column 1: Invalid key None. Must be text or a number"),
        ("{[1]: 1}", "Invalid key [1]"),
        ("a: on", "line 1, column 4: Invalid value on. Must be a finite decimal number, true"),
        *((f"a: {value}", f"Invalid value {value}. Must") for value in ("No", "012", "0o17")),
        *((f"a: {value}", f"Invalid value {value}. Must") for value in ("12:30", "1_000", "1e3")),
        *((f"a: {value}", f"Invalid value {value}. Must") for value in (".inf", "-.5", "1.0e+999")),
        *((f"a: {value}", f"Invalid value {value}. Must") for value in ("2026-01-02", "0x1F", "=")),
        ("a: " + "9" * 5000, "Invalid value 999"),
        ("a: {<<: {b: 1}}", "Invalid value <<"),
        ("a: &x [1]\nb: *x", "line 1, column 4: Invalid anchor or alias 'x'. Must be written out"),
        ("a: !!python/name:os.system ''", "Invalid tag 'tag:yaml.org,2002:python/name:os.system'"),
        ("a: " + "[" * 60 + "]" * 60, "line 1, column 53: Invalid nesting deeper than 50"),
        ("- " * 200_000, "Invalid nesting deeper than 50"),
        ("a: 1\n---\nb: 2", "line 2, column 1: Invalid second document. Must be one"),
        ("", "Invalid content None. Must be a mapping"),
        ("[1, 2]", "Invalid content [1, 2]. Must be a mapping"),
        ("x" * 500, "xxx... (502 characters). Must be a mapping"),
        ("a: [1", "line 2, column 1: Must be YAML"),
        ("a: \t- b: \x01", "Must be YAML"),
        ("a: '\ud800'", "Must be YAML"),
    ],
)
def test_yaml_is_refused_in_one_line(text: str, message: str) -> None:
    """Repeated keys, ambiguous values, references and tags are refused by place and rule."""
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        texts.parse_yaml(text, "f.yaml")
    assert str(error.value).startswith("f.yaml")
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300


def test_project_files_are_plain_yaml() -> None:
    """The parameters and sessions of the project, and its list of files, are read."""
    root = Path(__file__).parents[1]
    files = [*(root / "params").rglob("*.yaml"), root / "data_manifest.yaml"]
    assert all(read_yaml(path) for path in files)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": 1,\n "a": 2}', "f.json: Repeated key 'a'. Must be listed once"),
        ('{"a": NaN}', "f.json: Invalid number 'NaN'. Must be finite"),
        ('{"a": 1e999}', "f.json: Invalid number '1e999'. Must be finite"),
        ('{"a": ' + "9" * 5000 + "}", "f.json: Invalid number '9999"),
        ('{"a": 1,\n', "f.json, line 2, column 1: Must be JSON"),
        ("[" * 100_000, "f.json: Invalid nesting. Must be less deep"),
    ],
)
def test_json_is_refused_by_place(text: str, message: str) -> None:
    """Repeated keys, numbers that are not finite and text that is no JSON name the file."""
    with pytest.raises(ValueError, match=re.escape(message)):
        texts.parse_json(text, "f.json")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n3", "f.csv, line 3: Truncated line '3'. Must end with a line end"),
        ('a,b\n1,"2\n', "f.csv, line 2: Must be comma-separated values"),
        ("a,b\n1,2,3\n", "f.csv, line 2: Invalid row ['1', '2', '3']. Must be 2 numbers"),
        ("a,b\n\n", "f.csv, line 2: Invalid row [].* Must be 2 numbers".replace(".*", ".")),
        ("a,b\n1,2\n1,2_0\n", "f.csv, line 3, column 2: Invalid number '2_0'. Must be finite"),
        ("a,b\n", "Empty table in 'f.csv'. Must hold at least one row"),
    ],
)
def test_tables_are_refused_by_place(text: str, message: str) -> None:
    """Rows that are cut, short or no numbers are named by line and column."""
    with pytest.raises(ValueError, match=re.escape(message)):
        texts.numbers(texts.table_rows(text, "f.csv")[1:], 2, "f.csv")
