"""What can be asked of the phantom: by file, by flag, and how senseless wishes are refused."""

import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest

import data_synth
from data_synth import PhantomSettings, read_settings
from data_synth.__main__ import ProgressLine, main
from data_synth.errors import SynthError
from data_synth.population import PATHOLOGIES
from data_synth.settings import Pathology
from data_synth.settings_table import settings_table


def test_the_scanners_ecg_keeps_its_artefact_and_its_field():
    settings = PhantomSettings.model_validate(
        {"ecg": {"mains_mv": 0.1}, "mr": {"field_strength_t": 3.0}}
    )
    assert settings.ecg.magnetohydrodynamic_mv == 0.5
    assert settings.ecg.field_strength_t == 3.0
    assert PhantomSettings.model_validate(settings.model_dump(mode="json")) == settings


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("mr: {phases: 1}", r"mr\.phases.*greater than or equal to 2"),
        ("mr: {snr: 0}", r"mr\.snr.*greater than 0"),
        ("mr: {pixel_mm: -1}", r"mr\.pixel_mm"),
        ("mr: {slice_thickness_mm: -8}", r"mr\.slice_thickness_mm.*greater than 0"),
        ("mr: {snr: .nan}", r"mr\.snr"),
        ("mr: {field_strength_t: 2}", r"mr\.field_strength_t"),
        ("ecg: {field_strength_t: 3}", r"ecg\.field_strength_t = 3.0 is not mr"),
        ("ultrasound: {depth_mm: -1}", r"ultrasound\.depth_mm"),
        ("ultrasound: {probe: sonic}", r"ultrasound\.probe.*transoesophageal"),
        ("heart_rate_bpm: -70", "heart_rate_bpm"),
        ("spread: 9", "spread"),
        ("seed: -1", "seed"),
        ("pathology: grief", r"pathology.*healthy.*infarct.*enlarged_atrium.*'grief'"),
        ("cine: film", r"cine.*dicom.*enhanced.*nifti"),
        ("colour: red", "colour: unknown key"),
        ("seed: 7\nheart_rate_bpm: 0100", "line 2: 0100 would be read as 64"),
        ("heart_rate_bpm: 1:30", "line 1: 1:30 would be read as 90"),
        ("heart_rate_bpm: 1:30.5", "line 1: 1:30.5 would be read as 90.5"),
        ("mr:\n  slices: 8\n  slices: 9", "line 3: slices is given a second time, after line 2"),
        ("mr: {flavour: 1}", r"mr\.flavour: unknown key; check its spelling"),
        ("mr: {snrr: 20}", r"mr\.snrr: unknown key; did you mean snr\?"),
        ("pathologie: infarct", r"unknown key; did you mean pathology\?"),
        ("- 1", "keys and values"),
        ("[]", "keys and values"),
        ("false", "keys and values"),
        ("mr: [", "cannot be read as YAML"),
        ("mr: !!map foo", "cannot be read as YAML"),
        ("seed: 2024-13-01", "cannot be read as YAML"),
        ("seed: !!int ''", "cannot be read as YAML"),
        ("[" * 3000, "cannot be read as YAML"),
    ],
)
def test_bad_settings_name_file_key_and_fault(tmp_path, capsys, text, words):
    config = tmp_path / "bad.yaml"
    config.write_text(text)
    with pytest.raises(SynthError, match=words):
        read_settings(config)
    assert main([str(tmp_path / "out"), "--config", str(config)]) == 2
    assert str(config) in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "faulty"),
    [
        ("mr: {snr: true, phases: 0}\nsped: 1", ["mr.snr", "mr.phases", "sped"]),
        ("mr: {phases: true}", ["mr.phases"]),
        ("ecg: {fibrillation: true, fibrillation_s: [true, 5]}", ["ecg.fibrillation_s.0"]),
        (
            "ecg: {lost: [{lead: II, start_s: false, end_s: 4}], lost_per_minute: 99}",
            ["ecg.lost.0.start_s", "ecg.lost_per_minute"],
        ),
    ],
)
def test_every_fault_of_a_file_is_told_once(tmp_path, text, faulty):
    config = tmp_path / "bad.yaml"
    config.write_text(text)
    with pytest.raises(SynthError) as told:
        read_settings(config)
    lines = str(told.value).split("\n")
    assert sorted(line.split(": ")[1] for line in lines) == sorted(faulty)


def test_a_name_too_long_for_dicom_is_refused_before_the_heart_is_drawn(
    tmp_path, monkeypatch, capsys
):
    config = tmp_path / "long.yaml"
    config.write_text(f"patient_id: {'x' * 57}\n")
    monkeypatch.setattr("data_synth.study.simulate_study", lambda *_: pytest.fail("simulated"))
    assert main([str(tmp_path / "out"), "--config", str(config)]) == 2
    assert "patient_id" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("out", ["out", "x" * 300], ids=["hidden folder's", "place's"])
def test_a_name_too_long_for_the_system_is_told(tmp_path, capsys, out):
    config = tmp_path / "long.yaml"
    # With the marks of a hidden folder about it, it passes 255 bytes, the most of Linux.
    config.write_text(f"cine: nifti\npatient_id: {'x' * 250}\n")
    assert main([str(tmp_path / out), "--config", str(config)]) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_a_section_of_comments_alone_is_the_default(tmp_path):
    (tmp_path / "p.yaml").write_text("seed: 4\nmr:\n  # pixel_mm: 2\n")
    assert read_settings(tmp_path / "p.yaml") == PhantomSettings(seed=4)


def test_a_second_file_of_settings_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main([str(tmp_path / "o"), "--config", "a.yaml", "--config", "b.yaml"])
    assert ended.value.code == 2
    assert "given a second time" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_settings_that_are_not_there_are_told(tmp_path):
    with pytest.raises(SynthError, match=r"none\.yaml: no such file"):
        read_settings(tmp_path / "none.yaml")


def test_flags_lie_over_the_settings_of_the_file(tmp_path, monkeypatch):
    """Each flag reaches the study that is written, and the file holds for the rest."""
    config = tmp_path / "mine.yaml"
    config.write_text("pathology: rv_dilation\nspread: 0.5\n")
    made = []
    monkeypatch.setattr("data_synth.study.write_study", lambda *given: made.append(given))
    flags = ["--pathology", "infarct", "--cine", "enhanced", "--seed", "7", "--preview"]
    assert main([str(tmp_path / "o"), "--config", str(config), *flags]) == 0
    ((folder, settings, _, overwrite, preview),) = made
    assert folder == tmp_path / "o" / "patient-0001"
    assert (settings.pathology, settings.cine, settings.seed) == ("infarct", "enhanced", 7)
    assert settings.spread == 0.5
    assert preview
    assert not overwrite


def test_one_patient_keeps_the_name_that_the_file_gives(tmp_path, monkeypatch, capsys):
    config = tmp_path / "mine.yaml"
    config.write_text("patient_id: robot-01\n")
    made = []
    monkeypatch.setattr("data_synth.study.write_study", lambda *given: made.append(given[:2]))
    command = [str(tmp_path / "o"), "--config", str(config)]
    assert main(command) == 0
    ((folder, settings),) = made
    assert folder == tmp_path / "o" / "robot-01"
    assert settings.patient_id == "robot-01"
    assert main([*command, "--patients", "2"]) == 2
    assert "patient_id is robot-01" in capsys.readouterr().err
    assert len(made) == 1


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--config", "none.yaml"], "none.yaml"),
        (["--patients", "0"], "--patients"),
        (["--seed", "-1"], "seed"),
        (["--pathology", "grief"], "infarct"),
    ],
)
def test_bad_flags_are_refused_and_nothing_is_written(tmp_path, capsys, flags, words):
    assert main([str(tmp_path / "out"), *flags]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_pipelines_command_passes_its_flags_on(tmp_path):
    command = [sys.executable, "-m", "pipeline", "synth", str(tmp_path / "o"), "--pathology", "x"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "hypertrophic_cardiomyopathy" in done.stderr
    assert not (tmp_path / "o").exists()


def test_settings_and_help_know_every_pathology(capsys):
    assert get_args(Pathology) == PATHOLOGIES
    with pytest.raises(SystemExit):
        main(["--help"])
    told = "".join(capsys.readouterr().out.split())
    assert all(name in told for name in PATHOLOGIES)


@pytest.mark.parametrize(
    "path", sorted(Path("configs/phantoms").glob("*.yaml")), ids=lambda p: p.stem
)
def test_shipped_phantoms_are_valid(path):
    assert isinstance(read_settings(path), PhantomSettings)


def test_every_public_name_can_be_had_and_importing_is_light():
    for name in data_synth.__all__:
        assert getattr(data_synth, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'sorcery'"):
        _ = data_synth.sorcery
    script = "import data_synth, sys; assert not {'numpy', 'numba'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", script], check=True)


def test_the_settings_table_tells_limits_choices_and_meanings():
    rows = {line.split("`")[1]: line for line in settings_table().splitlines()[2:]}
    assert "| 25 | ≥ 2, ≤ 100 |" in rows["mr.phases"]
    assert "> 0" in rows["mr.snr"]
    assert "hypertrophic_cardiomyopathy" in rows["pathology"]
    assert "Way from end-expiration" in rows["ultrasound.breathing.amplitude_mm"]
    assert len(rows) == len(set(rows)) > 80


def test_progress_appears_only_for_long_work(capsys):
    line = ProgressLine("patient-0001")
    line(1, 2)
    line.end()
    assert capsys.readouterr().err == ""
    line.next = 0.0
    line(1, 2)
    line.end()
    assert capsys.readouterr().err == "\rpatient-0001:  50 %\n"


@pytest.mark.parametrize(
    "handler",
    [
        "from data_synth.__main__ import _end_cleanly as hear",
        "from pipeline.ending import hear_signals as hear",
    ],
    ids=["phantom", "pipeline"],
)
def test_an_interrupt_while_the_compiler_calls_back_is_heard_when_it_has_ended(handler):
    """What is raised within the callback would be printed and dropped."""
    program = (
        f"import os, signal, time\n{handler}\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "hear()\n"
        "compiler = {'__name__': 'llvmlite.binding', 'os': os, 'signal': signal, 'time': time}\n"
        "call = 'os.kill(os.getpid(), signal.SIGINT); time.sleep(0.3); ended = True'\n"
        "try:\n"
        "    exec(call, compiler)\n"
        "    time.sleep(60)\n"
        "    print('not heard')\n"
        "except KeyboardInterrupt:\n"
        "    print('heard', 'ended' in compiler)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=50
    )
    assert done.stdout == "heard True\n"
