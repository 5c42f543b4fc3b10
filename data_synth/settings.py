"""What can be asked of the phantom, and how a file that asks is read."""

from __future__ import annotations

from collections.abc import Iterator
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal, Self, get_args

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from data_synth.ecg import EcgSettings
from data_synth.errors import SynthError
from data_synth.mr import MrSettings
from data_synth.ultrasound import UltrasoundSettings

Pathology = Literal[
    "healthy",
    "dilated_cardiomyopathy",
    "hypertrophic_cardiomyopathy",
    "rv_dilation",
    "infarct",
    "enlarged_atrium",
]


NO_VALUE = (ValueError, KeyError, IndexError, AttributeError, TypeError)
"""What the library raises of values that are none, such as 2024-13-01 or !!bool maybe."""


class _Loader(yaml.SafeLoader):
    """Refuses a key that is given twice, of which YAML would keep the last and say nothing."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """The keys and values of one section."""
        lines: dict[str, int] = {}
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            name, line = str(key.value), key.start_mark.line + 1
            if name in lines:
                raise SynthError(
                    f"{self.name}: line {line}: {name} is given a second time, after line "
                    f"{lines[name]}; keep one of them"
                )
            lines[name] = line
        return super().construct_mapping(node, deep)

    def construct_number(self, node: yaml.ScalarNode) -> float:
        """A number; not one that a person writes to mean another than YAML 1.1 reads."""
        digits = node.value.lstrip("+-").replace("_", "")
        kind = node.tag.rpartition(":")[2]
        read = self.construct_yaml_int if kind == "int" else self.construct_yaml_float
        value: float = read(node)
        if ":" in digits or (kind == "int" and digits[:1] == "0" and digits[1:2].isdigit()):
            raise SynthError(
                f"{self.name}: line {node.start_mark.line + 1}: {node.value} would be read as "
                f"{value}; write it without the leading zero or colon, or, of text, in quotes"
            )
        return value


for _kind in ("int", "float"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_kind}", _Loader.construct_number)


class StudyEcgSettings(EcgSettings):
    """The ECG of a study: recorded inside the scanner, unless said otherwise."""

    magnetohydrodynamic_mv: float = Field(default=0.5, ge=0, le=5)
    """Height of the flow artefact in lead II at 1.5 T, in the record made during MR alone."""


class PhantomSettings(BaseModel):
    """One synthetic patient; the same settings give the same bytes."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    seed: int = Field(default=1, ge=0)
    """From which everything is drawn; patient k of a batch has the first one's seed + k - 1."""
    patient_id: str = Field(default="patient-0001", pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    """Name of the study's folder, and PatientID in DICOM; of one patient alone."""
    pathology: Pathology = "healthy"
    """What ails the heart; with one seed it befalls the same person."""
    spread: float = Field(default=1.0, ge=0, le=2)
    """Width of the population the heart is drawn from: 0 is the mean heart, 1 is nature's."""
    heart_rate_bpm: float = Field(default=75.0, ge=35, le=180)
    """Mean heart rate of both recordings, before couplets or early atrial beats add to it;
    systole's share of the beat follows it."""
    cine: Literal["dicom", "enhanced", "nifti"] = "dicom"
    """Classic single-frame DICOM, Enhanced multi-frame DICOM, or NIfTI."""
    long_axis: bool = True
    """Acquire 2-, 3- and 4-chamber views beside the short-axis stack."""
    cine_only: bool = False
    """Leave out ECG and ultrasound."""
    mr: MrSettings = MrSettings()
    ecg: StudyEcgSettings = StudyEcgSettings()
    ultrasound: UltrasoundSettings = UltrasoundSettings()

    @model_validator(mode="after")
    def _one_scanner(self) -> Self:
        """The ECG made during MR is made in the MR's field."""
        asked, here = self.ecg.field_strength_t, self.mr.field_strength_t
        if "field_strength_t" not in self.ecg.model_fields_set:
            ecg = self.ecg.model_copy(update={"field_strength_t": here})
            object.__setattr__(self, "ecg", ecg)
        elif asked != here:
            raise ValueError(
                f"ecg.field_strength_t = {asked} is not mr.field_strength_t = {here}; "
                "leave the first out"
            )
        return self


def read_settings(path: Path | None, changes: dict[str, Any] | None = None) -> PhantomSettings:
    """Settings from a YAML file, with ``changes`` laid over it; the defaults without a file.

    Raises
    ------
    SynthError
        When the file cannot be read, or a key or a value is wrong; all faults are listed, but
        values that do not go together only once each is right by itself.
    """
    content: Any = {}
    if path is not None:
        try:
            with path.open("rb") as stream:
                content = yaml.load(stream, _Loader)
        except FileNotFoundError as error:
            raise SynthError(f"{path}: no such file; see configs/phantoms for some") from error
        except (OSError, yaml.YAMLError, RecursionError, *NO_VALUE) as error:
            raise SynthError(f"{path}: cannot be read as YAML settings ({error})") from error
    where = str(path) if path is not None else "settings"
    # A file of comments alone asks for nothing.
    content = {} if content is None else content
    if not isinstance(content, dict):
        raise SynthError(f"{where}: needs keys and values, such as `spread: 1.0`")
    # Nor does a section of which all keys are commented out.
    sections = {
        name: {} if value is None and name in SECTIONS else value for name, value in content.items()
    }
    return check_settings({**sections, **(changes or {})}, where)


SECTIONS = ("mr", "ecg", "ultrasound")


def check_settings(content: dict[str, Any], where: str) -> PhantomSettings:
    """Settings from keys and values; ``where`` they come from is named in errors.

    Raises
    ------
    SynthError
        When a key or a value is wrong; all faults are listed, as of `read_settings`.
    """
    truths = list(_truths(content, PhantomSettings))
    faults = [f"{where}: {key}: true and false are no numbers" for key in truths]
    try:
        settings = PhantomSettings.model_validate(content)
    except ValidationError as error:
        # Taken for 1 or 0, a truth may break a limit besides.
        others = [one for one in error.errors() if _key(one) not in truths]
        faults += [_told(one, where) for one in others]
    if faults:
        raise SynthError("\n".join(faults))
    return settings


def _truths(value: Any, kind: Any, key: str = "") -> Iterator[str]:
    """Keys of numbers that were given true or false, which the library takes for 1 and 0."""
    kinds = set(_kinds(kind))
    if isinstance(value, list):
        for number, one in enumerate(value):
            yield from _truths(one, kind, f"{key}.{number}")
    elif isinstance(value, dict):
        head = f"{key}." if key else ""
        for model in (one for one in kinds if isinstance(one, type) and issubclass(one, BaseModel)):
            for name, field in model.model_fields.items():
                yield from _truths(value.get(name), field.annotation, f"{head}{name}")
    elif isinstance(value, bool) and bool not in kinds and kinds & {int, float}:
        yield key


def _kinds(kind: Any) -> Iterator[Any]:
    """A type with all that it is made of."""
    yield kind
    for part in get_args(kind):
        yield from _kinds(part)


def _instead(place: tuple[int | str, ...]) -> str:
    """What to do about an unknown key."""
    model: type[BaseModel] = PhantomSettings
    for part in place[:-1]:
        field = model.model_fields.get(str(part))
        kinds = [field.annotation, *get_args(field.annotation)] if field else []
        below = [one for one in kinds if isinstance(one, type) and issubclass(one, BaseModel)]
        if not below:
            return "check its spelling"
        model = below[0]
    near = get_close_matches(str(place[-1]), list(model.model_fields), 1)
    return f"did you mean {near[0]}?" if near else "check its spelling"


def _key(fault: Any) -> str:
    return ".".join(str(part) for part in fault["loc"]) or "(all)"


def _told(fault: Any, where: str) -> str:
    """A fault that the library found, in a line: file, key, what is wrong, what came."""
    message = fault["msg"].removeprefix("Value error, ")
    if fault["type"] == "extra_forbidden":
        message = f"unknown key; {_instead(fault['loc'])}"
    return f"{where}: {_key(fault)}: {message} (got {fault['input']!r})"
