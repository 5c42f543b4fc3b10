"""What can be asked of the ultrasound examination."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from data_synth.breathing import Breathing


class UltrasoundSettings(BaseModel):
    """The scanner's preset, the operator's hand and the tracker's faults.

    Where None is the default, the probe's own value is taken.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    probe: Literal["combined", "surface", "transoesophageal", "intracardiac", "epicardial"] = (
        "combined"
    )
    """``surface``: on the chest, from the apex, beside the breastbone and below the ribs;
    ``transoesophageal``: from behind the left atrium; ``intracardiac``: a catheter in the right
    atrium and ventricle; ``epicardial``: on the open heart, through a pad; ``combined``: from the
    apex, from the oesophagus, beside the breastbone."""
    sweeps: int = Field(default=2, ge=1, le=3)
    """How many of the three windows are used, in that order."""
    frames: int = Field(default=40, ge=1, le=2000)
    """Of each sweep."""
    frame_rate_hz: float = Field(default=20.0, gt=0, le=200)
    depth_mm: float | None = Field(default=None, ge=40, le=250)
    """Range at which the picture ends."""
    angle_deg: float | None = Field(default=None, ge=20, le=120)
    """Of the fan, from its first beam to its last."""
    pixel_mm: float | None = Field(default=None, ge=0.1, le=3)
    """Of the picture, square."""
    beams: int | None = Field(default=None, ge=16, le=512)
    """Of each picture, evenly over the fan."""
    frequency_mhz: float | None = Field(default=None, ge=1, le=15)
    gain_db: float = Field(default=0.0, ge=-30, le=30)
    dynamic_range_db: float = Field(default=58.0, ge=30, le=90)
    """From black to white in the picture."""
    compensation_db_per_cm: float | None = Field(default=None, ge=0, le=12)
    """Time-gain compensation."""
    slice_mm: float | None = Field(default=None, ge=0, le=5)
    """Standard deviation of the beam across the picture's plane, at its focus: what makes walls
    fuzzy."""
    standoff_mm: float | None = Field(default=None, ge=0, le=30)
    """Thickness of the pad or wall between tip and heart; on the skin it is the chest's own."""
    turn_deg: float | None = Field(default=None, ge=0, le=180)
    """How far the fan is turned during a sweep."""
    hand_mm: float = Field(default=2.0, ge=0, le=20)
    """Swing of the hand along each axis."""
    hand_deg: float = Field(default=2.0, ge=0, le=20)
    """Swing of the hand about each axis."""
    breath: Literal["hold", "free"] = "hold"
    """Each sweep in a breath-hold of its own, or all in quiet breathing."""
    breathing: Breathing = Breathing(hold_sd_mm=0.5)
    dropout: float = Field(default=0.6, ge=0, le=1)
    """Chance of each of two wedges of poor contact in a sweep."""
    lifted: float = Field(default=0.0, ge=0, le=1)
    """Chance that the probe leaves the body for a while during a sweep."""
    lifted_frames: int = Field(default=5, ge=1, le=500)
    """How many frames show nothing then."""
    tracker_mm: float = Field(default=0.2, ge=0, le=20)
    """Standard deviation of a recorded position along each axis."""
    tracker_deg: float = Field(default=0.1, ge=0, le=20)
    """Standard deviation of a recorded rotation about each axis."""
    outliers: float = Field(default=0.0, ge=0, le=0.5)
    """Chance that a recorded pose is far off."""
    outlier_mm: float = Field(default=20.0, ge=0, le=300)
    """How far off it is, in a random direction."""
    outlier_deg: float = Field(default=10.0, ge=0, le=180)
    untracked: float = Field(default=0.0, ge=0, le=1)
    """Chance that the tracker loses sight of the marker for a while during a sweep."""
    untracked_frames: int = Field(default=5, ge=1, le=500)
    """How many frames carry the status INVALID, and the last known pose, then."""
    calibration_mm: float = Field(default=0.3, ge=0, le=20)
    """How far the written ImageToProbe is off at the tip, in a random direction."""
    calibration_deg: float = Field(default=0.2, ge=0, le=20)
    """How far it is turned about the tip."""
    jitter_ms: float = Field(default=1.0, ge=0, le=50)
    """Standard deviation of a time stamp; none is off by more than a quarter of a period."""
    clock_offset_s: float = Field(default=0.0, ge=-60, le=60)
    """How far the ultrasound's clock is ahead of the ECG's."""
