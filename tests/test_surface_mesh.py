"""Meshes of level sets: closed, outward, even, without folds; their operators; their files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import pyvista
from field_shapes import flipped
from surface_shapes import crossing_triangles, ellipsoid, smooth_level, two_lobes, voxel_centres

from pipeline.errors import InputError, StageError
from pipeline.evaluation.metrics import closedness
from pipeline.geometry import Surface
from pipeline.meshes import read_mesh, write_vtp
from pipeline.surface.level_set import LevelSet
from pipeline.surface.mesh import (
    adjacency,
    bad_triangles,
    extract_surface,
    laplacian,
    largest_component,
    untangled,
    vertex_areas,
    vertex_normals,
)

SHAPES = {
    "ball": ellipsoid((18, 18, 18)),
    "ellipsoid": ellipsoid((16, 20, 30)),
    "thin": ellipsoid((7, 22, 26)),
    "lobes": two_lobes,
    "bowl": lambda p: np.maximum(ellipsoid((22, 22, 32))(p), p[..., 2] / 10 - 1),
}

TETRAHEDRON = Surface(
    np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)


def level_of(name: str) -> LevelSet:
    return smooth_level(SHAPES[name], (40, 40, 46))


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("edge_mm", [2.0, 3.0])
def test_surface_is_a_solid_of_even_triangles(name, edge_mm):
    """Euler's number 2 makes it a sphere; a quality of 0.3 is a right triangle of sides 1 : 5."""
    level = level_of(name)
    surface = extract_surface(level, edge_mm)

    assert closedness(surface).is_solid
    assert len(surface.vertices_mm) - len(surface.triangles) / 2 == 2
    assert crossing_triangles(surface) == 0
    corners = surface.vertices_mm[surface.triangles]
    edges_of = corners - np.roll(corners, 1, axis=1)
    edges = np.linalg.norm(edges_of, axis=2)
    # Density of marching cubes varies with direction between 1 and sqrt(3), the edge by its root.
    assert edges.mean() == pytest.approx(edge_mm, rel=0.15)
    area = np.linalg.norm(np.cross(edges_of[:, 0], edges_of[:, 1]), axis=1) / 2
    assert (4 * np.sqrt(3) * area / np.square(edges).sum(axis=1)).min() > 0.3
    assert np.abs(level.sample(surface.vertices_mm)[0]).max() < 0.05


def test_only_the_largest_piece_is_kept():
    points, _ = voxel_centres((30, 30, 40))
    apart = np.minimum(
        np.linalg.norm(points - (0, 0, 15), axis=-1) - 14,
        np.linalg.norm(points - (0, 0, -25), axis=-1) - 8,
    )
    surface = extract_surface(LevelSet(apart.astype(np.float32), 1.5), 2.0)
    assert closedness(surface).components == 1
    assert surface.volume_mm3() == pytest.approx(4 / 3 * np.pi * 14**3, rel=0.02)


def test_a_level_set_without_zero_names_the_trouble():
    with pytest.raises(StageError, match="too small for a surface"):
        extract_surface(LevelSet(np.ones((9, 9, 9), np.float32), 1.5), 2.0)


def test_a_body_that_leaves_the_grid_is_refused():
    """A plane through the grid cannot be closed."""
    z = np.indices((12, 12, 12))[0] - 5.3
    with pytest.raises(StageError, match="open edges"):
        extract_surface(LevelSet(z.astype(np.float32), 1.5), 2.0)


def test_volume_is_signed_and_the_same_wherever_a_body_lies():
    assert TETRAHEDRON.volume_mm3() == pytest.approx(1 / 6)
    assert flipped(TETRAHEDRON).volume_mm3() == pytest.approx(-1 / 6)
    # Places at a kilometre are told to 1e-10 mm, so volumes of a millimetre to some 1e-9 of it.
    away = Surface(TETRAHEDRON.vertices_mm + np.array([1e6, -1e6, 1e6]), TETRAHEDRON.triangles)
    assert away.volume_mm3() == pytest.approx(1 / 6, rel=1e-8)


def test_largest_component_renumbers():
    both = Surface(
        np.concatenate([TETRAHEDRON.vertices_mm[:3] + 9, TETRAHEDRON.vertices_mm]),
        np.concatenate([[[0, 1, 2]], TETRAHEDRON.triangles + 3]),
    )
    found = largest_component(both)
    np.testing.assert_array_equal(found.vertices_mm, TETRAHEDRON.vertices_mm)
    np.testing.assert_array_equal(found.triangles, TETRAHEDRON.triangles)


def test_adjacency_and_laplacian_of_a_tetrahedron():
    """All four are neighbours: ones off the diagonal; the Laplacian kills constants."""
    np.testing.assert_array_equal(
        adjacency(TETRAHEDRON.triangles, 4).toarray(), np.ones((4, 4)) - np.eye(4)
    )
    stiffness = laplacian(TETRAHEDRON.triangles, 4).toarray()
    np.testing.assert_allclose(stiffness @ np.ones(4), 0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.eigvalsh(stiffness), [0, 4 / 6, 4 / 6, 4 / 6], atol=1e-15)


def test_areas_and_normals_of_a_tetrahedron():
    """Three right triangles of area 1/2 and one of sqrt(3)/2; the corner looks along -(1, 1, 1)."""
    areas = vertex_areas(TETRAHEDRON.vertices_mm, TETRAHEDRON.triangles)
    assert areas.sum() == pytest.approx(1.5 + np.sqrt(3) / 2)
    assert areas[0] == pytest.approx(0.5)
    normals = vertex_normals(TETRAHEDRON.vertices_mm, TETRAHEDRON.triangles)
    np.testing.assert_allclose(normals[0], -np.ones(3) / np.sqrt(3))


def test_untangling_mends_a_fold_and_touches_nothing_else():
    level = level_of("ball")
    surface = extract_surface(level, 2.0)
    spoiled = surface.vertices_mm.copy()
    near = adjacency(surface.triangles, len(spoiled))[[100]].indices
    # Beyond its ring of neighbours a vertex folds its own triangles over.
    spoiled[100] += 2.0 * (spoiled[near[0]] - spoiled[100])
    assert bad_triangles(spoiled, surface.triangles).any()

    mended = untangled(spoiled, surface.triangles, level)

    assert not bad_triangles(mended, surface.triangles).any()
    assert crossing_triangles(Surface(mended, surface.triangles)) == 0
    moved = np.linalg.norm(mended - spoiled, axis=1) > 0
    assert np.count_nonzero(moved) < 100
    # The step back onto the level is Newton's: what is left is of second order.
    assert np.abs(level.sample(mended)[0]).max() < 0.1


def test_a_sound_mesh_is_not_touched_by_untangling():
    level = level_of("lobes")
    surface = extract_surface(level, 2.0)
    np.testing.assert_array_equal(
        untangled(surface.vertices_mm, surface.triangles, level), surface.vertices_mm
    )


@pytest.mark.parametrize("ending", [".ply", ".stl", ".vtp"])
@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("space", ["LPS", "RAS"])
def test_a_mesh_is_read_in_the_frame_that_its_file_names(
    tmp_path: Path, ending: str, binary: bool, space: str
) -> None:
    """As 3D Slicer notes it: in a comment, in the head, or in a field."""
    path = tmp_path / f"ball{ending}"
    ball = pyvista.Sphere(radius=5.0, center=(30, -50, 10))
    if ending == ".vtp":
        ball.field_data["SPACE"] = [space]
    ball.save(path, binary=binary)
    note = f"3D Slicer output. SPACE={space}".encode()
    content = path.read_bytes()
    if ending == ".ply":
        content = content.replace(b"comment VTK generated PLY File", b"comment " + note)
    elif ending == ".stl" and binary:
        content = note.ljust(80, b"\0") + content[80:]
    elif ending == ".stl":
        content = b"solid " + note + content[content.index(b"\n") :]
    path.write_bytes(content)
    assert (note in content) is (ending != ".vtp")
    middle = read_mesh(path).vertices_mm.mean(axis=0)
    np.testing.assert_allclose(middle, (30, -50, 10) if space == "LPS" else (-30, 50, 10), atol=0.1)


def test_a_written_mesh_says_in_which_frame_it_is(tmp_path: Path) -> None:
    ball = pyvista.Sphere(radius=5.0, center=(30, -50, 10))
    surface = Surface(np.asarray(ball.points, float), np.asarray(ball.regular_faces, np.int64))
    write_vtp(tmp_path / "ball.vtp", surface)
    assert pyvista.read(tmp_path / "ball.vtp").field_data["SPACE"][0] == "LPS"
    np.testing.assert_array_equal(read_mesh(tmp_path / "ball.vtp").vertices_mm, surface.vertices_mm)


@pytest.mark.parametrize(("ending", "binary"), [
    (".ply", True), (".ply", False), (".stl", True), (".stl", False), (".vtp", True),
])  # fmt: skip
@pytest.mark.parametrize("left", [0.01, 0.5, 0.99])
def test_a_mesh_file_that_is_cut_off_is_refused(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], ending: str, binary: bool, left: float
) -> None:
    """VTK's readers end the whole process on some, and say a page about others."""
    whole, cut = tmp_path / f"whole{ending}", tmp_path / f"cut{ending}"
    pyvista.Sphere().save(whole, binary=binary)
    assert len(read_mesh(whole).triangles) == pyvista.Sphere().n_cells
    content = whole.read_bytes()
    cut.write_bytes(content[: round(left * len(content))])
    capfd.readouterr()
    with pytest.raises(InputError, match=r"cut\.\w+: is (cut off|no whole)"):
        read_mesh(cut)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("ending", [".vtp", ".ply"])
def test_what_is_no_surface_is_left_out(tmp_path: Path, ending: str) -> None:
    """Points that no triangle names, and triangles that are lines: both would bend a field."""
    ball = pyvista.Sphere(radius=5.0)
    faces = np.asarray(ball.regular_faces)
    points = np.vstack([[0.0, 0, 0], ball.points, [90.0, 0, 0]])
    lines = [[1, 1, 200], [7, 300, 7]]
    mesh = pyvista.PolyData.from_regular_faces(points, np.vstack([faces + 1, lines]))
    mesh.save(tmp_path / f"ball{ending}")

    found = read_mesh(tmp_path / f"ball{ending}")

    np.testing.assert_allclose(found.vertices_mm, ball.points, atol=1e-6)
    np.testing.assert_array_equal(found.triangles, faces)


def test_triangles_of_vertices_that_are_not_there_are_refused(tmp_path: Path) -> None:
    pyvista.Sphere().save(tmp_path / "ball.ply", binary=False)
    text = (tmp_path / "ball.ply").read_text().rstrip()
    (tmp_path / "ball.ply").write_text(f"{text.rpartition(chr(10))[0]}\n3 0 1 842\n")
    with pytest.raises(InputError, match=r"has the corners .0, 1, 842., of 842 vertices"):
        read_mesh(tmp_path / "ball.ply")
