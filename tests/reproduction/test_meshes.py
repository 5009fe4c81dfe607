"""The reader of meshes: what the file has, no more and no less, or an error that names its line."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from reproduction.twins import meshes

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nv 5 5 5\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def test_mesh(tmp_path: Path) -> None:
    """Vertices and faces as they are in the file, an unused vertex among them."""
    (tmp_path / "a.obj").write_text(TETRAHEDRON)
    found = meshes.mesh(tmp_path / "a.obj")
    assert_array_equal(found["vertices"][:, 0], [0, 1, 0, 0, 5])
    assert_array_equal(found["faces"], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


@pytest.mark.parametrize(
    "text",
    [
        TETRAHEDRON.replace("f 1 2 4", "usemtl a\nf 1 2 4\nusemtl b"),
        "vn 1 0 0\nvt 0 0\n" + TETRAHEDRON.replace("f 1 3 2", "f 1/1/1 3/1/1 2//1"),
        TETRAHEDRON.replace("f 1 3 2", "f -5 -3 -4"),
    ],
)
def test_mesh_is_not_torn(tmp_path: Path, text: str) -> None:
    """Materials, normals and textures change no vertex and no face, nor do negative indices."""
    (tmp_path / "a.obj").write_text(text)
    (tmp_path / "b.obj").write_text(TETRAHEDRON)
    found, expected = (meshes.mesh(tmp_path / name) for name in ("a.obj", "b.obj"))
    assert found.drop_attrs().identical(expected.drop_attrs())


def test_polygon_is_fanned(tmp_path: Path) -> None:
    """A face of four corners is two triangles; a negative index counts back from where it is."""
    square = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf -4 -3 -2 -1\nv 9 9 9\n"
    (tmp_path / "a.obj").write_text(square)
    assert_array_equal(meshes.mesh(tmp_path / "a.obj")["faces"], [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "of 3 vertices and no face. Must hold triangles"),
        (TETRAHEDRON.replace("5", "nan"), "line 5 .* vertex nan nan nan. Must be three finite"),
        (TETRAHEDRON.replace("5 5 5", "5 5"), "line 5 .* vertex 5 5. Must be three finite"),
        (TETRAHEDRON.replace("5 5 5", "5 5 x"), "line 5 .* coordinate 'x'. Must be a number"),
        (TETRAHEDRON.replace("1 3 2", "1 2 9"), r"line 6 .* vertex 9. Must lie in \[1, 5\]"),
        (TETRAHEDRON.replace("1 3 2", "0 1 2"), "line 6 .* vertex 0. Must be from 1, or"),
        (TETRAHEDRON.replace("1 3 2", "1 2 -6"), "line 6 .* vertex -6. Must be .* -1 to -5"),
        (TETRAHEDRON.replace("1 3 2", "1 2"), "line 6 .* face 1 2. Must have three corners"),
        (TETRAHEDRON.replace("1 3 2", "1 2 /3"), "line 6 .* corner '/3'. Must be a whole number"),
    ],
)
def test_no_mesh(tmp_path: Path, text: str, message: str) -> None:
    """A file that holds no mesh is refused, with the line, the value and the rule."""
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        meshes.mesh(tmp_path / "a.obj")
    assert "of mesh 'a.obj'" in str(caught.value) or "Invalid mesh 'a.obj'" in str(caught.value)


@pytest.mark.data
def test_bunny(mirror: Path) -> None:
    """The Stanford bunny has the vertices and faces that its source gives, in metres."""
    bunny = meshes.mesh(mirror / "meshes" / "stanford-bunny.obj")
    assert (bunny.sizes["vertex"], bunny.sizes["face"]) == (35947, 69451)
    assert 35947 - np.unique(bunny["faces"]).size == 1113  # unused
    assert float(np.ptp(bunny["vertices"].values, axis=0).max()) == pytest.approx(
        0.156, abs=1e-3
    )  # m
