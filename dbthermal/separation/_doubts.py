"""Sentences on what speaks against a result as a whole: its calibration, its share of flags."""

from typing import Final

import numpy as np
import xarray as xr

from dbthermal import response as responses
from dbthermal import schema
from dbthermal.schema import Status
from dbthermal.separation._tiles import RANGE_SIGMAS

_FRAMES: Final = 200  # about as many frames and pixels tell
_PIXELS: Final = 10_000
_OUTSIDE: Final = 0.01  # share of samples outside the calibration that is told
_HARDLY: Final = 0.1  # share of the moving pixels
_REASONS: Final = 3  # flags that are named


def against_response(corrected: xr.Dataset, response: xr.Dataset) -> list[str]:
    """Doubts about counts of a capture that do not fit its response."""
    found = list[str]()
    counts = schema.check(corrected, "corrected")["counts"]
    if counts.dtype.kind != "f":  # raw counts of pixels that differ
        return []
    step = max(1, int(np.sqrt(counts.sizes["y"] * counts.sizes["x"] / _PIXELS)))
    status = corrected["status"].values if "status" in corrected else np.zeros(counts.shape[2:])
    good = (status.astype(np.uint32) & np.uint32(Status.DEAD_PIXEL))[::step, ::step] == 0
    names = [str(name) for name in counts["band"].values]
    noises = responses.noise(response, names) if "noise" in response else np.zeros(len(names))
    factors = corrected["noise_factor"].values if "noise_factor" in corrected else 1.0
    patterns = corrected["pattern_std"].values if "pattern_std" in corrected else 0.0
    stds = np.hypot(noises * factors, patterns)
    for name, one, std in zip(names, counts, stds, strict=True):
        every = one[:: max(1, len(one) // _FRAMES), ::step, ::step].values[:, good]
        curve = responses.curve(response, name)
        low, high = curve.counts([curve.lowest, curve.highest])
        margin = RANGE_SIGMAS * std
        outside = (every < low - margin) | (every > high + margin)
        share = float(outside.sum() / max(1, np.isfinite(every).sum()))
        if share > _OUTSIDE:
            found.append(
                f"{share:.0%} of the samples of band '{name}' lie outside the {low:.0f} to "
                f"{high:.0f} count that its response was calibrated over. Must lie within: "
                "calibrate over the temperatures of the scene; or is it another band's response?"
            )
    return found


def hardly_measured(result: xr.Dataset) -> list[str]:
    """Share of the moving pixels without a flag, and the commonest flags, if these are few."""
    if "status" not in result:
        return []
    status = result["status"].values.astype(np.uint32)
    moving = status[(status & np.uint32(Status.NO_BACKGROUND_MOTION)) == 0]
    measured = (moving & ~np.uint32(Status.COMPLETED_FRAMES)) == 0
    share = measured.sum() / max(1, moving.size)
    if share >= _HARDLY:
        return []
    bits = [bit for bit in Status if not bit & schema.COMPLETED]
    shares = {bit.label: float(np.mean((status & np.uint32(bit)) != 0)) for bit in bits}
    reasons = sorted(shares, key=lambda name: -shares[name])[:_REASONS]
    named = ", ".join(f"{name} {shares[name]:.0%}" for name in reasons if shares[name] > 0)
    found = f"{share:.0%} of the {moving.size} pixels with moving reflections have no flag"
    rule = "What to do about each flag is in docs/status.md"
    return [f"Hardly anything was measured: {found}. Of all pixels: {named}. {rule}."]
