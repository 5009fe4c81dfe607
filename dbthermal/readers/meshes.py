"""Triangle meshes in the Wavefront format."""

from pathlib import Path

import numpy as np
import trimesh
import xarray as xr


def mesh(path: str | Path) -> xr.Dataset:
    """
    Read a triangle mesh.

    Parameters
    ----------
    path : str or Path
        File ``*.obj``; faces with more than three corners are cut into triangles.

    Returns
    -------
    Dataset
        `vertices` (vertex, axis), in the file's own unit, and `faces` (face, corner), indices of
        vertices; both as they are in the file, none merged or dropped.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file holds no triangle, or a coordinate that is not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"No mesh '{path}'. Must be a file.")
    loaded = trimesh.load_mesh(path, file_type="obj", process=False, maintain_order=True)
    vertices = np.asarray(loaded.vertices, dtype=np.float64)
    faces = np.asarray(loaded.faces, dtype=np.int64)
    if faces.size == 0 or not np.all(np.isfinite(vertices)):
        raise ValueError(
            f"Invalid mesh '{path.name}' of {len(vertices)} vertices and {len(faces)} faces. "
            "Must hold triangles of finite coordinates."
        )
    return xr.Dataset(
        {"vertices": (("vertex", "axis"), vertices), "faces": (("face", "corner"), faces)},
        coords={"axis": ["x", "y", "z"]},
        attrs={"source": path.name},
    )
