"""What a field says of itself: the schema of the ``beatfield`` attributes."""

from __future__ import annotations

import itertools
import re
from typing import Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from pipeline.errors import InputError
from pipeline.field.fixture import DEVICES, Device, Fixture, Kind, Side
from pipeline.geometry import Grid, require_rigid

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
LONGEST_NAME = 63
"""What the C header has room for, too."""
LONGEST_FOLDER = 255
"""Of stores that were written by something else, and that Python alone reads."""

Row = tuple[float, float, float, float]
Transform = tuple[Row, Row, Row, Row]

INTERPOLATION = {
    "space": "quadratic B-spline whose coefficients are the arrays under spline/; beyond the "
    "boundary they go on in a straight line; about each surface they were corrected, by "
    "correction_mm at most, to bring the zero to the moving surface; points "
    "outside the grid are moved to its boundary",
    "time": "quadratic B-spline with knots halfway between phases; the first follows the last",
    "force": "-f_max * f(q) * direction, f and the direction from the interpolated distance",
    "direction": "gradient / max(length of the gradient, 0.5): a unit vector except near the "
    "medial axis, where it passes continuously through zero",
    "rate": "on the medial axis the force passes through zero without a step; anywhere, and in any "
    "direction, it changes with place by at most accuracy's force_rate_bound_n_per_mm",
}


class Part(BaseModel):
    """A part of the metadata: unknown keys and values that are not numbers are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class GridPart(Part):
    """The grid that all arrays share."""

    shape_zyx: tuple[int, int, int]
    origin_mm: tuple[float, float, float]
    spacing_mm: tuple[float, float, float]

    def nodes(self) -> Grid:
        """The grid that these numbers describe."""
        return Grid(self.shape_zyx, self.origin_mm, self.spacing_mm)


class StructurePart(Part):
    """One surface's distance."""

    path: str
    spline: str
    """Coefficients of the spline that readers evaluate. It takes these distances at the nodes and
    phases, but for the correction about the surface."""
    triangles: list[int]
    """Per phase."""
    volume_ml: list[float]
    """Per phase, enclosed."""
    correction_mm: float = Field(default=0.0, ge=0)
    """Largest change of a coefficient that brought the spline's zero to the moving surface."""


class DeviceLimits(Part):
    """What the device that a fixture was made for renders at most."""

    force_n: float
    stiffness_n_per_m: float | None
    """None where it is not known."""


class FixturePart(Part):
    """One fixture's potential, as resolved."""

    path: str
    structure: str
    kind: Kind
    side: Side | None
    gamma_mm: float
    gamma_level: float
    delta_mm: float
    m: int
    f_max_n: float
    device: str
    device_limits: DeviceLimits
    stiffness_n_per_m: float

    @classmethod
    def of(cls, name: str, fixture: Fixture) -> Self:
        """What the store says of a fixture."""
        return cls(
            path=f"potential/{name}",
            structure=fixture.structure,
            kind=fixture.kind,
            side=fixture.side,
            gamma_mm=fixture.resolved_gamma_mm,
            gamma_level=fixture.gamma_level,
            delta_mm=fixture.resolved_delta_mm,
            m=fixture.m,
            f_max_n=fixture.f_max_n,
            device=fixture.device.name,
            device_limits=DeviceLimits(
                force_n=fixture.device.force_n,
                stiffness_n_per_m=fixture.device.stiffness_n_per_m,
            ),
            stiffness_n_per_m=fixture.stiffness_n_per_m,
        )

    @model_validator(mode="before")
    @classmethod
    def _limits_of_the_known(cls, given: Any) -> Any:
        """Stores of version 1 may name a known device without its limits."""
        if isinstance(given, dict) and "device_limits" not in given:
            name = given.get("device")
            if isinstance(name, str) and name in DEVICES:
                return given | {"device_limits": DEVICES[name].model_dump(exclude={"name"})}
        return given

    def fixture(self) -> Fixture:
        """The fixture that these numbers describe."""
        return Fixture(
            structure=self.structure,
            kind=self.kind,
            side=self.side,
            delta_mm=self.delta_mm,
            m=self.m,
            f_max_n=self.f_max_n,
            device=Device(name=self.device, **self.device_limits.model_dump()),
        )


class FieldMetadata(Part):
    """The ``beatfield`` attributes of a field."""

    format_version: Literal[1] = 1
    frame: Literal["LPS"] = "LPS"
    unit: Literal["mm"] = "mm"
    phases: list[float] = Field(min_length=1)
    periodic: Literal[True] = True
    rr_s: float | None = Field(gt=0)
    mr_from_tracker: Transform | None
    grid: GridPart
    structures: dict[str, StructurePart] = Field(min_length=1)
    fixtures: dict[str, FixturePart] = Field(min_length=1)
    interpolation: dict[str, str] = INTERPOLATION
    source: dict[str, Any]
    accuracy: dict[str, Any]

    @model_validator(mode="after")
    def _phases_rise(self) -> Self:
        require_phases(self.phases, "phases")
        return self

    @model_validator(mode="after")
    def _transform_is_rigid(self) -> Self:
        if self.mr_from_tracker is not None:
            require_rigid(np.array(self.mr_from_tracker), "mr_from_tracker")
        return self

    @model_validator(mode="after")
    def _names_agree(self) -> Self:
        for name, structure in self.structures.items():
            require_name(name, "structure", LONGEST_FOLDER)
            if structure.path != f"distance/{name}":
                raise ValueError(f"structure {name}: path {structure.path!r} is not its own")
            if structure.spline != f"spline/{name}":
                raise ValueError(f"structure {name}: spline {structure.spline!r} is not its own")
            if not len(structure.triangles) == len(structure.volume_ml) == len(self.phases):
                raise ValueError(
                    f"structure {name}: triangles and volume_ml need {len(self.phases)} numbers, "
                    f"one a phase, not {len(structure.triangles)} and {len(structure.volume_ml)}"
                )
        for name, fixture in self.fixtures.items():
            require_name(name, "fixture", LONGEST_FOLDER)
            if fixture.path != f"potential/{name}":
                raise ValueError(f"fixture {name}: path {fixture.path!r} is not its own")
            if fixture.structure not in self.structures:
                raise ValueError(f"fixture {name}: no structure {fixture.structure!r}")
        return self

    @property
    def arrays(self) -> list[str]:
        """Paths of all arrays in the store."""
        parts = self.structures.values()
        fixtures = [fixture.path for fixture in self.fixtures.values()]
        return [part.path for part in parts] + fixtures + [part.spline for part in parts]


def attributes(metadata: FieldMetadata) -> dict[str, Any]:
    """Attributes of the group: OME-NGFF 0.5 multiscales, one for each array, and our own."""
    return {
        "ome": {
            "version": "0.5",
            "multiscales": [_multiscale(name, metadata) for name in metadata.arrays],
        },
        "beatfield": metadata.model_dump(mode="json"),
    }


def _multiscale(name: str, metadata: FieldMetadata) -> dict[str, Any]:
    grid = metadata.grid
    time: dict[str, Any] = {"name": "t", "type": "time"}
    if metadata.rr_s is not None:
        time["unit"] = "second"
    beat = 1.0 if metadata.rr_s is None else metadata.rr_s
    step = beat / len(metadata.phases)
    space = [{"name": axis, "type": "space", "unit": "millimeter"} for axis in "zyx"]
    placed = [
        {"type": "scale", "scale": [step, *grid.spacing_mm[::-1]]},
        {"type": "translation", "translation": [beat * metadata.phases[0], *grid.origin_mm[::-1]]},
    ]
    return {
        "name": name,
        "axes": [time, *space],
        "datasets": [{"path": name, "coordinateTransformations": placed}],
    }


LEAST_PHASE_STEP = 1e-3
"""Of a cycle; phases nearer than that are a unit mistaken."""


def require_phases(phases: list[float], where: str) -> None:
    """Raise ValueError unless phases rise within [0, 1), by `LEAST_PHASE_STEP` or more each."""
    inside = all(0 <= phase < 1 for phase in phases)
    if not phases or not inside or any(b <= a for a, b in itertools.pairwise(phases)):
        raise ValueError(f"{where} must rise within [0, 1), got {phases}")
    # The first follows the last, a cycle later.
    step = min(b - a for a, b in itertools.pairwise([*phases, phases[0] + 1]))
    if step < LEAST_PHASE_STEP:
        raise ValueError(
            f"{where} lie {step:.2g} of a cycle apart, at least {LEAST_PHASE_STEP:g} is "
            f"needed; they are shares of a cycle, not seconds; got {phases}"
        )


def require_name(name: str, what: str, longest: int = LONGEST_NAME) -> None:
    """Raise InputError unless a name can be a folder everywhere."""
    if not NAME.fullmatch(name) or len(name) > longest:
        raise InputError(
            f"{what} name {name!r}: needs letters, digits, '_' and '-', a letter or digit first, "
            f"{longest} of them at most"
        )
