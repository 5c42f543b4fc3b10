"""The settings of a run: one section a stage, defaults in code, YAML only overrides."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path

from pydantic import Field, ValidationError, field_validator

from pipeline.errors import InputError
from pipeline.field.fixture import DEFAULT_FIXTURES, BakeSettings, Fixture
from pipeline.field.metadata import require_name
from pipeline.imaging.settings import SegmentSettings
from pipeline.registration.settings import RegisterSettings
from pipeline.surface.settings import SurfaceSettings
from pipeline.validation import Section, describe_validation
from pipeline.yaml_files import read_yaml

WIDTHS_MM = (0.1, 1000.0)
"""Of a potential: below, a force rises within what its steps are measured over, and within the
error of the surface itself; above, there is none anywhere near a heart."""

FORCES_N = (1e-3, 1000.0)


class Settings(Section):
    """Everything that a user can set."""

    segment: SegmentSettings = SegmentSettings()
    surface: SurfaceSettings = SurfaceSettings()
    register_: RegisterSettings = Field(RegisterSettings(), alias="register")
    bake: BakeSettings = BakeSettings()
    fixtures: dict[str, Fixture] = DEFAULT_FIXTURES
    """Fixtures by name; giving any replaces the default set."""

    @field_validator("fixtures")
    @classmethod
    def _has_a_fixture(cls, fixtures: dict[str, Fixture]) -> dict[str, Fixture]:
        if not fixtures:
            raise ValueError("at least one fixture is needed; leave the key out for the default")
        return fixtures

    @field_validator("fixtures")
    @classmethod
    def _can_be_felt(cls, fixtures: dict[str, Fixture]) -> dict[str, Fixture]:
        """A store may hold what other hands and hearts made use of; a new one may not."""
        for name, one in fixtures.items():
            for what, value, (least, most) in (
                ("delta_mm", one.resolved_delta_mm, WIDTHS_MM),
                ("f_max_n", one.f_max_n, FORCES_N),
            ):
                if not least <= value <= most:
                    raise ValueError(
                        f"{name}: {what} is {value:.3g}, given or by gamma_mm; needs "
                        f"{least:g} to {most:g}"
                    )
        return fixtures

    @field_validator("fixtures")
    @classmethod
    def _can_be_stored(cls, fixtures: dict[str, Fixture]) -> dict[str, Fixture]:
        """Each gets a folder of its name, which the bake stage, minutes later, would refuse."""
        for name in fixtures:
            try:
                require_name(name, "fixture")
            except InputError as error:
                raise ValueError(str(error)) from error
        return fixtures


def read_settings(path: Path | None, *, own_surfaces: bool = False) -> Settings:
    """Read a YAML file over the defaults; without one, the defaults.

    Parameters
    ----------
    own_surfaces
        The surfaces are of one's own: fixtures may name structures that the pipeline never makes.

    Raises
    ------
    InputError
        When the file cannot be read, a key is unknown or its value wrong (all of them named), or
        a structure is none that the pipeline makes.
    """
    if path is None:
        return Settings()
    settings = _settings(path)
    if not own_surfaces:
        _require_known_structures(settings, path)
    return settings


def _settings(path: Path) -> Settings:
    if not path.exists():
        raise InputError(
            f"{path}: no such file; copy configs/default.yaml and keep what you change"
        )
    content = read_yaml(path)
    if content is None:
        return Settings()
    if not isinstance(content, dict):
        raise InputError(f"{path}: needs sections such as `bake:`, got {content!r}")
    # Where all keys of a section are commented out, all of them are the default.
    sections = {name: {} if value is None else value for name, value in content.items()}
    try:
        return Settings.model_validate(sections)
    except ValidationError as error:
        # Only to name the place of a key that belongs there.
        from pipeline.study import Described

        other = ("the study's study.yaml", Described)
        raise InputError(describe_validation(error, str(path), Settings, other)) from error


def _require_known_structures(settings: Settings, path: Path) -> None:
    """Refuse a name that only the bake stage, minutes later, would find to be missing."""
    # The surface stage's libraries are heavy, and settings are read for every command.
    from pipeline.surface.extraction import STRUCTURES

    named = {f"fixtures.{name}.structure": one.structure for name, one in settings.fixtures.items()}
    named |= {f"bake.structures.{k}": name for k, name in enumerate(settings.bake.structures)}
    lines = []
    for key, name in named.items():
        if name not in STRUCTURES:
            near = get_close_matches(name, STRUCTURES, 1)
            meant = f"did you mean {near[0]}? " if near else ""
            lines.append(
                f"{path}: {key}: no structure {name!r}; {meant}the pipeline makes "
                + ", ".join(STRUCTURES)
            )
    if lines:
        raise InputError("\n".join(lines))
