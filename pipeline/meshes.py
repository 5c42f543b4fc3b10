"""Surface files in and out: VTP, STL, PLY. VTK is loaded on the first call only."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float, Integer, Surface
from pipeline.ply import require_sound_ply
from pipeline.regular_files import require_text_name

MESH_ENDINGS = (".vtp", ".stl", ".ply")

# Room for the notes that begin a file.
_STL_NOTES_BYTES, _NOTES_BYTES = 80, 4096
_VTP_NUMBER = re.compile(rb'NumberOf(\w+)\s*=\s*"([^"]*)"')
_MOST_COMPONENTS = 64
# Bytes that one packed byte may become, at most.
_PACKED = 1032


def write_vtp(path: Path, surface: Surface) -> None:
    """Write a VTP file; the same bytes every time, and a full disk is noticed."""
    import pyvista
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    mesh = pyvista.PolyData.from_regular_faces(surface.vertices_mm, surface.triangles)
    mesh.field_data["SPACE"] = ["LPS"]
    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(mesh)
    writer.SetDataModeToBinary()
    # The quickest level: two fifths of the usual one's time, for files one per cent longer.
    writer.SetCompressionLevel(1)
    # VTK does not report a failed write, Python does: so VTK only makes the text.
    writer.WriteToOutputStringOn()
    writer.Write()
    path.write_text(writer.GetOutputString())


def read_mesh(path: Path) -> Surface:
    """Read a triangle mesh in LPS; vertices that STL repeats for every triangle become one.

    A file that says it is in RAS, as 3D Slicer notes in what it saves, is turned. Triangles that
    name a vertex twice and vertices that no triangle names are left out: they are no surface.

    Raises
    ------
    InputError
        When the file cannot be read or holds no triangles.
    """
    import pyvista

    require_text_name(path)
    require_whole(path)
    try:
        mesh = pyvista.read(path)
        if isinstance(mesh, pyvista.PolyData) and mesh.n_cells:
            mesh = mesh if mesh.is_all_triangles else mesh.triangulate()
            mesh = mesh.clean() if path.suffix.lower() == ".stl" else mesh
            vertices_mm = np.asarray(mesh.points, dtype=np.float64)
            triangles = np.asarray(mesh.regular_faces, dtype=np.int64)
    except Exception as error:  # VTK's readers raise whatever the format's parser raises
        raise InputError(f"{path}: cannot be read as a surface ({error})") from error
    if not isinstance(mesh, pyvista.PolyData) or not mesh.n_cells or not len(triangles):
        raise InputError(f"{path}: holds no triangles; a closed surface is needed")
    if triangles.min() < 0 or triangles.max() >= len(vertices_mm):
        raise InputError(
            f"{path}: triangles name vertices {triangles.min()} to {triangles.max()}, there are "
            f"{len(vertices_mm)}; export the surface again"
        )
    vertices_mm, triangles = _what_bounds(vertices_mm, triangles)
    if not len(triangles):
        raise InputError(f"{path}: all its triangles are lines or points; export the surface again")
    return Surface(_in_lps(vertices_mm, path, mesh), triangles)


def _what_bounds(vertices: Float, triangles: Integer) -> tuple[Float, Integer]:
    """Triangles with three corners, and their vertices. It goes by numbers alone, so that vertices
    that correspond through the phases still do."""
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    used = np.zeros(len(vertices), dtype=bool)
    used[triangles] = True
    numbers = np.cumsum(used) - 1
    return vertices[used], numbers[triangles]


def _in_lps(vertices_mm: Float, path: Path, mesh: Any) -> Float:
    """3D Slicer writes ``SPACE=RAS`` into comments of PLY, the head of STL, a field of VTP."""
    room = _STL_NOTES_BYTES if path.suffix.lower() == ".stl" else _NOTES_BYTES
    with path.open("rb") as file:
        noted = b"SPACE=RAS" in file.read(room).partition(b"end_header")[0]
    if path.suffix.lower() == ".vtp":
        noted = "SPACE" in mesh.field_data and "RAS" in str(mesh.field_data["SPACE"])
    return vertices_mm * (-1.0, -1.0, 1.0) if noted else vertices_mm


def require_whole(path: Path) -> None:
    """Refuse what VTK's readers would crash on, or say pages about: a file that ends too soon, or
    promises more than it can hold.

    Raises
    ------
    InputError
        When it does, a PLY file has no header, or its faces name vertices that are none.
    """
    checks = {".ply": require_sound_ply, ".stl": _require_whole_stl, ".vtp": _require_whole_vtp}
    check = checks.get(path.suffix.lower())
    if check is None:
        return
    try:
        check(path, path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error})") from error


def _require_whole_vtp(path: Path, content: bytes) -> None:
    if not content.rstrip().endswith(b"</VTKFile>"):
        raise InputError(f"{path}: is no whole VTP file: no </VTKFile> at its end; copy it again")
    # What is told is made room for before it is read.
    for name, told in _VTP_NUMBER.findall(content):
        most = _MOST_COMPONENTS if name == b"Components" else _PACKED * len(content)
        if not told.isdigit() or len(told) > 12 or int(told) > most:
            raise InputError(
                f"{path}: NumberOf{name.decode()} is {told.decode('ascii', 'replace')[:20]}, more "
                "than such a file can hold; export the surface again"
            )


def _require_whole_stl(path: Path, content: bytes) -> None:
    """A binary file says how many triangles follow its head of 84 bytes, 50 bytes each; one in
    text, which begins with ``solid`` as some binary ones do, ends with a line ``endsolid``."""
    promised = 84 + 50 * int.from_bytes(content[80:84], "little")
    if content.lstrip()[:5].lower() == b"solid" and len(content) != promised:
        if b"endsolid" not in content[-1000:].lower():
            raise InputError(f"{path}: is no whole STL file: no line endsolid; copy it again")
    elif len(content) < max(promised, 84):
        raise InputError(
            f"{path}: is no whole STL file: it has {len(content)} bytes, its head promises "
            f"{max(promised, 84)}; copy it again"
        )
