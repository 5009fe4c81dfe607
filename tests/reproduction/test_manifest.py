"""Outside files: a list with checksums, downloads from their origin, errors for altered files."""

import contextlib
import hashlib
import re
import threading
import time
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote, unquote

import pytest
from refused import assert_raises, assert_refused

from reproduction import locked, manifest

CONTENT = {"one.txt": b"first", "two.txt": b"second"}

LISTED = """collections:
  notes:
    title: two notes
    origin: {origin}
    citation: ["Nobody (2000). Notes."]
    terms: free
    used_by: [tests]
    note: ""
    files:
"""


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Project that lists two files, whose origin cannot be reached."""
    root = tmp_path / "project"
    root.mkdir()
    list_files(root, "http://127.0.0.1:9/")
    monkeypatch.chdir(root)
    monkeypatch.delenv(locked.MIRROR, raising=False)
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr(manifest, "_RETRIES", 0)
    return root


def written(folder: Path) -> Path:
    """Make a folder of the two files."""
    folder.mkdir(parents=True)
    for name, content in CONTENT.items():
        (folder / name).write_bytes(content)
    return folder


@pytest.fixture
def copies(tmp_path: Path, project: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of the two files within a mirror that DBTHERMAL_DATA names."""
    assert project.is_dir()
    monkeypatch.setenv(locked.MIRROR, str(tmp_path / "mirror"))
    return written(tmp_path / "mirror" / "notes")


@pytest.fixture
def served(tmp_path: Path, project: Path) -> Iterator[Path]:
    """Folder, with a space in its name, from which the project's origin serves the two files."""
    folder = written(tmp_path / "all notes")
    handler = partial(Quiet, directory=str(tmp_path))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        list_files(project, f"http://127.0.0.1:{server.server_port}/all notes/")
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield folder
        server.shutdown()
        thread.join()


class Quiet(SimpleHTTPRequestHandler):
    """Serve files without a line for each; the names of some say what is wrong with them."""

    def do_GET(self) -> None:
        """Send a file, an endless one, one that trickles, or lead elsewhere with an endless one."""
        if not (found := re.search("/(endless|slow|to-(.*)).txt$", self.path)):
            super().do_GET()
        else:
            self.send_response(302 if found[2] else 200)
            if found[2]:
                self.send_header("Location", unquote(found[2]).replace(" ", "/"))
            self.end_headers()
            with contextlib.suppress(OSError):
                while True:
                    self.wfile.write(b"x" * (1 if found[1] == "slow" else 2**16))
                    time.sleep(0.02 if found[1] == "slow" else 0)

    def log_message(self, *_: object) -> None:
        """Print no line."""


def list_files(root: Path, origin: str) -> None:
    """Write the project's list."""
    lines = [
        f"      - {{name: {name}, sha256: {hashlib.sha256(content).hexdigest()}, "
        f"bytes: {len(content)}}}\n"
        for name, content in CONTENT.items()
    ]
    (root / "data_manifest.yaml").write_text(LISTED.format(origin=origin) + "".join(lines))


def edit(root: Path, old: str, new: str) -> None:
    """Change the project's list."""
    path = root / "data_manifest.yaml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_the_list_is_complete() -> None:
    """Every collection has an origin, a citation, terms; all but the mesh are used; 959 files."""
    collections = manifest.load().collections
    names = {"arm", "ecostress", "slum", "ucsb", "scenes", "other_scenes", "meshes", "recordings"}
    assert set(collections) == names
    optional = {name for name in names if collections[name].optional}
    assert optional == {"other_scenes", "recordings"}
    for collection in collections.values():
        assert collection.origin.startswith("https://")
        assert collection.origin.endswith("/")
        assert all((collection.citation, collection.terms))
        assert collection.used_by
    assert sum(len(collection.files) for collection in collections.values()) == 959
    url = collections["slum"].url("LUMA_SLUM_IR.csv")
    assert re.fullmatch(r"https://[\w./-]+/other%20files/LUMA_SLUM_IR\.csv", url)


def test_mirror(copies: Path) -> None:
    """Files of a mirror are verified where they lie, by every way to ask for them."""
    expected = {name: copies / name for name in CONTENT}
    assert manifest.available("notes")
    assert manifest.local("notes") == expected
    assert manifest.fetch_collection("notes") == expected
    sums = {name: hashlib.sha256(content).hexdigest() for name, content in CONTENT.items()}
    assert manifest.provenance("notes") == sums
    with pytest.raises(ValueError, match=r"Unknown collection 'notices'. Must be one of .'notes'."):
        manifest.local("notices")


def test_a_mirror_with_a_fault(
    copies: Path, project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Altered files are named with checksums, missing ones not fetched, files no mirror."""
    (copies / "two.txt").write_bytes(b"seconds")
    got, expected = (hashlib.sha256(text).hexdigest() for text in (b"seconds", b"second"))
    for read in (manifest.local, manifest.fetch_collection):
        assert_refused(rf"two\.txt': {got}. Must be {expected}", read, "notes")
    (copies / "two.txt").unlink()
    assert not manifest.available("notes")
    with pytest.raises(FileNotFoundError, match=r"Missing 1 of 2 files of 'notes'.*'two\.txt'"):
        manifest.local("notes")
    with pytest.raises(FileNotFoundError, match=r"Missing file '.*two\.txt'"):
        manifest.fetch_collection("notes")
    assert not (project / "data").exists()
    monkeypatch.setenv(locked.MIRROR, str(copies / "absent"))
    with pytest.raises(ValueError, match=r"Invalid DBTHERMAL_DATA '.*absent'\. Must name a folder"):
        manifest.available("notes")


def test_download(served: Path, project: Path) -> None:
    """`fetch_collection` alone takes files from their origin, once; altered ones are removed."""
    assert not manifest.available("notes")
    assert_raises(FileNotFoundError, "Missing 2 of 2 files", manifest.local, "notes")
    assert not (project / "data").exists()
    (served / "two.txt").write_bytes(b"SECOND")
    with pytest.raises(ValueError, match=rf"two\.txt.*{hashlib.sha256(b'second').hexdigest()}"):
        manifest.fetch_collection("notes")
    assert not (project / "data" / "notes" / "two.txt").exists()
    (served / "two.txt").write_bytes(CONTENT["two.txt"])
    found = manifest.fetch_collection("notes")
    assert {name: path.read_bytes() for name, path in found.items()} == CONTENT
    (served / "one.txt").unlink()
    assert manifest.local("notes") == manifest.fetch_collection("notes") == found
    assert found["one.txt"] == project / "data" / "notes" / "one.txt"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("endless.txt", r"Invalid size of 'http.*endless\.txt'\. Must be the listed 5 bytes"),
        ("to-ftp:  127.0.0.1 x.txt", "Invalid redirect of 'http.*' to 'ftp://127.0.0.1/x'"),
        ("to-file:   etc passwd.txt", "Invalid redirect of 'http.*' to 'file:///etc/passwd'"),
        ("to-.. all%20notes to-two.txt.txt", "404"),
        ("slow.txt", r"Slow download of 'http.*slow\.txt'"),
    ],
)
def test_a_download_that_misbehaves(
    served: Path, project: Path, name: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Too large, led to another scheme, or too slow for its size, it leaves nothing."""
    assert served.is_dir()
    monkeypatch.setattr(
        manifest.Collection, "url", lambda self, _: quote(f"{self.origin}{name}", ":/")
    )
    if name == "slow.txt":
        for size in ("bytes: 5", "bytes: 6"):
            edit(project, size, "bytes: 1000")
        for limit, value in (("_SLOWEST", 5000), ("_TIMEOUT", 0.3)):
            monkeypatch.setattr(manifest, limit, value)
    assert_raises(OSError, message, manifest.fetch_collection, "notes")
    assert not any((project / "data" / "notes").iterdir())


@pytest.mark.parametrize("folder", [False, True])
def test_main(
    copies: Path, project: Path, capsys: pytest.CaptureFixture[str], folder: bool
) -> None:
    """A line for what is complete; a mirror may lack an optional collection, but no part."""
    assert manifest.main() == 0
    assert re.fullmatch(r"notes: 2 files, 0\.0 MB, in .*notes\n", capsys.readouterr().out)
    (copies / "two.txt").unlink()
    assert manifest.main() == 1
    assert capsys.readouterr().err.startswith("notes: ")
    edit(project, "    terms: free\n", "    terms: free\n    optional: true\n")
    (copies / "one.txt").unlink()
    if not folder:
        copies.rmdir()
    assert manifest.main() == int(folder)
    said = capsys.readouterr()
    assert ("notes: left out" in said.out, "Missing file" in said.err) == (not folder, folder)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("bytes: 5", "bytes: 0", r"files\.`one\.txt`\.bytes\n.*greater than 0"),
        ("sha256: ", "sha256: A", r"files\.`one\.txt`\.sha256\n.*match pattern .*'A"),
        ("name: one.txt", "name: ../one.txt", r"match pattern .*'\.\./one\.txt'"),
        ("name: one.txt", 'name: "one\\0.txt"', r"match pattern .*'one\\x00.txt'"),
        ("name: one.txt", "name: .one.txt", r"match pattern .*'\.one\.txt'"),
        ("  notes:", "  ../notes:", r"match pattern .*'\.\./notes'"),
        ("  notes:", "  '':", "match pattern .*''"),
        ("origin: http:", "origin: file:", "match pattern .*'file:"),
        ("bytes: 5", "bytes: 5, origin: 'ftp://a/'", "match pattern .*'ftp:"),
        ("name: one.txt", "name: two.txt", r"notes\.files\n.*Repeated file name"),
        ("bytes: 5", "bytes: 5, colour: red", "colour"),
        ("    terms: free\n", "", "terms"),
        ("collections:", "collection:", "collections"),
    ],
)
def test_a_malformed_list_is_refused(project: Path, old: str, new: str, message: str) -> None:
    """A malformed list raises an error with its name."""
    edit(project, old, new)
    assert_refused(rf"(?s)Invalid 'data_manifest\.yaml'.*{message}", manifest.load)


@pytest.mark.data
@pytest.mark.parametrize("collection", ["ecostress", "slum", "ucsb", "scenes", "meshes"])
@pytest.mark.usefixtures("mirror")
def test_every_file_of_the_mirror(collection: str) -> None:
    """Each file has the listed checksum and size."""
    files = manifest.load()[collection].files
    sizes = {name: path.stat().st_size for name, path in manifest.local(collection).items()}
    assert sizes == {name: file.bytes for name, file in files.items()}
