"""Surroundings of an object: a room, and bodies that move in it, as seen by reflected rays.

A ray carries the temperature of the first body that it meets, or that of the room. All are taken
as blackbodies: skin, clothes, walls and hot drinks have emissivities of 0.95 and more.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial.transform import Rotation

from dbthermal._arrays import Array
from dbthermal._compiled import kept
from reproduction.twins.rays import Caster, Hits

Rays = tuple[Array, Array]

_MARGIN: Final = 1e-3  # about a body's box, in units of its size: above single precision's rounding


@dataclass(frozen=True)
class Pose:
    """Position and orientation of a rigid body: its point p is at R p + t [m] in the world."""

    rotation: Rotation = field(default_factory=Rotation.identity)
    translation: npt.ArrayLike = (0.0, 0.0, 0.0)

    def __matmul__(self, inner: "Pose") -> "Pose":
        """Pose in the world of a body whose pose within this one is the inner pose."""
        return Pose(self.rotation * inner.rotation, self.outwards(inner.translation))

    def outwards(self, points: npt.ArrayLike) -> Array:
        """Points (..., 3) of the body's own frame, in the world."""
        return np.asarray(points @ self.rotation.as_matrix().T + np.asarray(self.translation))

    def inwards(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """Origins and directions (ray, 3) of the world, in the body's own frame."""
        matrix = self.rotation.as_matrix()
        return (origins - np.asarray(self.translation)) @ matrix, directions @ matrix


Motion = Callable[[float], Pose]  # pose at a time [s]
Warmth = Callable[[float], Array]  # temperature of each vertex (vertex,) [K] at a time [s]


def hinged(joint: npt.ArrayLike, rotation: Rotation) -> Pose:
    """Pose of a body rotated about a joint (3,) [m] of its own."""
    joint = np.asarray(joint, dtype=np.float64)
    return Pose(rotation, joint - rotation.apply(joint))


def gliding(times: npt.ArrayLike, places: npt.ArrayLike) -> Motion:
    """Motion in straight lines between places (stop, 3) [m] at times (stop,) [s], without turning.

    Before and after, the pose is that of the nearest stop.
    """
    times, places = np.asarray(times, dtype=np.float64), np.asarray(places, dtype=np.float64)
    return lambda now: Pose(translation=[np.interp(now, times, along) for along in places.T])


@dataclass(frozen=True)
class Actor:
    """A rigid body of the surroundings: a mesh in its own frame [m], and its temperature [K].

    One for each vertex (vertex,), finite, or a function of time [s]. Without a motion, its pose as
    a function of time, it stands still, its own frame being the world's.
    """

    mesh: trimesh.Trimesh
    temperature: Array | Warmth
    motion: Motion | None = None

    def warmth(self, time: float) -> Array:
        """Temperature of each vertex (vertex,) [K] at a time [s]."""
        return self.temperature(time) if callable(self.temperature) else self.temperature


def painted(meshes: Sequence[tuple[trimesh.Trimesh, float]], motion: Motion | None = None) -> Actor:
    """Rigid actor of several meshes, each of one temperature [K], side by side."""
    warmth = [np.full(len(mesh.vertices), temperature) for mesh, temperature in meshes]
    whole = trimesh.util.concatenate([mesh for mesh, _ in meshes])
    return Actor(cast("trimesh.Trimesh", whole), np.concatenate(warmth), motion)


@kept(nogil=True, error_model="numpy")
def _approaching(rays: Rays, sphere: tuple[Array, float], pose: Rays, box: Rays) -> tuple[Any, ...]:
    """Numbers of the rays that meet a sphere and a box; their origins and directions in its frame.

    Rays are origins and directions (ray, 3); of the sphere the middle and the radius; of the box
    its rotation and place in the world, and its lowest and highest corners in its own frame.
    """
    (origins, directions), (middle, radius) = rays, sphere
    (rotation, place), (low, high) = pose, box
    numbers, inwards = np.empty(len(origins), np.int64), np.empty((2, len(origins), 3))
    count = 0
    for ray in range(len(origins)):
        square = along = 0.0
        for k in range(3):
            away = middle[k] - origins[ray, k]
            square += away * away
            along += away * directions[ray, k]
        if square > radius**2 and (along < 0.0 or square - along**2 > radius**2):
            continue
        enter, leave = 0.0, np.inf
        for axis in range(3):
            origin = direction = 0.0
            for k in range(3):
                origin += (origins[ray, k] - place[k]) * rotation[k, axis]
                direction += directions[ray, k] * rotation[k, axis]
            inwards[0, count, axis], inwards[1, count, axis] = origin, direction
            near, far = (low[axis] - origin) / direction, (high[axis] - origin) / direction
            enter, leave = max(enter, min(near, far)), min(leave, max(near, far))
        if not enter > leave:  # NaN: along a face
            numbers[count] = ray
            count += 1
    return numbers[:count], inwards[0, :count], inwards[1, :count]


class _Target:
    """One actor, ready for rays of fixed origins and directions (ray, 3)."""

    def __init__(self, actor: Actor, origins: Array, directions: Array) -> None:
        self.actor, self.caster = actor, Caster(actor.mesh)
        self.rays = (origins, directions)
        low, high = actor.mesh.bounds
        self.middle = (low + high) / 2.0
        self.radius = float(np.max(np.linalg.norm(actor.mesh.vertices - self.middle, axis=1)))
        margin = _MARGIN * self.radius
        self.box = (low - margin, high + margin)

    def at(self, time: float) -> tuple[npt.NDArray[np.int64], Hits]:
        """Numbers of the rays that meet the actor at a time [s], and their intersections."""
        motion = self.actor.motion
        return self._unmoved if motion is None else self._cast(motion(time))

    @cached_property
    def _unmoved(self) -> tuple[npt.NDArray[np.int64], Hits]:
        """Intersections with an actor without motion: cast once for all frames."""
        return self._cast(Pose())

    def _cast(self, pose: Pose) -> tuple[npt.NDArray[np.int64], Hits]:
        sphere = (pose.outwards(self.middle), self.radius)
        frame = (pose.rotation.as_matrix(), np.asarray(pose.translation, dtype=np.float64))
        near, origins, directions = _approaching(self.rays, sphere, frame, self.box)
        hits = self.caster.cast(origins, directions)
        return near[hits.met], hits.select(hits.met)


def incident(
    origins: Array, directions: Array, time: Array, room: float, actors: Sequence[Actor]
) -> Array:
    """Blackbody temperature (time, ray) [K] that rays meet, frame by frame.

    Of rays (ray, 3), the same in all frames, by their origins [m] and unit vectors, at times
    (time,) [s], before the walls of a room [K] and actors, of which the nearest hides the others.
    """
    targets = [_Target(actor, origins, directions) for actor in actors]
    result = np.full((time.size, len(directions)), room)
    for frame, now in zip(result, time, strict=True):
        nearest = np.full(frame.shape, np.inf)
        for target in targets:
            rays, hits = target.at(float(now))
            first = hits.distance < nearest[rays]
            selected, warmth = rays[first], target.actor.warmth(float(now))
            nearest[selected] = hits.distance[first]
            frame[selected] = target.caster.interpolate(hits.select(first), warmth)
    return result
