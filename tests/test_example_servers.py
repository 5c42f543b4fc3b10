"""The force servers of docs/examples: an ECG, or its R peaks, in; the field's forces out."""

import re
import runpy
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from c_program import build
from field_baked import FIXTURES, PHASES, RADII_MM, bake_small

from data_synth.ecg import EcgSettings, LostLead, phase_at, simulate_ecg, write_wfdb
from pipeline.cli import main
from pipeline.field import ForceField
from pipeline.field.passivity import EnergyTank
from pipeline.registration.clock import PhaseClock

DOCS = Path(__file__).parents[1] / "docs"
EXAMPLES = DOCS / "examples"
SERVER_C = EXAMPLES / "server.c"
TIP_MM = (0.0, 25.0, 0.0)
GUIDE = FIXTURES["guide"]


def recorded(folder, **settings):
    """A recording of 20 s on disk, and its truth."""
    rng = np.random.default_rng(3)
    ecg = simulate_ecg(rng, 20.0, 0.8, 500.0, EcgSettings(**settings))
    write_wfdb(folder, "us", ecg)
    return folder / "us", ecg


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("served") / "field.zarr"
    bake_small(folder, doubts_of=lambda accuracy: ["walls may lie 2 mm off", "slice 3"])
    return folder


def table(text):
    return np.loadtxt(text.splitlines(), delimiter=",", skiprows=1)


def python_server(capsys, *words):
    server = runpy.run_path(str(EXAMPLES / "server.py"))
    code = server["main"]([str(word) for word in words])
    said = capsys.readouterr()
    return code, said.out, said.err


def test_forces_are_those_of_the_heart_at_its_true_phase(tmp_path, path, capsys):
    record, ecg = recorded(tmp_path)
    code, out, told = python_server(capsys, path, record, *TIP_MM)
    rows = table(out)
    assert (code, told) == (0, "note: walls may lie 2 mm off\nnote: slice 3\n")
    # A lead's own rhythm must be learnt first; after half the record a regular heart is known.
    late = rows[rows[:, 0] > 10]
    assert late[:, 2].mean() > 0.9
    now = late[(late[:, 2] == 1) & (late[:, 3] == 1) & (late[:, 0] < ecg.r_times_s[-1])]
    off = now[:, 1] - phase_at(now[:, 0], ecg.r_times_s)
    # A regular heart's next R is known to some 3 % (docs/time.md: 27 ms in 95 %, of 800 ms).
    assert np.percentile(np.abs(off - np.round(off)), 90) < 0.04
    # Within 0.01 of a baked phase the wall is where a straight line puts it, to 0.05 mm; the grid
    # of 3 mm holds a ball to as much, and the force changes by 0.4 N a millimetre at most.
    near = np.abs(now[:, 1, None] - PHASES).min(axis=1) < 0.01
    now = now[near]
    radius_mm = np.interp(now[:, 1], PHASES, RADII_MM, period=1)
    away_mm = np.abs(TIP_MM[1] - radius_mm)
    law_n = GUIDE.f_max_n * -np.expm1(-((away_mm**2 / (2 * GUIDE.resolved_delta_mm**2)) ** GUIDE.m))
    felt_n = np.linalg.norm(now[:, 4:], axis=1)
    assert np.abs(felt_n - law_n).max() < 0.04
    assert felt_n.max() > 1.5


def test_a_lead_that_falls_off_fades_the_force_out_at_the_bounded_rate(tmp_path, path, capsys):
    lost = (LostLead(lead="all", start_s=12.0, end_s=20.0),)
    record, _ = recorded(tmp_path, lost=lost)
    _, out, _ = python_server(capsys, path, record, *TIP_MM)
    rows = table(out)
    before = (rows[:, 0] > 11) & (rows[:, 0] < 12)
    # 0.1 s until it is known, and 2 N at 10 N/s.
    after = rows[:, 0] > 12.0 + 0.11 + GUIDE.f_max_n / 10
    assert rows[before, 3].min() == 1.0
    assert not rows[after][:, 4:].any()
    # 10 N/s is 0.01 N a turn; six decimals are printed.
    assert np.abs(np.diff(rows[:, 3])).max() * GUIDE.f_max_n < 0.01 + 2e-6


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return build(EXAMPLES / "server.c", tmp_path_factory.mktemp("c") / "server", "-std=c99")


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
def test_c_server_is_cpp_too(tmp_path):
    build(EXAMPLES / "server.c", tmp_path / "server", "-std=c++11", compiler="g++")


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs a C compiler")
@pytest.mark.parametrize("settings", [{}, {"atrial_probability": 0.1}])
def test_c_server_renders_the_same_forces(tmp_path, path, program, capsys, settings):
    """In a regular heart, and where beats come early that look like the others."""
    record, _ = recorded(tmp_path, **settings)
    peaks = tmp_path / "peaks.csv"
    assert main(["rpeaks", str(record), "--out", str(peaks)]) == 0
    words = [str(word) for word in (path, peaks, *TIP_MM)]
    done = subprocess.run([program, *words], capture_output=True, text=True, check=True)
    assert done.stderr == f"note: 2 things speak against {path}; `beatfield verify` prints them\n"
    field, table_of_peaks, *point = words
    for given, told in (
        ((field, table_of_peaks, "1O", "0", "0"), b"grid does not hold"),
        ((field, table_of_peaks, "900", "0", "0"), b"grid does not hold"),
        ((field, f"{record}.hea", *point), b"no table"),
    ):
        wrong = subprocess.run([program, *given], capture_output=True, check=False)
        assert (wrong.returncode, wrong.stdout) == (2, b"")
        assert told in wrong.stderr
    capsys.readouterr()
    _, out, _ = python_server(capsys, path, record, *TIP_MM)
    by_c = table(done.stdout)
    by_python = table(out)
    # The C server begins when the first peak is known; until then there is no force.
    first = np.flatnonzero(by_python[:, 0] == by_c[0, 0])[0]
    assert not by_python[:first, 3:].any()
    by_python = by_python[first : first + len(by_c)]
    assert len(by_c) > 15_000
    # Peaks come rounded to 10 us, 1.3e-5 of the cycle, and the clock corrects by what it is off;
    # a wall that moves 6 mm in a quarter of the cycle changes the force by 10 N a cycle.
    np.testing.assert_allclose(by_c[:, :4], by_python[:, :4], rtol=0, atol=2e-4)
    np.testing.assert_allclose(by_c[:, 4:], by_python[:, 4:], rtol=0, atol=2e-3)


GOOD_ROW = "1.20000,normal,0,II,0.80000,0.999,1.33200,0\n"


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs a C compiler")
@pytest.mark.parametrize(
    "row",
    [
        "abc,,",
        "2026-01-01,normal,1",
        "2.0,normal,1,II,0.8,0.999,2.1x,0",
        "2.0,normal,1,II,0.8,0.999,2.13,",
        "2.0,normal,1,II,0.8,0.999,2.13,ectopic",
        "2.0,regular,1,II,0.8,0.999,2.13,0",
        "nan,normal,1,II,0.8,0.999,2.13,0",
        # Cut off in the last number.
        "2.0,normal,1,II,0.8,0.999,1",
        "",
        "2.0,normal,1," + "I" * 300 + ",0.8,0.999,2.13,0",
    ],
)
def test_a_broken_row_of_peaks_is_told_with_its_line(tmp_path, path, program, row):
    head = "time_s,kind,valid,lead,rr_s,likeness,known_s,strange\n"
    words = [str(program), str(path), str(tmp_path / "peaks.csv"), *map(str, TIP_MM)]
    (tmp_path / "peaks.csv").write_text(f"{head}{GOOD_ROW}{row}\n{GOOD_ROW}")
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert f"{tmp_path / 'peaks.csv'}, line 3: is no row" in done.stderr
    assert done.stderr.count("\n") == 2
    (tmp_path / "peaks.csv").write_text(head + GOOD_ROW.replace("II", '"II, left"').strip())
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    # The header, and the one millisecond at which the beat is known.
    assert len(done.stdout.splitlines()) == 2


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time_s,II\n0.000,0.1\nabc,,\n", "line 3: needs 2 numbers"),
        ("time_s,II\n0.000,0.1\n2026-01-01,1\n", "line 3: needs 2 numbers"),
    ],
)
def test_a_broken_row_of_samples_is_told_with_its_line(tmp_path, path, capsys, text, words):
    (tmp_path / "ecg.csv").write_text(text)
    code, out, err = python_server(capsys, path, tmp_path / "ecg.csv", *TIP_MM)
    assert (code, out) == (2, "")
    assert f"{tmp_path / 'ecg.csv'}, {words}" in err


def test_wrong_words_are_told(path, tmp_path, capsys):
    assert python_server(capsys, path, "nowhere")[0] == 2
    code, out, err = python_server(capsys, path, tmp_path / "none", 900, 0, 0)
    assert (code, out) == (2, "")
    assert "grid does not hold" in err
    code, out, err = python_server(capsys, path, tmp_path / "none", *TIP_MM)
    assert (code, out) == (2, "")
    assert "none" in err


def test_times_are_those_of_the_recordings_own_clock(tmp_path, path, capsys):
    """A CSV file whose first sample is at 1000 s."""
    _, ecg = recorded(tmp_path)
    times_s = 1000 + np.arange(len(ecg.signal_mv)) / ecg.sampling_rate_hz
    lines = (
        f"{time_s:.3f},{one:.4f}" for time_s, one in zip(times_s, ecg.signal_mv[:, 0], strict=True)
    )
    (tmp_path / "ecg.csv").write_text("\n".join(["time_s,II", *lines]) + "\n")
    rows = table(python_server(capsys, path, tmp_path / "ecg.csv", *TIP_MM)[1])
    assert rows[0, 0] == 1000
    late = rows[(rows[:, 0] > 1010) & (rows[:, 2] == 1) & (rows[:, 0] < 1000 + ecg.r_times_s[-1])]
    off = late[:, 1] - phase_at(late[:, 0] - 1000, ecg.r_times_s)
    assert len(late) > 5000
    assert np.percentile(np.abs(off - np.round(off)), 90) < 0.04


LOOP = """
int main(int count, char **words)
{
    bf_field field;
    bf_clock clock = bf_new_clock(0.8, 5);
    bf_tank tank = bf_full_tank(5, 20);
    tip tool = {{0, 0, 0}, 2, 0};
    long turn;
    if (count < 2 || bf_open(&field, words[1]) != BF_OK) return 1;
    field.fixture[0].device_force_n = 1.2;
    for (turn = 0; turn < 8000; turn++) {
        double force_n[3], tip_mm[3] = {20, 0, -7};
        int seen = turn < 4000 || turn > 4060;
        tip_mm[0] += 6 * sin(0.01 * (double)turn) + (turn > 7500 ? 200 : 0);
        if (turn > 5000) tip_mm[1] += 20;
        if (turn % 800 == 130) bf_beat(&clock, 0.001 * (double)(turn - 130), 0);
        if (one_turn(&field, 0, &clock, &tank, 0.001 * (double)turn, 1, &tool, seen ? tip_mm : NULL,
                     force_n) != BF_OK) return 2;
        fwrite(force_n, sizeof(double), 3, stdout);
    }
    bf_close(&field);
    return 0;
}
"""


@pytest.mark.parametrize("compiler", [pytest.param("gcc", marks=pytest.mark.slow), "g++"])
def test_the_pages_turn_of_a_loop_is_what_python_does(tmp_path, path, compiler):
    """Tracker, clock, fade, the device's limit, tank; the tip is not seen for 60 ms while it moves,
    is told to be elsewhere from one turn to the next, and leaves the grid at last."""
    if shutil.which(compiler) is None:
        pytest.skip(f"needs {compiler}")
    page = (DOCS / "field.md").read_text()
    [turn] = [part for part in re.findall("```c\n(.*?)```", page, re.DOTALL) if "one_turn" in part]
    headers = re.findall("#(?:define|include) .*BEATFIELD.*|#include .*", SERVER_C.read_text())
    (tmp_path / "loop.c").write_text("\n".join([*headers, turn, LOOP]))
    build(tmp_path / "loop.c", tmp_path / "loop", compiler=compiler)
    done = subprocess.run([tmp_path / "loop", path], capture_output=True, check=True)
    field, tank = ForceField.open(path), EnergyTank(5, 20)
    # A full force fades within 0.2 s.
    clock = PhaseClock(0.8, f_max_n=2.0, force_rate_n_per_s=10.0)
    mr_from_tracker, expected = field.mr_from_tracker, []
    asked_mm, lost = np.zeros(3), False
    for number in range(8000):
        x_mm = 20 + 6 * np.sin(0.01 * number) + (200 if number > 7500 else 0)
        seen_mm = np.array([x_mm, 20 if number > 5000 else 0, -7])
        seen = not 4000 <= number <= 4060
        lost = lost or not seen or np.abs(seen_mm - asked_mm).max() >= 2
        lost = lost and not (seen and clock.tick.fade == 0)
        asked_mm = asked_mm if lost else seen_mm
        point_mm = (mr_from_tracker @ (*asked_mm, 1))[:3]
        if number % 800 == 130:
            clock.beat(0.001 * (number - 130))
        outside = not field.contains([point_mm])[0]
        tick = clock.at(0.001 * number, withheld=lost or outside)
        force_n = tick.fade * np.array(field.force_at(*point_mm, tick.phase, "guide"))
        force_n *= min(1.0, 1.2 / max(np.linalg.norm(force_n), 1e-9))
        passed_n = np.array(tank.passed(point_mm, force_n))
        expected.append(passed_n @ mr_from_tracker[:3, :3])
    found = np.frombuffer(done.stdout).reshape(-1, 3)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
    size_n = np.linalg.norm(found, axis=1)
    assert size_n[:1000].max() == 0 < 1.19 < size_n.max() < 1.2 + 1e-9
    assert size_n[-300:].max() == 0
    assert size_n[5300:7500].max() > 0.5
    # 10 N/s, and what a way of 0.06 mm and the wall's own motion do to forces of 1.2 N.
    assert np.abs(np.diff(found, axis=0)).max() < 0.06
