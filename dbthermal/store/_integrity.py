"""Checksums of a store: of every file when it is written, compared when it is read.

``checksums.sfv`` has a line for each file, its name and CRC-32, as programs for "simple file
verification" read it, written before the file: a recording cut short has the lines of all valid
files. A replaced file has a line for each state until the recording is closed. A damaged, cut,
missing, foreign or exchanged file is seen: metadata and names on opening, values on reading.

The codec crc32c of zarr sees every damaged chunk, but not flipped bits of metadata, exchanged
chunks, edited attributes, lost or renamed arrays, foreign files, or chunks missing in a recording.
"""

import asyncio
import json
import os
import warnings
import zlib
from collections import deque
from collections.abc import AsyncIterator, Collection, Mapping
from itertools import takewhile
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from zarr.core.buffer import Buffer
from zarr.storage import LocalStore

from dbthermal import _text as texts

Content = bytes | memoryview

GROUP: Final = "zarr.json"  # file of a zarr group's attributes
TIME: Final = "time"  # array that a recording gets when it is closed
SUMS: Final = "checksums.sfv"
MARK: Final = MappingProxyType({"checksums": f"CRC-32 of every file, in {SUMS}"})
"""Attribute of every store with checksums, so that their loss is seen."""
GROWING: Final = MappingProxyType({"checksums": f"{MARK['checksums']}, and of earlier states"})
"""Mark of a recording that is not closed; a result made of the recording has `MARK` again."""


class SummedStore(LocalStore):
    """Zarr store in an existing folder, which keeps the checksum of every file it writes."""

    hidden: tuple[str, ...] = ()  # arrays that are not listed

    def set_sync(self, key: str, value: Buffer) -> None:
        """Write a file by its relative name, its checksum first."""
        add_sum(self.root, key, value.as_numpy_array().data)
        super().set_sync(key, value)

    async def set(self, key: str, value: Buffer) -> None:
        """Write a file; see `set_sync`."""
        await asyncio.to_thread(self.set_sync, key, value)

    async def list_dir(self, prefix: str) -> AsyncIterator[str]:
        """Names in a group's folder; other files, such as the checksums, do not belong to it."""
        async for name in super().list_dir(prefix):
            if name == GROUP or (name not in self.hidden and (self.root / prefix / name).is_dir()):
                yield name


class CheckedStore(SummedStore):
    """Zarr store in a folder, to be read; all that is not as it was written is a ValueError."""

    def __init__(self, root: Path | str, *, read_only: bool = True) -> None:  # noqa: ARG002 - zarr's
        super().__init__(root, read_only=True)
        deque(texts.tree_files(self.root), maxlen=0)  # refuses links, pipes and devices
        # Read before the checksums, which may grow, and again if the recording was just closed.
        self.closed, content = False, self._content(GROUP)
        self._sums = dict.fromkeys(_read_sums(self.root))
        if not _is_listed(self._sums, GROUP, content):
            content = self._content(GROUP)
        self._compare(GROUP, content)
        # Attributes, of which a mark says that the store has checksums.
        try:
            group = json.loads(content or b"")
            self.attrs: dict[str, Any] = group["attributes"]
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            label = self._named(GROUP) if content else f"store '{self.root}': it has no '{GROUP}'"
            raise ValueError(f"Invalid {label}. Must be a zarr group.") from error
        if group.get("node_type") == "array":
            rule = f"Must be the store that it is in: '{self.root.parent}'"
            raise ValueError(f"Invalid store '{self.root}', an array. {rule}.")
        mark = {name: self.attrs[name] for name in MARK if name in self.attrs}
        self.closed = mark != GROWING if mark else bool(self.attrs.get("closed", True))
        # A recording that is not closed is read as far as it is valid, without its time.
        self.hidden = () if self.closed else (TIME,)
        # The list of files, unless the store is of version 0.1.0, without one.
        if mark and not self._sums:
            raise ValueError(f"Missing {self._named(SUMS)}. {AS_WRITTEN}")
        if self._sums:
            self._check_files(_sum(GROUP, content or b""))
        else:
            rule = "as of dbthermal 0.1.0: damage is not seen. Saved again, it has them."
            warnings.warn(f"No checksums in '{self.root}', {rule}", stacklevel=3)

    def get_sync(self, key: str, *, prototype: Any = None, byte_range: Any = None) -> Buffer | None:
        """Read a file that is as it was written."""
        content = super().get_sync(key, prototype=prototype)
        self._compare(key, None if content is None else content.as_numpy_array().data)
        if byte_range is None:
            return content
        return super().get_sync(key, prototype=prototype, byte_range=byte_range)

    async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Buffer | None:
        """Read a file; see `get_sync`."""
        options = {"prototype": prototype, "byte_range": byte_range}
        return await asyncio.to_thread(self.get_sync, key, **options)

    def _compare(self, key: str, content: Content | None) -> None:
        """ValueError unless a file is as it was written, or absent as it was."""
        if not self._sums or _is_listed(self._sums, key, content):
            return
        state, now = "Missing" if content is None else "Damaged", _read_sums(self.root)
        if _is_listed(now, key, content):
            if not self.closed:
                self._sums = dict.fromkeys(now)
                return
            state = "Since it was opened, replaced"
        raise ValueError(f"{state} {self._named(key)}. {AS_WRITTEN}")

    def _check_files(self, group: tuple[str, str]) -> None:
        """ValueError if a file is missing, or foreign to a store that grows no more."""
        files, listed = files_of(self.root), {key for key, _ in self._sums}
        # Of a store that grows, all files were on the disk whose lines precede that of its group.
        lines = self._sums if self.closed else takewhile(lambda line: line != group, self._sums)
        wanted = {key for key, _ in lines}
        if missing := sorted(wanted - files):
            raise ValueError(f"Missing {self._named(missing[0])}. {AS_WRITTEN}")
        # A kill, or a system's file browser, may leave hidden files.
        foreign = sorted(key for key in files - listed if not f"/{key}".count("/."))
        if self.closed and foreign:
            raise ValueError(f"Foreign {self._named(foreign[0])}. {AS_WRITTEN}")

    def _content(self, key: str) -> bytes | None:
        path = self.root / key
        return path.read_bytes() if path.is_file() else None

    def _named(self, key: str) -> str:
        array = key.rpartition("/c/")[0] or key.rpartition("/")[0]
        return f"file '{key}' of {f'array {array!r} in ' if array else ''}store '{self.root}'"


AS_WRITTEN: Final = "Must be as it was written: copy it again, or make it anew."


def add_sum(root: Path, key: str, content: Content) -> Path:
    """Append the checksum of a file by its relative name; path of the file of checksums."""
    if (root / GROUP).exists() and not (root / SUMS).exists():
        raise FileNotFoundError(f"No file '{SUMS}' in '{os.path.realpath(root)}' any more.")
    with (root / SUMS).open("ab") as stream:  # in one piece, for several threads may append
        stream.write(f"{' '.join(_sum(key, content))}\n".encode())
    return root / SUMS


def last_sums(root: Path) -> dict[str, str]:
    """Checksum of the last state of every file, by name."""
    return dict(_read_sums(root))


def sums_file(sums: Mapping[str, str]) -> bytes:
    """Content of a file of checksums, of one state of every file."""
    return "".join(f"{key} {sums[key]}\n" for key in sorted(sums)).encode()


def _sum(key: str, content: Content) -> tuple[str, str]:
    return key, f"{zlib.crc32(content):08x}"


def _read_sums(root: Path) -> list[tuple[str, str]]:
    """Name and checksum of every state of each file, as written; a line cut short has none."""
    path = root / SUMS
    text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
    lines = (line.rpartition(" ") for line in text.split("\n")[:-1])
    return [(key, crc) for key, _, crc in lines]


def _is_listed(sums: Collection[tuple[str, str]], key: str, content: Content | None) -> bool:
    """True if a file's content is one of its listed states; without content, if it has none."""
    if content is None:
        return all(key != name for name, _ in sums)
    return _sum(key, content) in sums


def files_of(root: Path) -> set[str]:
    """Relative names of all files but that of the checksums."""
    return {*texts.tree_files(root)} - {SUMS}
