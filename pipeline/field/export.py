"""Write a field's distances and potentials in formats that other programs read.

The coefficients under ``spline/`` stay behind: they are no values, only a reader of this project
or of docs/field.md knows what to do with them.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from pipeline.errors import InputError
from pipeline.field.files import chunk_path, map_phase, read_metadata, require_manifest
from pipeline.field.metadata import FieldMetadata
from pipeline.geometry import Float, Float32
from pipeline.publish import publishing


def export_field(path: Path, form: str, out: Path) -> Path:
    """Write a field anew in another format, into a folder that does not exist yet.

    Parameters
    ----------
    path
        The ``field.zarr`` folder.
    form
        ``nrrd``, ``nifti``, ``vti``, ``mhd`` or ``sofa``; docs/field.md says what each is.
    out
        Folder to write.

    Returns
    -------
    ``out``.

    Raises
    ------
    InputError
        When the format is unknown, the folder exists, lies in the field or cannot be written, the
        field cannot be read, or ``mhd`` cannot name its files: their path holds a % or the end of
        a line. Nothing is left behind then.
    """
    if form not in WRITERS:
        raise InputError(f"--to {form}: no such format; there are {', '.join(WRITERS)}")
    if out.exists() or out.is_symlink():
        raise InputError(f"--out {out}: exists already; remove it or choose another place")
    if out.resolve().is_relative_to(path.resolve()):
        raise InputError(
            f"--out {out}: lies inside the field, which it would spoil; choose another"
        )
    require_manifest(path)
    field = _Stored(path.resolve(), read_metadata(path))
    for part in field.arrays:
        for index in range(len(field.times)):
            field.at(part, index)
    with publishing(out) as folder:
        WRITERS[form](field, folder)
    return out


def lost_in(path: Path, form: str) -> str:
    """What a format cannot say of a field, in words; empty where it says all."""
    field = _Stored(path, read_metadata(path))
    even = field.times[0] + field.beat * np.arange(len(field.times)) / len(field.times)
    off = float(np.abs(even - field.times).max())
    if form not in EVENLY or off < EVEN_ENOUGH * field.beat:
        return ""
    unit = "s" if field.about.rr_s else "of a beat"
    return (
        f"phases are not evenly spaced, and 4D files of {form} count them as if they were: times "
        f"are up to {off:.3f} {unit} off; those of nrrd and vti are not"
    )


class _Stored:
    """The values of a store, a phase at a time."""

    def __init__(self, path: Path, about: FieldMetadata) -> None:
        self.path, self.about = path, about
        self.grid = about.grid.nodes()
        # Seconds where the heartbeat's length is known, else shares of it.
        self.beat = about.rr_s or 1.0
        self.times = [self.beat * phase for phase in about.phases]
        self.arrays = [one for one in about.arrays if not one.startswith("spline/")]

    def at(self, part: str, index: int) -> Float32:
        """Values of one phase, ``(z, y, x)``, mapped."""
        return map_phase(self.path / part, index, self.grid)

    @property
    def nodes(self) -> tuple[int, int, int]:
        """Number of nodes along x, y, z."""
        nz, ny, nx = self.grid.shape
        return nx, ny, nz


def _name(part: str) -> str:
    return part.replace("/", "_")


def _numbers(values: tuple[float, ...] | list[float] | Float) -> str:
    return " ".join(repr(float(value)) for value in values)


def _write(path: Path, header: bytes, field: _Stored, part: str) -> None:
    """A header, then all phases as they are stored: x fastest, the phase slowest."""
    with path.open("wb") as file:
        file.write(header)
        for index in range(len(field.times)):
            file.write(field.at(part, index).data)


def _nrrd(field: _Stored, folder: Path) -> None:
    """One ``.seq.nrrd`` an array, as 3D Slicer's Sequences module reads and writes it."""
    for part in field.arrays:
        _write(folder / f"{_name(part)}.seq.nrrd", _nrrd_header(field), field, part)


def _nrrd_header(field: _Stored) -> bytes:
    (x, y, z), (sx, sy, sz) = field.grid.origin_mm, field.grid.spacing_mm
    known = field.about.rr_s is not None
    lines = [
        "NRRD0005",
        "type: float",
        "dimension: 4",
        "space: left-posterior-superior",
        f"sizes: {' '.join(map(str, field.nodes))} {len(field.times)}",
        f"space directions: ({sx!r},0,0) (0,{sy!r},0) (0,0,{sz!r}) none",
        "kinds: domain domain domain list",
        f'labels: "" "" "" "{"time" if known else "phase"}"',
        f'units: "" "" "" "{"s" if known else ""}"',
        'space units: "mm" "mm" "mm"',
        "endian: little",
        "encoding: raw",
        f"space origin: ({x!r},{y!r},{z!r})",
        "DataNodeClassName:=vtkMRMLScalarVolumeNode",
        "axis 3 index type:=numeric",
        f"axis 3 index values:={_numbers(field.times)}",
    ]
    return ("\n".join(lines) + "\n\n").encode("ascii")


def _nifti(field: _Stored, folder: Path) -> None:
    """One 4D ``.nii`` an array, in NIfTI's RAS frame, values unscaled."""
    import nibabel

    lps_from_index = np.diag([*field.grid.spacing_mm, 1.0])
    lps_from_index[:3, 3] = field.grid.origin_mm
    header = nibabel.Nifti1Header()
    header.set_data_dtype(np.dtype("<f4"))
    header.set_data_shape((*field.nodes, len(field.times)))
    ras_from_index = np.diag([-1.0, -1.0, 1.0, 1.0]) @ lps_from_index
    header.set_sform(ras_from_index, code="scanner")
    header.set_qform(ras_from_index, code="scanner")
    header.set_xyzt_units("mm", "sec" if field.about.rr_s is not None else "unknown")
    header["pixdim"][4] = field.beat / len(field.times)
    header["toffset"] = field.times[0]
    header["scl_slope"], header["scl_inter"] = 1, 0
    header["vox_offset"] = 352
    for part in field.arrays:
        # Four zeros: no extensions follow.
        _write(folder / f"{_name(part)}.nii", header.binaryblock + bytes(4), field, part)


def _vti(field: _Stored, folder: Path) -> None:
    """One ``.vti`` a phase with all arrays, and a ``.pvd`` that names them with their times."""
    import pyvista
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    rows = []
    for index, time in enumerate(field.times):
        image = pyvista.ImageData(
            dimensions=field.nodes, spacing=field.grid.spacing_mm, origin=field.grid.origin_mm
        )
        for part in field.arrays:
            image.point_data[_name(part)] = field.at(part, index).ravel()
        name = f"phase_{index:03d}.vti"
        writer = vtkXMLImageDataWriter()
        writer.SetInputData(image)
        writer.SetDataModeToBinary()
        # VTK does not report a failed write, Python does: so VTK only makes the text.
        writer.WriteToOutputStringOn()
        writer.Write()
        (folder / name).write_text(writer.GetOutputString())
        rows.append(f'    <DataSet timestep="{time!r}" file="{name}"/>')
    lines = ['<VTKFile type="Collection" version="0.1">', "  <Collection>", *rows]
    (folder / "field.pvd").write_text("\n".join([*lines, "  </Collection>", "</VTKFile>", ""]))


def _mhd(field: _Stored, folder: Path) -> None:
    """MetaImage headers that point into the store: one an array for 4D, one a phase for 3D."""
    for part in field.arrays:
        chunks = [
            Path(os.path.relpath(chunk_path(field.path / part, index), folder.resolve())).as_posix()
            for index in range(len(field.times))
        ]
        if "%" in chunks[0]:
            raise InputError(
                f"{chunks[0]}: MetaImage headers take a % in the path to a file for a number; "
                "rename the folder"
            )
        if "\n" in chunks[0] or "\r" in chunks[0]:
            raise InputError(
                f"{chunks[0]!r}: a line of a MetaImage header ends where the path to a file does; "
                "rename the folder"
            )
        for index, chunk in enumerate(chunks):
            _write_mhd(folder / f"{_name(part)}_{index:03d}.mhd", field, chunk)
        time = field.times[0], field.beat / len(chunks), len(chunks)
        _write_mhd(folder / f"{_name(part)}.mhd", field, "\n".join(["LIST 3", *chunks]), time)


def _write_mhd(
    path: Path, field: _Stored, files: str, time: tuple[float, float, int] | None = None
) -> None:
    """A header; ``time`` are the first moment, the step and the number of phases of a 4D one."""
    start, step, count = ([one] for one in time) if time else ([], [], [])
    axes = 3 + len(count)
    lines = [
        "ObjectType = Image",
        f"NDims = {axes}",
        "BinaryData = True",
        "BinaryDataByteOrderMSB = False",
        "CompressedData = False",
        f"TransformMatrix = {_numbers(np.eye(axes).ravel())}",
        f"Offset = {_numbers([*field.grid.origin_mm, *start])}",
        f"ElementSpacing = {_numbers([*field.grid.spacing_mm, *step])}",
        f"DimSize = {' '.join(map(str, (*field.nodes, *count)))}",
        "ElementType = MET_FLOAT",
        f"ElementDataFile = {files}",
    ]
    text = "\n".join(lines) + "\n"
    path.write_text(text, encoding="utf-8", errors="surrogateescape")


def _sofa(field: _Stored, folder: Path) -> None:
    """Distances as SOFA's DistanceGrid loads a ``.raw``: float64, x fastest, no header.

    SOFA takes the number of nodes and the box from the scene; ``grids.xml`` has them.
    """
    low, high = _numbers(field.grid.origin_mm), _numbers(field.grid.upper_mm)
    nx, ny, nz = field.nodes
    rows = []
    for part in field.arrays:
        if not part.startswith("distance/"):
            continue
        for index in range(len(field.times)):
            name = f"{_name(part)}_{index:03d}.raw"
            # What `tofile` raises on a full disk says nothing of why.
            (folder / name).write_bytes(field.at(part, index).astype("<f8").tobytes())
            rows.append(
                f"  <DistanceGridForceField filename={quoteattr(name)} "
                f'nx="{nx}" ny="{ny}" nz="{nz}" box="{low} {high}"/>'
            )
    (folder / "grids.xml").write_text("\n".join(["<Node>", *rows, "</Node>", ""]))


WRITERS: dict[str, Callable[[_Stored, Path], None]] = {
    "nrrd": _nrrd,
    "nifti": _nifti,
    "vti": _vti,
    "mhd": _mhd,
    "sofa": _sofa,
}

EVENLY = ("nifti", "mhd")
"""Formats whose time axis is a first moment and a step."""

EVEN_ENOUGH = 0.001
"""Of a beat: less than times of triggers are known to."""
