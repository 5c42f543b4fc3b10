"""The examples on the page of input formats are what the readers read."""

from __future__ import annotations

import json
import re
from pathlib import Path

import nibabel
import numpy as np
import pytest
import yaml

from pipeline.geometry import Float
from pipeline.study import CineFiles, EcgFiles, Study, UltrasoundFiles, open_study

PAGE = Path(__file__).parent.parent / "docs" / "study.md"


def shown(language: str) -> list[str]:
    """The examples of one language on the page of formats."""
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(), re.DOTALL)


def test_the_page_shows_every_key_of_study_yaml(tmp_path: Path) -> None:
    (example,) = shown("yaml")
    given = yaml.safe_load(example)
    assert set(given) == set(Study.model_fields) - {"folder"}
    sections = {"cine": CineFiles, "ecg": EcgFiles, "us": UltrasoundFiles}
    for name, model in sections.items():
        assert set(given[name]) == set(model.model_fields)
    files = ["mr/cine.nii.gz", "mr/beat.json", "signals/scanner.csv", "signals/lab.hea"]
    for name in [*files, "us/left.mha", "us/right.mha"]:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "study.yaml").write_text(example)
    study = open_study(tmp_path)
    assert study.cine.path == tmp_path / "mr" / "cine.nii.gz"
    assert study.ecg.us == tmp_path / "signals" / "lab"


def test_the_pages_timing_file_is_read(tmp_path: Path) -> None:
    from pipeline.imaging.nifti import read_nifti_cine

    timing, _ = shown("json")
    image = nibabel.Nifti1Image(np.ones((5, 6, 3, 4), np.int16), np.diag([1, 1, 8, 1.0]))
    nibabel.save(image, tmp_path / "cine.nii.gz")
    (tmp_path / "timing.json").write_text(timing)
    stack = read_nifti_cine(tmp_path / "cine.nii.gz", tmp_path / "timing.json")
    np.testing.assert_allclose(stack.cine.phases, [0, 0.25, 0.5, 0.75])


def test_the_pages_way_to_join_phases_makes_a_cine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pipeline.imaging.nifti import read_nifti_cine

    (example,) = shown("python")
    place = np.diag([1.5, 1.25, 9, 1])
    for value, name in enumerate(re.findall(r'"(\w+\.nii\.gz)"', example)[:2]):
        image = nibabel.Nifti1Image(np.full((5, 6, 3), value, np.int16), place)
        nibabel.save(image, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    exec(example, {})
    (timing,) = re.findall(r"{.*}", example)
    (tmp_path / "timing.json").write_text(timing)
    cine = read_nifti_cine(tmp_path / "cine.nii.gz", tmp_path / "timing.json").cine
    np.testing.assert_allclose(cine.phases, [0, 320 / 900])
    assert cine.intensity.shape == (2, 3, 6, 5)
    assert [set(phase.ravel()) for phase in cine.intensity] == [{0}, {1}]
    np.testing.assert_allclose(np.abs(cine.mr_from_index), place, atol=1e-6)


def test_the_pages_ecg_is_read(tmp_path: Path) -> None:
    from pipeline.imaging.ecg import read_ecg

    (table,) = shown("csv")
    (tmp_path / "us.csv").write_text(table)
    ecg = read_ecg(tmp_path / "us.csv")
    assert ecg.leads == ("I", "II")
    assert ecg.sampling_rate_hz == pytest.approx(500)


def test_the_pages_sweep_is_read(tmp_path: Path) -> None:
    from pipeline.imaging.ultrasound import read_sweep

    (header,) = shown("mha")
    (tmp_path / "left.mha").write_bytes(header.encode() + bytes(range(12)))
    sweep = read_sweep(tmp_path / "left.mha")
    assert sweep.images.tolist() == [[[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]]]
    assert sweep.times_s.tolist() == [0.447]
    # The probe's shift after the pixel's: both matrices have no rotation.
    first_mm: Float = sweep.tracker_from_image[0, :3, 3]
    np.testing.assert_allclose(first_mm, (-67.2 - 77.4, 17.8 - 47.0, -140.8 + 149.1))


def test_the_pages_phases_of_own_surfaces_are_read() -> None:
    from pipeline.surface_folders import Timing

    _, phases = shown("json")
    given = json.loads(phases)
    assert set(given) == set(Timing.model_fields)
    Timing.model_validate(given)
