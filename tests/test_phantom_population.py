"""Drawn hearts have the sizes of healthy adults, and each pathology its defining measure."""

from functools import lru_cache

import numpy as np
import pytest

from data_synth.errors import SynthError
from data_synth.heart import BeatingHeart
from data_synth.measures import measure_heart, wall_thickness_mm
from data_synth.pathology import PATHOLOGIES, Person
from data_synth.population import draw_heart, draw_person
from data_synth.profiles import away_from, endocardium_at, epicardium

Drawn = tuple[BeatingHeart, Person, dict[str, float]]

HEALTHY = 12
ILL = 2

# Normal ranges, mean -+ 2 standard deviations: men, women. Hudsmith et al., J. Cardiovasc. Magn.
# Reson. 7:775-782, 2005 (volumes); Petersen et al., ibid. 19:18, 2017 (ejection, mass by body
# surface); Kawel et al., Circ. Cardiovasc. Imaging 5:500-508, 2012 (wall); Davis et al., J.
# Cardiovasc. Magn. Reson. 16:9, 2014 (aortic sinus).
NORMAL = {
    "lv_ml": ((102, 218), (83, 187)),
    "lv_systolic_ml": ((18, 82), (18, 66)),
    "lv_ejection": ((0.48, 0.68), (0.51, 0.71)),
    "lv_mass_g_m2": ((35, 71), (28, 56)),
    "rv_ml": ((124, 256), (78, 218)),
    "rv_systolic_ml": ((38, 118), (20, 92)),
    "la_ml": ((43, 163), (47, 131)),
    "lv_wall_mm": ((4.1, 8.5), (3.5, 7.1)),
    "sinus_mm": ((24.7, 40.1), (21.8, 33.4)),
}
# Means of the same sources, men and women together weighed alike, with the deviation of one sex.
POOLED = {"lv_ml": (147.5, 27.5), "lv_ejection": (0.595, 0.05), "rv_ml": (169, 34)}


@lru_cache(maxsize=32)
def measured(seed: int, pathology: str = "healthy") -> Drawn:
    """A heart, the person it belongs to, and what is measured on its meshes."""
    heart = draw_heart(np.random.default_rng([7, seed]), pathology=pathology)
    person = draw_person(np.random.default_rng([7, seed]))
    measures = measure_heart(heart)
    for side in ("lv", "rv"):
        measures[f"{side}_systolic_ml"] = measures[f"{side}_ml"] - measures[f"{side}_stroke_ml"]
    measures["lv_mass_g_m2"] = measures["lv_mass_g"] / person.body_surface_m2
    measures["sinus_mm"] = 2 * heart.shape.sinus_radius
    return heart, person, measures


@pytest.fixture(scope="module")
def healthy() -> list[Drawn]:
    return [measured(seed) for seed in range(HEALTHY)]


def test_both_sexes_are_drawn(healthy):
    men = sum(person.male for _, person, _ in healthy)
    # Outside for one generator in 1e3.
    assert 2 <= men <= HEALTHY - 2


@pytest.mark.parametrize("name", NORMAL)
def test_every_healthy_heart_lies_in_the_normal_range_of_its_sex(healthy, name):
    for _, person, measures in healthy:
        low, high = NORMAL[name][0 if person.male else 1]
        assert low <= measures[name] <= high


@pytest.mark.parametrize("name", POOLED)
def test_the_population_is_centred_on_the_published_mean(healthy, name):
    mean, deviation = POOLED[name]
    values = [measures[name] for _, _, measures in healthy]
    # Half a deviation, and three standard errors for the few hearts drawn here.
    assert np.mean(values) == pytest.approx(mean, abs=deviation * (0.5 + 3 / HEALTHY**0.5))
    assert np.std(values) > 0.3 * deviation


@pytest.mark.parametrize("name", POOLED)
def test_people_are_drawn_about_the_published_mean(name):
    mean, deviation = POOLED[name]
    people = [draw_person(np.random.default_rng([7, seed])) for seed in range(400)]
    # Three standard errors, and a fifth of a deviation, by which ventricles that must eject alike
    # give way to one another.
    assert np.mean([getattr(one, name) for one in people]) == pytest.approx(
        mean, abs=deviation * (0.2 + 3 / 400**0.5)
    )


def test_right_atrium_lies_between_the_published_ranges(healthy):
    """At most 77 + 2 * 11 ml/m2 (Radiology 191:137-142, 1994: casts and eight subjects).

    Two-dimensional estimates are lower, so the lower bound is three deviations below that mean.
    """
    for _, person, measures in healthy:
        assert 77 - 3 * 11 < measures["ra_ml"] / person.body_surface_m2 < 77 + 2 * 11


def test_both_ventricles_eject_the_same(healthy):
    for _, _, measures in healthy:
        assert measures["rv_stroke_ml"] == pytest.approx(measures["lv_stroke_ml"], rel=0.1)
        assert measures["rv_ejection"] > 0.45


def test_atria_empty_by_a_third_to_two_thirds(healthy):
    """58 of 103 ml in men, 48 of 89 ml in women (Hudsmith et al. 2005): 55 % on average."""
    for _, _, measures in healthy:
        assert 0.4 < measures["la_emptying"] < 0.66
        assert 0.3 < measures["ra_emptying"] < 0.6


def test_sizes_go_with_the_body(healthy):
    """Larger bodies have larger ventricles, and both ventricles go together."""
    area = [person.body_surface_m2 for _, person, _ in healthy]
    left = [measures["lv_ml"] for _, _, measures in healthy]
    right = [measures["rv_ml"] for _, _, measures in healthy]
    assert np.corrcoef(area, left)[0, 1] > 0.3
    assert np.corrcoef(left, right)[0, 1] > 0.8


def test_measures_are_those_asked_of_the_person(healthy):
    """Meshes of 3 mm lose up to 2.5 % of the atria, 1.5 % of the ventricles."""
    for _, person, measures in healthy:
        assert measures["lv_ml"] == pytest.approx(person.lv_ml, rel=0.025)
        assert measures["rv_ml"] == pytest.approx(person.rv_ml, rel=0.035)
        assert measures["lv_mass_g"] == pytest.approx(person.lv_mass_g, rel=0.05)
        assert measures["la_ml"] == pytest.approx(person.la_ml, rel=0.06)
        assert measures["ra_ml"] == pytest.approx(person.ra_ml, rel=0.06)
        assert measures["lv_ejection"] == pytest.approx(person.lv_ejection, abs=0.02)


# Pathologies.


@pytest.mark.parametrize("seed", range(ILL))
def test_dilated_cardiomyopathy(seed):
    """Larger by more than two deviations, and ejection below 40 %."""
    _, person, measures = measured(seed, "dilated_cardiomyopathy")
    assert measures["lv_ml"] > NORMAL["lv_ml"][0 if person.male else 1][1]
    assert 0.1 < measures["lv_ejection"] < 0.4
    # Rounder than the same person's healthy heart.
    rounder = measures["lv_sphericity"] / measured(seed)[2]["lv_sphericity"]
    assert rounder > 1.1
    assert measures["rv_stroke_ml"] == pytest.approx(measures["lv_stroke_ml"], rel=0.1)


@pytest.mark.parametrize("seed", range(ILL))
def test_hypertrophic_cardiomyopathy(seed):
    """A septum of 15 mm or more, 1.3 times and more the wall opposite; it empties well."""
    heart, _, measures = measured(seed, "hypertrophic_cardiomyopathy")
    walls = wall_thickness_mm(heart)
    angles = np.linspace(-np.pi, np.pi, walls.shape[1], endpoint=False)
    septum = walls[:, np.abs(angles) < 0.8].max()
    lateral = walls[:, np.abs(angles) > np.pi - 0.5].mean()
    assert 15 <= septum < 30
    assert measures["lv_wall_largest_mm"] == septum
    assert septum > 1.3 * lateral
    assert lateral < 12
    assert measures["lv_ejection"] > 0.6
    assert measures["lv_mass_g"] > measured(seed)[2]["lv_mass_g"] * 1.25


@pytest.mark.parametrize("seed", range(ILL))
def test_right_ventricular_dilation(seed):
    """The major criterion of size: 110 ml/m2 in men, 100 ml/m2 in women; ejection at most 45 %."""
    _, person, measures = measured(seed, "rv_dilation")
    index = measures["rv_ml"] / person.body_surface_m2
    assert (110 if person.male else 100) < index < 180
    assert measures["rv_ejection"] <= 0.45
    assert measures["rv_stroke_ml"] == pytest.approx(measures["lv_stroke_ml"], rel=0.1)


@pytest.mark.parametrize("seed", range(ILL))
def test_infarct_is_thin_and_still(seed):
    """In the segment: wall below 5.5 mm that hardly thickens; opposite, it thickens by a third."""
    heart, _, measures = measured(seed, "infarct")
    shape = heart.shape
    assert measures["lv_wall_smallest_mm"] < min(5.5, 0.75 * measures["lv_wall_largest_mm"])
    assert measures["lv_ejection"] < 0.5
    assert (shape.scar_angle, shape.scar_height) == (
        heart.pulse.infarct_angle,
        heart.pulse.infarct_height,
    )

    def thickening(angle: float) -> float:
        z = -shape.scar_height * shape.lv_length
        squared = endocardium_at(z, angle, shape)[0], epicardium(z, shape)[0]
        rest = np.array([[r * np.cos(angle), r * np.sin(angle), z] for r in np.sqrt(squared)])
        moved = heart.into_heart(heart.carry(heart.into_patient(rest), heart.pulse.end_systole))
        before, after = (np.hypot(*points[:, :2].T) for points in (rest, moved))
        return float((after[1] - after[0]) / (before[1] - before[0]) - 1)

    assert thickening(shape.scar_angle) < 0.1
    assert thickening(shape.scar_angle + np.pi) > 0.3


@pytest.mark.parametrize("seed", range(ILL))
def test_enlarged_atrium(seed):
    """Larger than normal by more than two deviations, and weak."""
    _, person, measures = measured(seed, "enlarged_atrium")
    assert measures["la_ml"] > NORMAL["la_ml"][0 if person.male else 1][1]
    assert measures["la_emptying"] < 0.45
    assert measures["lv_ml"] == pytest.approx(measured(seed)[2]["lv_ml"], rel=0.02)


# The draws.


def test_a_pathology_changes_the_same_person():
    """Chest and place of the heart stay; a pathology only changes the heart."""
    well = measured(0)[0]
    for pathology in ("infarct", "dilated_cardiomyopathy"):
        ill = measured(0, pathology)[0]
        assert ill.chest == well.chest
        assert ill.mr_from_heart == well.mr_from_heart
        assert ill.shape != well.shape


def test_spread_zero_is_the_mean_heart_and_seeds_differ_otherwise():
    first, second = (draw_heart(np.random.default_rng(k), 0.0) for k in (1, 2))
    assert first == second
    assert draw_heart(np.random.default_rng(1)) != draw_heart(np.random.default_rng(2))
    assert draw_heart(np.random.default_rng(1)) == draw_heart(np.random.default_rng(1))


def test_the_widest_spread_still_gives_hearts():
    for seed in range(3):
        heart = draw_heart(np.random.default_rng(seed), 3.0)
        assert heart.shape.lv_wall > 3
        assert heart.shape.lv_radius > 12
        assert np.isfinite(heart.shape).all()


def test_heart_rate_sets_the_beat():
    slow, fast = (draw_heart(np.random.default_rng(4), heart_rate_bpm=bpm) for bpm in (50, 110))
    assert (slow.rr_s, fast.rr_s) == pytest.approx((1.2, 60 / 110))
    # Systole takes the larger share of the shorter beat.
    assert slow.pulse.end_systole < fast.pulse.end_systole
    assert slow.shape == fast.shape


@pytest.mark.parametrize("spread", [-0.1, 3.5, float("nan")])
def test_senseless_spread_is_refused(spread):
    with pytest.raises(SynthError, match="spread"):
        draw_heart(np.random.default_rng(0), spread)


@pytest.mark.parametrize("rate", [0.0, -60.0, 29.0, 300.0, float("nan")])
def test_senseless_heart_rate_is_refused(rate):
    with pytest.raises(SynthError, match="heart_rate_bpm"):
        draw_heart(np.random.default_rng(0), heart_rate_bpm=rate)


def test_unknown_pathology_is_refused_with_the_list():
    with pytest.raises(SynthError, match="enlarged_atrium") as caught:
        draw_heart(np.random.default_rng(0), pathology="cold")
    assert all(name in str(caught.value) for name in PATHOLOGIES)


def test_angles_are_compared_the_short_way_round():
    assert away_from(3.0, -3.0) == pytest.approx(6.0 - 2 * np.pi)
    assert away_from(-3.0, 3.0) == pytest.approx(2 * np.pi - 6.0)
