"""The outside files: what they are, where they come from, and the verified copies at hand.

``data_manifest.yaml`` lists every file of every collection with its checksum. If the variable
DBTHERMAL_DATA names a folder, the files are read from there, as ``<collection>/<name>``, and
nothing is downloaded. Otherwise they lie in the project's ``data/``, and `fetch`,
`fetch_collection` and ``make data``, which runs this module, download what is not there yet. Every
path that this module hands out leads to a file whose SHA-256 has just been compared.
"""

import hashlib
import os
import re
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final
from urllib.parse import quote

import pooch
import yaml

from reproduction import paths

MIRROR: Final = "DBTHERMAL_DATA"
"""Variable that names the folder with a copy of the files."""

_CONNECTIONS: Final = 8
_RETRIES: Final = 3


@dataclass(frozen=True)
class File:
    """
    One outside file.

    Attributes
    ----------
    name : str
        Name, in its collection's folder and at its origin.
    sha256 : str
        Checksum, 64 hexadecimal digits.
    bytes : int
        Size [byte].
    covers_8_14um : bool
        False for a spectrum that ends short of 14 um.
    thermal_duplicate_of : str or None
        A file with the same values in the thermal infrared, under another name.
    """

    name: str
    sha256: str
    bytes: int
    covers_8_14um: bool = True
    thermal_duplicate_of: str | None = None

    def __post_init__(self) -> None:
        """Refuse an entry that cannot be checked against a file."""
        if Path(self.name).name != self.name:
            raise ValueError(f"Invalid file name '{self.name}'. Must name no folder.")
        if not re.fullmatch("[0-9a-f]{64}", str(self.sha256)):
            raise ValueError(
                f"Invalid sha256 '{self.sha256}' of '{self.name}'. Must be 64 lower-case digits."
            )
        if type(self.bytes) is not int or self.bytes <= 0:
            raise ValueError(f"Invalid size {self.bytes} of '{self.name}'. Must be > 0 bytes.")


@dataclass(frozen=True)
class Collection:
    """
    Files of one origin.

    Attributes
    ----------
    title : str
        What it is.
    origin : str
        Address to which a file's name is appended; it may hold spaces.
    citation : tuple of str
        Works to cite, with DOI where there is one.
    terms : str
        What the owners allow.
    used_by : tuple of str
        Functions and notebooks that read it.
    note : str
        Known defects, and what to mind.
    files : mapping of str to File
        Name to file.
    """

    title: str
    origin: str
    citation: tuple[str, ...]
    terms: str
    used_by: tuple[str, ...]
    note: str
    files: Mapping[str, File]

    def url(self, name: str) -> str:
        """Address of the file `name`, with spaces and the like quoted."""
        return quote(self.origin + self[name].name, safe=":/")

    def __getitem__(self, name: str) -> File:
        """File by name; ValueError if the collection does not list it."""
        if name not in self.files:
            raise ValueError(f"Unknown file '{name}'. Must be listed under '{self.title}'.")
        return self.files[name]


@dataclass(frozen=True)
class Manifest:
    """All outside files: `collections`, by their name, which is also their folder's."""

    collections: Mapping[str, Collection]

    def __getitem__(self, name: str) -> Collection:
        """Collection by name; ValueError if there is none."""
        if name not in self.collections:
            raise ValueError(f"Unknown collection '{name}'. Must be one of {[*self.collections]}.")
        return self.collections[name]


def load() -> Manifest:
    """
    Read ``data_manifest.yaml`` at the project's root.

    Returns
    -------
    Manifest
        What it lists.

    Raises
    ------
    FileNotFoundError
        If the project's root is not found.
    ValueError
        If an entry lacks a field, has an unknown one, a malformed checksum, or occurs twice.
    """
    path = paths.manifest()
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    try:
        collections = {name: _collection(entry) for name, entry in content["collections"].items()}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"Invalid '{path.name}': {error}") from error
    return Manifest(MappingProxyType(collections))


def available(collection: str) -> bool:
    """
    Whether a collection is at hand; nothing is downloaded, no checksum computed.

    Parameters
    ----------
    collection : str
        Such as ``"ecostress"``.

    Returns
    -------
    bool
        False if any file is missing.

    Raises
    ------
    ValueError
        If the collection is unknown, or DBTHERMAL_DATA names no folder.
    """
    folder = _folder(collection)
    return all((folder / name).is_file() for name in load()[collection].files)


def local(collection: str) -> dict[str, Path]:
    """
    Verified files of a collection that is at hand; nothing is downloaded.

    Parameters
    ----------
    collection : str
        Such as ``"ecostress"``.

    Returns
    -------
    dict of str to Path
        Name to path, in the order of the manifest.

    Raises
    ------
    FileNotFoundError
        If files are missing; the message counts them and names the first.
    ValueError
        If a file's checksum is another one, the collection is unknown, or DBTHERMAL_DATA names no
        folder.
    """
    folder, files = _folder(collection), load()[collection].files
    missing = [name for name in files if not (folder / name).is_file()]
    if missing:
        raise FileNotFoundError(
            f"Missing {len(missing)} of {len(files)} files of '{collection}' in '{folder}', the "
            f"first is '{missing[0]}'. Must all be there: fetch them with 'make data', or name "
            f"a folder that holds them in {MIRROR}."
        )
    return {name: _verified(folder / name, file) for name, file in files.items()}


def fetch(name: str, collection: str) -> Path:
    """
    Verified file, downloaded if it is not in ``data/`` and DBTHERMAL_DATA is not set.

    Parameters
    ----------
    name : str
        Name of the file.
    collection : str
        Collection that lists it.

    Returns
    -------
    Path
        Where it lies.

    Raises
    ------
    OSError
        If the mirror lacks the file (FileNotFoundError), or the origin cannot be reached.
    ValueError
        If the file's checksum is another one (a download is then thrown away), or the file or
        collection is unknown.
    """
    listed, folder = load()[collection], _folder(collection)
    return _fetch(listed, listed[name], folder)


def fetch_collection(collection: str) -> dict[str, Path]:
    """
    Verified files of a collection, several downloads at a time; see `fetch`.

    Parameters
    ----------
    collection : str
        Such as ``"ecostress"``.

    Returns
    -------
    dict of str to Path
        Name to path, in the order of the manifest.

    Raises
    ------
    OSError, ValueError
        As `fetch`.
    """
    listed, folder = load()[collection], _folder(collection)
    files = listed.files.values()
    with ThreadPoolExecutor(_CONNECTIONS) as pool:
        found = pool.map(lambda file: _fetch(listed, file, folder), files)
        return dict(zip(listed.files, found, strict=True))


def provenance(collection: str) -> dict[str, str]:
    """
    Checksums that the files of a collection must have, for the record of a result.

    Parameters
    ----------
    collection : str
        Such as ``"ecostress"``; ValueError if it is unknown.

    Returns
    -------
    dict of str to str
        Name to SHA-256.
    """
    return {name: file.sha256 for name, file in load()[collection].files.items()}


def main() -> int:
    """
    Fetch or verify all collections, and print a line on each; ``make data`` runs this.

    Returns
    -------
    int
        Exit status: 1 if any collection is not whole, else 0.
    """
    pooch.get_logger().setLevel("WARNING")  # one line a collection, not one a file
    status = 0
    for name, listed in load().collections.items():
        try:
            found = fetch_collection(name)
        except (OSError, ValueError) as error:
            print(f"{name}: {error}", file=sys.stderr)
            status = 1
        else:
            size = sum(file.bytes for file in listed.files.values()) / 1e6
            print(f"{name}: {len(found)} files, {size:.1f} MB, in {_folder(name)}")
    return status


def _collection(entry: Mapping[str, Any]) -> Collection:
    files = {file["name"]: File(**file) for file in entry["files"]}
    if len(files) < len(entry["files"]):
        raise ValueError(f"Repeated file name under '{entry['title']}'. Must occur once.")
    lists = {key: tuple(entry[key]) for key in ("citation", "used_by")}
    return Collection(**{**entry, **lists, "files": MappingProxyType(files)})


def _mirror() -> Path | None:
    """Folder that DBTHERMAL_DATA names, None if it is unset or empty."""
    named = os.environ.get(MIRROR)
    if named and not Path(named).is_dir():
        raise ValueError(f"Invalid {MIRROR} '{named}'. Must name a folder.")
    return Path(named) if named else None


def _folder(collection: str) -> Path:
    return (_mirror() or paths.data()) / collection


def _fetch(listed: Collection, file: File, folder: Path) -> Path:
    path = folder / file.name
    if _mirror() is None and not path.is_file():
        source = pooch.create(
            folder,
            base_url=listed.origin,
            registry={file.name: f"sha256:{file.sha256}"},
            urls={file.name: listed.url(file.name)},
            retry_if_failed=_RETRIES,
        )
        source.fetch(file.name)
    return _verified(path, file)


def _verified(path: Path, file: File) -> Path:
    """Return the path of a file that is there and has the right checksum."""
    if not path.is_file():
        raise FileNotFoundError(f"Missing file '{path}'. Must be in the folder {MIRROR} names.")
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if found != file.sha256:
        raise ValueError(
            f"Wrong checksum of '{path}': {found}. Must be {file.sha256}; remove the file and "
            "fetch it again."
        )
    return path


if __name__ == "__main__":
    sys.exit(main())
