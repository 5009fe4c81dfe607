"""Films in memory and on disk."""

import resource
from pathlib import Path

import numpy as np
import pytest

from dbthermal import _arrays as films


def test_a_film_on_disk_is_an_array_without_a_name(tmp_path: Path) -> None:
    """Values outlive the pages, no file is left to be deleted, and small arrays stay in memory."""
    before = films.empty((3, 512, 1024), np.float32)
    with films.on_disk(tmp_path):
        film = films.empty((3, 512, 1024), np.float32)
        small = films.empty((4, 5), np.float32)
    film[:] = np.arange(3, dtype=np.float32)[:, np.newaxis, np.newaxis]
    films.release()
    np.testing.assert_array_equal(film[:, ::100, 7], np.outer([0, 1, 2], np.ones(6)))
    again = films.copied(film)
    np.testing.assert_array_equal(again, film)
    assert list(tmp_path.iterdir()) == []
    assert film.flags.writeable
    assert not films.made_on_disk()
    assert before.base is None
    assert small.base is None
    assert film.base is not None


def test_a_full_disk_is_an_error(tmp_path: Path) -> None:
    """A film for which there is no room is refused, and does not end the process when written."""
    with films.on_disk(tmp_path), pytest.raises(OSError):  # noqa: PT011 - the system's own words
        films.empty((2**44,), np.float64)


def test_pages_are_given_back(tmp_path: Path) -> None:
    """A film of 256 MB that is released part by part takes a fraction of that."""
    with films.on_disk(tmp_path):
        film = films.empty((64, 2**20), np.float32)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for frame in film:
        frame[:] = 1.0
        films.release()
    taken = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    assert taken < film.nbytes / 4
    assert float(film[::9].mean()) == 1.0
