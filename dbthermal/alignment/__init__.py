"""Alignment of two cameras or more: one clock and one pixel grid.

`register` estimates where the pixels of the first view lie in the others, `time_offset` by how much
one camera is exposed later than the first, and `align` brings all bands onto one clock and onto the
grid of the first.
"""

from functools import partial

import xarray as xr

from dbthermal import schema
from dbthermal.alignment._clocks import exposure_times, fill_times
from dbthermal.alignment._joint import compare
from dbthermal.alignment._offset import SEARCH, time_offset
from dbthermal.alignment._reflections import reflection_shift
from dbthermal.alignment._registration import register
from dbthermal.alignment._resampling import on_one_clock, registered

__all__ = ["align", "exposure_times", "fill_times", "reflection_shift", "register", "time_offset"]
__dir__ = __all__.copy


def align(
    corrected: xr.Dataset,
    *,
    offset: float | xr.DataArray | None = None,
    transform: xr.DataArray | None = None,
    search: int = SEARCH,
    clock: str | None = None,
    reflection_shift: xr.Dataset | None = None,
    lazy: bool = False,
) -> xr.Dataset:
    """Resample all bands onto one clock, and onto the first band's grid.

    The band with the most noise relative to its signal, or `clock`, keeps its samples in time. The
    others are interpolated at its exposure times by cubics through four frames, bent more or less
    where rapid changes would else not be as large as in that band.

    Frames are NaN in a band across a gap or a change of `segment`, past an end, and where the
    camera gave none (NaN, or a copy of the frame before). A sample is NaN where the signal steps by
    five standard deviations of noise between two frames, and beside it, where a curve overshoots.
    Interpolation lessens the noise (`noise_factor`), and correlates neighbouring frames.

    TypeError or ValueError if an argument is not as described, no offset is found, one leaves no
    frame that all bands have, or a band's clock was set while it ran: its stamps step, and the
    images go on as without the step. A UserWarning if the clocks of cameras apart still seem to be
    off by more than a tenth of a frame, or the images contradict an offset that was stated to
    `readers.two_bands`, and are followed.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`. Optionally `exposure_time` (band, time) [s], each camera's
        own stamps, which need be neither even nor of one rate, NaN behind the last frame; `segment`
        (time), which counts shutter events; `status` (y, x).
    offset : float or DataArray, optional
        How much later than the first band the others were exposed, beyond their stamps [s]: a
        number for two bands, or (band), 0 in the first; it is kept. By default that of the
        registered views: `time_offset`, or where the cameras see reflections apart, found together
        with their shift. One that was stated to `readers.two_bands` is kept if this is within a
        tenth of a frame, or three deviations.
    transform : DataArray, optional
        (band, row, column), from `register`; or, of a curved surface whose shape is known, (band,
        axis, y, x) [pixel], the row and column in each view of each pixel of the first. The views
        are interpolated by polynomials through 6x6 pixels, near the border and bad pixels by
        lines. Pixels outside a view, or without a place in it (NaN), are NaN.
    search : int
        Largest lag that `time_offset` searches, either way [frame].
    clock : str, optional
        Band whose samples are not touched in time.
    reflection_shift : Dataset, optional
        From the function of this name: the time offset is found of places that show the same
        reflection. It changes nothing else.
    lazy : bool
        Compute the counts when they are read, some rows at a time and each time anew, as
        `correction.correct_capture` does: the capture may be lazy, too.

    Returns
    -------
    Dataset
        Stage `corrected` with as many frames: `counts` (band, time, y, x) [count], float32; `time`,
        exposure times of the band `clock` on the first band's clock. After a warp, a pixel's
        `status` is that of all the pixels that it may be made of; `noise_factor` (band) [1], by how
        much interpolation in time and over pixels lessens the noise, root mean square;
        `pattern_std`, lessened over pixels. Attributes: `clock`, `rapid_noise_factor` (as
        `noise_factor`, of differences of frames), `time_offset` (of each band) [s],
        `time_offset_std` [s] where the images tell it, `frames_lost` (of each band), `pauses`
        (times of the frames before and after each gap of more than 20 frame periods, in turn) [s],
        `transform` (the matrices, row by row). Other variables over `time` are dropped.

    Examples
    --------
    A shift by one whole frame: the last frame has no counterpart.

    >>> import numpy as np, xarray as xr
    >>> rng, time = np.random.default_rng(1), np.arange(40) / 10.0
    >>> counts = rng.normal(20000, 5, (2, 40, 4, 4)).astype(np.float32)
    >>> axes = {"band": ["8-14", "9.5"], "time": time}
    >>> corrected = xr.Dataset({"counts": (("band", "time", "y", "x"), counts)}, axes)
    >>> aligned = align(corrected, offset=-0.1, clock="8-14")
    >>> bool((aligned.counts[1, :-1] == counts[1, 1:]).all()), aligned.frames_lost
    (True, [0, 1])
    """
    schema.check_corrected(corrected)
    if transform is not None:
        # Registered first: a moving reflection passes an unregistered view earlier or later.
        corrected = registered(corrected, transform, lazy=lazy)
    onto = partial(on_one_clock, corrected, clock=clock, lazy=lazy)
    if offset is not None or reflection_shift is not None:
        return onto(offset=offset, search=search, reflection_shift=reflection_shift)
    comparison = compare(corrected, search=search, clock=clock, lazy=lazy)
    return comparison.noted(onto(offset=comparison.offset))
