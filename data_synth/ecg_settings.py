"""What can be asked of the simulated electrocardiogram."""

from __future__ import annotations

from typing import Literal, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, model_validator

from data_synth.ecg_waves import Focus, Lead
from data_synth.rhythm import RhythmSettings

ALL_LEADS: tuple[Lead, ...] = get_args(Lead)
LEADS: tuple[Lead, ...] = ("I", "II", "V1")
"""What is recorded unless other leads are asked for."""


class LostLead(BaseModel):
    """A stretch in which a lead shows nothing of the heart."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    lead: Literal[Lead, "all"]
    start_s: float = Field(ge=0)
    end_s: float = Field(gt=0)
    kind: Literal["flat", "rail"] = "flat"
    """Flat: 0 mV, as of a monitor that noticed. Rail: the end of the amplifier's range; it comes
    back over about a second, which is no longer part of the stretch."""

    @model_validator(mode="after")
    def _forward(self) -> Self:
        if not self.start_s < self.end_s:
            raise ValueError(f"start_s = {self.start_s} is not before end_s = {self.end_s}")
        return self


class EcgSettings(RhythmSettings):
    """How regular the heart beats, what is recorded and how clean the recording is.

    Heights of disturbances are those in limb and chest leads; augmented leads show 0.87 of them.
    """

    leads: tuple[Lead, ...] = Field(default=LEADS, min_length=1)
    qtc_ms: float = Field(default=410.0, ge=300, le=600)
    """QT interval at 60 beats a minute."""
    qt_correction: Literal["fridericia", "bazett"] = "fridericia"
    """How QT follows the RR interval, with its cubic or its square root."""
    ectopic_focus: Focus = "right_ventricle"
    """Where early ventricular beats start, which decides their shape."""
    respiratory_modulation: float = Field(default=0.06, ge=0, le=0.3)
    """Swing with the breath of the length of the heart's vector, as a fraction; it turns a little
    besides, so that R in lead II swings by 1.5 times this, in aVF by 1.9 and in III by 2.9 times,
    in I by a third."""
    fibrillation_wave_mv: float = Field(default=0.1, ge=0, le=0.5)
    """Height of the f waves in V1 during atrial fibrillation."""
    fibrillation_wave_hz: float = Field(default=6.0, ge=4, le=9)
    baseline_mv: float = Field(default=0.12, ge=0, le=10)
    mains_mv: float = Field(default=0.02, ge=0, le=5)
    mains_hz: float = Field(default=50.0, ge=10, le=100)
    """Harmonics are added; what lies at half the sampling rate or above is left out."""
    muscle_mv: float = Field(default=0.015, ge=0, le=5)
    muscle_snr_db: float | None = Field(default=None, ge=-20, le=60)
    """Power of the heart's signal in lead II over that of muscle noise; in place of `muscle_mv`."""
    motion_per_minute: float = Field(default=0.0, ge=0, le=60)
    """How often an electrode is tugged."""
    motion_mv: float = Field(default=1.5, ge=0, le=10)
    """Size of the largest jump of a tugged electrode."""
    magnetohydrodynamic_mv: float = Field(default=0.0, ge=0, le=5)
    """Height of the flow artefact in lead II at 1.5 T, about 0.5; 0 off the scanner.
    In a study it shows in the record made during MR alone."""
    field_strength_t: float = Field(default=1.5, gt=0, le=11)
    """The flow artefact grows in proportion."""
    gradient_mv: float = Field(default=0.0, ge=0, le=5)
    """Height in lead II of what switched gradients induce."""
    gradient_segment_s: float = Field(default=0.038, ge=0.005, le=0.2)
    """Time in which the scanner plays the lines of one picture of a beat."""
    lost: tuple[LostLead, ...] = ()
    """Leads that come off, as `[{lead: II, start_s: 5, end_s: 8, kind: flat}]`. `lead: all` is all
    of them; `kind` is flat (0 mV; the default) or rail (the end of the amplifier's range). In a
    study they come off in both recordings, so before the end of the shorter."""
    lost_per_minute: float = Field(default=0.0, ge=0, le=20)
    """How often, besides, a lead comes off at random."""
    lost_mean_s: float = Field(default=3.0, ge=0.2, le=30)
    """Mean duration of those losses."""
    range_mv: float = Field(default=10.0, ge=0.5, le=32)
    """The amplifier clips at plus and minus this voltage."""

    @model_validator(mode="after")
    def _leads_fit(self) -> Self:
        if len(set(self.leads)) < len(self.leads):
            raise ValueError(f"leads = {list(self.leads)} names one twice; name each once")
        for one in self.lost:
            if one.lead not in ("all", *self.leads):
                raise ValueError(f"lost: lead {one.lead} is not recorded; leads = {self.leads}")
        return self

    def away_from_scanner(self) -> EcgSettings:
        """The same heart and electrodes without what the scanner adds."""
        return self.model_copy(update={"magnetohydrodynamic_mv": 0.0, "gradient_mv": 0.0})
