"""The clock's C header: compiled without a warning, and the same answers as Python's clock."""

from __future__ import annotations

import shutil
import subprocess

import numpy as np
import pytest
from c_program import HERE, SANITIZE, build

from pipeline.field import get_include
from pipeline.registration.clock import KINDS, STATES, PhaseClock, to_cycle

DRIVER = HERE / "clock_driver.c"

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs a C compiler")


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return build(DRIVER, tmp_path_factory.mktemp("clock") / "driver", "-std=c99", *SANITIZE)


@pytest.mark.parametrize(
    ("compiler", "standard"),
    [("gcc", "-std=c99"), ("clang", "-std=c99"), ("g++", "-std=c++11")],
)
def test_compiles_without_a_warning(tmp_path, compiler, standard):
    if shutil.which(compiler) is None:
        pytest.skip(f"needs {compiler}")
    build(DRIVER, tmp_path / "driver", standard, compiler=compiler)


def stream(rng: np.random.Generator) -> np.ndarray:
    """Beats and questions in turn: ramps, early beats, disorder, pauses, lost leads, times back,
    beats taken back, and beats of another clock, before the first question too."""
    rows = [(0, 500.0 + rng.uniform(), False)] if rng.random() < 0.5 else []
    r_s, now_s, rr_s = 0.3, 0.0, float(rng.uniform(0.4, 1.2))
    for _ in range(300):
        mood = rng.integers(30)
        rr_s = float(np.clip(rr_s * (1 + 0.03 * rng.normal()), 0.3, 1.6))
        step_s = rr_s * {0: 0.65, 1: 1.4, 2: 3.5, 3: rng.uniform(0.5, 1.5)}.get(int(mood), 1.0)
        lost = mood == 4
        while now_s < r_s + 0.13:
            withheld = mood == 12 and rng.random() < 0.5
            rows.append((1, now_s, 2 * withheld or not (lost and rng.random() < 0.5)))
            now_s += float(rng.uniform(0.001, 0.05))
        if mood == 5:
            rows.append((1, now_s - rng.choice([5.0, 0.015, 0.025]), True))
        if mood == 11 and rng.random() < 0.3:
            rows.append((1, rng.choice([np.nan, np.inf, 1.7e308, 5e11, now_s + 900.0]), True))
        if mood == 7:
            rows.append((0, r_s + 1000.0, False))
        if mood == 9:
            rows += [(0, r_s - 0.15, False), (2, r_s, False)]
        if mood == 13:
            rows.append((3, rng.choice([0.5, 0.9, 1.3, 0.0, np.nan, 900.0]), False))
        rows.append((0, r_s - (2.0 if mood == 6 else 0.0), rng.random() < 0.1))
        if mood == 6:
            rows.append((2, r_s, False))
        if mood == 8:
            rows.append((0, r_s + rng.uniform(2.5, 3.5), False))
        if mood == 14:
            rows += [(0, r_s + k * rng.choice([0.005, 0.1, 0.18]), False) for k in range(1, 5)]
        if mood == 10:
            rows.append((0, now_s + rng.choice([0.015, 0.025, 0.4, 1.0]), False))
        if mood == 15:
            rows += [(0, now_s + 2.9, False), (0, now_s + 5.5, False)]
        if mood == 16:
            rows += [(0, r_s + 0.1, False), (1, now_s, False), (2, r_s, False)]
        r_s += step_s
    return np.array(rows, dtype=float)


def by_python(rows: np.ndarray, cycle_rr_s: float, latency_s: float) -> np.ndarray:
    from pipeline.registration import ticks

    clock = PhaseClock(cycle_rr_s, f_max_n=2.0, force_rate_n_per_s=8.0, latency_s=latency_s)
    c, out = clock._state, np.zeros((len(rows), 6))
    for row, (what, time_s, flag) in zip(out, rows, strict=True):
        if what == 0:
            row[0] = ticks.beat(c, time_s, bool(flag))
        elif what == 2:
            clock.take_back()
        elif what == 3:
            row[0] = ticks.change(c, time_s, 5.0) if 0.2 <= time_s <= 3.0 else -1
        else:
            row[0] = ticks.advance(c, time_s, flag > 0, flag > 1)
            row[1:] = c[[ticks.PHASE, ticks.SD, ticks.STATE, ticks.VALID, ticks.FADE]]
    return out


@pytest.mark.parametrize("seed", range(8))
def test_c_says_what_python_says(program, seed):
    rng = np.random.default_rng(seed)
    rows, cycle_rr_s = stream(rng), float(rng.uniform(0.5, 1.2))
    latency_s = 0.14 if seed % 2 else 0.3
    given = np.array([cycle_rr_s, 4.0, latency_s]).tobytes() + rows.tobytes()
    done = subprocess.run([program], input=given, capture_output=True, check=True)
    found = np.frombuffer(done.stdout).reshape(-1, 6)
    expected = by_python(rows, cycle_rr_s, latency_s)
    # Both sides do the same operations in the same order; libm and the compiler's own functions
    # may differ by units in the last place, which nothing here amplifies a millionfold.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    assert {0, 1, 2} <= set(expected[:, 3]), "the stream meets most states"
    other_clock = expected[(rows[:, 0] == 0) & (rows[:, 1] > 1000), 0]
    assert len(other_clock)
    assert (other_clock == -1).all()
    changes = expected[rows[:, 0] == 3, 0]
    assert len(changes)
    assert len(STATES) == 4
    assert len(KINDS) == 3


NEVER_VALID = r"""
#include <stdio.h>
#include <math.h>
#define BEATFIELD_CLOCK_IMPLEMENTATION
#include "beatfield_clock.h"
int main(void)
{
    const double wrong[][2] = {{0.0, 5.0}, {800.0, 5.0}, {NAN, 5.0}, {0.8, -5.0}, {0.8, 0.0},
                               {0.8, INFINITY}, {0.8, NAN}, {0.19, 5.0}, {0.8, 5.0},
                               {0.8, 5.0}};
    int n, k;
    for (n = 0; n < 10; n++) {
        bf_clock clock = bf_new_clock(wrong[n][0], wrong[n][1]);
        bf_tick tick;
        double most = 0, least = 0;
        int valid = 0, sound = 1;
        if (n == 9) clock.latency_s = 1.01; /* nobody waits so long for a beat */
        for (k = 0; k < 20000; k++) {
            if (k % 800 == 130) bf_beat(&clock, 0.001 * (k - 130), 0);
            bf_now(&clock, 0.001 * k, 1, &tick);
            valid += tick.valid;
            sound &= isfinite(tick.phase) && isfinite(tick.sd);
            most = fmax(most, tick.fade);
            least = fmin(least, tick.fade);
        }
        printf("%d %d %g %g\n", valid > 0, sound, least, most);
    }
    return 0;
}
"""


def test_beats_as_near_to_each_other_as_their_spread_are_pythons(program):
    rows = np.array([[0, 0.0, 0], [0, 0.18, 0], [1, 0.19, 1]])
    given = np.array([3.0, 4.0, 0.14]).tobytes() + rows.tobytes()
    done = subprocess.run([program], input=given, capture_output=True, check=True)
    found = np.frombuffer(done.stdout).reshape(-1, 6)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found, by_python(rows, 3.0, 0.14), rtol=0, atol=1e-9)


def test_a_clock_of_nonsense_is_never_valid_and_renders_nothing(tmp_path):
    (tmp_path / "wrong.c").write_text(NEVER_VALID)
    program = build(tmp_path / "wrong.c", tmp_path / "wrong", "-std=c99", *SANITIZE)
    said = subprocess.run([program], capture_output=True, check=True, text=True).stdout.split("\n")
    assert said[:8] == ["0 1 0 0"] * 8
    assert said[8:10] == ["1 1 0 1", "0 1 0 0"]


def test_a_compiler_that_takes_no_numbers_for_numbers_is_refused(tmp_path):
    command = ["gcc", "-ffast-math", f"-I{get_include()}", "-c", str(DRIVER)]
    done = subprocess.run(
        [*command, "-o", tmp_path / "out.o"], capture_output=True, check=False, text=True
    )
    assert done.returncode != 0
    assert "compile without -ffast-math" in done.stderr


def test_phases_map_alike(tmp_path):
    source = tmp_path / "map.c"
    source.write_text(
        '#include <stdio.h>\n#define BEATFIELD_CLOCK_IMPLEMENTATION\n#include "beatfield_clock.h"\n'
        "int main(void) { double q[3]; while (fread(q, sizeof q, 1, stdin) == 1) {"
        " double p = bf_to_cycle(q[0], q[1], q[2]); fwrite(&p, sizeof p, 1, stdout); } return 0; }"
    )
    target = build(source, tmp_path / "map", "-std=c99")
    rng = np.random.default_rng(0)
    questions = np.column_stack(
        [rng.uniform(0, 1, 1000), rng.uniform(0.25, 2.5, 1000), np.full(1000, 0.85)]
    )
    done = subprocess.run([target], input=questions.tobytes(), capture_output=True, check=True)
    expected = to_cycle(questions[:, 0], questions[:, 1], 0.85)
    np.testing.assert_allclose(np.frombuffer(done.stdout), expected, rtol=0, atol=1e-12)
    # What tells no phase is no number, which a field refuses; a 0 would be the R peak's.
    none = [[0.3, 0.8, 0], [0.3, 0, 0.8], [0.3, 0, 0], [0.3, -1, 0.8]]
    none += [[0.3, np.nan, 0.8], [0.3, np.inf, 0.8], [0.3, 0.8, np.inf], [np.nan, 0.7, 0.8]]
    given = np.array(none, dtype=float).tobytes()
    done = subprocess.run([target], input=given, capture_output=True, check=True)
    assert np.isnan(np.frombuffer(done.stdout)).all()
