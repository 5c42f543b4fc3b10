"""What the ingest stage says of the heartbeat: images, times and ECG must be of one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ecg_records import record

from pipeline.config import Settings
from pipeline.imaging.nifti import write_image
from pipeline.job import Job
from pipeline.stages import ingest
from pipeline.study import open_study

PHASES, SLICES = 10, 4


def remarks_of(
    folder: Path,
    rr_ms: float,
    ecg_rr_s: float | None,
    shown: float = 1.0,
    count: int = PHASES,
) -> list[str]:
    """Remarks on noise whose phases are spread evenly over a share of beats of ``rr_ms``."""
    for name in ("cine", "ecg", "out"):
        (folder / name).mkdir()
    rng = np.random.default_rng(2)
    pixels = rng.normal(100, 20, (count, SLICES, 48, 48)).astype(np.float32)
    write_image(folder / "cine" / "cine.nii.gz", pixels, np.diag([2.0, 2.0, 8.0, 1.0]))
    times_ms = (shown * rr_ms * np.arange(count) / count).tolist()
    timing = {"trigger_times_ms": times_ms, "rr_ms": rr_ms}
    (folder / "cine" / "timing.json").write_text(json.dumps(timing))
    if ecg_rr_s is not None:
        ecg = record(duration_s=20.0, mean_rr_s=ecg_rr_s, seed=4)
        rows = [
            f"{k / ecg.sampling_rate_hz:.4f},{one[0]:.5f}" for k, one in enumerate(ecg.signal_mv)
        ]
        (folder / "ecg" / "mr.csv").write_text("\n".join(["time_s,I", *rows, ""]))
    (folder / "study.yaml").write_text("patient_id: p\n")
    job = Job(open_study(folder), Settings(), folder, folder / "out", lambda done, total: None)
    figures: dict[str, Any] = ingest.run(job)
    return [one for one in figures["remarks"] if "order" not in one]


@pytest.mark.parametrize("ecg_rr_s", [None, 0.8, 0.65])
def test_a_beat_that_fits_raises_no_doubt(tmp_path: Path, ecg_rr_s: float | None) -> None:
    assert remarks_of(tmp_path, 800.0, ecg_rr_s) == []


def test_gating_that_waits_for_the_next_peak_raises_none(tmp_path: Path) -> None:
    assert remarks_of(tmp_path, 800.0, None, shown=0.85) == []


def test_few_phases_that_share_the_beat_evenly_raise_none(tmp_path: Path) -> None:
    assert remarks_of(tmp_path, 800.0, None, count=3) == []


def test_an_ecg_of_another_patient_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read_cine, read_ecg = ingest.read_nifti_cine, ingest.read_ecg
    monkeypatch.setattr(
        ingest, "read_nifti_cine", lambda *given: replace(read_cine(*given), patient="A17")
    )
    monkeypatch.setattr(ingest, "read_ecg", lambda path: replace(read_ecg(path), patient="B4"))
    [told] = remarks_of(tmp_path, 800.0, 0.8)
    assert "has another PatientID than the cine" in told


def test_a_beat_of_which_half_is_not_shown_is_told(tmp_path: Path) -> None:
    """As of an RR interval of two beats, or cine.rr_ms of another examination."""
    [told] = remarks_of(tmp_path, 1600.0, None, shown=0.5)
    assert told.startswith("no image shows the 55% of the heartbeat after phase 0.45")


def test_an_ecg_of_another_heart_rate_is_told(tmp_path: Path) -> None:
    [told] = remarks_of(tmp_path, 1100.0, 0.8)
    assert told.startswith("the cine's RR interval is 1100 ms, that of ")
    assert "ms: either timing is wrong, or the ECG is of another" in told


def test_phases_in_pairs_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As of two acquisitions that no attribute tells apart."""
    read_cine = ingest.read_nifti_cine

    def paired(*given: Any) -> Any:
        stack = read_cine(*given)
        phases = (np.arange(PHASES) // 2 + 0.02 * (np.arange(PHASES) % 2)) / (PHASES // 2)
        return replace(stack, cine=replace(stack.cine, phases=phases))

    monkeypatch.setattr(ingest, "read_nifti_cine", paired)
    [told] = remarks_of(tmp_path, 800.0, None)
    assert told.startswith("phases come in pairs, 0.004 of a beat apart")


def test_the_way_round_to_the_first_phase_counts_from_that_phase() -> None:
    """Shares 0.3 to 0.85 of a beat: 0.45 of it, to 0.3 of the next, is not shown."""

    def doubts(phases: Any) -> list[str]:
        cine: Any = SimpleNamespace(rr_s=0.8, phases=phases)
        job: Any = None
        stack: Any = SimpleNamespace(cine=cine)
        return ingest._doubts_of_beat(job, stack, None)

    (told,) = doubts(np.linspace(0.3, 0.85, 12))
    assert told.startswith("no image shows the 45% of the heartbeat after phase 0.85")
    assert doubts(np.linspace(0, 0.76, 12)) == []
    (told,) = doubts(np.linspace(0, 0.74, 12))
    assert told.startswith("no image shows the 26%")
