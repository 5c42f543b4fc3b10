"""Hearts of another renderer are labelled, and what is no heart is refused."""

import ast
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from mr_phantom import dice

from pipeline.errors import StageError
from pipeline.imaging.labels import LABELS
from pipeline.imaging.segmentation import segment_cine
from pipeline.imaging.settings import SegmentSettings
from tests import outside_anatomy, outside_chest, outside_heart, outside_people, outside_shapes
from tests.outside_anatomy import (
    Stuff,
    heart_stuff,
    left_ventricle,
)
from tests.outside_heart import Scan, render, steady_state, without_heart
from tests.outside_people import ILLNESSES, draw_body, made_ill

SEEDS = (1, 2, 3)
"""Three people; nothing was chosen by what they give."""

FEW = SEEDS[:1]
"""Those whom quick tests ask."""

AS_USUAL = SegmentSettings(most_views=2)
"""The ways in which a study of 12 slices in 25 phases is looked at; one of two phases would be in
five."""

LOSS = 0.04
"""Most that images from elsewhere may cost, in Dice."""

REQUIRED = {"lv_cavity": 0.95, "lv_myocardium": 0.89, "rv_cavity": 0.93}
"""Dice required on the phantom's own images."""


@cache
def drawn(seed):
    return render(seed, Scan())


PEOPLE = (
    pytest.param((1.0, FEW), id="an adult"),
    pytest.param((1.0, SEEDS), id="adults", marks=pytest.mark.slow),
    pytest.param((0.7, SEEDS[1:]), id="children", marks=pytest.mark.slow),
)


@pytest.fixture(scope="module", params=PEOPLE)
def people(request):
    """Truth and labels of each person at end-diastole and end-systole; a child is all smaller."""
    size, seeds = request.param
    pairs = []
    for seed in seeds:
        outside = drawn(seed)
        frame = outside.cine.mr_from_index.copy()
        frame[:3, :3] *= size
        found = segment_cine(replace(outside.cine, mr_from_index=frame), AS_USUAL)
        pairs.append((outside.labels, found.labels))
    return pairs


@pytest.mark.parametrize("name", REQUIRED)
def test_hearts_from_elsewhere_cost_little_dice(people, name):
    value = LABELS[name]
    over = [
        dice(found[k] == value, truth[k] == value)
        for truth, found in people
        for k in range(len(truth))
    ]
    assert np.mean(over) >= REQUIRED[name] - LOSS


def test_no_person_is_lost(people):
    """Half of each ventricle would be missed or invented below a Dice of 2/3."""
    for truth, found in people:
        for name in REQUIRED:
            assert dice(found == LABELS[name], truth == LABELS[name]) > 2 / 3


@pytest.mark.parametrize(
    ("kind", "seed"), [pytest.param("brain", 1, marks=pytest.mark.slow), ("chest", 1)]
)
def test_images_without_a_heart_are_refused_by_slice_and_phase(kind, seed):
    with pytest.raises(StageError, match=r"(?s)(slice.*phase|phase.*slice)"):
        segment_cine(without_heart(kind, seed), AS_USUAL)


@pytest.mark.parametrize("kind", ["constant", pytest.param("gradient", marks=pytest.mark.slow)])
def test_images_that_show_nothing_are_refused(kind):
    with pytest.raises(StageError, match="no heart found"):
        segment_cine(without_heart(kind), AS_USUAL)


def test_the_renderer_shares_nothing_with_the_phantom():
    for module in (
        outside_anatomy,
        outside_chest,
        outside_heart,
        outside_people,
        outside_shapes,
    ):
        tree = ast.parse(Path(module.__file__).read_text())
        named = [
            name
            for node in ast.walk(tree)
            if isinstance(node, ast.Import | ast.ImportFrom)
            for name in [getattr(node, "module", None), *(part.name for part in node.names)]
        ]
        assert not [name for name in named if name and name.startswith("data_synth")]


@pytest.mark.parametrize("field_t", [1.5, 3.0])
def test_signal_on_resonance_is_the_textbooks(field_t):
    """Bernstein et al., Handbook of MRI Pulse Sequences (2004), balanced steady state."""
    angle, tr = 55.0, 3.1
    found = steady_state(field_t, angle, tr, np.zeros(1))
    for kind in (Stuff.BLOOD, Stuff.LV_MUSCLE, Stuff.LIVER):
        t1, t2, density = outside_heart.RELAXATION_MS[field_t][kind]
        e1, e2, a = np.exp(-tr / t1), np.exp(-tr / t2), np.radians(angle)
        wanted = np.sin(a) * (1 - e1) / (1 - (e1 - e2) * np.cos(a) - e1 * e2)
        assert abs(found[kind, 0]) == pytest.approx(
            density * wanted * np.exp(-tr / 2 / t2), rel=1e-5
        )


def test_drawn_volumes_are_those_of_the_body():
    """Counted on a grid that holds the ventricle, at both ends of the beat.

    Nodes 2 mm apart in a body of surface 150 cm^2 count it to 2 mm * sqrt(150 cm^2 * 2 mm) = 0.3 ml
    a standard deviation.
    """
    body = draw_body(np.random.default_rng(8))
    # Flat across the axis, so that the mitral plane takes nothing off either side.
    body = replace(body, mitral_tilt=0.0)
    z, y, x = np.meshgrid(np.arange(-130, 10, 2), *[np.arange(-60, 60, 2)] * 2, indexing="ij")
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32) + np.float32(1)
    for phase, kept in ((0.0, 1.0), (body.systole, 1 - body.lv_ef)):
        stuff = heart_stuff(body, points, phase)
        cavity_ml = np.isin(stuff, (Stuff.LV_BLOOD, Stuff.LV_PAPILLARY)).sum() * 0.008
        whole_ml = cavity_ml + (stuff == Stuff.LV_MUSCLE).sum() * 0.008
        wanted_ml = kept * body.lv_ed_ml
        # The outflow tract is carved out of the muscle: a tube of the root's size, 10 mm long,
        # part of which was cavity already.
        carved_ml = np.pi * body.root_radius**2 * 15 / 1000
        assert wanted_ml * 0.99 < cavity_ml < wanted_ml + carved_ml
        assert whole_ml == pytest.approx(wanted_ml + body.muscle_ml, rel=0.01)
    assert left_ventricle(body, body.systole).wall > left_ventricle(body, 0.0).wall


def along_x(body, phase=0.0):
    """What lies on the way from the side wall to the right ventricle, at mid height, by 0.1 mm."""
    x = np.arange(-60, 90, 0.1, dtype=np.float32)
    middle_mm = left_ventricle(body, phase).base - 0.4 * body.lv_length
    line = np.stack([x, np.full_like(x, 3.0), np.full_like(x, middle_mm)], axis=1)
    return x, heart_stuff(body, line, phase)


RIGHT = (Stuff.RV_BLOOD, Stuff.RV_TRABECULA)


@pytest.mark.parametrize("seed", range(5))
def test_illnesses_are_as_they_say(seed):
    rng = np.random.default_rng([seed, 5])
    # Round, and without trabeculae, so that ends of the cavity tell its shape.
    body = replace(draw_body(rng), squash=1.0, mitral_tilt=0.0, trabeculae=-9.0)
    for illness in ILLNESSES:
        ill = made_ill(rng, body, illness)
        x, stuff = along_x(ill)
        inside = x[np.isin(stuff, (Stuff.LV_BLOOD, Stuff.LV_PAPILLARY))]
        muscle = x[stuff == Stuff.LV_MUSCLE]
        side, septum = float(inside[0] - muscle[0]), float(muscle[-1] - inside[-1])
        # Half a millimetre of each length: steps, and a tube of the outflow's that grazes it.
        if illness == "overload":
            assert inside[-1] == pytest.approx((1 - ill.flat) * -inside[0], abs=0.5)
            assert septum == pytest.approx(side, abs=1.5)
            usual = np.isin(along_x(body)[1], RIGHT).sum()
            assert np.isin(stuff, RIGHT).sum() > 1.2 * usual
        elif illness not in ("scar", "right"):
            assert septum - side == pytest.approx(2 * ill.lopsided, abs=0.5)
            assert inside[-1] + inside[0] == pytest.approx(-2 * ill.lopsided, abs=0.5)
        if illness == "thick":
            # A wall of 15 mm is what the illness is known by.
            assert septum > 15
            emptied = left_ventricle(ill, ill.systole).radius / left_ventricle(ill, 0.0).radius
            assert emptied < 0.65
        if illness == "wide":
            # Men's normal ones are up to 58 mm wide (Lang et al., J. Am. Soc. Echocardiogr.
            # 28:1-39, 2015).
            assert inside[-1] - inside[0] > 58
        if illness == "right":
            free = x[(stuff == Stuff.WALL) & (x > x[np.isin(stuff, RIGHT)].max())]
            # Slanting walls and flat ellipsoids are thicker along the line than they are.
            assert 0.9 * ill.rv_wall < len(free) / 10 < 2 * ill.rv_wall


@pytest.mark.parametrize("seed", range(12))
def test_a_scar_is_as_thin_as_it_says_and_bulges_at_end_systole(seed):
    rng = np.random.default_rng([seed, 6])
    body = replace(draw_body(rng), squash=1.0, mitral_tilt=0.0, trabeculae=-9.0)
    ill = made_ill(rng, body, "scar")
    scar, reached = ill.scar, []
    for phase in (0.0, ill.systole):
        now = left_ventricle(ill, phase)
        size = np.array([now.radius + now.wall] * 2 + [0.55 * now.length + now.wall])
        place = np.array([0, 0, now.base - 0.45 * now.length]) + size * scar.way
        # Along the ellipsoid's own direction outwards there.
        out = scar.way / size
        out /= np.linalg.norm(out)
        along = np.arange(-25, 25, 0.1)
        line = (place + along[:, None] * out).astype(np.float32)
        muscle = along[heart_stuff(ill, line, phase) == Stuff.LV_MUSCLE]
        whole = along[heart_stuff(replace(ill, scar=None), line, phase) == Stuff.LV_MUSCLE]
        # What papillary muscles stand there are the cavity's. A tip may be thinner than its scar.
        thick = len(muscle) / 10
        assert thick < 1.25 * scar.wall + 0.3
        assert thick > 0.75 * min(scar.wall, len(whole) / 10) - 0.3
        reached.append(muscle[-1] - whole[-1])
    assert reached[0] == pytest.approx(0.3 * scar.bulge, abs=0.15 * scar.bulge + 0.3)
    assert reached[1] == pytest.approx(scar.bulge, abs=0.3 * scar.bulge + 0.3)


def test_a_thick_right_wall_takes_nothing_of_aorta_and_atria():
    rng = np.random.default_rng(11)
    points = rng.uniform((-60, -70, -110), (110, 80, 90), (200_000, 3)).astype(np.float32)
    for _ in range(5):
        ill = made_ill(rng, draw_body(rng), "right")
        was, now = (heart_stuff(one, points, 0.1) for one in (replace(ill, rv_wall=2.5), ill))
        assert (now == Stuff.WALL).sum() > (was == Stuff.WALL).sum()
        for kind in (Stuff.AORTA, Stuff.LEFT_ATRIUM, Stuff.RIGHT_ATRIUM, Stuff.RV_BLOOD):
            np.testing.assert_array_equal(now == kind, was == kind)


def test_fluid_surrounds_the_heart_and_changes_nothing_of_it():
    rng = np.random.default_rng(7)
    ill = made_ill(rng, draw_body(rng), "fluid")
    points = rng.uniform((-80, -80, -110), (100, 80, 80), (200_000, 3)).astype(np.float32)
    was, now = (heart_stuff(one, points, 0.2) for one in (replace(ill, fluid=0.0), ill))
    changed = was != now
    assert set(was[changed]) <= {Stuff.NONE, Stuff.FAT, Stuff.PERICARDIUM}
    assert set(now[changed]) == {Stuff.SPINAL_FLUID, Stuff.PERICARDIUM}
    cell_ml = 180 * 160 * 190 / 1000 / len(points)
    assert 50 < (now == Stuff.SPINAL_FLUID).sum() * cell_ml < 800


def test_a_spongy_wall_fills_more_of_the_cavity():
    rng = np.random.default_rng(9)
    body = draw_body(rng)
    ill = made_ill(rng, body, "spongy")
    points = rng.uniform((-40, -40, -100), (40, 40, 0), (100_000, 3)).astype(np.float32)
    shares = []
    for one in (replace(ill, sponge=0.0, trabeculae=body.trabeculae), ill):
        stuff = heart_stuff(one, points, 0.0)
        knots = (stuff == Stuff.LV_PAPILLARY).sum()
        shares.append(knots / (knots + (stuff == Stuff.LV_BLOOD).sum()))
    assert shares[1] > 2 * shares[0]


def test_an_unknown_illness_is_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="no illness 'gout'"):
        made_ill(rng, draw_body(rng), "gout")


def test_noise_is_as_asked():
    scan = Scan(phases=(0.0,), slices=3, snr=12.0, shading=0.0, depths=1)
    noisy, clean = (render(4, replace(scan, snr=snr)) for snr in (12.0, 1e6))
    blood = clean.labels == LABELS["lv_cavity"]
    error = (noisy.cine.intensity - clean.cine.intensity)[blood]
    # Papillary muscles stand in the cavity: the upper quartile is blood alone. Blood's signal
    # varies by inflow (up to 12 %), and so does what the noise is measured by: none is left.
    level = np.quantile(clean.cine.intensity[blood], 0.75)
    # Two thousand pixels tell a deviation to 1/sqrt(4000) = 1.6 %; field errors dim blood by 1 %.
    assert error.std() == pytest.approx(level / 12, rel=0.08)


def test_a_person_is_the_same_whatever_the_phases():
    """End-diastole alone or as one of two phases: the same labels."""
    scan = Scan(phases=(0.0,), slices=2, depths=1)
    one, two = render(6, scan), render(6, replace(scan, phases=(0.0, 0.3)))
    np.testing.assert_array_equal(one.labels[0], two.labels[0])
    np.testing.assert_array_equal(one.cine.mr_from_index, two.cine.mr_from_index)
