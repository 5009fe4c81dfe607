"""Text from elsewhere is read strictly, or refused with file, line, column and rule."""

import json
import os
import re
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st
from refused import assert_raises, assert_refused

from dbthermal.readers import read_yaml
from reproduction import libraries

WORDS = st.text(st.characters(exclude_categories=["C", "Zl", "Zp"]))
LEAVES = st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(0.001, 1e9) | WORDS


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a\nb\xffc", r"a\.yaml, line 2, column 2: Invalid byte 0xff. Must be text in utf-8"),
        (b"a\r\nb\x00", r"a\.yaml, line 2, column 2: Invalid control character '\\x00'"),
        (b"\xff\xfea\x00", r"a\.yaml, line 1, column 1: Invalid byte 0xff"),
        (b"x" * 10**8, r"Invalid size 100000000 bytes of '.*a\.yaml'. Must be at most"),
    ],
)
def test_text_is_refused_with_its_place(tmp_path: Path, content: bytes, message: str) -> None:
    """Bytes that are no text are named with line and column, a large file with its size."""
    path = tmp_path / "a.yaml"
    path.write_bytes(content)
    assert_refused(message, read_yaml, path)


def test_only_regular_files_are_opened(tmp_path: Path) -> None:
    """A folder, a pipe and a device are refused; nothing waits for a pipe's other end."""
    os.mkfifo(tmp_path / "pipe")
    for path, kind in ((tmp_path, "folder"), (tmp_path / "pipe", "pipe"), ("/dev/zero", "pipe")):
        assert_refused(f"a {kind}.* Must be a regular file", read_yaml, path)
    assert_raises(FileNotFoundError, r"absent\.txt", read_yaml, tmp_path / "absent.txt")


def emissivity(folder: Path, text: str) -> float:
    """Number in a table of spectra, after a byte-order mark, with line ends of all kinds."""
    path = folder / "f.csv"
    path.write_bytes(b"\xef\xbb\xbf" + f"wavelength,A1\r\n8,{text}\r14,0.5\n".encode())
    return float(libraries.slum(path)["A1"]["emissivity"][0])


def test_decimal_numbers(tmp_path: Path) -> None:
    """Decimal numbers have Python's value; words, other digits and separators are refused."""
    for text in ("1", "0.75", ".5", "1.", "1e0", "5E-1", " 0.7\t"):
        assert emissivity(tmp_path, text) == float(text)
    for text in ("", "nan", "inf", "1e999", "1_000", "1 000", "0x10", "\u0661\u0662", "1d3"):
        message = f"f.csv, line 2, column 2: Invalid number {text!r}"
        assert_refused(re.escape(message), emissivity, tmp_path, text)


ODD = "No 012 0o17 12:30 1_000 1e3 .inf -.5 1.0e+999 2026-01-02 0x1F ="


@given(st.dictionaries(WORDS, st.recursive(LEAVES, st.lists, max_leaves=20)))
def test_yaml_of_json_is_read_back(content: dict[str, object]) -> None:
    """What json writes, which is YAML, is read back as it was."""
    with TemporaryDirectory() as folder:
        path = Path(folder, "a.yaml")
        path.write_text(json.dumps(content, ensure_ascii=False), encoding="utf-8", newline="")
        assert read_yaml(path) == content


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: 2\na: 3", "line 3, column 1: Repeated key 'a'. Must be listed once"),
        ("a: {1: x, '1': y}", "line 1, column 11: Repeated key '1'"),
        ("null: 1", "line 1, column 1: Invalid key None. Must be text or a number"),
        ("{[1]: 1}", "Invalid key [1]"),
        ("a: on", "line 1, column 4: Invalid value on. Must be a finite decimal number, true"),
        *((f"a: {value}", f"Invalid value {value}. Must") for value in ODD.split()),
        ("a: " + "9" * 5000, "Invalid value 999"),
        ("a: {<<: {b: 1}}", "Invalid value <<"),
        ("a: &x [1]\nb: *x", "line 1, column 4: Invalid anchor or alias 'x'. Must be written out"),
        ("a: !!python/name:os.system ''", "Invalid tag 'tag:yaml.org,2002:python/name:os.system'"),
        ("a: " + "[" * 60 + "]" * 60, "line 1, column 53: Invalid nesting deeper than 50"),
        ("- " * 200_000, "Invalid nesting deeper than 50"),
        ("a: 1\n---\nb: 2", "line 2, column 1: Invalid second document. Must be one"),
        ("", "Invalid content None. Must be a mapping"),
        ("x" * 500, "xxx... (502 characters). Must be a mapping"),
        ("a: [1", "line 2, column 1: Must be YAML"),
        ("a: \t- b: c", "Must be YAML"),
    ],
)
def test_yaml_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, message: str
) -> None:
    """Repeated keys, ambiguous values, references and tags are refused by place and rule."""
    monkeypatch.chdir(tmp_path)
    Path("f.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        read_yaml("f.yaml")
    assert str(error.value).startswith("f.yaml")
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300
