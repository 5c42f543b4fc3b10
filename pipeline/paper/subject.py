"""What the experiments are made on: a baked field, and what else lies beside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import InputError
from pipeline.field.files import read_metadata
from pipeline.field.fixture import Fixture
from pipeline.field.metadata import FixturePart
from pipeline.field.reader import ForceField


@dataclass(frozen=True, slots=True)
class Subject:
    """One patient's field and images."""

    field_path: Path
    """The ``field.zarr`` folder."""

    products: Path | None
    """Folder of the patient's products; None where only a field was given."""

    study: Path | None
    """Folder of the patient's study, whose ultrasound frames are shown."""

    field: ForceField

    @property
    def structure(self) -> str:
        """The surface that a tool from outside meets: the whole heart, or the epicardium."""
        for name in ("heart", "epicardium"):
            if name in self.field.structures:
                return name
        return self.field.structures[0]

    def with_fixtures(self, fixtures: Mapping[str, Fixture]) -> ForceField:
        """The same baked distances, read by the same reader under other fixtures.

        Raises
        ------
        InputError
            When a fixture names a surface that is not in the field.
        """
        metadata = read_metadata(self.field_path)
        for name, fixture in fixtures.items():
            if fixture.structure not in metadata.structures:
                raise InputError(
                    f"{self.field_path}: fixture {name} acts from {fixture.structure!r}, which is "
                    f"not baked; there are {', '.join(metadata.structures)}"
                )
        parts = {name: FixturePart.of(name, fixture) for name, fixture in fixtures.items()}
        return ForceField(self.field_path, metadata.model_copy(update={"fixtures": parts}))


def open_subject(products: Path, study: Path | None = None) -> Subject:
    """Open a patient's products folder, or a ``field.zarr``.

    Raises
    ------
    InputError
        When there is no field, or it does not know how long a heartbeat takes.
    """
    alone = (products / "zarr.json").is_file()
    path = products if alone else products / "bake" / "field.zarr"
    if not path.is_dir():
        raise InputError(
            f"--products {products}: holds neither bake/field.zarr nor zarr.json; give a "
            "patient's products folder (make demo writes demo/products-1/patient-0001) or a field"
        )
    field = ForceField.open(path)
    if field.rr_s is None:
        raise InputError(
            f"{path}: does not say how long a heartbeat takes (rr_s), so nothing can be simulated "
            "in time; bake it from a cine, or with rr_s in phases.json"
        )
    return Subject(path, None if alone else products, study, field)
