"""Which studies a batch runs: what cannot be run is known before the first one begins."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pipeline.errors import InputError
from pipeline.publish import patients_in, standing_products
from pipeline.study import how_to_name_cine, is_study, open_study, studies_in
from pipeline.study_files import cannot_be_entered, is_litter

LOGS = "logs"
"""Where a batch writes beside the patients' folders, but for its table."""

_TABLES = re.compile(r"batch(-\d+-of-\d+)?\.csv")

MOST_NAMED = 5


@dataclass(frozen=True, slots=True)
class Shard:
    """One of several parts of a batch that run apart, on as many machines."""

    number: int
    """From 1."""

    of: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Read what a user writes: 2/4 is the second of four.

        Raises
        ------
        InputError
            When it is no such pair.
        """
        pair = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
        number, of = map(int, pair.groups()) if pair else (0, 0)
        if not 1 <= number <= of:
            raise InputError(
                f"--shard {text}: I/N is needed, I from 1 to N; 2/4 is the second of 4"
            )
        return cls(number, of)

    @property
    def name(self) -> str:
        """What tells it from the others; empty of a batch that is whole."""
        return f"{self.number}-of-{self.of}" if self.of > 1 else ""

    @property
    def table(self) -> str:
        """The file in which its studies are told."""
        return f"batch-{self.name}.csv" if self.name else "batch.csv"

    def part(self, plans: Sequence[Plan]) -> Sequence[Plan]:
        """Its share of all plans: every ``of``-th."""
        return plans[self.number - 1 :: self.of]


@dataclass(frozen=True, slots=True)
class Plan:
    """A folder among the studies, and what is to be done with it."""

    name: str
    folder: Path
    """The study; of a folder that holds exactly one study, that one."""

    patient_id: str = ""
    """Empty where the study cannot be opened; its own run says why."""

    refused: str = ""
    """Why it is not run; empty where it is."""

    is_study: bool = True


def plan_batch(studies: Path, out: Path) -> list[Plan]:
    """What is to be done with each folder in ``studies``, by name.

    Folders that are no study are told too, but for hidden ones and where ``out`` lies.

    Raises
    ------
    InputError
        When ``studies`` is missing or holds no study, or products in ``out`` would lie in a study
        or be taken for one.
    """
    if not studies.is_dir():
        raise InputError(f"{studies}: no such folder; give the folder that holds the studies")
    try:
        beside = sorted(studies.iterdir())
        folders = [path for path in beside if path.is_dir() or _is_dead(path)]
    except OSError as error:
        raise InputError(cannot_be_entered(error)) from error
    direct = {one for one in folders if not one.name.startswith(".") and _is_study(one)}
    here = _real(out)
    looked_at = [
        one
        for one in folders
        if one in direct or not (one.name.startswith(".") or _real(one) == here)
    ]
    plans = [_plan(one, one in direct) for one in looked_at]
    plans = [one for one in plans if one.is_study or not here.is_relative_to(_real(one.folder))]
    there = [one for one in plans if not _is_dead(one.folder)]
    if not any(one.is_study for one in there):
        if is_study(studies):
            raise InputError(
                f"{studies}: is a study itself; give the folder that holds it, or run it alone: "
                f"beatfield run {studies} --out {out}"
            )
        first = there[0].folder if there else studies
        raise InputError(
            f"{studies}: holds no study (folders with cine/ or study.yaml); for {first}: "
            f"{how_to_name_cine(first)}"
        )
    _require_out_elsewhere(studies, out, plans)
    return _without_clashes(plans)


def _real(path: Path) -> Path:
    """The place that a path leads to; of links that lead in a circle, some place."""
    return Path(os.path.realpath(path))


def _is_study(folder: Path) -> bool:
    """Whether a folder is plainly a study; one that is closed costs itself alone."""
    try:
        return is_study(folder)
    except OSError:
        return False


def _is_dead(path: Path) -> bool:
    return path.is_symlink() and not path.exists()


def _plan(path: Path, direct: bool) -> Plan:
    if _is_dead(path):
        to = path.readlink()
        said = f"{path}: is a link to {to}, where nothing is; mount it, or take the link out"
        return Plan(path.name, path, refused=said)
    try:
        inside = [path] if direct else studies_in(path)
    except OSError as error:
        return Plan(path.name, path, refused=cannot_be_entered(error))
    if not inside:
        return Plan(path.name, path, is_study=False)
    folder = inside[0] if len(inside) == 1 else path
    try:
        return Plan(path.name, folder, open_study(folder).patient_id)
    except InputError:
        return Plan(path.name, folder)
    except OSError as error:
        return Plan(path.name, folder, refused=cannot_be_entered(error))


def _require_out_elsewhere(studies: Path, out: Path, plans: Sequence[Plan]) -> None:
    here = _real(out)
    if here == _real(studies):
        raise InputError(
            f"{out}: holds the studies, and products would be taken for some; choose another --out"
        )
    for plan in plans:
        if plan.is_study and here.is_relative_to(_real(plan.folder)):
            raise InputError(f"{out}: lies inside the study {plan.folder}; choose another --out")


def _without_clashes(plans: Sequence[Plan]) -> list[Plan]:
    """Refuse studies that would write into one folder, or where the batch itself writes.

    Capitals do not tell folders apart everywhere.
    """
    checked = []
    for plan in plans:
        name = plan.patient_id.casefold()
        same = [one for one in plans if name and one.patient_id.casefold() == name]
        others = [str(one.folder) for one in same if one is not plan]
        refused = plan.refused
        if others:
            refused = (
                f"{plan.folder}: has the patient id {plan.patient_id!r} of {_named(others)}; give "
                "each study its own patient_id in study.yaml"
            )
        elif name == LOGS or _TABLES.fullmatch(name):
            refused = (
                f"{plan.folder}: a batch writes {name} of its own beside the patients; give a "
                f"patient_id other than {plan.patient_id!r} in study.yaml"
            )
        checked.append(replace(plan, refused=refused))
    return checked


def notes_on(studies: Path, out: Path, plans: Sequence[Plan]) -> list[str]:
    """What lies in either folder and belongs to no study of the batch, a sentence each."""
    try:
        beside = [path for path in sorted(studies.iterdir()) if not path.is_dir()]
    except OSError:
        # Gone while the studies ran; what they left is told all the same.
        beside = []
    loose = [one.name for one in beside if not one.is_symlink() and not is_litter(one.name)]
    known = {one.patient_id or one.name for one in plans if one.is_study}
    known |= {products.name for one in plans if (products := products_of(out, one))}
    others = [one.name for one in patients_in(out) if one.name not in known]
    told = (
        (loose, f"{studies}: files beside the studies were not looked at"),
        (others, f"{out}: also holds products that are of no study of this batch"),
    )
    return [f"{what}: {_named(names)}" for names, what in told if names]


def _named(names: Sequence[str]) -> str:
    more = len(names) - MOST_NAMED
    return ", ".join(names[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def products_of(out: Path, plan: Plan) -> Path | None:
    """The patient's folder of products, if there is one.

    Of a study that cannot be opened it is the one whose ``run.json`` names the study.
    """
    if plan.patient_id:
        known = out / plan.patient_id
        return known if known.is_dir() else None
    return next(iter(standing_products(plan.folder, out)), None)
