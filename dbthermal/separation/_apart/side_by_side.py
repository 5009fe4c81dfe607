"""Separation of cameras side by side: each pixel alone, and all together for the object, in turns.

A first separation takes the object at the second camera's place for that at the first. All pixels
together tell by how much the two differ (`joint`), from maps of the signals where the object is
smooth, else from another separation; with that each pixel is separated once more.
"""

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from typing import Final, TypeAlias

import numpy as np
import xarray as xr

from dbthermal.separation._apart import joint, neighbours, planes
from dbthermal.separation._inputs import Inputs
from dbthermal.separation._pooling import pool
from dbthermal.separation._tiles import Material

Each: TypeAlias = Callable[[Inputs, Material | None], object]
"""Separates each pixel alone, into the result."""

# Turns of the materials and the object at each camera's place; and the median change of the
# emissivities that ends them: of simulated scenes below 0.0026 a second turn changes no error by
# more than 2 %, at a change of 0.008 it makes the error 2.6 times less.
_TURNS, _SETTLED = 2, 0.003
_OBJECTS: Final = "objects"  # what a displacement keeps of the pixels alone


def alone(inputs: Inputs, result: xr.Dataset, separate_pixels: Each, threads: Executor) -> None:
    """Separate without materials, then by the ratios of bands that are blurred alike."""
    displacement = inputs.displacement
    assert displacement is not None
    separate_pixels(inputs, None)
    inputs.division[:] = 0  # it holds what each camera sees to rise
    material, blur, maps, objects = None, 0.0, None, None
    frames = joint.Frames.of(result)
    moves = displacement.resample.nnz > displacement.resample.shape[0]  # reflections, somewhere
    if inputs.method.pools and moves:
        if not frames.smooth:  # what one camera sees to rise the other sees at another time
            objects = joint.solve(inputs, result, threads, frames)
            inputs = inputs if objects is None else replace(inputs, difference=objects.difference)
            separate_pixels(inputs, None)
        shares, _ = neighbours.emissivities(inputs, result)
        maps = planes.project(inputs, result, shares, threads)
        material, blur = neighbours.ratios(inputs, maps, result["status"].values), neighbours.BLUR
        if not frames.smooth:
            separate_pixels(inputs, material)
    objects = joint.solve(
        inputs, result, threads, frames, maps=maps, material=material, before=objects, blur=blur
    )
    del maps  # a large part of the memory
    if objects is not None:
        inputs = replace(inputs, difference=objects.difference)
    if objects is not None or material is not None:
        separate_pixels(inputs, material)
    if material is not None:
        result["reflection_ratio_std"].attrs["pixels"] = neighbours.SHARING
    if objects is not None:
        objects.finish(result, threads)
    displacement.found[_OBJECTS] = objects


def pooled(
    inputs: Inputs,
    before: xr.Dataset,
    result: xr.Dataset,
    separate_pixels: Each,
    threads: Executor,
    materials: Callable[..., Material | None],
    regroup: pool.Regroup | None = None,
) -> None:
    """Separate with materials, from a result of each pixel alone before."""
    assert inputs.displacement is not None
    frames = joint.Frames.of(before)
    objects: joint.Joint | None = inputs.displacement.found[_OBJECTS]
    shares, _ = neighbours.emissivities(inputs, before)
    # The first turn finds materials by the object and emissivities of pixels alone, and may regroup
    # them; the second by the object and emissivities of the first turn.
    for turn in range(_TURNS):
        inputs = replace(inputs, difference=None if objects is None else objects.difference)
        # Of a smooth object the difference changes no rapid product.
        plain = replace(inputs, difference=None) if frames.smooth else inputs
        maps = planes.project(plain, before, shares, threads)
        values = threads.map(maps.scatters, neighbours.BLURS)
        scatters = dict(zip(neighbours.BLURS, values, strict=True))
        survey = partial(
            neighbours.materials, scatters=scatters, per_pixel=before, pooled=materials
        )
        inputs, material = pool.regrouped(inputs, survey, regroup if turn == 0 else None)
        source, of_pixels = before, material and scatters[0.0].uncontradicted(material)
        if not frames.smooth:
            separate_pixels(inputs, material)
            source = result
        objects = joint.solve(
            inputs, source, threads, frames, maps=maps, material=of_pixels, before=objects
        )
        if objects is None:  # the object hardly differs between the places
            break
        sound = source["status"].values.ravel() == 0
        changes, shares = np.abs(objects.emissivity - shares)[:, sound], objects.emissivity
        if sound.any() and np.median(changes) < _SETTLED:
            break
    inputs = replace(inputs, difference=None if objects is None else objects.difference)
    del maps, scatters, survey  # a large part of the memory
    separate_pixels(inputs, material)
    if objects is not None:
        objects.finish(result, threads)
