"""Folders of zarr of other programs: what contradicts itself is refused, what is right is read."""

import json
from pathlib import Path
from typing import Any

import numcodecs
import numpy as np
import pytest
import zarr
from hostile_files import COUNTS
from numpy.testing import assert_array_equal

from dbthermal import readers


def read(source: Any) -> np.ndarray[Any, Any]:
    """Counts of a source."""
    return readers.array(source, unit="count", clock=10.0)["counts"].values


@pytest.mark.parametrize("change", [{"shape": [1, 24, 32]}, {"data_type": "int16"}])
def test_consolidated_metadata_are_a_copy(tmp_path: Path, change: dict[str, Any]) -> None:
    """Those that say something else than the array's are not used."""
    zarr.open_group(tmp_path / "a.zarr", mode="w").create_array("frames", data=COUNTS)
    with pytest.warns(UserWarning, match="Consolidated metadata"):
        zarr.consolidate_metadata(tmp_path / "a.zarr")
    file = tmp_path / "a.zarr" / "zarr.json"
    about = json.loads(file.read_text())
    about["consolidated_metadata"]["metadata"]["frames"] |= change
    file.write_text(json.dumps(about))
    assert_array_equal(read(tmp_path / "a.zarr"), COUNTS)


@pytest.mark.parametrize(
    ("code", "lossless"),
    [
        (numcodecs.Delta("u2"), True),
        (numcodecs.Shuffle(2), True),
        (numcodecs.Fletcher32(), True),
        (numcodecs.FixedScaleOffset(offset=0, scale=0.1, dtype="u2"), False),
        (numcodecs.Quantize(digits=1, dtype="f4"), False),
    ],
)
def test_filters_that_change_counts_are_refused(tmp_path: Path, code: Any, lossless: bool) -> None:
    """By their names; those that change nothing are read."""
    zarr.create_array(tmp_path / "a.zarr", data=COUNTS, filters=[code], zarr_format=2)
    if lossless:
        assert_array_equal(read(tmp_path / "a.zarr"), COUNTS)
    else:
        with pytest.raises(ValueError, match=rf"Invalid filter '{code.codec_id}' of 'a'"):
            read(tmp_path / "a.zarr")


@pytest.mark.parametrize("frames", [1, 2])
def test_shards_that_end_beyond_the_frames(tmp_path: Path, frames: int) -> None:
    """A last shard that is not full lacks nothing."""
    counts = np.concatenate([COUNTS, COUNTS + 1])[:frames]
    options: dict[str, Any] = {"chunks": (1, 12, 16), "shards": (2, 36, 32)}
    zarr.create_array(tmp_path / "a.zarr", data=counts, **options)
    assert_array_equal(read(tmp_path / "a.zarr"), counts)


def test_arrays_of_unknown_size() -> None:
    """Of dask, after a selection by values: the shape is named."""

    class Unknown:
        """Array of which the number of frames is not known."""

        shape, dtype, ndim = (float("nan"), 8, 8), np.dtype("u2"), 3

    with pytest.raises(ValueError, match=r"Invalid shape \(nan, 8, 8\) of 'array'"):
        read(Unknown())
