"""What can be asked of the phantom, and how a file that asks is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from data_synth.ecg import EcgSettings
from data_synth.errors import SynthError
from data_synth.mr import MrSettings
from data_synth.ultrasound import UltrasoundSettings


class PhantomSettings(BaseModel):
    """One synthetic patient; the same settings give the same bytes."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    seed: int = Field(default=1, ge=0)
    patient_id: str = Field(default="patient-0001", pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    spread: float = Field(default=1.0, ge=0, le=2)
    """Width of the population the heart is drawn from: 0 is the mean heart, 1 is nature's."""
    heart_rate_bpm: float = Field(default=75.0, ge=35, le=180)
    cine: Literal["dicom", "nifti"] = "dicom"
    cine_only: bool = False
    """Leave out ECG and ultrasound."""
    mr: MrSettings = MrSettings()
    ecg: EcgSettings = EcgSettings(magnetohydrodynamic_mv=0.5)
    ultrasound: UltrasoundSettings = UltrasoundSettings()


def read_settings(path: Path | None, changes: dict[str, Any] | None = None) -> PhantomSettings:
    """Settings from a YAML file, with ``changes`` laid over it; the defaults without a file.

    Raises
    ------
    SynthError
        When the file cannot be read, or a key or a value is wrong; all faults are listed.
    """
    content: Any = {}
    if path is not None:
        try:
            content = yaml.safe_load(path.read_text()) or {}
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise SynthError(f"{path}: cannot be read as YAML settings ({error})") from error
    where = str(path) if path is not None else "settings"
    if not isinstance(content, dict):
        raise SynthError(f"{where}: needs keys and values, such as `spread: 1.0`")
    try:
        return PhantomSettings.model_validate({**content, **(changes or {})})
    except ValidationError as error:
        raise SynthError(describe(error, where)) from error


def describe(error: ValidationError, where: str) -> str:
    """Every fault on a line of its own: file, key, what is wrong, what came."""
    lines = []
    for one in error.errors():
        key = ".".join(str(part) for part in one["loc"]) or "(all)"
        message = one["msg"].removeprefix("Value error, ")
        if one["type"] == "extra_forbidden":
            message = "unknown key; check its spelling"
        lines.append(f"{where}: {key}: {message} (got {one['input']!r})")
    return "\n".join(lines)
