"""The published scenes: synthetic films for the rules, the real ones for the figures."""

from collections.abc import Mapping
from pathlib import Path

import av
import numpy as np
import pytest
import xarray as xr
from matplotlib import colormaps

from dbthermal import separation
from reproduction import videos as published

Files = Mapping[str, Path]


def film(path: Path, frames: int, width: int = 64) -> Path:
    """Encode a wave in plasma that moves, 10 frames a second."""
    time, y, x = np.ogrid[:frames, :48, :width]
    wave = 0.5 + 0.35 * np.sin(y / 9 + time / 4) * np.cos(x / 11)
    colours = colormaps["plasma"](np.rint(255 * wave).astype(int), bytes=True)[..., :3]
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10, options={"crf": "18"})
        stream.height, stream.width, stream.pix_fmt = 48, width, "yuv420p"
        for frame in np.ascontiguousarray(colours):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    return path


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """Both bands of a scene of 6 frames, and of one whose bands differ in width."""
    folder = tmp_path_factory.mktemp("scenes")
    bands = (("toy-0-bg.mp4", 64), ("toy-1-bg.mp4", 64), ("odd-0-bg.mp4", 64), ("odd-1-bg.mp4", 32))
    return {name: film(folder / name, 6, width) for name, width in bands}


def test_inputs(toy: Files) -> None:
    """The selected frames of both bands come as uncalibrated pictures of a scene."""
    movie = published.inputs(toy, "toy", 2, 5)
    assert dict(movie.sizes) == {"band": 2, "time": 3, "y": 48, "x": 64}
    assert movie["band"].values.tolist() == ["8-14", "9.5"]
    np.testing.assert_allclose(movie["time"], [0.2, 0.3, 0.4], rtol=0, atol=1e-9)  # s
    assert (movie.attrs["radiometric"], movie.attrs["scene"]) == (0, "toy")
    np.testing.assert_array_equal(movie[0], movie[1])  # the same wave was filmed


@pytest.mark.parametrize(("first", "last"), [(0, 7), (-1, 3), (3, 3), (4, 2)])
def test_frames_out_of_range(toy: Files, first: int, last: int) -> None:
    """Frames beyond the video raise an error with the available range."""
    message = rf"Invalid frames {first} to {last} of scene 'toy'. Must lie in \[0, 6\]"
    with pytest.raises(ValueError, match=message):
        published.inputs(toy, "toy", first, last)


def test_bands_must_agree(toy: Files) -> None:
    """Bands of different shape raise a ValueError."""
    with pytest.raises(ValueError, match=r"Invalid shapes \(6, 48, 64\), \(6, 48, 32\) of scene"):
        published.inputs(toy, "odd", 0, 6)


def test_missing_video(toy: Files) -> None:
    """A missing scene raises an error that lists the available ones."""
    with pytest.raises(FileNotFoundError, match=r"Missing video 'plate-0-bg.mp4'. .*toy-0-bg.mp4"):
        published.inputs(toy, "plate", 0, 1)
    with pytest.raises(FileNotFoundError, match=r"Missing video 'toy_calib_Tbdiff_video.mp4'"):
        published.authors_reflection(toy, "toy", "calib", 64)


def pair() -> tuple[xr.DataArray, xr.Dataset]:
    """A reflection that grows over 10 frames, and a map that agrees in all frames but the last."""
    time, y, x = np.ogrid[:10, :30, :60]
    ours = xr.DataArray(
        (time + 1) * np.sin((x + 5 * time) / 9) * np.cos(y / 11),
        dims=("time", "y", "x"),
        coords={"time": np.arange(10.0)},
    )
    value = 0.01 * abs(ours)
    value[9] = -value[9]
    return ours, xr.Dataset({"value": value, "valid": xr.ones_like(ours, dtype=bool)})


def test_agreement() -> None:
    """The strongest frames are compared, in their order; unit and sign do not matter."""
    ours, theirs = pair()
    theirs["valid"][:, :8] = False
    ours[4, :3] = 1e3  # outside the authors' map: neither strength nor score
    found = published.agreement(ours, theirs, 3)
    np.testing.assert_array_equal(found["time"], [7.0, 8.0, 9.0])
    np.testing.assert_allclose(found, [1.0, 1.0, -1.0], rtol=0, atol=0.01)
    np.testing.assert_allclose(published.agreement(-5 * ours, theirs, 3), found, rtol=0, atol=1e-9)


def test_agreement_of_other_frames() -> None:
    """Maps of another number of frames raise a ValueError."""
    ours, theirs = pair()
    with pytest.raises(ValueError, match=r"Invalid shape \(10, 30, 60\) .* Must be \(9, 30, 60\)"):
        published.agreement(ours[1:], theirs, 3)


@pytest.mark.data
def test_coffee_pot(mirror: Path) -> None:
    """The bands' ratio lies within 1.9-2.4, and our reflection correlates with theirs at 0.6."""
    files = {path.name: path for path in (mirror / "scenes").glob("*.mp4")}
    movie = published.inputs(files, "coffeepot", 0, 350)
    assert movie.shape == (2, 350, 240, 262)
    assert movie.attrs["radiometric"] == 0
    found = separation.uncalibrated_reflection(movie)
    assert 1.9 <= found.attrs["pooled_ratio"] <= 2.4
    assert found.attrs["radiometric"] == 0
    theirs = published.authors_reflection(files, "coffeepot", "uncalib", 262)
    agreement = published.agreement(found["reflection"], theirs, 40)
    assert agreement.sizes == {"time": 40}
    assert float(agreement.median()) >= 0.6
