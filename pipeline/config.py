"""The settings of a run: one section a stage, defaults in code, YAML only overrides."""

from __future__ import annotations

from pathlib import Path
from typing import Self

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from pipeline.errors import InputError
from pipeline.field.fixture import DEFAULT_FIXTURES, BakeSettings, Fixture
from pipeline.imaging.settings import SegmentSettings
from pipeline.registration.settings import RegisterSettings
from pipeline.study import describe_validation
from pipeline.surface.settings import SurfaceSettings


class Settings(BaseModel):
    """Everything that a user can set."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    segment: SegmentSettings = SegmentSettings()
    surface: SurfaceSettings = SurfaceSettings()
    register_: RegisterSettings = Field(RegisterSettings(), alias="register")
    bake: BakeSettings = BakeSettings()
    fixtures: dict[str, Fixture] = DEFAULT_FIXTURES
    """Fixtures by name; giving any replaces the default set."""

    @model_validator(mode="after")
    def _has_a_fixture(self) -> Self:
        if not self.fixtures:
            raise ValueError("at least one fixture is needed; leave the key out for the default")
        return self


def read_settings(path: Path | None) -> Settings:
    """Read a YAML file over the defaults; without one, the defaults.

    Raises
    ------
    InputError
        When the file cannot be read, or a key is unknown or its value wrong: all of them named.
    """
    if path is None:
        return Settings()
    try:
        content = yaml.safe_load(path.read_text()) or {}
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError(f"{path}: cannot be read as YAML ({error})") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: needs sections such as `bake:`, got {content!r}")
    try:
        return Settings.model_validate(content)
    except ValidationError as error:
        raise InputError(describe_validation(error, str(path))) from error
