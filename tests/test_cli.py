"""The command line: exit codes, messages, and how soon it answers."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from data_synth.__main__ import main as synthesise
from data_synth.settings_table import settings_table
from pipeline.cli import main
from pipeline.config import Settings
from pipeline.errors import InputError, StageError
from pipeline.field.verify import Report
from pipeline.summary import summary


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "no-such-study", "--out", "o"], "no-such-study: no such study"),
        (["run", ".", "--out", "o", "--config", "none.yaml"], "none.yaml: no such file"),
        (["run", "p", "--out", "o", "--until", "polish"], "no stage 'polish'; the stages are"),
        (["run", "p", "--out", "o", "--from", "polish"], "no stage 'polish'; the stages are"),
        (["bake", "--out", "o"], "needs either a STUDY or --surfaces"),
        (["query", "none.zarr", "--point", "0", "0", "0", "--phase", "0"], "none.zarr"),
        (["verify", "none.zarr"], "none.zarr"),
        (["batch", "none", "--out", "o"], "none: no such folder"),
        (["batch", ".", "--out", "o", "--workers", "0"], "at least 1 is needed"),
        (["batch", ".", "--out", "o"], "holds no study"),
        (["run", "", "--out", "o"], "what follows run: is empty"),
        (["run", "p", "--out", ""], "--out: is empty, as where a variable"),
        (["run", "p", "--out=", "--until", "bake"], "--out: is empty"),
        ([""], "the first argument: is empty"),
        (["batch", ".", "--out", "o", "--config", "none.yaml"], "none.yaml: no such file"),
        (
            ["run", "p", "--out", "o", "--from", "bake", "--until", "surface"],
            "--from bake comes after --until surface",
        ),
    ],
)
def test_wrong_input_ends_with_exit_code_2_and_says_what_is_wrong(
    arguments: list[str],
    words: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert "error: " in said
    assert words in said
    assert not list(tmp_path.iterdir()), "nothing is written for a command that is wrong"


@pytest.mark.parametrize(
    "arguments",
    [
        ["rnu", "p"],
        ["run", "p"],
        ["run", "p", "--out", "o", "--untill", "bake"],
        ["batch", "p", "--out", "o", "--workers", "1.5"],
        ["paper", "p", "--seed", "1.7"],
        ["paper", "p", "--operators", "0x10"],
    ],
)
def test_a_wrong_command_ends_with_exit_code_2(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    assert capsys.readouterr().err


@pytest.mark.parametrize(
    ("yaml", "words"),
    [
        ("bkae: {spacing_mm: 1}", "bkae: unknown key; did you mean bake?"),
        ("spacing_mm: 1", "spacing_mm: unknown key; it belongs under bake"),
        ("rr_ms: 800", "rr_ms: unknown key; it belongs in the study's study.yaml, under cine"),
        ("bake: {grid_mm: 2}", "bake.grid_mm: unknown key; it belongs under segment"),
        ("bake: {sign_errors: 1}", "sign_errors: unknown key; it belongs under bake.bounds"),
        ("surface: {margin_mm: 1}", "it belongs under segment or under bake"),
        ("bake: {structure: aorta}", "under fixtures.NAME, or did you mean structures?"),
        ("bake: {register: {seed: 1}}", "bake.register: unknown key; it belongs at the top level"),
        ("bake: {samples: 200}\nbake: {spacing_mm: 2}", "line 2: bake is given a second time"),
        ("bake: 3", "bake: needs keys below it (spacing_mm, "),
        ("bkae:", "bkae: unknown key; did you mean bake?"),
        ("fixtures:", "at least one fixture is needed; leave the key out"),
        ("[]", "needs sections"),
        ("bake: {spcing_mm: 1}", "bake.spcing_mm: unknown key; did you mean spacing_mm?"),
        ("regster: {seed: 1}", "regster: unknown key; did you mean register?"),
        ("bake: {bounds: {sing_errors: 1}}", "did you mean sign_errors?"),
        (
            "fixtures: {f: {structure: aorta, kind: guidance, delta_mm: 9, f_max: 1}}",
            "fixtures.f.f_max: unknown key; did you mean f_max_n?",
        ),
        (
            "fixtures: {f: {structure: epicardum, kind: guidance, delta_mm: 9, f_max_n: 1}}",
            "fixtures.f.structure: no structure 'epicardum'; did you mean epicardium?",
        ),
        ("bake: {structures: [aorta, lung]}", "bake.structures.1: no structure 'lung'"),
        ("bake: {spacing_mm: wide}", "bake.spacing_mm"),
        ("bake: {spacing_mm: 200}", "bake.spacing_mm: Input should be less than or equal to 20"),
        ("bake: [1, 2]", "bake"),
        ("fixtures: {}", "at least one fixture"),
        (
            "fixtures: {f: {structure: s, kind: guidance, delta_mm: 3, gamma_mm: 1, f_max_n: 1}}",
            "exactly one of delta_mm and gamma_mm",
        ),
        (
            "fixtures: {f: {structure: s, kind: guidance, delta_mm: 9, f_max_n: 5}}",
            "beyond the touch",
        ),
        (
            "fixtures: {f: {structure: s, kind: guidance, delta_mm: 1, f_max_n: 3}}",
            "smallest width that would do",
        ),
        (
            "fixtures: {a b: {structure: aorta, kind: guidance, delta_mm: 9, f_max_n: 1}}",
            "fixtures: fixture name 'a b': needs letters, digits",
        ),
        ("bake: {margin_mm: 020}", "line 1: 020 would be read as 16; write it without"),
        ("segment: {margin_mm: 1:30}", "1:30 would be read as 90"),
        ("segment: {margin_mm: 1:30.5}", "1:30.5 would be read as 90.5"),
        ("bake: {margin_mm: 0_20}", "0_20 would be read as 16"),
        (f"fixtures: {{{'n' * 64}: {{}}}}", "fixtures"),
        ("bake: {samples: 3000000000}", "bake.samples: Input should be less than or equal to"),
        ("a: [", "cannot be read as YAML"),
        ("segment:\n\tmost_views: 2\n", "spaces in the place of tabs"),
        ("7", "needs sections"),
    ],
)
def test_a_wrong_config_is_refused_with_file_and_key(
    yaml: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "mine.yaml"
    config.write_text(yaml)
    arguments = ["run", str(tmp_path), "--out", str(tmp_path / "o"), "--config", str(config)]
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert "mine.yaml" in said
    assert words in said


@pytest.mark.parametrize("text", ["", "# bake:\n", "bake:\n# spacing_mm: 2\nregister:\n"])
def test_what_is_left_empty_is_the_default(text: str, tmp_path: Path) -> None:
    from pipeline.config import Settings, read_settings

    (tmp_path / "mine.yaml").write_text(text)
    assert read_settings(tmp_path / "mine.yaml") == Settings()


def test_a_configuration_that_is_not_there_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["run", str(tmp_path), "--out", str(tmp_path / "o"), "--config", "nope.yaml"]
    assert main(arguments) == 2
    assert "nope.yaml: no such file" in capsys.readouterr().err


def test_surfaces_of_ones_own_have_names_of_ones_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import pyvista

    pyvista.Sphere(radius=20).save(tmp_path / "liver.stl")
    config = tmp_path / "mine.yaml"
    config.write_text(
        "fixtures: {f: {structure: liver, kind: guidance, delta_mm: 9, f_max_n: 1}}\n"
        "bake: {spacing_mm: 4}\n"
    )
    out = tmp_path / "o"
    arguments = ["bake", "--surfaces", str(tmp_path), "--out", str(out), "--config", str(config)]
    assert main(arguments) == 0
    assert "no structure" not in capsys.readouterr().err
    assert (out / "field.zarr").is_dir()


def test_the_page_of_settings_has_every_key_with_its_range() -> None:
    # `settings_table(Settings)` is what belongs there.
    assert (
        settings_table(Settings)
        in (Path(__file__).parent.parent / "docs" / "settings.md").read_text()
    )


def test_the_default_configuration_file_says_what_the_code_says() -> None:
    from pipeline.config import Settings, read_settings

    described = Path(__file__).parent.parent / "configs" / "default.yaml"
    assert read_settings(described) == Settings()
    # Every setting is in the file, so that a user sees all that can be set.
    import yaml

    def keys(tree: object) -> set[str]:
        if not isinstance(tree, dict):
            return set()
        return set(tree) | {k for value in tree.values() for k in keys(value)}

    shown = keys(yaml.safe_load(described.read_text()))
    sections = Settings().model_dump(by_alias=True)
    for section in ("segment", "surface", "register", "bake"):
        assert set(sections[section]) <= shown


@pytest.mark.parametrize("path", sorted(Path("configs/fixtures").glob("*.yaml")))
def test_every_named_fixture_can_be_used(path: Path) -> None:
    from pipeline.config import read_settings

    assert read_settings(path).fixtures


@pytest.mark.parametrize("module", ["pipeline", "pipeline.cli"])
def test_the_module_is_the_program(module: str) -> None:
    command = [sys.executable, "-m", module, "verify", "none.zarr"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "none.zarr" in done.stderr


def test_help_loads_no_heavy_library() -> None:
    script = (
        "import sys; from pipeline.cli import main; main(['--help'])\n"
        "heavy = {'numpy', 'SimpleITK', 'vtk', 'pyvista', 'scipy', 'numba', 'cv2', 'matplotlib'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    for command in ("run", "batch", "bake", "query", "verify", "synth", "segment"):
        assert command in done.stdout


@pytest.mark.parametrize("state", ["done", "stale"])
def test_stale_products_are_not_offered_as_if_they_were_current(tmp_path, state):
    (tmp_path / "report").mkdir()
    (tmp_path / "report" / "index.html").touch()
    example = {"point_mm": [1.0, 2.0, 3.0], "phase": 0.5}
    stage = {"status": state, "figures": {"example": example}}
    record = {"status": "done", "stages": {"bake": stage, "report": {"status": state}}}
    said = summary(record, tmp_path)
    assert ("beatfield query" in said) == (state == "done")
    assert ("stale: " in said) == (state == "stale")


@pytest.mark.parametrize(
    ("verdict", "reason", "calibration", "line"),
    [
        (
            "good",
            "",
            "",
            "good, expected error over the heart 1.5 mm (under 2 mm with a chance of 96%), "
            "borne out by 78 of 80 frames",
        ),
        (
            "doubtful",
            "parts apart",
            "",
            "doubtful, expected error over the heart 1.5 mm (under 2 mm with a chance of 96%), "
            "borne out by 78 of 80 frames, because: parts apart",
        ),
        (
            "good",
            "",
            "calibration of left corrected by 0.2 ± 0.9 mm and 0.1 ± 0.8 degrees",
            "good, expected error over the heart 1.5 mm (under 2 mm with a chance of 96%), "
            "borne out by 78 of 80 frames, widened by calibration: per_sweep",
        ),
    ],
)
def test_the_summary_says_what_the_registration_is_worth(
    tmp_path: Path, verdict: str, reason: str, calibration: str, line: str
) -> None:
    figures = {
        "verdict": verdict,
        "reason": reason,
        "expected_tre_mm": 1.541,
        "chance_under_2_mm": 0.957,
        "valid": 78,
        "frames": 80,
    }
    stage = {"status": "done", "figures": {**figures, "calibration": calibration}}
    record = {"status": "done", "stages": {"register": stage}}
    assert f"verdict   registration {line}" in summary(record, tmp_path).splitlines()
    assert "clock" not in summary(record, tmp_path)
    stage["figures"] |= {"us_clock_applied_s": -0.11}
    assert "clock     ultrasound 0.110 s behind its ECG, which" in summary(record, tmp_path)
    assert "the MR's phases that do not begin" in summary(record, tmp_path)
    stage["figures"] |= {"us_clock_applied_s": 0.09}
    assert "the MR's phases that do not begin" not in summary(record, tmp_path)
    stage["status"] = "stale"
    assert "verdict" not in summary(record, tmp_path)
    stage.update(status="skipped", cause="no tracked ultrasound", figures={})
    assert "verdict" not in summary(record, tmp_path)


@pytest.mark.parametrize("orientation", ["as the file says", "other than the file says: mirrored"])
def test_the_summary_says_when_a_heart_lies_otherwise(tmp_path: Path, orientation: str) -> None:
    stage = {"status": "done", "figures": {"orientation": orientation}}
    said = summary({"status": "done", "stages": {"segment": stage}}, tmp_path)
    assert ("lies other than the file says: mirrored;" in said) == orientation.startswith("other")


def test_the_summary_says_what_must_be_known_before_a_field_is_used(tmp_path: Path) -> None:
    """Labels in doubt, a stack that ends too soon, and a beat that nobody wrote down."""
    ingest = {"phases": 2, "rr_s": 2.0, "timing_source": "NIfTI time step"}
    segment = {
        "orientation": "as the file says",
        "lowest_confidence": 0.66,
        "least_certain": {"phase": 1, "slice": 4},
        "cut_off": {"left atrium": {"9": 2}, "aorta": {"9": 2}, "left ventricle": {"0": 1}},
        "volumes_ml": {"lv_myocardium": [81.0, 136.0]},
    }
    ingest["remarks"] = ["phase 1 shows the same images as phase 0 in all slices"]
    stages = {
        "ingest": {"status": "done", "figures": ingest},
        "segment": {"status": "done", "figures": segment},
    }
    said = summary({"status": "done", "stages": stages}, tmp_path).splitlines()
    assert any(line.startswith("timing    two phases evenly over a beat of 2 s") for line in said)
    assert any(line.startswith("doubtful  labels of slice 4 in phase 1, whose") for line in said)
    assert any(line.startswith("input     phase 1 shows the same") for line in said)
    told = "doubtful  labels: of heart muscle phase 0 has 81 ml and phase 1 136 ml"
    assert any(line.startswith(told) for line in said)
    segment["volumes_ml"] = {"lv_myocardium": [100.0, 139.0]}
    assert "heart muscle" not in summary({"status": "done", "stages": stages}, tmp_path)
    cut = [line for line in said if line.startswith("cut off")]
    assert len(cut) == 2
    assert cut[0].startswith("cut off   left atrium, aorta at slice 9 in 2 of 2 phases")
    assert cut[1].startswith("cut off   left ventricle at slice 0 in 1 of 2 phases")
    for stage in stages.values():
        stage["status"] = "stale"
    assert len(summary({"status": "done", "stages": stages}, tmp_path).splitlines()) == 4


@pytest.mark.parametrize(
    ("phase", "ejection", "odd"),
    [
        (0.44, 0.6, False),
        (0.28, 0.6, False),
        (0.26, 0.6, True),
        (0.58, 0.6, False),
        (0.60, 0.6, True),
        (0.16, 0.6, True),
        (0.96, 0.6, True),
        (0.16, 0.17, True),
        (0.16, 0.14, False),
    ],
)
def test_the_summary_doubts_phases_that_do_not_begin_at_the_r_peak(
    tmp_path: Path, phase: float, ejection: float, odd: bool
) -> None:
    systole = {"phase": phase, "usual": 0.44}
    figures = {"end_systole": systole, "lv_ejection_fraction": ejection}
    stages = {"surface": {"status": "done", "figures": figures}}
    said = summary({"status": "done", "stages": stages}, tmp_path)
    assert ("doubtful  times: the left ventricle is smallest at phase 0.16" in said) == (
        odd and phase == 0.16
    )
    assert ("by the pulse at a finger" in said) == odd


def test_an_interruption_says_what_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("pipeline.cli._run", interrupted)
    assert main(["run", str(tmp_path), "--out", str(tmp_path / "out")]) == 130
    assert "interrupted; what is finished is kept" in capsys.readouterr().err


def test_a_bad_field_does_not_hide_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def verified(field: Path) -> Report:
        if field.name == "good":
            return Report(5, 10**6, 1, "", ("box",), ("hold",), ("a doubt\nof two lines",))
        raise (StageError if field.name == "late" else InputError)(f"{field.name}: cut short")

    monkeypatch.setattr("pipeline.field.verify.verify_field", verified)
    assert main(["verify", "bad", "late", "good"]) == 2
    printed, said = capsys.readouterr()
    assert printed.startswith("good: whole: 5 files, ")
    assert printed.endswith("\ndoubtful  a doubt\\nof two lines\n")
    assert said == "error: bad: cut short\nerror: late: cut short\n"
    assert main(["verify", "good", "late"]) == 1
    assert main(["verify", "good", "good"]) == 0
    assert main(["verify", "good", "good", "--surfaces", str(tmp_path)]) == 2
    assert "is of one field" in capsys.readouterr().err
    assert main(["verify"]) == 2


def test_notes_beside_an_interrupt_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object) -> None:
        interrupt = KeyboardInterrupt()
        interrupt.add_note("bake is old")
        raise interrupt

    monkeypatch.setattr("pipeline.cli._run", interrupted)
    assert main(["run", str(tmp_path), "--out", str(tmp_path / "out")]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "note: bake is old"


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_a_reader_that_has_read_enough_gets_no_traceback(stream: str) -> None:
    """As `beatfield ... | head -1` does, here with a pipe that nobody reads. It is no success
    either: a run whose progress nobody reads has not gone to its end."""
    reading, writing = os.pipe()
    os.close(reading)
    script = (
        "import sys; from pipeline.ending import guarded; "
        f"sys.exit(guarded(lambda: print(1, file=sys.{stream}, flush=True)))"
    )
    other = {"stdout": "stderr", "stderr": "stdout"}[stream]
    done = subprocess.run(
        [sys.executable, "-c", script], **{stream: writing, other: subprocess.PIPE}, check=False
    )
    os.close(writing)
    assert (done.returncode, getattr(done, other)) == (141, b"")


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("NUMBA_DISABLE_JIT", "1", "NUMBA_DISABLE_JIT turns the compiler off"),
        ("NUMBA_NUM_THREADS", "0", "NUMBA_NUM_THREADS is 0; give 1 or more"),
        ("NUMBA_NUM_THREADS", "-2", "NUMBA_NUM_THREADS is -2; give 1 or more"),
    ],
)
def test_an_environment_that_nothing_works_in_is_told(monkeypatch, capsys, name, value, words):
    monkeypatch.setenv(name, value)
    assert main(["verify", "none.zarr"]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(("error", "code"), [(BrokenPipeError(), 141), (OSError(28, "full"), 2)])
def test_synthetic_studies_are_written_although_nobody_reads_their_names(
    monkeypatch, tmp_path, capsys, error, code
):
    class Deaf:
        def __init__(self, file):
            self.fileno = file.fileno

        def write(self, text):
            raise error

    made = []
    monkeypatch.setattr("data_synth.study.write_study", lambda folder, *_: made.append(folder))
    monkeypatch.setattr("data_synth.__main__._end_cleanly", lambda: None)
    with (tmp_path / "out").open("w") as file:
        monkeypatch.setattr(sys, "stdout", Deaf(file))
        assert synthesise([str(tmp_path / "studies")]) == code
    assert len(made) == 1
    assert ("cannot be written (full)" in capsys.readouterr().err) == (code == 2)
