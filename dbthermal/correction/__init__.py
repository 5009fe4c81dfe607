"""Correction of a camera's raw counts: errors of the detector are undone or marked.

Begin with `fit_correction` (gain, offset and bad pixels, from `blackbody_statistics`); then
`correct_capture` does all else in one order, by steps that are functions, too. A sample that is no
measurement becomes NaN or is flagged, never filled. `alignment` follows, then `separation`.
"""

from collections.abc import Callable
from dataclasses import replace
from types import NoneType
from typing import Any

import numpy as np
import xarray as xr

from dbthermal import _arrays, _numbers, schema
from dbthermal._arrays import Mask
from dbthermal.correction._frames import sampling, unreported
from dbthermal.correction._nonuniformity import (
    DETECTOR_MAXIMUM,
    OUTLIER,
    blackbody_statistics,
    correct,
    fit_correction,
    renew_offset,
)
from dbthermal.correction._pixels import mark_bad, mark_repeats
from dbthermal.correction._temporal import (
    Reference,
    distinct,
    events_of,
    find_shutter,
    mark_shutter,
    refer,
    undo_drift,
    undo_lag,
)

__all__ = [
    "DETECTOR_MAXIMUM",
    "OUTLIER",
    "Reference",
    "blackbody_statistics",
    "correct",
    "correct_capture",
    "corrected_by_camera",
    "find_shutter",
    "fit_correction",
    "mark_bad",
    "mark_shutter",
    "renew_offset",
    "undo_drift",
    "undo_lag",
]
__dir__ = __all__.copy


def corrected_by_camera(capture: xr.Dataset) -> xr.Dataset:
    """State that each camera corrects gain and offset of its pixels itself.

    The counts cannot prove it: without a correction each pixel would be off by kelvins.

    Parameters
    ----------
    capture : Dataset
        Stage `capture` of `schema`.

    Returns
    -------
    Dataset
        Stage `correction` for `correct_capture`: gain 1, offset 0 and no bad pixel (band, y, x);
        attribute ``by_camera`` = 1. TypeError or ValueError if there is no capture.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> counts = (("band", "time", "y", "x"), np.full((1, 2, 2, 2), 18000, np.uint16))
    >>> capture = xr.Dataset({"counts": counts}, {"band": ["8-14"], "time": [0.0, 0.1]})
    >>> correct(capture, corrected_by_camera(capture)).gain_offset_corrected
    0
    """
    ones = xr.ones_like(schema.check(capture, "capture")["counts"][:, 0], dtype=np.float64)
    ones = ones.drop_vars("time", errors="ignore")
    maps = {"gain": ones, "offset": 0 * ones, "bad": ones < 0}
    return xr.Dataset(maps).drop_attrs().assign_attrs(by_camera=1)


def correct_capture(  # noqa: PLR0913 - the options of each step, by name
    capture: xr.Dataset,
    correction: xr.Dataset,
    *,
    flat: xr.DataArray | None = None,
    shutter: bool = True,
    time_constant: float | xr.DataArray | None = None,
    bad_pixels: float | None = OUTLIER,
    drift_reference: xr.DataArray | None = None,
    reference: Reference | None = None,
    lazy: bool = False,
) -> xr.Dataset:
    """Correct a raw capture: gain, offset, shutter events, lag, bad pixels and drift, in order.

    1. `find_shutter` on raw counts, in which a repeated frame is an exact copy; frames recorded as
       closed (bit `schema.SHUTTER_CLOSED` of `frame_flags`) are added. Of a stream that repeats
       each frame, as one faster than its sensor, the distinct frames are kept, with their times.
    2. `renew_offset` and `correct`, while the limits of the detector still hold for each sample.
    3. `mark_shutter`: repeated, closed and damaged frames (without an exposure time) become NaN,
       and so do frames that neither those before nor those after predict: a shutter that is seen,
       black, torn or random frames, the rarer of two gains. A segment begins, too, where the fixed
       pattern of one band changes. Pixels whose raw counts heap on one level are saturated, those
       that repeat their counts for longer than noise does are frozen.
    4. `undo_lag`, after 3, because a repeated frame says nothing of the pixel's past.
    5. `mark_bad`: pixels that are noisy, stuck or jump, in units of this capture's noise.
    6. `undo_drift` last, so that no bad pixel is part of the reference patch.

    TypeError or ValueError if capture or correction is not of its stage, and as the steps.

    Parameters
    ----------
    capture : Dataset
        Stage `capture` of `schema`, raw: `counts` (band, time, y, x) [count], uint16; optionally
        `frame_flags` and `exposure_time` (band, time), as recorded.
    correction : Dataset
        From `fit_correction` or `corrected_by_camera`, or your own `gain` [1], `offset` [count] and
        `bad` (bool), each (band, y, x); it may hold more bands.
    flat : DataArray, optional
        Mean raw frames (band, y, x) [count] of a uniform view before the capture, for new offsets.
    shutter : bool
        False if no camera had a shutter, and no frame was lost or bad.
    time_constant : float or DataArray, optional
        Thermal time constant of the pixels [s], of all bands or (band); by default no correction.
    bad_pixels : float, optional
        Limit of the robust z-score of noise and jumps [1]; None for the bad pixels of the
        correction only, as for a capture of fewer than 16 frames.
    drift_reference : DataArray, optional
        True on a patch of constant temperature, (y, x), bool; by default no correction.
    reference : Reference, optional
        Patches in view whose temperature is known: the level of each camera, and by two patches its
        gain, are made theirs, and the bars of results contain the patches' errors in place of what
        drifts after a calibration; attribute ``level_reference``.
    lazy : bool
        Compute the counts anew whenever rows of them are read, for captures larger than memory.

    Returns
    -------
    Dataset
        Stage `corrected`: `counts` (band, time, y, x) [count], float32, NaN where a frame is no
        measurement; `status` (y, x); `segment` (time); `drift` (band, time) [count]; `pattern_std`
        (band) [count]. Attributes: those of the steps; ``shutter_events`` (renewals of the
        offsets), ``frames_taken_out`` (by band, by `mark_shutter`), ``bad_frames`` (by band, which
        show no scene), and ``shutter_closed_frames`` (by band, recorded as closed; -1 without
        `frame_flags`). UserWarning of bad frames, which it names, of frames that a stream repeats,
        and of a pattern that changes or is not corrected.

    Examples
    --------
    Two bands of 40 frames, of which the camera repeats one five times while its shutter is closed.

    >>> import numpy as np, xarray as xr
    >>> counts = np.random.default_rng(1).normal(20000, 4, (2, 40, 8, 8)).astype(np.uint16)
    >>> counts[1, 21:26] = counts[1, 20]
    >>> axes = {"band": ["8-14", "9.5"], "time": np.arange(40) / 10.0}
    >>> capture = xr.DataArray(counts, axes, ("band", "time", "y", "x")).to_dataset(name="counts")
    >>> corrected = correct_capture(capture, corrected_by_camera(capture))
    >>> corrected.shutter_events, corrected.frames_taken_out, int(corrected.segment[-1])
    (1, [0, 5], 1)
    >>> float(corrected.counts.std()) < 5
    True
    """
    schema.check(capture, "capture")
    schema.check(correction, "correction")
    _numbers.truth_value("shutter", shutter)
    schema.require(reference, (Reference, NoneType), "reference")
    # Steps 1 and 2: distinct frames, shutter events, new offsets.
    before = correction if flat is None else renew_offset(correction, flat)
    maximum = int(correction.attrs.get("detector_maximum", DETECTOR_MAXIMUM))
    events, notes, stamped = None, list[str](), capture
    if shutter:
        capture, repeats = distinct(capture)
        stamped, events, notes = _events(capture, repeats, before, maximum)
    closed = _closed(capture)

    def measured(rows: slice, columns: slice = slice(None)) -> xr.Dataset:
        """Correct some rows and columns, in the steps that need no others."""
        pixels = {"y": rows, "x": columns}
        corrected = correct(stamped.isel(pixels), before.isel(pixels), maximum=maximum)
        corrected = corrected if events is None else mark_shutter(corrected, events)
        if "exposure_time" in corrected:  # NaN in frames that have none, and their number by band
            counts, valid = corrected["counts"], corrected["exposure_time"].notnull()
            if not valid.all():
                counts = counts.where(valid).assign_attrs(counts.attrs)
            damaged = (~valid).sum("time").values.tolist()
            corrected = corrected.assign(counts=counts).assign_attrs(damaged_frames=damaged)
        return corrected if time_constant is None else undo_lag(corrected, time_constant)

    result = _by_rows(measured, capture["counts"]) if lazy else measured(slice(None))
    result = mark_repeats(result, capture["counts"], shutter=shutter)
    if bad_pixels is not None:
        result = mark_bad(result, threshold=bad_pixels)
    if drift_reference is not None:
        result = undo_drift(result, drift_reference, lazy=lazy)
    if reference is not None:
        result = refer(result, reference, lazy=lazy)
    if "exposure_time" not in capture:
        result = result.drop_vars("exposure_time", errors="ignore")
    number = -1 if closed is None else closed.sum("time").values.tolist()
    return schema.warned(result.assign_attrs(shutter_closed_frames=number), *notes)


def _by_rows(measured: Callable[..., xr.Dataset], raw: xr.DataArray) -> xr.Dataset:
    """Correct block by block of rows, with counts that are computed when they are read."""
    blocks = [measured(rows).drop_vars("counts") for rows in _arrays.blocks(raw.shape)]
    rule: Any = {"data_vars": "minimal", "coords": "minimal", "compat": "override"}
    result = xr.concat(blocks, "y", combine_attrs="override", **rule)
    if "pattern_std" in result:
        squares = np.array([block["pattern_std"].values ** 2 for block in blocks])
        finite = squares[np.isfinite(squares).all(axis=1)]  # blocks with a good pixel
        if len(finite):
            result["pattern_std"].values[:] = np.sqrt(np.mean(finite, axis=0))
    template = raw.assign_attrs(schema.STAGES["corrected"]["counts"].attrs)
    counts = _arrays.by_pixels(lambda *window: measured(*window)["counts"].values, template)
    dead = sum(block.attrs["dead_pixels"] for block in blocks)
    return result.assign(counts=counts).assign_attrs(dead_pixels=dead)


def _events(
    capture: xr.Dataset, repeats: Mask, correction: xr.Dataset, maximum: int
) -> tuple[xr.Dataset, xr.Dataset, list[str]]:
    """Capture with bad frames without exposure time, its events, and sentences on both."""
    counts, closed = capture["counts"], _closed(capture)
    clock = counts["time"].astype(np.float64).expand_dims(band=counts["band"])
    stamps = capture.get("exposure_time", clock).assign_attrs(schema.EXPOSURE_TIME.attrs)
    shut = xr.zeros_like(stamps, dtype=bool) if closed is None else closed
    valid = ~repeats & ~shut.values & stamps.notnull().values
    # First frames after the events that are known.
    events = events_of(counts, repeats, closed)
    names = [str(name) for name in counts["band"].values]
    renewals = np.zeros(valid.shape, dtype=bool)
    for event in np.flatnonzero(events["renewed"]):
        after = int(events["first_frame"][event] + events["frames"][event])
        renewals[names.index(str(events["band"].values[event])), after : after + 1] = True
    # What no camera reports, in some pixels.
    pixels = sampling(counts)
    sample = correct(capture.isel(pixels), correction.isel(pixels), maximum=maximum)
    findings = unreported(sample, valid, renewals)
    if findings.bad.any():
        # Copies of a bad frame are bad, too.
        last = np.maximum.accumulate(np.where(repeats, 0, np.arange(counts.sizes["time"])), axis=1)
        findings = replace(findings, bad=np.take_along_axis(findings.bad, last, axis=1))
        capture = capture.assign(exposure_time=stamps.where(~findings.bad))
    capture = capture.assign_attrs(bad_frames=findings.bad.sum(axis=1).tolist())
    events = events_of(counts, repeats, shut | findings.shutter, findings.steps)
    return capture, events, findings.notes(names)


def _closed(capture: xr.Dataset) -> xr.DataArray | None:
    """Frames (band, time) recorded as taken with the shutter closed; None if not recorded."""
    flags, name = capture.get("frame_flags", xr.DataArray()), schema.SHUTTER_CLOSED
    meanings = str(flags.attrs.get("flag_meanings", "")).split()  # a file need not tell
    return schema.has_flag(flags, name) if name in meanings else None
