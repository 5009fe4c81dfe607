"""Triangle meshes in the Wavefront format."""

import itertools
import math
from pathlib import Path

import numpy as np
import xarray as xr


def mesh(path: str | Path) -> xr.Dataset:
    """
    Read a triangle mesh.

    Of the format, the lines ``v`` and ``f`` are read; normals, textures, materials and groups tear
    no mesh apart. A corner is ``a``, ``a/b``, ``a/b/c`` or ``a//c``, of which a is the vertex: from
    1 in the file's order, or, if negative, back from the latest before the face.

    Parameters
    ----------
    path : str or Path
        File ``*.obj``; faces with more than three corners are cut into triangles, fanned about the
        first corner.

    Returns
    -------
    Dataset
        `vertices` (vertex, axis), in the file's own unit, and `faces` (face, corner), indices of
        vertices from 0; both as they are in the file, none merged or dropped.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file holds no triangle, a vertex that is not three finite coordinates, or a face with
        fewer than three corners, with a vertex that the file has not, or with one that is no
        number; the error names the line.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"No mesh '{path}'. Must be a file.")
    vertices: list[list[float]] = []
    corners: list[list[int]] = []
    sources: list[int] = []
    with path.open(encoding="latin-1") as lines:  # what is read is ASCII; a comment may be anything
        for number, line in enumerate(lines, start=1):
            kind, *fields = line.split() or [""]
            try:
                if kind == "v":
                    vertices.append(_vertex(fields))
                elif kind == "f":
                    corners += _fan(_face(fields, len(vertices)))
                    sources += [number] * (len(fields) - 2)
            except ValueError as error:
                raise ValueError(f"Invalid line {number} of mesh '{path.name}': {error}") from None
    if not corners:
        raise ValueError(
            f"Invalid mesh '{path.name}' of {len(vertices)} vertices and no face. "
            "Must hold triangles."
        )
    faces = np.array(corners)
    beyond = np.flatnonzero((faces >= len(vertices)).any(axis=1))
    if beyond.size:
        raise ValueError(
            f"Invalid line {sources[beyond[0]]} of mesh '{path.name}': vertex "
            f"{faces[beyond[0]].max() + 1}. Must lie in [1, {len(vertices)}]."
        )
    points = np.array(vertices)
    return xr.Dataset(
        {"vertices": (("vertex", "axis"), points), "faces": (("face", "corner"), faces)},
        coords={"axis": ["x", "y", "z"]},
        attrs={"source": path.name},
    )


def _vertex(fields: list[str]) -> list[float]:
    """Coordinates of a vertex; a weight or a colour after them is left out."""
    place = [_number(field) for field in fields[:3]]
    if len(place) < 3 or not all(map(math.isfinite, place)):
        raise ValueError(f"vertex {' '.join(fields)}. Must be three finite coordinates.")
    return place


def _number(field: str) -> float:
    """One coordinate."""
    try:
        return float(field)
    except ValueError:
        raise ValueError(f"coordinate '{field}'. Must be a number.") from None


def _face(fields: list[str], count: int) -> list[int]:
    """Vertices of a face, from 0, after so many vertices."""
    if len(fields) < 3:
        raise ValueError(f"face {' '.join(fields)}. Must have three corners or more.")
    return [_corner(field, count) for field in fields]


def _corner(field: str, count: int) -> int:
    """Vertex of a corner, from 0, after so many vertices."""
    try:
        number = int(field.split("/", 1)[0])
    except ValueError:
        raise ValueError(f"corner '{field}'. Must be a whole number, or such with '/'.") from None
    if number == 0 or number < -count:
        raise ValueError(
            f"vertex {number}. Must be from 1, or from -1 to -{count}, back from the latest."
        )
    return number - 1 if number > 0 else count + number


def _fan(face: list[int]) -> list[list[int]]:
    """Triangles of a polygon about its first corner."""
    return [[face[0], *pair] for pair in itertools.pairwise(face[1:])]
