"""Outside files: list, origins, and verified local copies.

``data_manifest.yaml`` lists the files of every collection with their checksums. If the variable
DBTHERMAL_DATA names a folder, they are read from there, as ``<collection>/<name>``, and nothing is
downloaded. Otherwise they lie in the project's ``data/``, and `fetch_collection` and ``make data``,
which runs this module, download the missing ones: no more bytes than are listed, in limited time,
and from no other scheme. Every path from this module is of a file whose SHA-256 has
just been compared.
"""

import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any, Final, TypeAlias
from urllib.parse import quote, urljoin, urlsplit

import pooch
import requests
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from dbthermal import readers, store
from reproduction import locked, paths

_CONNECTIONS: Final = 8
_RETRIES: Final = 3
_TIMEOUT: Final = 30.0  # without a byte [s]
_SLOWEST: Final = 10_000  # of a whole download, beside one `_TIMEOUT` [byte/s]


# A name is of a file, and of no folder.
_Name: TypeAlias = Annotated[str, Field(pattern="^[A-Za-z0-9_][A-Za-z0-9 _.-]{0,199}$")]
_Folder: TypeAlias = Annotated[str, Field(pattern="^[a-z][a-z0-9_]{0,49}$")]
_Origin: TypeAlias = Annotated[str, Field(pattern=r"^https?://[^?#@\\\x00-\x1f]+/$")]


class File(BaseModel):
    """Outside file: name at its origin and in its folder, checksum, and size [byte]."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    name: _Name
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    bytes: Annotated[int, Field(gt=0)]
    covers_8_14um: bool = True  # False for a spectrum that ends short of 14 um
    thermal_duplicate_of: str | None = None  # file with the same values in the thermal infrared
    origin: _Origin | None = None  # where it is not the collection's


def _by_name(entries: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    named = {entry["name"]: entry for entry in entries}
    if len(named) < len(entries):
        raise ValueError("Repeated file name. Must occur once.")
    return named


class Collection(BaseModel):
    """Files of one origin, an address to which a name is appended; works to cite; owners' terms."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    title: str
    origin: _Origin
    citation: tuple[str, ...]
    terms: str
    used_by: tuple[str, ...]
    optional: bool = False  # a mirror may lack it
    note: str
    files: Annotated[dict[str, File], BeforeValidator(_by_name)]

    def url(self, name: str) -> str:
        """Address of a file, with spaces and the like quoted."""
        return quote((self.files[name].origin or self.origin) + name, safe=":/")


class Manifest(BaseModel):
    """All collections by name, which is also the name of their folder."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    collections: Mapping[_Folder, Collection]

    def __getitem__(self, name: str) -> Collection:
        """Collection by name; ValueError if it is not listed."""
        if name not in self.collections:
            raise ValueError(f"Unknown collection '{name}'. Must be one of {[*self.collections]}.")
        return self.collections[name]


def load() -> Manifest:
    """``data_manifest.yaml``; ValueError if an entry is missing, unknown, malformed or repeated."""
    path = paths.manifest()
    try:
        return Manifest.model_validate(readers.read_yaml(path))
    except (KeyError, TypeError, ValidationError) as error:
        raise ValueError(f"Invalid '{path.name}': {error}") from error


def available(collection: str) -> bool:
    """True if no file of the collection is missing; nothing is downloaded or verified."""
    folder = _folder(collection)
    return all((folder / name).is_file() for name in load()[collection].files)


def local(collection: str) -> dict[str, Path]:
    """Verified local files of a collection, name to path; FileNotFoundError if any is missing."""
    folder, files = _folder(collection), load()[collection].files
    missing = [name for name in files if not (folder / name).is_file()]
    if missing:
        raise FileNotFoundError(
            f"Missing {len(missing)} of {len(files)} files of '{collection}' in '{folder}', the "
            f"first is '{missing[0]}'. Must all be there: fetch them with 'make data', or name "
            f"a folder that holds them in {locked.MIRROR}."
        )
    return {name: _verified(folder / name, file) for name, file in files.items()}


def fetch_collection(collection: str) -> dict[str, Path]:
    """Verified files of a collection, name to path, several downloads at a time.

    Downloaded are those that are not in ``data/`` if DBTHERMAL_DATA is not set. A download with
    another checksum is thrown away: ValueError. OSError if the origin cannot be reached, sends more
    bytes than are listed or sends them too slowly, or leads to another scheme; FileNotFoundError if
    the mirror lacks a file.
    """
    listed, folder = load()[collection], _folder(collection)
    with ThreadPoolExecutor(_CONNECTIONS) as pool:
        paths = pool.map(lambda file: _fetch(listed, file, folder), listed.files.values())
        return dict(zip(listed.files, paths, strict=True))


def provenance(collection: str) -> dict[str, str]:
    """Checksums that the files of a collection must have, for the provenance of a result."""
    return {name: file.sha256 for name, file in load()[collection].files.items()}


def main() -> int:
    """Fetch or verify all collections, a line on each; exit status 1 if any is incomplete.

    An optional collection that a mirror has no folder for is left out, and the line says so.
    """
    pooch.get_logger().setLevel("WARNING")  # one line a collection, not one a file
    try:
        collections = load().collections
    except (OSError, ValueError) as error:
        print(error, file=sys.stderr)
        return 1
    status = 0
    for name, listed in collections.items():
        if listed.optional and locked.mirror() is not None and not _folder(name).exists():
            print(f"{name}: left out, '{_folder(name)}' does not exist")
            continue
        try:
            number = len(fetch_collection(name))
        except (OSError, ValueError) as error:
            print(f"{name}: {error}", file=sys.stderr)
            status = 1
        else:
            size = sum(file.bytes for file in listed.files.values()) / 1e6
            print(f"{name}: {number} files, {size:.1f} MB, in {_folder(name)}")
    return status


def _folder(collection: str) -> Path:
    return (locked.mirror() or paths.data()) / collection


def _fetch(listed: Collection, file: File, folder: Path) -> Path:
    path = folder / file.name
    if locked.mirror() is None and not path.is_file():
        source = pooch.create(
            folder,
            base_url=file.origin or listed.origin,
            registry={file.name: f"sha256:{file.sha256}"},
            urls={file.name: listed.url(file.name)},
            retry_if_failed=_RETRIES,
        )
        source.fetch(file.name, downloader=_download(file))
    return _verified(path, file)


def _download(file: File) -> Callable[[str, str, object], None]:
    """Downloader for pooch, which gives up when it has more than the file, or takes too long."""

    def download(url: str, path: str, _: object) -> None:
        end, size = time.monotonic() + _TIMEOUT + file.bytes / _SLOWEST, 0
        with (
            requests.get(
                url,
                stream=True,
                timeout=_TIMEOUT,
                headers={"Accept-Encoding": "identity"},
                hooks={"response": _check_redirect},
            ) as response,
            Path(path).open("wb") as output,
        ):
            response.raise_for_status()
            while block := response.raw.read1(2**16, decode_content=False):
                size += output.write(block)
                if size > file.bytes:
                    rule = f"Must be the listed {file.bytes} bytes"
                    raise OSError(f"Invalid size of '{url}'. {rule}.")
                if time.monotonic() > end:
                    rule = f"Must have {_SLOWEST} bytes/s or more"
                    raise OSError(f"Slow download of '{url}'. {rule}.")

    return download


def _check_redirect(response: requests.Response, **_: object) -> None:
    """OSError if a redirect leaves the scheme, unless for https; its body is not read."""
    if response.is_redirect:
        response.close()
        following = urljoin(response.url, response.headers["location"])
        if urlsplit(following).scheme not in {urlsplit(response.url).scheme, "https"}:
            rule = "Must stay at its scheme"
            raise OSError(f"Invalid redirect of '{response.url}' to '{following}'. {rule}.")


def _verified(path: Path, file: File) -> Path:
    """Path of a file that exists and has the listed checksum."""
    if not path.is_file():
        rule = f"Must be in the folder {locked.MIRROR} names"
        raise FileNotFoundError(f"Missing file '{path}'. {rule}.")
    if (sha256 := store.checksum(path)) != file.sha256:
        rule = f"Must be {file.sha256}; remove the file and fetch it again"
        raise ValueError(f"Wrong checksum of '{path}': {sha256}. {rule}.")
    return path


if __name__ == "__main__":
    sys.exit(main())
