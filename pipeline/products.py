"""What the stages leave for one another on disk, in and out."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from pipeline.errors import InputError
from pipeline.field.threads import processors
from pipeline.geometry import Float, Label, MovingSurface
from pipeline.imaging.cine import Cine, Stack
from pipeline.imaging.labels import LABELS
from pipeline.imaging.long_axis_series import LongAxis
from pipeline.imaging.nifti import LPS_FROM_RAS, read_image, write_image
from pipeline.meshes import read_mesh, write_vtp
from pipeline.registration.clock import to_cycle
from pipeline.sealing import PHASE_FILE

One = TypeVar("One")
What = TypeVar("What")


def write_cine(folder: Path, stack: Stack, views: Sequence[LongAxis] = ()) -> None:
    """``cine.nii.gz``, ``phases.json`` and ``long_axis_<k>.nii.gz``, one a view."""
    cine = stack.cine
    for number, view in enumerate(views):
        path = folder / f"long_axis_{number}.nii.gz"
        _write_phases(path, view.cine)
    _write_phases(folder / "cine.nii.gz", cine)
    write_table(
        folder / "phases.json",
        {
            "phases": cine.phases.tolist(),
            "rr_s": cine.rr_s,
            "trigger_times_ms": _by_slice(stack, stack.trigger_times_ms.tolist()),
            "rr_ms": _by_slice(stack, stack.rr_ms.tolist()),
            "timing_source": stack.timing_source,
            "left_out": list(stack.left_out),
            "interpolated_slices": list(cine.interpolated),
            "blank_ends": list(stack.blank_ends),
            "long_axis": [
                {"name": view.name, "phases": view.cine.phases.tolist(), "rr_s": view.cine.rr_s}
                for view in views
            ],
        },
    )


def _by_slice(stack: Stack, told: list[Any]) -> list[Any]:
    """What is told of each slice; None of those that are drawn between others."""
    if not stack.timed:
        return told
    known = dict(zip(stack.timed, told, strict=True))
    return [known.get(number) for number in range(stack.cine.intensity.shape[1])]


def _write_phases(path: Path, cine: Cine) -> None:
    step_s = cine.rr_s / len(cine.phases)
    write_image(path, _compact(cine.intensity), cine.mr_from_index, step_s)


def read_cine(folder: Path) -> Cine:
    """What ``write_cine`` wrote."""
    intensity, mr_from_index = read_image(folder / "cine.nii.gz")
    timing = read_table(folder / "phases.json")
    return Cine(
        np.ascontiguousarray(intensity, np.float32),
        mr_from_index,
        np.array(timing["phases"]),
        float(timing["rr_s"]),
        tuple(timing.get("interpolated_slices", ())),
        _moments(timing),
    )


def read_blank_ends(folder: Path) -> tuple[int, int]:
    """`Stack.blank_ends` of what ``write_cine`` wrote."""
    before, after = read_table(folder / "phases.json").get("blank_ends", (0, 0))
    return before, after


def _moments(timing: Mapping[str, Any]) -> Float | None:
    """`Cine.moments`; of slices drawn between others, between theirs."""
    told = list(zip(timing.get("trigger_times_ms", []), timing.get("rr_ms", []), strict=True))
    known = [number for number, one in enumerate(told) if None not in one]
    if not known:
        return None
    seen = [
        to_cycle(
            np.array(told[number][0]) / told[number][1], told[number][1] / 1000, timing["rr_s"]
        )
        for number in known
    ]
    columns = [np.interp(range(len(told)), known, column) for column in np.transpose(seen)]
    return np.stack(columns, axis=1)


def read_long_axis(folder: Path) -> tuple[LongAxis, ...]:
    """The long-axis views that ``write_cine`` wrote; none where there were none."""
    views = []
    for number, entry in enumerate(read_table(folder / "phases.json").get("long_axis", [])):
        intensity, mr_from_index = read_image(folder / f"long_axis_{number}.nii.gz")
        pixels = np.ascontiguousarray(intensity, np.float32)
        cine = Cine(pixels, mr_from_index, np.array(entry["phases"]), float(entry["rr_s"]))
        views.append(LongAxis(entry["name"], cine))
    return tuple(views)


def _compact(intensity: npt.NDArray[np.float32]) -> npt.NDArray[Any]:
    """Whole numbers as 16-bit integers, as scanners store them; other values as they are."""
    limits = np.iinfo(np.int16)
    whole = np.rint(intensity)
    fits = whole.min() >= limits.min and whole.max() <= limits.max
    return whole.astype(np.int16) if fits and np.array_equal(whole, intensity) else intensity


def write_labels(
    folder: Path,
    stem: str,
    labels: Label,
    mr_from_index: Float,
    blank_ends: tuple[int, int] = (0, 0),
) -> None:
    """``<stem>_000.nii.gz`` ..., one file a phase, from ``(phase, z, y, x)``, with so many empty
    slices before and after."""
    whole = np.pad(labels, ((0, 0), blank_ends, (0, 0), (0, 0)))
    frame = mr_from_index.copy()
    frame[:3, 3] -= blank_ends[0] * frame[:3, 2]

    def write(number: int) -> None:
        write_image(folder / f"{stem}_{number:03d}.nii.gz", whole[number], frame)

    _each(write, range(len(whole)))


def read_labels(folder: Path, stem: str) -> tuple[Label, Float]:
    """``(phase, z, y, x)`` labels and ``mr_from_index``.

    Raises
    ------
    InputError
        When there are none, a file holds what is no label, or files differ in shape.
    """
    paths = sorted(one for one in folder.glob(f"{stem}_*.nii.gz") if PHASE_FILE.search(one.name))
    if not paths:
        raise InputError(f"{folder}: holds no {stem}_000.nii.gz ...; give the labels of each phase")
    volumes = _each(read_image, paths)
    shape = volumes[0][0].shape
    for path, (volume, _) in zip(paths, volumes, strict=True):
        if volume.shape != shape:
            raise InputError(
                f"{path}: its labels are {volume.shape} (slice, row, column), those of "
                f"{paths[0].name} are {shape}; give labels of one grid in every phase"
            )
        others = np.setdiff1d(np.unique(volume), [0, *LABELS.values()])
        if len(others):
            known = ", ".join(f"{value} {name}" for name, value in LABELS.items())
            raise InputError(
                f"{path}: holds {others[0]:g}, which is no label; labels are whole numbers: "
                f"0 background, {known}"
            )
    return np.stack([np.asarray(volume, np.uint8) for volume, _ in volumes]), volumes[0][1]


def write_surfaces(folder: Path, surfaces: Mapping[str, MovingSurface]) -> None:
    """``<structure>_000.vtp`` ..., one file a structure and phase."""
    for name, moving in surfaces.items():

        def write(number: int, name: str = name, moving: MovingSurface = moving) -> None:
            write_vtp(folder / f"{name}_{number:03d}.vtp", moving.at(number))

        _each(write, range(len(moving.phases)))


def read_surfaces(folder: Path, phases: Float) -> dict[str, MovingSurface]:
    """What ``write_surfaces`` wrote, by structure."""
    paths = [one for one in folder.glob("*.vtp") if PHASE_FILE.search(one.name)]
    names = sorted({path.stem.rsplit("_", 1)[0] for path in paths})
    return {name: _read_moving(folder, name, phases) for name in names}


def _read_moving(folder: Path, name: str, phases: Float) -> MovingSurface:
    paths = [folder / f"{name}_{number:03d}.vtp" for number in range(len(phases))]
    each = _each(read_mesh, paths)
    vertices_mm = np.stack([surface.vertices_mm for surface in each])
    return MovingSurface(vertices_mm, each[0].triangles, phases)


def _each(work: Callable[[One], What], every: Iterable[One]) -> list[What]:
    """What files of one kind each give, in order; while one is packed or unpacked, another is."""
    with ThreadPoolExecutor(processors()) as pool:
        return list(pool.map(work, every))


def write_slicer_transform(path: Path, mr_from_tracker: Float) -> None:
    """A rigid motion as 3D Slicer and ITK read it (``.tfm``).

    Tracker numbers are taken as they are, and the MR's are RAS, as Slicer shows them: a tool's pose
    under this transform stands where it belongs beside the MR. An ITK file holds, in LPS, the way
    from the target to the source.
    """
    ras_from_tracker = LPS_FROM_RAS @ mr_from_tracker
    stored = LPS_FROM_RAS @ np.linalg.inv(ras_from_tracker) @ LPS_FROM_RAS
    numbers = (*stored[:3, :3].ravel(), *stored[:3, 3])
    lines = [
        "#Insight Transform File V1.0",
        "#Transform 0",
        "Transform: AffineTransform_double_3_3",
        f"Parameters: {' '.join(repr(float(number)) for number in numbers)}",
        "FixedParameters: 0 0 0",
    ]
    path.write_text("\n".join(lines) + "\n")


@dataclass(frozen=True, slots=True)
class FrameRow:
    """One tracked frame as ``frames.csv`` lists it."""

    sweep: str
    frame: int
    time_s: float
    phase: float
    residual: float
    valid: bool


def write_frames(path: Path, rows: Sequence[FrameRow]) -> None:
    """``frames.csv``: per US frame its time, phase, residual, and whether it counted."""
    with path.open("w", newline="", encoding="utf-8", errors="surrogateescape") as handle:
        table = csv.writer(handle, lineterminator="\n")
        table.writerow(FrameRow.__slots__)
        for row in rows:
            table.writerow([row.sweep, row.frame, *_rounded(row), int(row.valid)])


def _rounded(row: FrameRow) -> list[str]:
    # A phase that is rounded up to 1 is that of the next beat's beginning.
    return [f"{value:.6f}" for value in (row.time_s, round(row.phase, 6) % 1, row.residual)]


def read_frames(path: Path) -> list[FrameRow]:
    """What ``write_frames`` wrote."""
    with path.open(newline="", encoding="utf-8", errors="surrogateescape") as handle:
        return [
            FrameRow(
                row["sweep"],
                int(row["frame"]),
                float(row["time_s"]),
                float(row["phase"]),
                float(row["residual"]),
                bool(int(row["valid"])),
            )
            for row in csv.DictReader(handle)
        ]


def write_table(path: Path, content: Mapping[str, Any]) -> None:
    """A small JSON file, readable by people too."""
    path.write_text(json.dumps(content, indent=1) + "\n")


def read_table(path: Path) -> dict[str, Any]:
    """What ``write_table`` wrote."""
    content: dict[str, Any] = json.loads(path.read_text())
    return content
