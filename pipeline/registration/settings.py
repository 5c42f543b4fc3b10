"""What a user may choose about registration."""

from __future__ import annotations

from typing import Self

from pydantic import BaseModel, ConfigDict, Field, model_validator


class RegisterSettings(BaseModel):
    """How tracked ultrasound is brought to the MR model."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    min_frames: int = Field(10, ge=3)
    """Fewer frames than this are refused: they do not fix six degrees of freedom."""
    max_frames: int = Field(60, ge=10)
    """More frames than this are thinned evenly while the pose is sought; all are judged at it."""
    sample_spacing_mm: float = Field(4.0, gt=0, le=10)
    """Distance between the pixels that are compared, in the plane of a frame."""
    smoothing_mm: float = Field(1.5, gt=0, le=10)
    """Standard deviation of the smoothing that takes out speckle; the model is blurred alike."""
    grid_mm: float = Field(2.0, gt=0, le=5)
    """Node spacing of the grid on which the model's tissues are drawn."""
    capture_mm: float = Field(20.0, gt=0, le=60)
    """How far off the start may be: wider makes the search sparser. A solution half as far away
    again is refused."""
    capture_deg: float = Field(20.0, gt=0, le=60)
    """The same for rotation."""
    starts: int = Field(4, ge=1, le=100)
    """How many of the most promising poses around the start are followed to their own optimum."""
    min_confidence: float = Field(1.6, gt=0)
    """How many times as well as frames in the wrong place (mirrored, or in reverse order) the
    frames must agree with the model; below, the registration is not trusted."""
    seed: int = 0
    """Of the poses that are tried around the start."""

    @model_validator(mode="after")
    def _frames_in_order(self) -> Self:
        if self.max_frames < self.min_frames:
            raise ValueError(
                f"max_frames = {self.max_frames} is under min_frames = {self.min_frames}; "
                "raise max_frames or lower min_frames"
            )
        return self
