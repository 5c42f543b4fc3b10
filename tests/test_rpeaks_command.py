"""``beatfield rpeaks``: a table for any record, and nothing for one that cannot be read."""

from __future__ import annotations

import csv
import errno
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_synth.ecg import EcgSettings, simulate_ecg, write_wfdb
from pipeline.cli import main
from pipeline.registration.rhythm import RhythmBeat, unordered


@pytest.fixture(scope="module")
def ecg():
    settings = EcgSettings(ectopic_probability=0.1)
    return simulate_ecg(np.random.default_rng(4), 40.0, 0.8, 250.0, settings)


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("ending", ["", ".hea", ".dat"])
def test_a_wfdb_record_gives_its_beats(ecg, tmp_path, ending, capsys):
    write_wfdb(tmp_path, "rec", ecg)
    assert main(["rpeaks", str(tmp_path / f"rec{ending}"), "--out", str(tmp_path / "p.csv")]) == 0
    rows = rows_of(tmp_path / "p.csv")
    times_s = np.array([float(row["time_s"]) for row in rows])
    inner_s = ecg.r_times_s[(ecg.r_times_s > 0.1) & (ecg.r_times_s < 39.8)]
    assert np.abs(inner_s[:, None] - times_s).min(axis=1).max() < 0.02
    assert (np.diff(times_s) > 0).all()
    ectopic = np.array([row["kind"] != "normal" for row in rows])
    nearest = np.abs(ecg.r_times_s[:, None] - times_s).argmin(axis=1)
    learnt = ecg.r_times_s > 5.0
    assert ectopic[nearest[ecg.ectopic & learnt]].all(), "every early beat is called one"
    assert {row["lead"] for row in rows} <= set(ecg.leads)
    assert {row["valid"] for row in rows} == {"0", "1"}
    assert "beats" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["rec.hea", "rec.dat", "../wfdb/rec.dat"])
def test_a_table_does_not_replace_its_recording(ecg, tmp_path, name, capsys):
    folder = tmp_path / "wfdb"
    folder.mkdir()
    write_wfdb(folder, "rec", ecg)
    before = {path: path.read_bytes() for path in folder.iterdir()}
    assert main(["rpeaks", str(folder / "rec"), "--out", str(folder / name)]) == 2
    assert "is the recording itself" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    for _ in range(2):
        assert main(["rpeaks", str(folder / "rec"), "--out", str(folder / "rec_peaks.csv")]) == 0


def test_csv_times_are_those_of_the_recording(ecg, tmp_path):
    times_s = 100.0 + np.arange(len(ecg.signal_mv)) / 250.0
    lines = ["time_s,I,II,V1"]
    lines += [
        f"{t:.3f}," + ",".join(f"{v:.4f}" for v in row)
        for t, row in zip(times_s, ecg.signal_mv, strict=True)
    ]
    (tmp_path / "ecg.csv").write_text("\n".join(lines) + "\n")
    assert main(["rpeaks", str(tmp_path / "ecg.csv"), "--out", str(tmp_path / "p.csv")]) == 0
    found_s = np.array([float(row["time_s"]) for row in rows_of(tmp_path / "p.csv")])
    inner_s = 100.0 + ecg.r_times_s[(ecg.r_times_s > 0.1) & (ecg.r_times_s < 39.8)]
    assert np.abs(inner_s[:, None] - found_s).min(axis=1).max() < 0.02


def test_a_disk_that_takes_no_files_is_told(ecg, tmp_path, capsys, monkeypatch):
    write_wfdb(tmp_path, "rec", ecg)

    def refused(path, *_, **__):
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    opened = Path.open
    monkeypatch.setattr(
        Path,
        "open",
        lambda p, mode="r", *a, **k: refused(p) if "w" in mode else opened(p, mode, *a, **k),
    )
    monkeypatch.setattr(Path, "unlink", refused)
    assert main(["rpeaks", str(tmp_path / "rec"), "--out", str(tmp_path / "p.csv")]) == 2
    said = capsys.readouterr().err
    assert f"error: {tmp_path / 'p.csv'}: cannot be written (Read-only file system" in said
    assert "may write in" in said


def test_a_name_that_is_a_folder_is_told(ecg, tmp_path, capsys):
    write_wfdb(tmp_path, "rec", ecg)
    assert main(["rpeaks", str(tmp_path / "rec"), "--out", str(tmp_path)]) == 2
    assert f"error: {tmp_path}: cannot be written" in capsys.readouterr().err
    assert not (tmp_path.parent / f".{tmp_path.name}.part").exists()


def test_a_folder_of_records_is_told_what_it_holds(ecg, tmp_path, capsys):
    write_wfdb(tmp_path, "mr", ecg)
    write_wfdb(tmp_path, "us", ecg)
    assert main(["rpeaks", str(tmp_path), "--out", str(tmp_path / "p.csv")]) == 2
    assert f"{tmp_path}: is a folder; name one ECG in it: mr.hea, us.hea" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("record", "out", "words"),
    [("none", "p.csv", "no such ECG"), ("rec", "nowhere/p.csv", "nowhere; make it first")],
)
def test_trouble_ends_with_exit_code_2_and_no_file(ecg, tmp_path, capsys, record, out, words):
    write_wfdb(tmp_path, "rec", ecg)
    before = sorted(tmp_path.rglob("*"))
    assert main(["rpeaks", str(tmp_path / record), "--out", str(tmp_path / out)]) == 2
    assert words in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


def test_a_rhythm_in_which_forces_are_withheld_is_told_of_a_study():
    """One beat in five that is not normal is a few extrasystoles; more is no rhythm to rely on."""

    def row(kind, rr_s):
        return RhythmBeat(1.0, kind, True, 0, rr_s, 1.0, 1.1, False)

    usual = [row("normal", math.nan), *[row("normal", 0.8)] * 15]
    assert unordered([*usual, *[row("ectopic", 0.5)] * 4]) == ""
    said = unordered([*usual, *[row("ectopic", 0.5)] * 2, *[row("irregular", 1.31)] * 3])
    counted = "of 21 beats 2 are ectopic and 3 irregular, at 21 the phase is valid"
    assert said == f"{counted}, 0.50 to 1.31 s apart"
    assert unordered([]) == ""
    # Where no two intervals agree from the first beat on, no beat is told as early.
    unsure = [replace(one, valid=False) for one in usual]
    assert "0 are ectopic and 0 irregular, at 0 the phase is valid" in unordered(unsure)
    # A rhythm is learnt for some beats, and judged by more than a few others.
    assert unordered(unsure[:15]) == ""
    # Where leads are lost between any two beats there are no intervals.
    assert unordered([usual[0], *[replace(one, rr_s=math.nan) for one in unsure]]).endswith("valid")
