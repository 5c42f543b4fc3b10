"""What a user may set about the surfaces."""

from __future__ import annotations

from pydantic import Field

from pipeline.validation import Section


class SurfaceSettings(Section):
    """How labels become surfaces that move."""

    edge_mm: float = Field(2.0, gt=0.5, le=10)
    """Mean edge of the triangles."""

    smoothing_voxels: float = Field(1.5, ge=0.5, le=3)
    """Width (standard deviation) of the Gaussian that takes the steps of the voxels away."""

    reference_phase: float = Field(0.0, ge=0, lt=1)
    """Phase whose surface is carried through the cycle; 0, the R peak, is end-diastole."""

    temporal_smoothing_beats: float = Field(0.03, ge=0, le=0.1)
    """Width (standard deviation) of the cyclic smoothing in time, in beats; 0 for none."""

    heart_blend_mm: float = Field(8.0, ge=0, le=16)
    """Width of the seams between chambers that the surface of the whole heart bridges smoothly."""

    decimation_error_mm: float = Field(0.0, ge=0, le=2)
    """Largest deviation, in any phase, by which flat parts may have fewer triangles; 0 for none."""
