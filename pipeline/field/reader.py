"""Read a baked field: JSON and memory maps, nothing else.

A force server imports this module only. Opening maps files into memory without reading them;
numba is loaded by the first question.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from pipeline.errors import InputError
from pipeline.field.fixture import Fixture
from pipeline.field.manifest import MANIFEST
from pipeline.field.metadata import FieldMetadata
from pipeline.field.potential import direction_scale, offence, potential, pull
from pipeline.geometry import Float, Float32, Grid, Mask

ATTRIBUTES = "zarr.json"


class ForceField:
    """A moving distance field and the forces of its fixtures, in LPS mm of the MR frame.

    The distance is interpolated by tricubic Catmull-Rom splines in space (exact at the nodes,
    with a continuous gradient) and linearly between phases, the first following the last. The
    gradient is the exact derivative of that interpolant; potential and force are the formulas
    evaluated on it, so the force has no step at voxel faces or at phases.

    The direction of the force is ``g / max(|g|, 0.5)`` for the gradient g: a unit vector except
    near the medial axis, where two parts of the surface are equally near; there the force passes
    continuously through zero, along an axis of the grid at no more than 8 f_max / spacing.

    Points outside the grid are treated as the nearest point of its boundary, which is continuous
    but says less the farther out they are: ask ``contains``.
    """

    def __init__(self, path: Path, metadata: FieldMetadata) -> None:
        self._path = path
        self._metadata = metadata
        self._fixtures = MappingProxyType(
            {name: part.fixture() for name, part in metadata.fixtures.items()}
        )
        grid = metadata.grid
        self._grid = Grid(grid.shape_zyx, grid.origin_mm, grid.spacing_mm)
        self._origin_mm = np.array(grid.origin_mm)
        self._spacing_mm = np.array(grid.spacing_mm)
        self._phases = np.array(metadata.phases)
        self._since_first = self._phases - self._phases[0]
        self._gaps = np.diff(self._since_first, append=1.0)
        self._distances = {
            name: [map_phase(path / part.path, k, self._grid) for k in range(len(self._phases))]
            for name, part in metadata.structures.items()
        }

    @classmethod
    def open(cls, path: Path | str) -> ForceField:
        """Open ``field.zarr``.

        Raises
        ------
        InputError
            When the folder is no complete field, or its description or size is wrong. Values are
            not read; ``beatfield verify`` checks every byte.
        """
        path = Path(path)
        require_manifest(path)
        return cls(path, read_metadata(path))

    @property
    def phases(self) -> Float:
        """Stored phases, ``(phase,)`` in [0, 1), rising."""
        return self._phases.copy()

    @property
    def fixtures(self) -> Mapping[str, Fixture]:
        """Fixtures by name; the first is the default of every question."""
        return self._fixtures

    @property
    def structures(self) -> tuple[str, ...]:
        """Names of the surfaces whose distance is stored."""
        return tuple(self._metadata.structures)

    @property
    def rr_s(self) -> float | None:
        """Mean duration of a heartbeat when the images were taken, if it is known."""
        return self._metadata.rr_s

    @property
    def mr_from_tracker(self) -> Float | None:
        """4x4 transform from the tracker's frame (mm) to the frame of this field, if known."""
        transform = self._metadata.mr_from_tracker
        return None if transform is None else np.array(transform)

    @property
    def grid(self) -> Grid:
        """Nodes of the stored arrays."""
        return self._grid

    @property
    def accuracy(self) -> dict[str, Any]:
        """The certificate measured at baking."""
        return self._metadata.accuracy

    @property
    def source(self) -> dict[str, Any]:
        """What the field was made from."""
        return self._metadata.source

    def contains(self, points_mm: npt.ArrayLike) -> Mask:
        """Which of ``(n, 3)`` points lie in the grid."""
        points = _as_points(points_mm)
        inside = (points >= self._origin_mm) & (points <= self._grid.upper_mm)
        return np.asarray(inside.all(axis=1))

    def stored_distance_mm(self, structure: str, index: int) -> Float32:
        """The stored ``(z, y, x)`` distances of one phase, mapped, not copied."""
        return self._distances[self._structure(structure)][index]

    def distance_mm(
        self, points_mm: npt.ArrayLike, phase: npt.ArrayLike, structure: str | None = None
    ) -> Float:
        """Signed distance in mm at ``(n, 3)`` points, negative inside.

        Parameters
        ----------
        points_mm
            ``(n, 3)``, LPS mm.
        phase
            One number or ``(n,)``; only its fraction counts.
        structure
            Which surface; that of the first fixture when None.

        Returns
        -------
        ``(n,)`` array, mm.

        Raises
        ------
        InputError
            When a shape is wrong, a value is not finite, or a name unknown.
        """
        return self._sample(points_mm, phase, self._structure(structure))[0]

    def gradient(
        self, points_mm: npt.ArrayLike, phase: npt.ArrayLike, structure: str | None = None
    ) -> Float:
        """Gradient of ``distance_mm`` at ``(n, 3)`` points: ``(n, 3)``, without unit."""
        return self._sample(points_mm, phase, self._structure(structure))[1]

    def potential(
        self, points_mm: npt.ArrayLike, phase: npt.ArrayLike, fixture: str | None = None
    ) -> Float:
        """Potential of a fixture at ``(n, 3)`` points: ``(n,)`` in [0, 1)."""
        law = self._fixture(fixture)
        distance_mm, _ = self._sample(points_mm, phase, law.structure)
        height: Float = potential(offence(distance_mm, law.side_code), law.resolved_delta_mm, law.m)
        return height

    def force_n(
        self, points_mm: npt.ArrayLike, phase: npt.ArrayLike, fixture: str | None = None
    ) -> Float:
        """Force of a fixture on a tool at ``(n, 3)`` points: ``(n, 3)`` newtons.

        ``-f_max f(q) direction``, with the direction in which the potential rises.
        """
        law = self._fixture(fixture)
        distance_mm, gradient = self._sample(points_mm, phase, law.structure)
        size = pull(distance_mm, law.side_code, law.resolved_delta_mm, law.m)
        length = np.sqrt(np.einsum("ij,ij->i", gradient, gradient))
        force: Float = (-law.f_max_n * size * direction_scale(length))[:, None] * gradient
        return force

    def _fixture(self, name: str | None) -> Fixture:
        if name is None:
            return next(iter(self._fixtures.values()))
        if name not in self._fixtures:
            raise InputError(
                f"{self._path}: no fixture {name!r}; there are {', '.join(self._fixtures)}"
            )
        return self._fixtures[name]

    def _structure(self, name: str | None) -> str:
        if name is None:
            return self._fixture(None).structure
        if name not in self._distances:
            raise InputError(
                f"{self._path}: no structure {name!r}; there are {', '.join(self._distances)}"
            )
        return name

    def _sample(
        self, points_mm: npt.ArrayLike, phase: npt.ArrayLike, structure: str
    ) -> tuple[Float, Float]:
        from pipeline.field.kernels import interpolate

        points = _as_points(points_mm)
        index, share = self._place(_as_phases(phase, len(points)))
        distance_mm, gradient = np.empty(len(points)), np.empty((len(points), 3))
        volumes = self._distances[structure]
        for k in np.unique(index):
            chosen = slice(None) if len(index) == 1 else np.flatnonzero(index == k)
            one_mm, slope = distance_mm[chosen], gradient[chosen]
            interpolate(
                volumes[k],
                volumes[(k + 1) % len(volumes)],
                np.broadcast_to(share, len(points))[chosen].astype(np.float64),
                self._origin_mm,
                self._spacing_mm,
                points[chosen],
                one_mm,
                slope,
            )
            distance_mm[chosen], gradient[chosen] = one_mm, slope
        return distance_mm, gradient

    def _place(self, phase: Float) -> tuple[npt.NDArray[np.intp], Float]:
        """Stored phase at or before each phase, and the share of the one after it."""
        since = np.mod(phase - self._phases[0], 1.0)
        # The remainder of a tiny negative number rounds to 1 itself.
        since[since >= 1.0] = 0.0
        index = np.searchsorted(self._since_first, since, side="right") - 1
        return index, (since - self._since_first[index]) / self._gaps[index]


def _as_points(points_mm: npt.ArrayLike) -> Float:
    points = np.ascontiguousarray(points_mm, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points must be (n, 3) in mm, got an array of shape {points.shape}")
    if not np.isfinite(points).all():
        bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise InputError(f"point {bad} is not finite: {points[bad]}; every coordinate must be mm")
    return points


def _as_phases(phase: npt.ArrayLike, count: int) -> Float:
    phases = np.atleast_1d(np.asarray(phase, dtype=np.float64))
    if phases.shape not in {(1,), (count,)}:
        raise InputError(f"phase must be one number or ({count},), got shape {phases.shape}")
    if not np.isfinite(phases).all():
        raise InputError("phase must be finite; it is a place in the heartbeat, [0, 1)")
    return phases


def chunk_path(array: Path, index: int) -> Path:
    """The file of one phase of a stored array: raw little-endian float32 ``(z, y, x)``."""
    return array / "c" / str(index) / "0" / "0" / "0"


def map_phase(array: Path, index: int, grid: Grid) -> Float32:
    """Map one phase of a stored array into memory, read-only.

    Raises
    ------
    InputError
        When the file is missing or its size is wrong.
    """
    path = chunk_path(array, index)
    size, needed = _size(path), 4 * int(np.prod(grid.shape))
    if size != needed:
        raise InputError(f"{path}: {size} bytes, {needed} were needed; bake the field again")
    # A plain view: subclasses of arrays make every call into a compiled kernel slower.
    return np.asarray(np.memmap(path, dtype="<f4", mode="r", shape=grid.shape))


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); bake it again") from error


def require_manifest(path: Path) -> None:
    """Raise InputError unless the folder has the manifest that is written last, and it agrees.

    Only the attributes are compared with it; this is the check that costs nothing.
    """
    if not path.is_dir():
        raise InputError(f"{path}: no such folder; give a field.zarr that bake wrote")
    try:
        manifest = json.loads((path / MANIFEST).read_bytes())
        expected = manifest["files"][ATTRIBUTES]["sha256"]
        actual = hashlib.sha256((path / ATTRIBUTES).read_bytes()).hexdigest()
    except FileNotFoundError as error:
        missing = Path(error.filename).name
        raise InputError(
            f"{path}: has no {missing}, so it is no complete field; bake it again"
        ) from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path / MANIFEST}: cannot be read ({error!r}); bake again") from error
    if expected != actual:
        raise InputError(f"{path / ATTRIBUTES}: is not what the manifest says; bake it again")


def read_metadata(path: Path) -> FieldMetadata:
    """The ``beatfield`` attributes of a store.

    Raises
    ------
    InputError
        When they are missing or wrong.
    """
    source = path / ATTRIBUTES
    try:
        attributes = json.loads(source.read_bytes())["attributes"]["beatfield"]
        return FieldMetadata.model_validate(attributes)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise InputError(f"{source}: beatfield.{place}: {first['msg']}") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{source}: holds no beatfield attributes ({error!r}); give a field.zarr"
        ) from error
