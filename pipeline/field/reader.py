"""Read a baked field: JSON and memory maps, nothing else.

A force server imports this module only. Opening maps files into memory without reading them;
numba is loaded by the first question.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import InputError
from pipeline.field.files import map_phase, read_metadata, readable_in_fours, require_manifest
from pipeline.field.fixture import Fixture
from pipeline.field.metadata import FieldMetadata
from pipeline.field.potential import offence, potential
from pipeline.field.questions import (
    as_numbers,
    as_phases,
    as_points,
    damaged,
    four_floats,
    no_answer,
    require_answers,
    require_finite,
    two_floats,
)
from pipeline.field.spline import grid_numbers, timeline
from pipeline.field.threads import in_parts
from pipeline.geometry import Float, Float32, Grid, Mask, require_rigid

if TYPE_CHECKING:
    from pipeline.field.tool import Tool


@dataclass(frozen=True, slots=True)
class ToolForce:
    """What a whole tool feels."""

    force_n: Float
    """``(3,)`` newtons, LPS."""

    torque_nmm: Float
    """``(3,)`` newton-millimetres about the handle, LPS."""

    evaluations: int
    """How often the field was asked."""


class ForceField:
    """A moving distance field and the forces of its fixtures, in LPS mm of the MR frame.

    The distance is a quadratic B-spline in space and time. It takes the stored distance at every
    node and phase but for where the surface is or passes up to two phases away: there it was moved
    such that its zero lies on the surface between nodes, too (`pipeline.field.surface_fit`). Its
    gradient is exact, and neither it nor the rate of change has a step at voxel faces, at phases,
    or where the cycle closes.
    Potential and force are the formulas evaluated on it.

    The direction of the force is ``g / max(|g|, 0.5)`` for the gradient g: a unit vector except
    near the medial axis, where two parts of the surface are equally near; there the force passes
    continuously through zero, and nowhere does it change faster with place than the certificate's
    ``force_rate_bound_n_per_mm``.

    Questions of many points are shared among the processors; the answers do not depend on how
    many there are. ``force_at`` and ``distance_at`` answer for one point at the least cost.

    Points outside the grid are treated as the nearest point of its boundary, which is continuous
    but says less the farther out they are: ask ``contains``.
    """

    def __init__(self, path: Path, metadata: FieldMetadata, in_memory: bool = False) -> None:
        self._path = path
        self._in_memory = in_memory
        self._metadata = metadata
        self._fixtures = MappingProxyType(
            {name: part.fixture() for name, part in metadata.fixtures.items()}
        )
        self._grid = metadata.grid.nodes()
        self._phases = np.array(metadata.phases)
        self._numbers = grid_numbers(self._grid)
        self._line = timeline(self._phases)
        parts = metadata.structures
        self._distances = {name: self._map(part.path) for name, part in parts.items()}
        self._coefficients = {
            name: [self._kept(phase) for phase in self._map(part.spline)]
            for name, part in parts.items()
        }
        self._addresses = {
            name: np.array([phase.ctypes.data for phase in mapped], dtype=np.uintp)
            for name, mapped in self._coefficients.items()
        }
        self._laws = {
            name: (
                self._addresses[law.structure], self._line, self._numbers,
                law.side_code, law.resolved_delta_mm, law.m, law.f_max_n,
            )
            for name, law in self._fixtures.items()
        }  # fmt: skip
        self._first = next(iter(self._fixtures))

    def _map(self, part: str) -> list[Float32]:
        count = len(self._phases)
        return [map_phase(self._path / part, index, self._grid) for index in range(count)]

    def _kept(self, coefficients: Float32) -> Float32:
        if not self._in_memory:
            return readable_in_fours(coefficients)
        kept = coefficients.copy()
        if not np.isfinite(kept).all():
            raise damaged(self._path)
        return readable_in_fours(kept)

    @classmethod
    def open(cls, path: Path | str, in_memory: bool = False) -> ForceField:
        """Open ``field.zarr``.

        Parameters
        ----------
        path
            The folder.
        in_memory
            Copy the coefficients, which are what questions read, so that none waits for a disk, and
            a file that is written over or cut later changes no force; look whether all values are
            finite. Else files are mapped.

        Raises
        ------
        InputError
            When it is no complete field, its description or size is wrong, it was replaced
            meanwhile, or a value that was copied is not finite. Values are not compared with the
            manifest; ``beatfield verify`` checks every byte.
        """
        path = Path(path).resolve()
        manifest = require_manifest(path)
        field = cls(path, read_metadata(path), in_memory)
        if require_manifest(path) != manifest:
            raise InputError(f"{path}: was replaced while it was opened; open it again")
        return field

    def __reduce__(self) -> tuple[Callable[[Path, bool], ForceField], tuple[Path, bool]]:
        """Another process, or a copy, opens the field anew: mapped values stay where they are."""
        return ForceField.open, (self._path, self._in_memory)

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
        """Which of ``(n, 3)`` points lie in the grid, its boundary included.

        Raises
        ------
        InputError
            When the shape is wrong or a value is not finite.
        """
        points = as_points(points_mm)
        require_finite(points)
        inside = (points >= self._grid.origin_mm) & (points <= self._grid.upper_mm)
        return np.asarray(inside.all(axis=1))

    def stored_distance_mm(self, structure: str, index: int) -> Float32:
        """The stored ``(z, y, x)`` distances of one phase, mapped, not copied.

        Raises
        ------
        InputError
            When the structure is unknown.
        """
        return self._distances[self._structure(structure)][index]

    def stored_coefficients(self, structure: str, index: int) -> Float32:
        """The spline's ``(z, y, x)`` coefficients of one phase, mapped, not copied.

        Raises
        ------
        InputError
            When the structure is unknown.
        """
        part = self._metadata.structures[self._structure(structure)]
        return map_phase(self._path / part.spline, index, self._grid)

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
            When a shape is wrong, a value is not finite, a name unknown, or the field damaged.
        """
        return self._sample(points_mm, phase, self._structure(structure))[0]

    def gradient(
        self, points_mm: npt.ArrayLike, phase: npt.ArrayLike, structure: str | None = None
    ) -> Float:
        """Gradient of ``distance_mm`` at ``(n, 3)`` points: ``(n, 3)``, without unit.

        Raises
        ------
        InputError
            As there.
        """
        return self._sample(points_mm, phase, self._structure(structure))[1]

    def potential(
        self, points_mm: npt.ArrayLike, phase: npt.ArrayLike, fixture: str | None = None
    ) -> Float:
        """Potential of a fixture at ``(n, 3)`` points: ``(n,)`` in [0, 1], rounded to 1 far off.

        Raises
        ------
        InputError
            As in ``distance_mm``.
        """
        law = self._fixture(fixture)
        distance_mm, _ = self._sample(points_mm, phase, law.structure)
        height: Float = potential(offence(distance_mm, law.side_code), law.resolved_delta_mm, law.m)
        return height

    def force_n(
        self, points_mm: npt.ArrayLike, phase: npt.ArrayLike, fixture: str | None = None
    ) -> Float:
        """Force of a fixture on a tool at ``(n, 3)`` points: ``(n, 3)`` newtons.

        ``-f_max f(q) direction``, with the direction in which the potential rises.

        Raises
        ------
        InputError
            As in ``distance_mm``.
        """
        from pipeline.field.batches import sample_force

        self._fixture(fixture)
        law = self._laws[self._first if fixture is None else fixture]
        points = as_points(points_mm)
        phases = as_phases(phase, len(points))
        force_n = np.empty((len(points), 3))

        def ask(part: slice, moments: Float) -> None:
            require_finite(points[part], moments, part.start)
            sample_force(law, points[part], moments, force_n[part])
            require_answers(force_n[part], self._path)

        in_parts(ask, phases, len(points))
        return force_n

    def distance_at(
        self, x_mm: float, y_mm: float, z_mm: float, phase: float, structure: str | None = None
    ) -> float:
        """Signed distance in mm at one point; as ``distance_mm``, without arrays.

        Raises
        ------
        InputError
            When a number is not finite, the structure unknown, or the field damaged.
        """
        kernel = self._distance_at or self._load()[0]
        try:
            name = self._fixtures[self._first].structure if structure is None else structure
            addresses = self._addresses[name]
        except (KeyError, TypeError):
            raise self._unknown("structure", structure, self._addresses) from None
        where = four_floats(x_mm, y_mm, z_mm, phase)
        found: float = kernel(addresses, self._line, self._numbers, *where)[0]
        # Neither of what is no number nor of what is infinite is the difference zero.
        if found - found != 0.0:
            raise no_answer(self._path, x_mm, y_mm, z_mm, phase)
        return found

    def force_at(
        self, x_mm: float, y_mm: float, z_mm: float, phase: float, fixture: str | None = None
    ) -> tuple[float, float, float]:
        """Force on a tool at one point, newtons along x, y, z; as ``force_n``, without arrays.

        Raises
        ------
        InputError
            When a number is not finite, the fixture unknown, or the field damaged.
        """
        kernel = self._force_at or self._load()[1]
        try:
            law = self._laws[self._first if fixture is None else fixture]
        except (KeyError, TypeError):
            raise self._unknown("fixture", fixture, self._laws) from None
        where = four_floats(x_mm, y_mm, z_mm, phase)
        force_n: tuple[float, float, float] = kernel(*law, *where)
        # Where one of the three is no number, no one is.
        if force_n[0] != force_n[0]:
            raise no_answer(self._path, x_mm, y_mm, z_mm, phase)
        return force_n

    def tool_force(
        self,
        tool: Tool,
        mr_from_tool: Float,
        phase: float,
        fixture: str | None = None,
        bound_n: float = 0.05,
    ) -> ToolForce:
        """Force and torque on a whole tool: the mean of the field's force over its length.

        A tool thus feels no more than ``f_max``. Its lines are divided where the field demands
        it, until dividing once more would change the force by less than ``bound_n``, or a stretch
        has been divided eight times.

        Parameters
        ----------
        tool
            From ``pipeline.field.tool``; ``read_tool`` reads one.
        mr_from_tool
            4x4, the tool's pose in LPS mm.
        phase
            Share of the heartbeat since the R peak; only its fraction counts.
        fixture
            Which; the first when None.
        bound_n
            The most that dividing may change, newtons: an estimate of the error.

        Raises
        ------
        InputError
            When the tool is none, the pose is not rigid, a number not finite, the bound not above
            0, the fixture unknown, the tool longer than 20 diagonals of the grid or so far from its
            handle that the torque is no number, or the field damaged.
        """
        kernel = self._tool_force or self._load_tools()
        phase, bound_n = two_floats(phase, bound_n)
        try:
            law = self._laws[self._first if fixture is None else fixture]
        except (KeyError, TypeError):
            raise self._unknown("fixture", fixture, self._laws) from None
        pose = as_numbers(mr_from_tool, "mr_from_tool")
        try:
            lines, found = tool.lines, np.empty(6)
        except AttributeError:
            raise InputError(
                f"tool must be one of pipeline.field.tool, such as read_tool(path), got {tool!r}"
            ) from None
        asked = -1
        if pose.shape == (4, 4):
            asked = kernel(
                law, lines.points_mm, lines.starts, tool.handle_mm, pose,
                phase, bound_n, found,
            )  # fmt: skip
        if asked == -2:
            raise InputError("tool is longer than 20 diagonals of the grid; its unit is mm")
        if asked < 0:
            require_rigid(pose, "mr_from_tool")
            raise InputError(f"mr_from_tool: is no rotation and shift to 1e-3, got\n{pose}")
        if found[0] != found[0]:
            raise damaged(self._path)
        if not math.isfinite(sum(found.tolist())):
            raise InputError(
                "tool or handle_mm: is so far away that the torque is no number; the unit is mm"
            )
        return ToolForce(found[:3], found[3:], asked)

    _tool_force: Any = None

    def _load_tools(self) -> Any:
        from pipeline.field.tool_kernels import tool_force

        self._tool_force = tool_force
        return tool_force

    _distance_at: Any = None
    _force_at: Any = None

    def _load(self) -> tuple[Any, Any]:
        """Compile or load the kernels at the first question."""
        from pipeline.field import kernels

        self._distance_at, self._force_at = kernels.distance_at, kernels.force_at
        return self._distance_at, self._force_at

    def _unknown(self, what: str, name: str | None, known: Mapping[str, Any]) -> InputError:
        return InputError(f"{self._path}: no {what} {name!r}; there are {', '.join(known)}")

    def _fixture(self, name: str | None) -> Fixture:
        if name is None:
            return self._fixtures[self._first]
        if not isinstance(name, str) or name not in self._fixtures:
            raise self._unknown("fixture", name, self._fixtures)
        return self._fixtures[name]

    def _structure(self, name: str | None) -> str:
        if name is None:
            return self._fixture(None).structure
        # What is no name may be nothing that can be looked up, either.
        if not isinstance(name, str) or name not in self._distances:
            raise self._unknown("structure", name, self._distances)
        return name

    def _sample(
        self, points_mm: npt.ArrayLike, phase: npt.ArrayLike, structure: str
    ) -> tuple[Float, Float]:
        from pipeline.field.batches import sample

        points = as_points(points_mm)
        phases = as_phases(phase, len(points))
        distance_mm, gradient = np.empty(len(points)), np.empty((len(points), 3))
        field = (self._addresses[structure], self._line, self._numbers)

        def ask(part: slice, moments: Float) -> None:
            require_finite(points[part], moments, part.start)
            sample(*field, points[part], moments, distance_mm[part], gradient[part])
            # A value of the field that is none leaves none in both.
            require_answers(distance_mm[part], self._path)

        in_parts(ask, phases, len(points))
        return distance_mm, gradient
