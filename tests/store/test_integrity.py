"""No fault in a store passes as data: every file is as it was written, or an error names it."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hostile_files import record

from dbthermal import store

KINDS = ("result", "recording", "cut short")


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A result, a recording, and one that was cut short."""
    folder = tmp_path_factory.mktemp("whole")
    paths = {kind: folder / f"{kind}.zarr" for kind in KINDS}
    record(paths["recording"], close=True)
    record(paths["cut short"], close=False)
    result = xr.Dataset(
        {
            "counts": (("time", "y", "x"), np.arange(9e5, dtype="float32").reshape(3, 600, 500)),
            "object_temperature": (("time", "y", "x"), np.full((3, 600, 500), np.nan, "float32")),
            "status": (("y", "x"), np.zeros((600, 500), "uint32"), {"units": "1"}),
        },
        {"band": ["8-14", "9.5"], "material": "glass", "time": [0.0, 0.1, 0.2]},
    )
    store.save(result, paths["result"], {"parameters": {"frames": 3}})
    return paths


def files(path: Path) -> list[Path]:
    """All files of a store, in order."""
    return sorted(file for file in path.rglob("*") if file.is_file())


def chunks(path: Path) -> list[Path]:
    """All chunks of a store, in order."""
    return [file for file in files(path) if "c" in file.relative_to(path).parts]


def outcome(path: Path, whole: Path, fault: Callable[[Path], Path]) -> str:
    """Result of a fault in a copy of a store: refused by name, harmless, or silent."""
    shutil.copytree(whole, path)
    damaged = fault(path).relative_to(path)
    message = ""
    try:
        opened = store.open_dataset(path).load()
    except ValueError as error:
        message = str(error)
    shutil.rmtree(path)
    if not message:
        return "harmless" if opened.identical(store.open_dataset(whole).load()) else "silent"
    named = re.fullmatch(
        rf"(Damaged|Missing|Foreign) file '(.*)' of (array '(.*)' in )?store '{path}'\. .*", message
    )
    assert named, message
    if damaged.name != "checksums.sfv":  # whose lines may then name any file
        assert named[2].startswith(damaged.as_posix())
        assert named[4] == (named[2].split("/")[0] if "/" in named[2] else None)
    return "refused"


def spoilt(name: str, change: Callable[[bytes], bytes | None]) -> Callable[[Path], Path]:
    """Fault of one file, a chunk unless it has a name: other content, or none."""

    def fault(path: Path) -> Path:
        file = path / name if name else chunks(path)[0]
        content = change(file.read_bytes())
        if content is None:
            file.unlink()
        else:
            file.write_bytes(content)
        return file

    return fault


def swapped(path: Path) -> Path:
    """Let two chunks of an array change places: their codec finds no fault."""
    first, second, *_ = (file for file in chunks(path) if "counts" in file.parts)
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)
    return path / "counts"


def no_array(path: Path) -> Path:
    """Lose the first array."""
    shutil.rmtree(path / "band")
    return path / "band"


FILL = rb'("fill_value": )[^,]+'
FAULTS: dict[str, Callable[[Path], Path]] = {
    "a chunk cut": spoilt("", lambda content: content[:-1]),
    "a chunk emptied": spoilt("", lambda _: b""),
    "a chunk lost": spoilt("", lambda _: None),
    "a bit of a chunk": spoilt("", lambda content: content[:-1] + bytes([content[-1] ^ 8])),
    "a bit of the attributes": spoilt("zarr.json", lambda c: c.replace(b'"', b"#", 9)),
    "chunks swapped": swapped,
    "no attributes": spoilt("zarr.json", lambda _: None),
    "no checksums": spoilt("checksums.sfv", lambda _: None),
    "checksums cut": spoilt("checksums.sfv", lambda content: content[: len(content) // 2]),
    "a chunk of noise": spoilt("", lambda content: bytes(reversed(content)) + b"x"),
    "metadata of an array lost": spoilt("band/zarr.json", lambda _: None),
    "metadata of an array cut": spoilt("counts/zarr.json", lambda content: content[:-20]),
    "metadata of another text": spoilt("counts/zarr.json", lambda _: b"[1, 2]\xff"),
    "another type": spoilt("counts/zarr.json", lambda c: re.sub(rb"uint16|float32", b"int8", c)),
    "another shape": spoilt("counts/zarr.json", lambda c: re.sub(rb"\d+,", b"1000000000,", c)),
    "another fill value": spoilt("counts/zarr.json", lambda c: re.sub(FILL, rb"\g<1>7", c)),
    "other attributes": spoilt(
        "zarr.json", lambda c: c.replace(b'"attributes": {', b'"attributes": {"x": 1,')
    ),
    "an array renamed": lambda path: (path / "band").rename(path / "band2").with_name("band"),
    "no array": no_array,
    "an array of an earlier state": spoilt(
        "band/zarr.json", lambda content: content.replace(b'"shape"', b'"shape" ')
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("kind", KINDS)
def test_faults_of_files_are_refused(
    stores: dict[str, Path], tmp_path: Path, kind: str, fault: str
) -> None:
    """A store that was cut, mixed, or copied in part is refused, with the file and the array."""
    assert outcome(tmp_path / "a.zarr", stores[kind], FAULTS[fault]) == "refused"


@pytest.mark.parametrize("kind", KINDS[:2])
def test_foreign_files_are_refused(stores: dict[str, Path], tmp_path: Path, kind: str) -> None:
    """A file that was not written into the store is refused; a hidden one is passed over."""

    def foreign(path: Path) -> Path:
        (path / "band" / "c" / "0.copy").touch()
        return path / "band" / "c" / "0.copy"

    def hidden(path: Path) -> Path:
        (path / ".DS_Store").touch()
        return path / ".DS_Store"

    assert outcome(tmp_path / "a.zarr", stores[kind], foreign) == "refused"
    assert outcome(tmp_path / "a.zarr", stores[kind], hidden) == "harmless"


@pytest.mark.parametrize("kind", KINDS)
def test_store_without_checksums_opens_with_a_warning(
    stores: dict[str, Path], tmp_path: Path, kind: str
) -> None:
    """A store of dbthermal 0.1.0 opens as before, and says that damage is not seen."""
    path = shutil.copytree(stores[kind], tmp_path / "a.zarr")
    (path / "checksums.sfv").unlink()
    content = json.loads((path / "zarr.json").read_text())
    del content["attributes"]["checksums"]
    (path / "zarr.json").write_text(json.dumps(content))
    with pytest.warns(
        UserWarning, match=r"No checksums in '.*a\.zarr', as of dbthermal 0.1.0: damage is not seen"
    ):
        opened = store.open_dataset(path)
    xr.testing.assert_identical(opened, store.open_dataset(stores[kind]))
    for file in stores[kind].glob("*/zarr.json"):  # another reader of zarr sees damage too
        assert json.loads(file.read_text())["codecs"][-1] == {"name": "crc32c"}


def test_recording_is_read_while_it_grows(tmp_path: Path) -> None:
    """Values that were valid when it was opened are read, though their files were replaced."""
    recording = record(tmp_path / "a.zarr", close=False)
    opened = store.open_dataset(tmp_path / "a.zarr")
    recording.append_log({"log_time": np.array([9.0]), "log_value": np.array([9.0])})
    recording.close()
    assert opened["log_value"].values.tolist() == [0.0, 0.0, 0.0]


def test_result_of_a_recording_cut_short_is_whole(stores: dict[str, Path], tmp_path: Path) -> None:
    """What was computed from a recording cut short has all its frames, and all its chunks."""
    opened = store.open_dataset(stores["cut short"])
    finer = opened[["counts"]].isel(time=[0, 0, 1, 1, 2, 2, 3, 3]).assign_coords(scene="pot")
    store.save(finer, tmp_path / "a.zarr", {})
    assert store.open_dataset(tmp_path / "a.zarr").sizes["time"] == 8
    chunks(tmp_path / "a.zarr")[-1].unlink()
    with pytest.raises(ValueError, match="Missing file"):
        store.open_dataset(tmp_path / "a.zarr")


def test_recording_without_its_checksums_ends(tmp_path: Path) -> None:
    """Without the file of checksums nothing more is recorded that could not be opened."""
    recording = record(tmp_path / "a.zarr", close=False)
    (tmp_path / "a.zarr" / "checksums.sfv").unlink()
    with pytest.raises(FileNotFoundError, match=r"No file 'checksums.sfv' in '.*a\.zarr' any more"):
        recording.append_log({"log_time": np.array([9.0]), "log_value": np.array([9.0])})
