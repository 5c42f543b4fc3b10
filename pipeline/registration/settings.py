"""What a user may choose about registration."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from pipeline.validation import Section


class RegisterSettings(Section):
    """How tracked ultrasound is brought to the MR model."""

    min_frames: int = Field(10, ge=3)
    """Fewer frames than this are refused: they do not fix six degrees of freedom."""
    max_frames: int = Field(60, ge=10)
    """More frames than this are thinned evenly while the pose is sought; all are judged at it."""
    sample_spacing_mm: float = Field(4.0, ge=0.5, le=10)
    """Distance between the pixels that are compared, in the plane of a frame."""
    smoothing_mm: float = Field(1.5, gt=0, le=10)
    """Standard deviation of the smoothing that takes out speckle; the model is blurred alike."""
    reading: Literal["network", "grey"] = "network"
    """What is compared with the model: the blood that a trained network finds in the pictures, or
    their grey values as they are."""
    trend_mm: float = Field(20.0, gt=0, le=200)
    """What changes over longer ways than this, across a frame, is taken for gain, shadow and haze,
    and is not looked at; three or more sample spacings."""
    grid_mm: float = Field(2.0, ge=0.5, le=5)
    """Node spacing of the grid on which the model's tissues are drawn."""
    capture_mm: float = Field(20.0, gt=0, le=60)
    """How far off the start may be: wider makes the search sparser. A solution half as far away
    again is refused."""
    capture_deg: float = Field(20.0, gt=0, le=60)
    """The same for rotation."""
    candidates: int = Field(400, ge=1, le=100_000)
    """How many poses around the start are looked at."""
    candidates_anywhere: int = Field(12_000, ge=1, le=1_000_000)
    """How many are looked at where there is no start: the heart in the middle of what the sweeps
    cover, give or take 2 capture_mm, turned in any way."""
    starts: int = Field(12, ge=1, le=1000)
    """How many of the most promising poses are followed to their own optimum; without a start,
    eight times as many."""
    min_confidence: float = Field(1.6, gt=0)
    """How many times as well as frames in the wrong place (mirrored, upside down, or in reverse
    order) the frames must agree with the model; below, the registration is not trusted."""
    model_error_mm: float = Field(0.5, ge=0, le=10)
    """Standard deviation of what all frames share, such as the surfaces' error: along each axis in
    shift, and about each axis at the heart's own radius. No spread between frames shows it."""
    good_tre_mm: float = Field(1.6, gt=0)
    """Expected error over the heart up to which a trusted registration is called good."""
    worst_tre_mm: float = Field(4.0, gt=0)
    """Expected error over the heart beyond which it is called failed."""
    breath: Literal["hold", "free"] = "hold"
    """Whether each sweep was recorded in a breath-hold, or in free breathing: then every frame's
    own displacement along the breathing axis is found, and the pose is that of the heart at the
    end of expiration."""
    calibration: Literal["fixed", "per_sweep"] = "fixed"
    """Whether each sweep's image calibration is right, or a small rigid correction of it is found
    together with the pose."""
    calibration_sd_mm: float = Field(2.0, gt=0, le=20)
    """Standard deviation, along each axis, of how far a calibration may be off in the middle of
    the picture, with ``calibration: per_sweep``."""
    calibration_sd_deg: float = Field(2.0, gt=0, le=20)
    """The same for rotation, about each axis."""
    accept: Literal["good", "doubtful"] = "doubtful"
    """The worst verdict that is let pass."""
    clock_offset: Literal["apply", "measure", "ignore"] = "apply"
    """What is done about an offset between the clocks of ultrasound and ECG: estimated from the
    frames and taken off their times where it is beyond doubt, estimated only, or not looked at."""
    on_failure: Literal["stop", "mr_frame"] = "stop"
    """What happens to a study that cannot be registered: the stage fails, or the field is made in
    the frame of the MR."""
    seed: int = Field(0, ge=0)
    """Of the poses that are tried around the start."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.max_frames < self.min_frames:
            raise ValueError(
                f"max_frames = {self.max_frames} is under min_frames = {self.min_frames}; "
                "raise max_frames or lower min_frames"
            )
        if self.trend_mm < 3 * self.sample_spacing_mm:
            raise ValueError(
                f"trend_mm = {self.trend_mm} is under three times sample_spacing_mm = "
                f"{self.sample_spacing_mm}: little would be left to compare; raise trend_mm"
            )
        if self.worst_tre_mm < self.good_tre_mm:
            raise ValueError(
                f"worst_tre_mm = {self.worst_tre_mm} is under good_tre_mm = {self.good_tre_mm}; "
                "raise worst_tre_mm or lower good_tre_mm"
            )
        return self
