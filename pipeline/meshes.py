"""Surface files in and out: VTP, STL, PLY. VTK is loaded on the first call only."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Surface

MESH_ENDINGS = (".vtp", ".stl", ".ply")


def write_vtp(path: Path, surface: Surface) -> None:
    """Write a VTP file; the same bytes every time, and a full disk is noticed."""
    import pyvista
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(pyvista.PolyData.from_regular_faces(surface.vertices_mm, surface.triangles))
    writer.SetDataModeToBinary()
    # VTK does not report a failed write, Python does: so VTK only makes the text.
    writer.WriteToOutputStringOn()
    writer.Write()
    path.write_text(writer.GetOutputString())


def read_mesh(path: Path) -> Surface:
    """Read a triangle mesh; vertices that STL repeats for every triangle become one.

    Raises
    ------
    InputError
        When the file cannot be read or holds no triangles.
    """
    import pyvista

    try:
        mesh = pyvista.read(path)
    except Exception as error:  # VTK's readers raise whatever the format's parser raises
        raise InputError(f"{path}: cannot be read as a surface ({error})") from error
    if not isinstance(mesh, pyvista.PolyData) or not mesh.n_cells:
        raise InputError(f"{path}: holds no triangles; a closed surface is needed")
    if not mesh.is_all_triangles:
        mesh = mesh.triangulate()
    if path.suffix.lower() == ".stl":
        mesh = mesh.clean()
    return Surface(
        np.asarray(mesh.points, dtype=np.float64),
        np.asarray(mesh.regular_faces, dtype=np.int64),
    )
