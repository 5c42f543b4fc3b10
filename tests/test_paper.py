"""`beatfield paper`: parts, files, refusals."""

from __future__ import annotations

import csv
import re
import shlex
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from field_baked import RADII_MM, RR_S
from field_shapes import beating, sphere

from pipeline.cli import main
from pipeline.errors import InputError
from pipeline.field import BakeSettings, Fixture, ForceField
from pipeline.field.bake import bake_field
from pipeline.paper import robustness
from pipeline.paper.constrained_motion import _shown, phases_between
from pipeline.paper.dissection import clock, rows_of
from pipeline.paper.laws import slopes
from pipeline.paper.options import PaperOptions
from pipeline.paper.reader_time import percentiles_us
from pipeline.paper.subject import open_subject
from pipeline.paper.torus_tool import frame_about, ring
from pipeline.paper.write import EXPERIMENTS
from pipeline.products import FrameRow, write_frames

FIXTURE = Fixture(structure="epicardium", kind="guidance", gamma_mm=2.5, m=2, f_max_n=2.0)


def bake(path: Path, rr_s: float | None = RR_S) -> Path:
    surfaces = {"epicardium": beating(sphere(1.0, 4), 1.6 * RADII_MM, np.arange(5) / 5)}
    settings = BakeSettings(spacing_mm=3.0, samples=100, fit_rounds=0)
    bake_field(
        path, surfaces, {"guide": FIXTURE}, settings, mr_from_tracker=None, rr_s=rr_s, source={}
    )
    return path


@pytest.fixture(scope="module")
def field_path(tmp_path_factory):
    return bake(tmp_path_factory.mktemp("paper") / "field.zarr")


def paper(out: Path, products: Path, *more: str) -> int:
    return main(["paper", str(out), "--products", str(products), *more])


def test_a_field_alone_gives_its_parts_and_says_what_is_left_out(field_path, tmp_path, capsys):
    out = tmp_path / "out"
    parts = ["--only", "figure-2", "--only", "figure-3", "--only", "figure-4"]
    assert paper(out, field_path, *parts) == 0
    page = (out / "index.html").read_text()
    assert str(out / "index.html") in capsys.readouterr().out
    assert "Figure 4 is left out: it needs a patient" in page
    assert "--only figure-2" in page
    # Self-contained: nothing is fetched from elsewhere.
    assert not re.findall(r'(?:src|href)="(?!data:|#)', page)
    assert (out / "figure-2-1.svg").read_bytes().startswith(b"<?xml")
    rows = list(csv.reader((out / "figure-2-table-1.csv").read_text().splitlines()))
    assert [row[0] for row in rows[1:]] == ["1", "2", "4", "8", "16"]


def test_the_same_command_writes_the_same_bytes(field_path, tmp_path):
    """Whatever a user's own figures look like."""
    assert paper(tmp_path / "a", field_path, "--only", "figure-2") == 0
    with matplotlib.rc_context({"axes.facecolor": "black", "text.usetex": True}):
        assert paper(tmp_path / "b", field_path, "--only", "figure-2") == 0
    names = sorted(path.name for path in (tmp_path / "a").iterdir())
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--only", "figure-9"], "figure-9: no such part; there are figure-2"),
        (["--operators", "1"], "an interval needs at least 2"),
        (["--seed", "-1"], "must be 0 or more"),
        (["--only", "figure-2", "--study", "nowhere"], "nowhere"),
    ],
)
def test_wrong_options_are_refused(field_path, tmp_path, capsys, more, words):
    assert paper(tmp_path / "out", field_path, *more) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_folder_of_something_else_is_left_alone(field_path, tmp_path, capsys):
    (tmp_path / "mine").write_text("dear")
    assert paper(tmp_path, field_path, "--only", "figure-3") == 2
    assert "was not written by this command" in capsys.readouterr().err
    assert (tmp_path / "mine").read_text() == "dear"


def test_what_is_no_field_and_a_field_without_a_clock_are_refused(tmp_path, capsys):
    assert paper(tmp_path / "out", tmp_path) == 2
    assert "holds neither bake/field.zarr nor zarr.json" in capsys.readouterr().err
    timeless = bake(tmp_path / "timeless.zarr", rr_s=None)
    assert paper(tmp_path / "out", timeless) == 2
    assert "how long a heartbeat takes" in capsys.readouterr().err


def test_every_part_of_the_paper_is_there():
    said = " ".join(one.what for one in EXPERIMENTS.values())
    for number in range(2, 8):
        assert f"Figure {number}" in said
    assert "Table 1" in said


def test_slopes_read_from_the_field_are_the_analytic_ones(field_path):
    for slope in slopes(open_subject(field_path)):
        # Differences over 0.01 mm miss the peak by f''' h^2 / 8 of it, below 1e-3 for m = 16; the
        # gradient of this coarse field is within 3 % of 1, which the direction takes out.
        assert slope.formula_n_per_mm == pytest.approx(slope.analytic_n_per_mm, rel=1e-3)
        assert slope.field_n_per_mm == pytest.approx(slope.analytic_n_per_mm, rel=5e-3)


def test_force_errors_grow_from_nothing_with_the_errors_of_registration(field_path):
    field = ForceField.open(field_path)
    in_space = [robustness.force_errors(field, "guide", s, 0.0, 1).mean() for s in (0, 1, 2, 5)]
    in_time = [robustness.force_errors(field, "guide", 0, t, 1).mean() for t in (0, 0.02, 0.1)]
    assert in_space[0] == in_time[0] == 0
    assert in_space == sorted(in_space)
    assert in_time == sorted(in_time)


def test_a_phase_error_of_a_whole_beat_is_none(field_path):
    field = ForceField.open(field_path)
    # One beat later is the same phase but for the rounding of a sum near 1.
    assert robustness.force_errors(field, "guide", 0.0, RR_S, 1).max() < 1e-9


def test_rows_without_force_stand_before_those_that_are_compared_with_them():
    rows = rows_of("epicardium")
    for row in rows:
        free = rows[row.beside].condition
        assert free.fixture is None
        assert (free.tool, free.beating) == (row.condition.tool, row.condition.beating)
        assert free.handle == row.condition.handle
    assert {row.condition.tool for row in rows} == {"point", "needle", "torus"}


def test_a_sweep_without_frames_that_bear_the_registration_out_is_not_shown(tmp_path):
    sweeps = [SimpleNamespace(name="first"), SimpleNamespace(name="second")]
    rows = [FrameRow(one, n, 0.1 * n, 0.1, 0.5, one == "second") for one in ("first", "second")
            for n in range(3)]  # fmt: skip
    write_frames(tmp_path / "frames.csv", rows)
    sweep, shown = _shown(sweeps, tmp_path / "frames.csv")
    assert sweep.name == "second"
    assert [row.frame for row in shown] == [0, 1, 2]
    with pytest.raises(InputError, match="no sweep has two frames"):
        _shown(sweeps[:1], tmp_path / "frames.csv")


def test_times_are_written_as_in_the_paper():
    assert [clock(s) for s in (211, 90, 225, 86)] == ["3'31\"", "1'30\"", "3'45\"", "1'26\""]


def test_ring_and_frame():
    frame = frame_about(np.array([0.3, -2.0, 0.4]))
    assert frame.T @ frame == pytest.approx(np.eye(3), abs=1e-15)
    assert np.linalg.det(frame) == pytest.approx(1)
    assert np.linalg.norm(ring(7, 10.0), axis=1) == pytest.approx(10.0)


def test_percentiles_rise():
    found = percentiles_us(lambda n: sum(range(n % 50)), 500)
    assert (np.diff(found) >= 0).all()
    assert found[0] > 0


@pytest.mark.parametrize("rr_s", [0.6, 0.8, 1.1])
def test_the_heart_of_figure_6_beats_as_the_frames_tell(rr_s: float) -> None:
    """Not at the rate of the images that the field was made of, by which only lost beats count."""
    times_s = np.sort(np.random.default_rng(3).uniform(2, 9, 25))
    # Nobody looked for two beats.
    times_s[12:] += 2 * rr_s
    at_s = np.linspace(times_s[0], times_s[-1], 400)
    found = phases_between(times_s, times_s / rr_s % 1, at_s, 0.9 * rr_s)
    away = (found - at_s / rr_s + 0.5) % 1 - 0.5
    np.testing.assert_allclose(away, 0, atol=1e-9)


def test_the_command_of_a_part_can_be_pasted_and_names_the_study():
    chosen = PaperOptions(products=Path("my products"), study=Path("a study"))
    words = shlex.split(chosen.command())
    assert words[words.index("--products") + 1] == "my products"
    assert words[words.index("--study") + 1] == "a study"
    assert "--study mine" in PaperOptions(study=Path("mine")).command()
