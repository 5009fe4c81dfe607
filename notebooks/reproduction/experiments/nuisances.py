"""Cost of the nuisances of a real rig, before and after their correction."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

import numpy as np
import xarray as xr

from dbthermal import _text as texts
from dbthermal import alignment, separation, simulation
from dbthermal.correction import mark_shutter
from dbthermal.simulation import Background, Rig
from reproduction import disturbances
from reproduction.cache import gridded
from reproduction.experiments.cases import STEPS, held, independent_pixels, rmse, scalars
from reproduction.experiments.limits import on_clock

TREATMENTS: Final = ("as recorded", "undone", "without")
"""A capture with the nuisance as it is; with the nuisance undone; and one that never had it."""

VIEWS: Final = ("registered", "registered by the truth", "one view")
"""Two views registered from the capture; by their true shift; and both bands from one place."""

NUISANCES: Final = ("lost frames", "shutter", "lost frames and shutter")
"""What `disturbed` puts into a capture."""

GLASS: Final = (0.86, 0.72)  # emissivities of plate glass in the two bands of the default `Rig` [1]

COLUMNS: Final = 4
"""Columns of the scene in a pixel of `parallax`, over which its sides see the mean."""

# Pixels around the scene of `parallax`.
_MARGIN: Final = 12


@dataclass(frozen=True)
class Pixels:
    """Independent pixels of one material before a moving background.

    Emissivity in the two bands of the default `Rig` [1]; first and last temperature of the object
    [K]; number of frames and their rate [Hz]; number of pixels; fields of `simulation.Background`.
    """

    emissivity: Sequence[float] = GLASS
    ends: Sequence[float] = (293.15, 318.15)
    clock: Sequence[float] = (350, 10.0)
    pixels: int = 400
    background: Mapping[str, Any] = field(default_factory=dict)

    def scene(self, rng: np.random.Generator, *, later: int = 0, steps: int = 1) -> xr.Dataset:
        """Scene on a clock of `steps` a frame that goes on `later` steps beyond the last frame."""
        count, rate = int(self.clock[0]), self.clock[1]
        time = np.arange((count - 1) * steps + 1 + later) / (rate * steps)
        value = xr.DataArray(list(self.emissivity), dims="band", coords={"band": list(Rig().bands)})
        background, (start, stop) = Background(**self.background), self.ends
        return independent_pixels(time, value, background, self.pixels, rng, start=start, stop=stop)


def apart(delay: float, *, pixels: Mapping[str, Any], seed: int) -> xr.Dataset:
    """Two bands recorded a delay [frame] apart: the delay estimated and undone.

    The delay of the second band is rounded to 1 / `cases.STEPS`; `pixels` are fields of `Pixels`.
    `found` [frame] is the offset by `alignment.time_offset`; over `treatment` the variables of
    `cost`, where "without" is a capture of both bands at the later time.
    """
    kind, later = Pixels(**pixels), round(delay * STEPS)
    rng, response = np.random.default_rng(seed), Rig().response()
    scene = kind.scene(rng, later=later, steps=STEPS)
    options, captures = {"every": STEPS, "frames": int(kind.clock[0])}, []
    for offsets in ((0, later), (later, later)):
        rng = np.random.default_rng(seed + 1)
        seen = disturbances.expose(scene, response, rng, offsets=offsets, **options)
        captures.append(seen.drop_vars("exposure_time"))
    offset = alignment.time_offset(captures[0])
    aligned = alignment.align(captures[0], offset=offset)
    result = _compare(scene, (captures[0], aligned, captures[1]), response, TREATMENTS)
    frame = {"units": "frame", "long_name": "time offset of the second band"}
    return result.assign(found=((), offset * kind.clock[1], frame))


def disturbed(
    name: str, *, pixels: Mapping[str, Any], nuisance: Mapping[str, Any], seed: int
) -> xr.Dataset:
    """A nuisance, one of `NUISANCES`, put into a capture, and marked by `correction.mark_shutter`.

    Lost are a `share` of each band's frames [1], the driver returning the previous one; both
    cameras' shutters close at `shutter`, times as shares of the capture [1]. `pixels` are fields of
    `Pixels`. Over `treatment`, the variables of `cost`.
    """
    texts.check_listed("Unknown nuisance", name, NUISANCES)
    kind, rng = Pixels(**pixels), np.random.default_rng(seed)
    scene, response = kind.scene(rng), Rig().response()
    capture = simulation.observe(scene, response, rng)
    spoiled = capture
    if "lost frames" in name:
        spoiled = disturbances.lose_frames(spoiled, nuisance["share"], rng).drop_vars("repeated")
    if "shutter" in name:
        last = float(capture["time"][-1])
        spoiled = disturbances.fire_shutter(spoiled, last * np.array(nuisance["shutter"]), rng)
    return _compare(scene, (spoiled, mark_shutter(spoiled), capture), response, TREATMENTS)


def parallax(
    distance: float,
    *,
    shape: Sequence[int],
    clock: Sequence[float],
    shift: Sequence[float],
    seed: int,
) -> xr.Dataset:
    """Two cameras side by side: the object is registered, its reflection is not.

    A plate of glass, heated in its middle, people walking by; a second camera sees the plate
    shifted, and its reflection shifted by some pixels more. A registration (translation) brings
    the plate together and leaves the reflection apart by a distance along x [pixel], a multiple of
    1 / `COLUMNS`. The clock is the number of frames and their rate [Hz]; the shift is how far the
    second camera looks to the right, a multiple of 1 / `COLUMNS`, and down, a whole number [pixel];
    together they stay within the margin of the scene, 12 pixels (ValueError).

    `misregistered` [pixel], distance of the transform by `alignment.register` from the true one;
    and over `treatment`, one of `VIEWS`, the variables of `cost`.
    """
    places = np.array([COLUMNS * shift[0], COLUMNS * distance, shift[1]])
    if np.any(places % 1) or max(abs(shift[0]) + abs(distance), abs(shift[1])) > _MARGIN:
        raise ValueError(
            f"Invalid shift {list(shift)} and parallax {distance} pixels. Must be multiples of "
            f"1/{COLUMNS} along x and of 1 along y, within {_MARGIN} together."
        )
    # People walking by: a margin around the view, and several columns a pixel.
    value = xr.DataArray(list(GLASS), dims="band", coords={"band": list(Rig().bands)})
    time, response = np.arange(int(clock[0])) / clock[1], Rig().response()
    height, width = (size + 2 * _MARGIN for size in shape)
    rng = np.random.default_rng(seed)
    wide = simulation.walkers(time, (height, width * COLUMNS), value, rng)
    first, captures = _view(wide, (0.0, 0.0)), []
    for right, down, more in ((*shift, distance), (0.0, 0.0, 0.0)):
        mirrored = _view(wide, (right + more, down))["background_temperature"]
        second = _view(wide, (right, down)).assign(background_temperature=mirrored)
        rng = np.random.default_rng(seed + 1)
        captures.append(disturbances.by_cameras((first, second), response, rng))
    capture, single = captures
    estimate = alignment.register(capture, model="translation")
    true = estimate.copy(data=np.stack([np.eye(3), np.eye(3)]))
    true[1, :2, 2] = -np.array(shift)
    align = partial(alignment.align, capture, offset=0.0)
    captures = [align(transform=estimate), align(transform=true), single]
    result = _compare(first, captures, response, VIEWS)
    away = float(np.hypot(*(estimate - true).values[1, :2, 2]))
    return result.assign(misregistered=((), away, {"units": "pixel"}))


def cost(truth: xr.Dataset, result: xr.Dataset) -> xr.Dataset:
    """Error and flags of one separation.

    `object_temperature_rmse` [K], root mean square over time, median over the pixels with a value;
    of them `flagged` [1], the share with any flag, and `covered` [1], share of the samples of the
    others whose 95 % interval holds the truth, NaN without any.
    """
    # Errors of all pixels with a value; intervals of those without a flag.
    error = result["object_temperature"] - truth["object_temperature"]
    solved, good = error.notnull().any("time"), result["status"] == 0
    return scalars(
        object_temperature_rmse=rmse(error),
        flagged=(~good).where(solved).mean(),
        covered=held(error.where(good), result["object_temperature_std"]),
    )


def _compare(
    scene: xr.Dataset, captures: Iterable[xr.Dataset], response: xr.Dataset, names: tuple[str, ...]
) -> xr.Dataset:
    """Cost of the separation of each capture of a scene."""
    results = [separation.solve(capture, response) for capture in captures]
    rows = [cost(on_clock(scene, result["time"]), result) for result in results]
    return gridded(rows, {"treatment": names}).assign_attrs(origin="simulated")


def _view(wide: xr.Dataset, shift: Sequence[float]) -> xr.Dataset:
    """Part of a wide scene within its margin, so far to the right and down [pixel]."""
    right, down = round((_MARGIN + shift[0]) * COLUMNS), round(_MARGIN + shift[1])
    width, height = wide.sizes["x"] - 2 * _MARGIN * COLUMNS, wide.sizes["y"] - 2 * _MARGIN
    seen = wide.isel(x=slice(right, right + width), y=slice(down, down + height))
    mean = seen.coarsen(x=COLUMNS).mean()
    places = {dim: np.arange(mean.sizes[dim]) for dim in ("x", "y")}
    return mean.assign_coords(places).assign_attrs(wide.attrs)
