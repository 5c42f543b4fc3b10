"""The tables of benchmarks/segmentation_figures.py: what they say of figures that are known."""

from __future__ import annotations

import importlib
import json
import sys
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data_synth.pathology import PATHOLOGIES

FOLDER = str(Path(__file__).parents[1] / "benchmarks")
sys.path.insert(0, FOLDER)
figures = importlib.import_module("segmentation_figures")
tables = importlib.import_module("segmentation_tables")
sys.path.remove(FOLDER)


def metrics(**changes: Any) -> dict[str, Any]:
    """A patient of two phases and two slices who passes everything."""
    one = {
        "dice": [0.97, 0.96],
        "mean_surface_distance_mm": [0.5, 0.7],
        "hausdorff_95_mm": [1.5, 2.0],
        "motion_error_mm": {"normal_mean": 0.4, "tangential_mean": 1.2},
    }
    return {
        "structures": {name: deepcopy(one) for name in tables.SURFACES},
        "lv_ejection_fraction": {"found": 0.60, "truth": 0.61},
        "rv_ejection_fraction": {"found": 0.50, "truth": 0.54},
        "lv_mass_g": {"found": 104.0, "truth": 99.0},
        "slice_dice": [[0.9, 0.95], [0.92, None]],
    } | changes


def patient(name: str = "a", **changes: Any) -> Any:
    return tables.Patient(name, "healthy", 20.0, metrics(**changes), [[0.9, 0.8], [0.7, 0.6]])


def verdicts(patients: list[Any]) -> dict[str, list[str]]:
    """Requirement -> found, worst, verdict."""
    lines = tables.requirements(patients).splitlines()[2:]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {first: rest for first, *rest in cells}


def failing(patients: list[Any]) -> set[str]:
    return {name for name, row in verdicts(patients).items() if "FAIL" in row[-1]}


def test_a_good_patient_passes_everything() -> None:
    found = verdicts([patient()])
    assert {row[-1] for row in found.values()} == {"pass", "reported"}
    # 5 structures twice, 3 distances, 5 Hausdorff, 7 motions, 2 fractions, mass, everyone served.
    assert len(found) == 10 + 3 + 5 + 7 + 2 + 1 + 1
    assert found["LV mass"][:2] == ["5.0 g off on average", "+5.0 g (a); bias +5.0 g"]


@pytest.mark.parametrize(
    ("surface", "key", "value", "row"),
    [
        ("lv_endocardium", "dice", 0.949, "Dice, LV cavity, every phase, >= 0.95"),
        ("epicardium", "dice", 0.889, "Dice, LV muscle, every phase, >= 0.89"),
        ("left_atrium", "dice", 0.899, "Dice, left atrium, every phase, >= 0.9"),
        (
            "epicardium",
            "mean_surface_distance_mm",
            1.11,
            "mean distance, LV muscle, every phase, <= 1.1 mm",
        ),
        (
            "rv_endocardium",
            "mean_surface_distance_mm",
            1.51,
            "mean distance, RV cavity, every phase, <= 1.5 mm",
        ),
        (
            "right_atrium",
            "hausdorff_95_mm",
            3.6,
            "95 % Hausdorff, right atrium, every phase, <= 3.5 mm",
        ),
    ],
)
def test_one_bad_phase_fails_its_own_requirement_and_is_named(
    surface: str, key: str, value: float, row: str
) -> None:
    bad = patient("unlucky")
    # The mean over both patients still passes.
    bad.metrics["structures"][surface][key] = [0.97 if key == "dice" else 0.5, value]
    assert failing([patient(), bad]) == {row}
    share, worst, _ = verdicts([patient(), bad])[row]
    assert share == "in 75.0 % of 4"
    assert "unlucky, phase 1" in worst
    assert f"{value:.3f}" in worst


def test_a_low_mean_fails_beside_the_phases() -> None:
    bad = patient()
    bad.metrics["structures"]["rv_endocardium"]["dice"] = [0.92, 0.92]
    assert failing([bad]) == {
        "Dice, RV cavity, mean, >= 0.93",
        "Dice, RV cavity, every phase, >= 0.93",
    }


def test_wrong_motion_fails_by_its_mean() -> None:
    bad, good = patient(), patient()
    bad.metrics["structures"]["aorta"]["motion_error_mm"]["normal_mean"] = 1.5
    assert failing([bad, good]) == set()
    assert failing([bad]) == {"normal motion error, aorta, mean, <= 1 mm"}


@pytest.mark.parametrize(("wrong", "passes"), [(1, True), (2, False)])
def test_ejection_fractions_must_hold_in_nineteen_of_twenty(wrong: int, passes: bool) -> None:
    off = {"lv_ejection_fraction": {"found": 0.50, "truth": 0.55}}
    many = [patient(f"p{k}", **(off if k < wrong else {})) for k in range(20)]
    row = verdicts(many)["LV ejection fraction within 3 points in 95 %"]
    assert (row[-1] == "pass") == passes
    assert row[0].startswith(f"in {95 if wrong == 1 else 90} % of 20")
    assert "-5.00 (p0)" in row[1]


def test_what_was_not_measured_does_not_pass() -> None:
    bad = patient()
    del bad.metrics["structures"]["aorta"]["motion_error_mm"]
    bad.metrics["structures"]["left_atrium"]["dice"] = []
    assert failing([bad]) == {
        "normal motion error, aorta, mean, <= 1 mm",
        "Dice, left atrium, mean, >= 0.9",
        "Dice, left atrium, every phase, >= 0.9",
    }


def test_a_patient_whose_run_failed_is_counted_and_says_why() -> None:
    lost = tables.Patient("lost", "infarct", 11.0, failure="phase 3, slice 2: not certain enough")
    assert failing([patient(), lost]) == {"every patient is served"}
    assert "phase 3, slice 2" in " ".join(tables.patient_row(lost))
    assert len(tables.patient_row(lost)) == len(tables.patient_row(patient()))
    assert "| infarct | 0 |" in tables.groups([lost, patient()], lambda one: one.pathology, "x")
    assert figures.report([lost]) == "No patient was segmented."
    assert "### Structures" in figures.report([lost, patient()])


def test_the_row_of_a_patient_names_the_worst_structure_and_phase() -> None:
    one = patient()
    one.metrics["structures"]["aorta"]["mean_surface_distance_mm"] = [2.5, 0.1]
    one.metrics["structures"]["epicardium"]["dice"] = [0.9, 0.8]
    row = tables.patient_row(one)
    assert row[2:5] == ["0.600 / 0.610", "0.500 / 0.540", "104 / 99"]
    assert row[5:7] == ["0.8 (LV muscle, phase 1)", "2.5 (aorta, phase 0)"]


def test_calibration_counts_the_slices_below_each_bound() -> None:
    """Half the slices are sure and right, half unsure and wrong; one is not known."""
    sure = [[0.97] * 10, [0.65] * 10]
    good = [[0.96] * 10, [0.5] * 9 + [None]]
    one = tables.Patient("a", "healthy", 20.0, metrics(slice_dice=good), sure)
    text = tables.calibration([one])
    assert "| below 0.6 | 0 | - | - |" in text
    assert "| below 0.7 | 9 | 0.500 | 100 % |" in text
    assert f"| all | 19 | {(9.6 + 4.5) / 19:.3f} | 47 % |" in text
    assert "Of the 9 slices with Dice < 0.8, confidence is below 0.6: 0 %" in text
    assert "below 0.6: 0 %; below 0.7: 100 %; below 0.75: 100 %" in text
    assert "Rank correlation of confidence and Dice: 1.00" in text


def test_the_worst_slices_are_named_with_their_confidence() -> None:
    good = [[0.9] * 20, [0.95] * 20]
    good[1][7], good[0][3] = 0.1, 0.2
    sure = [[0.9] * 20, [0.99] * 20]
    one = tables.Patient("a", "healthy", 20.0, metrics(slice_dice=good), sure)
    rows = tables.worst_slices([one]).splitlines()[2:]
    assert rows[:2] == ["| a | 1 | 7 | 0.100 | 0.990 |", "| a | 0 | 3 | 0.200 | 0.900 |"]
    assert len(rows) == 12


def test_confidence_and_truth_of_different_shape_are_not_paired_up() -> None:
    one = tables.Patient("a", "healthy", 20.0, metrics(), [[0.9, 0.8]])
    with pytest.raises(ValueError, match="zip"):
        tables.calibration([one])


def orders(out: Path, count: int) -> list[Any]:
    return [figures.Order(out, number, 701, 2, False) for number in range(count)]


def test_twenty_patients_have_every_pathology_and_signals_from_end_to_end(tmp_path: Path) -> None:
    settings = [order.settings() for order in orders(tmp_path, 20)]
    assert {one.pathology for one in settings} == set(PATHOLOGIES)
    assert len({one.seed for one in settings}) == 20
    ratios = np.sort([one.mr.snr for one in settings])
    assert (ratios.min(), ratios.max()) == pytest.approx((10, 40), abs=3)
    # Multiples of the golden section leave no gap wider than 1 / golden^2 over the count
    # (three-distance theorem), here 2.62 * 30 / 20.
    assert np.diff(ratios).max() < 2.7 * 30 / 20
    assert settings[:5] == [order.settings() for order in orders(tmp_path, 5)]


def test_a_study_is_drawn_once_unless_other_settings_are_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Path] = []

    def write(folder: Path, settings: Any, overwrite: bool) -> None:
        assert overwrite or not folder.exists()
        made.append(folder)
        (folder / "truth").mkdir(parents=True, exist_ok=True)
        content = {"settings": settings.model_dump(mode="json")}
        (folder / "truth" / "truth.json").write_text(json.dumps(content))

    monkeypatch.setattr(figures, "write_study", write)
    order = figures.Order(tmp_path, 4, 701, 2, False)
    assert figures.draw(order) == figures.draw(order) == tmp_path / "studies" / "705-infarct"
    assert len(made) == 1
    figures.draw(figures.Order(tmp_path, 4, 701, 3, False))
    assert len(made) == 2
    figures.draw(figures.Order(tmp_path, 4, 701, 3, True))
    assert len(made) == 3


def test_the_pipelines_settings_are_the_users_over_the_quick_ones(tmp_path: Path) -> None:
    from pipeline.config import read_settings

    figures.write_settings(tmp_path, None)
    assert list(read_settings(tmp_path / "settings.yaml").fixtures) == ["epicardium_guidance"]
    own = tmp_path / "own.yaml"
    own.write_text("segment: {min_confidence: 0.0}\n")
    figures.write_settings(tmp_path, own)
    read = read_settings(tmp_path / "settings.yaml")
    assert (read.segment.min_confidence, len(read.fixtures)) == (0.0, 1)
