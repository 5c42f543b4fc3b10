"""What can be asked of the simulated MR scanner."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

FIELD_STRENGTHS_T = (1.5, 3.0)
BREATH_HOLD_S = 7.0
"""Time from the start of one slice's breath-hold to that of the next."""
VOLUME_S = 180.0
"""Time that the isotropic volume takes; the navigator accepts a third of the beats or so."""


class MrSettings(BaseModel):
    """How the cine is planned and acquired."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    acquisition: Literal["stack", "volume"] = "stack"
    """A stack of short-axis slices, one breath-hold each, or one isotropic volume."""
    phases: int = Field(default=25, ge=2, le=100)
    slices: int | None = Field(default=None, ge=3, le=60)
    """Number of slices, counted from the apex; by default as many as reach the atrial roof."""
    slice_thickness_mm: float = Field(default=8.0, gt=0, le=20)
    """Full width at half height of the slice profile."""
    slice_gap_mm: float = Field(default=2.0, ge=0, le=20)
    pixel_mm: float = Field(default=1.4, ge=0.4, le=5)
    matrix: int = Field(default=192, ge=32, le=512)
    """Pixels along both sides of an image."""
    snr: float = Field(default=30.0, gt=0, le=1e9)
    """Steady-state signal of blood at the heart's centre over the noise's standard deviation in
    each channel, in the stack and the long-axis views."""
    field_strength_t: float = 1.5
    """1.5 or 3.0."""
    flip_angle_deg: float = Field(default=50.0, gt=0, le=90)
    repetition_ms: float = Field(default=3.0, gt=0, le=10)
    """TR; the echo time is half of it."""
    coil_shading: float = Field(default=0.35, ge=0, le=1)
    """Share, in the logarithm, of the receive coils' sensitivity that the image keeps: 0 for a
    scanner that corrects it away, 1 for one that does nothing about it."""
    inhomogeneity: float = Field(default=1.0, ge=0, le=3)
    """Strength of the field's error that the body itself causes; 1 is nature's, 0 none."""
    shim_error_hz: float = Field(default=0.0, ge=-1000, le=1000)
    """Centre frequency missed by this much: dark bands move into the image where the whole error
    comes near 1 / (2 TR), 167 Hz at 3 ms."""
    shim_error_hz_per_cm: float = Field(default=0.0, ge=-100, le=100)
    """Left-to-right gradient that the shim leaves."""
    inflow: float = Field(default=0.2, ge=0, le=1)
    """Share of the blood entering a slice that no pulse has touched before."""
    flow_dephasing: float = Field(default=5.0, ge=0, le=50)
    """First moment of the gradients at the echo, in radians per m/s; 5.35 is a read-out of
    20 mT/m that lasts 1 ms before the echo. Blood that swirls in valve jets goes dark by it."""
    sharpness_pixels: float = Field(default=0.45, ge=0, le=3)
    """Standard deviation of the in-plane point spread."""
    slice_edge: float = Field(default=0.15, ge=0, le=0.5)
    """Standard deviation of the slice profile's blurred edges, as a share of the thickness."""
    through_plane_samples: int = Field(default=6, ge=1, le=32)
    """Points of a voxel that are averaged, each at its own depth and place; no fewer than
    ``window_samples``."""
    window_samples: int = Field(default=3, ge=1, le=9)
    """Instants over the acquisition window of a frame (one phase step wide, at most 1/25 of the
    beat) that the points of a voxel are spread over; 1 gives still frames."""
    breath_hold_shift_mm: float = Field(default=1.5, ge=0, le=10)
    """Standard deviation of the heart's place from one slice's breath-hold to another."""
    planning_error_deg: float = Field(default=3.0, ge=0, le=30)
    """Standard deviation of a plane's turn off where it was meant to be, about each axis."""
    volume_axes: Literal["short_axis", "transverse", "sagittal", "coronal"] = "short_axis"
    """Planes of the isotropic volume: the heart's own, or the scanner's."""
    volume_voxel_mm: float = Field(default=2.0, ge=1, le=5)
    volume_snr: float = Field(default=20.0, gt=0, le=1e9)
    """Like ``snr``, in the isotropic volume."""
    volume_gating_mm: float = Field(default=3.0, ge=0, le=20)
    """Width of the breathing positions that the volume's navigator accepts and mixes."""

    @field_validator("field_strength_t")
    @classmethod
    def _field_is_known(cls, value: float) -> float:
        if value not in FIELD_STRENGTHS_T:
            raise ValueError("relaxation times are known for 1.5 and 3.0 T; give one of them")
        return value

    @property
    def slice_step_mm(self) -> float:
        """Distance from slice to slice."""
        return self.slice_thickness_mm + self.slice_gap_mm
