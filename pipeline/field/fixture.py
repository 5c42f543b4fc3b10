"""Virtual fixtures, the haptic devices that bound them, and the settings of the bake stage.

The potential of a fixture is ``f(q) = 1 - exp(-(q^2 / (2 delta^2))^m)``; its force is at most
``f_max_n``. Everything here is plain data: importing it brings pydantic, and no NumPy.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Literal, Self

from pydantic import Field, field_serializer, field_validator, model_validator

from pipeline.validation import Section

Kind = Literal["guidance", "forbidden_region"]
Side = Literal["inside", "outside"]
DeviceName = Literal["touch", "falcon", "omega7"]

# A delta that was computed as the smallest allowed must itself be allowed after rounding.
ROUNDING = 1e-9


def steepest_slope(m: int) -> float:
    """Largest slope of the potential over ``q / delta``, reached at its point of inflection.

    With ``s = (2m - 1) / (2m)`` the slope ``f'(q)`` is largest at ``(q^2 / (2 delta^2))^m = s``
    and is there ``m sqrt(2) s^s exp(-s) / delta``.

    >>> [round(steepest_slope(m), 3) for m in (1, 2, 3)]
    [0.607, 1.077, 1.584]
    """
    s = (2 * m - 1) / (2 * m)
    return m * math.sqrt(2) * math.pow(s, s) * math.exp(-s)


def delta_from_gamma(gamma_mm: float, level: float, m: int) -> float:
    """Width ``delta`` in mm of the potential that reaches ``level`` at ``gamma_mm``.

    >>> round(delta_from_gamma(3.0, 0.01, 2), 3)
    6.7
    """
    return gamma_mm / (math.sqrt(2) * math.pow(-math.log1p(-level), 1 / (2 * m)))


class Device(Section):
    """What a haptic device can render."""

    name: str = Field(min_length=1)

    force_n: float = Field(gt=0)
    """Largest force it can exert."""

    stiffness_n_per_m: float | None = Field(gt=0)
    """Stiffest spring it can render; None where none is known and only the force is checked."""


DEVICES: Mapping[str, Device] = MappingProxyType(
    {
        "touch": Device(name="touch", force_n=3.3, stiffness_n_per_m=400.0),
        "falcon": Device(name="falcon", force_n=8.9, stiffness_n_per_m=None),
        "omega7": Device(name="omega7", force_n=12.0, stiffness_n_per_m=5000.0),
    }
)
"""Those that a name alone stands for."""


class Fixture(Section):
    """One virtual fixture: which surface acts on the tool, and how."""

    structure: str = Field(min_length=1)
    """Name of the surface."""

    kind: Kind
    """``guidance`` attracts to the surface; ``forbidden_region`` pushes out of one side of it."""

    side: Side | None = None
    """The side that is forbidden; only for ``forbidden_region``."""

    delta_mm: float | None = Field(default=None, gt=0)
    """Width of the potential, 0.1 to 1000 mm. Give this or ``gamma_mm``, from which it follows."""

    gamma_mm: float | None = Field(default=None, gt=0)
    """Half-width of the workspace in which the tool should feel next to nothing."""

    gamma_level: float = Field(default=0.01, gt=0, lt=1)
    """Value of the potential at ``gamma_mm``."""

    m: int = Field(default=1, ge=1, le=20)
    """Sharpness: 1 is a Gaussian well, more is a flatter floor with steeper walls."""

    f_max_n: float = Field(gt=0)
    """Force far from the floor of the well, 0.001 to 1000 N."""

    device: Device = DEVICES["touch"]
    """The haptic device that will render the force: touch, falcon, omega7, or one of one's own,
    as {name: mine, force_n: 10, stiffness_n_per_m: 2000}, its stiffness null if not known."""

    @field_validator("device", mode="before")
    @classmethod
    def _known_by_name(cls, given: Any) -> Any:
        if isinstance(given, Device | dict):
            return given
        if isinstance(given, str) and given in DEVICES:
            return DEVICES[given]
        raise ValueError(
            f"is none of {', '.join(DEVICES)}; describe one of your own, as "
            "{name: mine, force_n: 10, stiffness_n_per_m: 2000}"
        )

    @field_validator("device")
    @classmethod
    def _known_as_they_are(cls, device: Device) -> Device:
        if DEVICES.get(device.name, device) != device:
            raise ValueError(f"{device.name} is known, with other limits; take another name")
        return device

    @field_serializer("device")
    def _name_of_the_known(self, device: Device) -> Any:
        return device.name if device in DEVICES.values() else device.model_dump()

    @model_validator(mode="after")
    def _one_width(self) -> Self:
        if (self.delta_mm is None) == (self.gamma_mm is None):
            given = "neither" if self.delta_mm is None else "both"
            raise ValueError(f"needs exactly one of delta_mm and gamma_mm, got {given}")
        if self.gamma_mm is None and "gamma_level" in self.model_fields_set:
            raise ValueError("gamma_level belongs to gamma_mm; with delta_mm leave it out")
        # Else sums overflow before anything can be said of the width.
        if not 1e-100 < self.resolved_delta_mm < 1e100:
            raise ValueError(f"a delta_mm of {self.resolved_delta_mm:.3g} is no width")
        return self

    @model_validator(mode="after")
    def _side_of_a_forbidden_region(self) -> Self:
        if self.kind == "forbidden_region" and self.side is None:
            raise ValueError("a forbidden_region needs side: inside or outside, what is forbidden")
        if self.kind == "guidance" and self.side is not None:
            raise ValueError("side belongs to a forbidden_region; a guidance acts on both sides")
        return self

    @model_validator(mode="after")
    def _within_the_device(self) -> Self:
        limit = self.device
        if self.f_max_n > limit.force_n * (1 + ROUNDING):
            raise ValueError(
                f"f_max_n = {self.f_max_n:g} N is beyond the {limit.name}, which exerts "
                f"{limit.force_n:g} N at most; lower f_max_n or choose another device"
            )
        allowed = limit.stiffness_n_per_m
        if allowed is not None and self.stiffness_n_per_m > allowed * (1 + ROUNDING):
            raise ValueError(self._too_stiff(allowed))
        return self

    def _too_stiff(self, allowed_n_per_m: float) -> str:
        stiffness = self.stiffness_n_per_m
        factor = stiffness / allowed_n_per_m
        # Rounded up, so that the printed number is itself accepted.
        smallest_delta = math.ceil(self.resolved_delta_mm * factor * 1e3) / 1e3
        also = ""
        if self.gamma_mm is not None:
            also = f", which is gamma_mm = {math.ceil(self.gamma_mm * factor * 1e3) / 1e3:g}"
        return (
            f"is stiffer than the {self.device.name} can render: {stiffness:.0f} N/m, at "
            f"most {allowed_n_per_m:g} N/m; the smallest width that would do is delta_mm = "
            f"{smallest_delta:g}{also} (or lower f_max_n)"
        )

    @property
    def resolved_delta_mm(self) -> float:
        """Width of the potential, given or derived from gamma."""
        if self.delta_mm is not None:
            return self.delta_mm
        assert self.gamma_mm is not None
        return delta_from_gamma(self.gamma_mm, self.gamma_level, self.m)

    @property
    def resolved_gamma_mm(self) -> float:
        """Distance at which the potential is ``gamma_level``, given or derived from delta."""
        if self.gamma_mm is not None:
            return self.gamma_mm
        return self.resolved_delta_mm / delta_from_gamma(1.0, self.gamma_level, self.m)

    @property
    def stiffness_n_per_m(self) -> float:
        """Steepest slope of the force over distance."""
        return 1000 * self.f_max_n * steepest_slope(self.m) / self.resolved_delta_mm

    @property
    def side_code(self) -> int:
        """0 for guidance, +1 where the outside is forbidden, -1 where the inside is."""
        return {None: 0, "outside": 1, "inside": -1}[self.side]


DEFAULT_FIXTURES: dict[str, Fixture] = {
    "epicardium_guidance": Fixture(
        structure="epicardium", kind="guidance", gamma_mm=3.0, m=2, f_max_n=2.0
    ),
    "left_atrium_guidance": Fixture(
        structure="left_atrium", kind="guidance", gamma_mm=2.5, m=2, f_max_n=2.0
    ),
    # A tool inside the left ventricle must not leave through the wall; one outside is pushed in.
    "left_ventricle_forbidden": Fixture(
        structure="epicardium",
        kind="forbidden_region",
        side="outside",
        delta_mm=3.0,
        m=1,
        f_max_n=1.9,
    ),
}
"""The fixtures of the default configuration, all of which a Touch can render."""


class Bounds(Section):
    """What the certificate of a field must keep to; a field that does not is not published."""

    node_error_near_mm: float = Field(default=1e-3, gt=0)
    """Of stored distances within 15 mm of the surface."""

    node_error_far_mm: float = Field(default=0.02, gt=0)
    """Of stored distances farther away."""

    sign_errors: int = Field(default=0, ge=0)
    """Nodes on the wrong side of the surface."""

    surface_error_p99_spacings: float = Field(default=0.25, gt=0)
    """Of the interpolated distance on the surface, but for one point in a hundred, in units of
    the grid's spacing."""


class BakeSettings(Section):
    """How surfaces become grids."""

    spacing_mm: float = Field(default=1.5, ge=0.05, le=20)
    """Distance between grid nodes, the same on every axis."""

    margin_mm: float = Field(default=15.0, ge=15, le=200)
    """Grid around the surfaces on every side, in all phases."""

    structures: tuple[str, ...] = ()
    """Surfaces to bake beside those that a fixture needs."""

    fit_rounds: int = Field(default=12, ge=0, le=100)
    """Rounds of the least squares that bring the interpolated zero to the moving surface, between
    nodes and phases too; 0 leaves the plain interpolation."""

    samples: int = Field(default=500, ge=100, le=100_000)
    """Random points per surface and phase at which the finished field is checked."""

    bounds: Bounds = Bounds()
    """How exact the finished field must be."""

    largest_store_mb: float = Field(default=4000.0, gt=0)
    """A field that would take more on disk is refused as its stage begins."""
