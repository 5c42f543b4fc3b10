"""Pictures obey the physics of echoes: speckle, shadows, reflections, gain.

Truth is analytic: statistics of Rayleigh envelopes, Gaussian beams, decibels along a path.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import kstest, rayleigh

from data_synth.echo import ACOUSTICS, Optics, bmode, received, silence
from data_synth.probe import PROBES
from data_synth.sector import Sector
from data_synth.tissue import Tissue
from data_synth.view import carried_echoes, draw_view
from data_synth.window import rigid

SECTOR = Sector(depth_mm=150.0, angle_deg=90.0, pixel_mm=0.8, beams=128)
OPTICS = Optics()
GREY_PER_DB = 255 / OPTICS.dynamic_range_db


@dataclass(frozen=True)
class Slab:
    """Muscle without end that glides along x by 20 mm in a beat."""

    centre_mm: np.ndarray
    long_axis: np.ndarray
    tissue: Tissue = Tissue.LV_MYOCARDIUM

    def heart_tissue(self, points_mm, phase):
        return np.full(len(points_mm), self.tissue, np.uint8)

    def chest_tissue(self, points_mm):
        return np.full(len(points_mm), Tissue.FAT, np.uint8)

    def reference(self, points_mm, phase):
        return points_mm - [20.0 * phase, 0, 0]

    def nominal_phase(self, phase, rr_s):
        return phase


def slab(tissue=Tissue.LV_MYOCARDIUM):
    return Slab(np.zeros(3), np.array([0.0, 0.0, 1.0]), tissue)


def picture(labels, seed=0, contact_db=0.0, optics=OPTICS):
    contact_db = np.full(SECTOR.beams, contact_db)
    return bmode(np.random.default_rng(seed), labels, SECTOR, contact_db, optics).astype(float)


def uniform(tissue, sector=SECTOR):
    return np.full(sector.points_mm.shape[:2], tissue, dtype=np.uint8)


def at_ranges(lowest_mm, highest_mm, angle_rad=0.6):
    """Pixels between two ranges, near the middle beam."""
    rows, columns = np.indices(SECTOR.picture_shape)
    along = rows * SECTOR.pixel_mm
    across = (columns - SECTOR.picture_shape[1] // 2) * SECTOR.pixel_mm
    distance = np.hypot(along, across)
    off_axis = np.abs(np.arctan2(across, along))
    return (distance > lowest_mm) & (distance < highest_mm) & (off_axis < angle_rad)


def left_half():
    return np.indices(SECTOR.picture_shape)[1] < SECTOR.picture_shape[1] // 2 - 12


def lines(view, pose, phase=0.0, moved_mm=(0.0, 0.0, 0.0), seed=0):
    """What the array hears of a slab without noise or haze, losses taken back."""
    sector, optics = view.probe.sector, replace(view.probe.optics, noise_db=-200.0)
    labels = uniform(Tissue.LV_MYOCARDIUM, sector)
    echoes = carried_echoes(view, pose, phase, np.array(moved_mm), labels)
    rng = np.random.default_rng(seed)
    heard = received(rng, labels, sector, np.zeros(sector.beams), optics, echoes)
    loss_db = 2 * optics.loss_scale * ACOUSTICS[Tissue.LV_MYOCARDIUM].attenuation_db_per_cm
    steps = np.arange(1, len(sector.ranges_mm) + 1) * sector.range_step_mm / 10
    return heard * 10 ** (loss_db * steps / 20)[:, None]


def view_of(name="surface", seed=0):
    probe = PROBES[name]
    wide = replace(probe.sector, depth_mm=120.0 if name == "surface" else 60.0)
    return draw_view(np.random.default_rng(seed), slab(), replace(probe, sector=wide), None)


def far_apart(count, seed=0):
    """Poses so far from each other that no scatterer is seen twice."""
    rng = np.random.default_rng(seed)
    return [rigid(rng.normal(size=3), [0.0, 0.0, 500.0 * k]) for k in range(count)]


def rows_between(view, lowest_mm, highest_mm):
    ranges = view.probe.sector.ranges_mm
    return (ranges > lowest_mm) & (ranges < highest_mm)


def test_every_tissue_has_acoustic_values():
    assert set(ACOUSTICS) == set(Tissue)


@pytest.mark.parametrize("name", ["surface", "intracardiac"])
def test_speckle_of_muscle_has_a_rayleigh_envelope(name):
    """Kolmogorov-Smirnov on independent samples before compression, the scale not fitted."""
    view = view_of(name)
    # The haze at the tip is 60 dB down beyond 40 mm at 2.5 MHz, and beyond 15 mm at 8 MHz.
    rows = np.flatnonzero(
        rows_between(view, 40.0, 100.0) if name == "surface" else rows_between(view, 16.0, 50.0)
    )
    # Samples 8 deviations of pulse and beam apart correlate by exp(-16).
    sector, optics = view.probe.sector, view.probe.optics
    step = int(np.ceil(8 * optics.pulse_mm / sector.range_step_mm))
    width_rad = optics.beam_rad(sector.ranges_mm[rows]).max()
    beams = int(np.ceil(8 * width_rad / (sector.angles_rad[1] - sector.angles_rad[0])))
    envelope = np.concatenate(
        [np.abs(lines(view, pose))[rows[::step], ::beams].ravel() for pose in far_apart(12)]
    )
    distance = kstest(envelope, rayleigh(scale=np.sqrt(0.5)).cdf).statistic
    # Chance exceeds 1.95 / sqrt(n) once in a thousand; a level that is 4 % off in power (2 % in
    # amplitude, what an even spread of the cells' directions leaves) moves the distribution by
    # 0.02 times its steepest slope in the logarithm, 2 / e.
    assert len(envelope) > 500
    assert distance < 1.95 / np.sqrt(len(envelope)) + 0.02 * 2 / np.e


def test_speckle_widens_with_depth_as_the_beam_does():
    """Echoes of a Gaussian beam of width s correlate by exp(-d^2 / (4 s^2))."""
    view = view_of()
    sector, optics = view.probe.sector, view.probe.optics
    heard = np.stack([lines(view, pose) for pose in far_apart(10, seed=1)])
    step_rad = sector.angles_rad[1] - sector.angles_rad[0]
    widths_mm = []
    for range_mm in (40.0, 80.0, 110.0):
        band = heard[:, rows_between(view, range_mm - 8, range_mm + 8)]
        alike = np.mean(band[..., 1:] * band[..., :-1].conj()).real / np.mean(np.abs(band) ** 2)
        width_mm = range_mm * step_rad / np.sqrt(-4 * np.log(alike))
        # Cells add their own width: a uniform one of 0.66 mm has a deviation of 0.19 mm.
        expected_mm = np.hypot(
            range_mm * optics.beam_rad(np.array([range_mm]))[0],
            view.scatterers.cell_mm / np.sqrt(12),
        )
        # 10 frames of 16 mm by 128 beams hold over 1000 grains: 1 / sqrt(1000) of correlation,
        # and up to 4 % for the side lobes.
        assert width_mm == pytest.approx(expected_mm, rel=0.08)
        widths_mm.append(width_mm)
    assert widths_mm[0] < widths_mm[1] < widths_mm[2]


def alike(a, b):
    return float(np.abs(np.vdot(a, b)) / np.sqrt(np.vdot(a, a).real * np.vdot(b, b).real))


def test_speckle_travels_with_the_tissue():
    """A pose moved along with the gliding muscle sees the same echoes; one left behind others."""
    view = view_of()
    pose = far_apart(1)[0]
    along = rigid(np.zeros(3), [6.0, 0.0, 0.0]) @ pose
    # The haze at the tip belongs to the probe.
    rows = rows_between(view, 40.0, 110.0)
    before, left, taken = (
        lines(view, one, phase)[rows] for one, phase in ((pose, 0.0), (pose, 0.3), (along, 0.3))
    )
    assert alike(before, taken) > 0.99
    assert alike(before, left) < 0.1
    # Breathing carries the scatterers too.
    breathed = lines(view, along, 0.0, (6.0, 0.0, 0.0))[rows]
    assert alike(before, breathed) > 0.99


def test_speckle_changes_as_the_plane_leaves_it():
    """Across the plane a way d leaves exp(-d^2 / (4 s^2)) of the likeness."""
    view = view_of()
    rows = rows_between(view, 65.0, 85.0)
    thickness_mm = view.slice_mm[rows].mean()
    for way_mm in (1.0, 2.0):
        ratio = []
        for pose in far_apart(6, seed=2):
            off = pose @ rigid(np.zeros(3), [0.0, 0.0, way_mm])
            ratio.append(alike(lines(view, pose)[rows], lines(view, off)[rows]))
        # The Gaussian is cut at 2 deviations, and cells hear nothing finer than themselves.
        expected = np.exp(-(way_mm**2) / (4 * thickness_mm**2))
        assert np.mean(ratio) == pytest.approx(expected, abs=0.12)


def test_speckle_in_decibels_has_the_spread_of_a_rayleigh_envelope():
    """The level of a Rayleigh envelope has a standard deviation of 5.57 dB, and is 2.51 dB low."""
    # On the middle beam of this fan pixels and samples coincide, so that nothing is interpolated.
    sector = Sector(depth_mm=60.0, angle_deg=60.0, pixel_mm=0.5, beams=65)
    labels = uniform(Tissue.LV_MYOCARDIUM, sector)
    columns = [
        bmode(np.random.default_rng(seed), labels, sector, np.zeros(65), OPTICS)[60:100, 60]
        for seed in range(100)
    ]
    level_db = (np.array(columns, dtype=float) / 255 - OPTICS.grey_of_muscle) / (GREY_PER_DB / 255)
    # 20 mm hold about 20 mm / (2 sqrt(pi) 0.55 mm) = 10 grains, so 1000 in all; the log's fourth
    # moment makes a standard deviation known to about 1.05 / sqrt(1000), here with three of those.
    assert level_db.std(axis=0).mean() == pytest.approx(5.57, rel=0.1)
    # Muscle loses 2.4 dB a cm from the tip (3 mm) on, and 1.5 dB a cm are given back.
    expected_db = -2.51 - 2.4 * 3.7 + 1.5 * 4.0
    assert level_db.mean() == pytest.approx(expected_db, abs=4 * 5.57 / np.sqrt(1000))


def test_blood_is_darker_than_muscle_by_its_scatter():
    deep = replace(OPTICS, dynamic_range_db=90.0)
    muscle = picture(uniform(Tissue.LV_MYOCARDIUM), optics=deep)
    blood = picture(uniform(Tissue.LV_CAVITY), optics=deep)
    near = at_ranges(50, 60)
    difference_db = (muscle[near].mean() - blood[near].mean()) * 90 / 255
    # 32 dB of scatter, less what muscle loses and blood does not, there and back over 52 mm; the
    # noise 48 dB under muscle, and 13 dB under this blood's 35, adds 0.2 dB.
    assert difference_db == pytest.approx(32 - 2 * (1.2 - 0.3) * 5.2 - 0.2, abs=0.5)


@pytest.mark.parametrize("tissue", [Tissue.BONE, Tissue.LUNG, Tissue.AIR])
def test_plate_that_sound_does_not_pass_casts_a_shadow(tissue):
    labels = uniform(Tissue.LV_MYOCARDIUM)
    ranges = SECTOR.ranges_mm
    labels[(ranges > 50) & (ranges < 70), :64] = tissue
    image = picture(labels)
    # Where no echo of the plate arrives a second time: that is at 100 to 140 mm.
    behind = at_ranges(75, 95)
    left, right = image[behind & left_half()], image[behind & ~left_half()]
    # Two-way loss of 2 cm is 64 dB or more: noise is left, 48 dB below muscle at the tip. Muscle
    # of 92 mm loses 22 dB of it.
    assert right.mean() - left.mean() > 12 * GREY_PER_DB
    wall = at_ranges(49, 52) & left_half()
    assert image[wall].mean() > image[at_ranges(40, 46)].mean() + 6 * GREY_PER_DB


def test_strong_reflector_is_seen_again_at_twice_its_range():
    labels = uniform(Tissue.LV_CAVITY)
    labels[SECTOR.ranges_mm > 50] = Tissue.AIR
    image = picture(labels)
    again, between = image[at_ranges(99, 103)], image[at_ranges(80, 92)]
    assert again.mean() > between.mean() + 10 * GREY_PER_DB


def test_wall_struck_squarely_is_brighter_than_one_struck_obliquely():
    """A plane across the beam against one tilted by 60 degrees, at the same range."""
    place = SECTOR.points_mm
    levels = []
    for tilt_deg in (0.0, 60.0):
        across, along = np.sin(np.deg2rad(tilt_deg)), np.cos(np.deg2rad(tilt_deg))
        beyond = place[..., 0] * across + (place[..., 1] - 80.0) * along > 0
        labels = np.where(beyond, Tissue.LV_MYOCARDIUM, Tissue.FAT).astype(np.uint8)
        image = picture(labels)
        levels.append(image[95:106, 131:136].max(axis=0).mean())
    assert levels[0] > levels[1] + 6 * GREY_PER_DB


def test_poor_contact_darkens_its_beams_alone():
    contact_db = np.where(np.arange(SECTOR.beams) < 40, -20.0, 0.0)
    labels = uniform(Tissue.LV_MYOCARDIUM)
    rng = np.random.default_rng
    poor = bmode(rng(0), labels, SECTOR, contact_db, OPTICS).astype(float)
    full = picture(labels)
    near, columns = at_ranges(30, 40, angle_rad=0.7), np.indices(SECTOR.picture_shape)[1]
    bad = near & (columns < 133 - 20)
    good = near & (columns > 133)
    # Noise and haze at 30 to 40 mm lie over 30 dB below muscle, so 20 dB are seen in full.
    assert (full[bad] - poor[bad]).mean() == pytest.approx(20 * GREY_PER_DB, rel=0.1)
    np.testing.assert_allclose(poor[good], full[good], atol=1.0)


def test_gain_and_compensation_lift_by_their_decibels():
    labels = uniform(Tissue.LV_MYOCARDIUM)
    # So wide a range and so little gain that nothing near is black or white.
    wide = replace(OPTICS, dynamic_range_db=90.0, gain_db=-15.0)
    plain = picture(labels, optics=wide)
    rows, columns = np.indices(SECTOR.picture_shape)
    near = at_ranges(20, 60) & (plain > 40)
    louder = picture(labels, optics=replace(wide, gain_db=-9.0))
    # A pixel between a loud and a silent sample may miss one that black cuts off.
    assert np.percentile(np.abs((louder - plain)[near] - 6 * 255 / 90), 99.5) <= 1.0
    deeper = picture(labels, optics=replace(wide, compensation_db_per_cm=2.5))
    range_cm = np.hypot(rows, columns - SECTOR.picture_shape[1] // 2) * SECTOR.pixel_mm / 10
    # One dB a cm more.
    assert np.percentile(np.abs(deeper - plain - range_cm * 255 / 90)[near], 99.5) <= 1.0


def test_higher_frequency_is_sharper_and_reaches_less_deep():
    low, high = Optics(frequency_mhz=2.5), Optics(frequency_mhz=5.0)
    assert high.pulse_mm == pytest.approx(low.pulse_mm / 2)
    ranges_mm = np.array([80.0])
    assert high.beam_rad(ranges_mm) == pytest.approx(low.beam_rad(ranges_mm) / 2)
    labels = uniform(Tissue.LV_MYOCARDIUM)
    equal = {"compensation_db_per_cm": 1.5, "dynamic_range_db": 90.0, "noise_db": -80.0}
    far = at_ranges(60, 70)
    lost_db = [
        picture(labels, optics=replace(one, **equal))[far].mean() * 90 / 255 for one in (low, high)
    ]
    # 2.4 dB a cm there and back over 62 mm, times 2^1.1 - 1.
    assert lost_db[0] - lost_db[1] == pytest.approx(2.4 * 6.2 * (2**1.1 - 1), abs=1.0)


def test_probe_in_air_shows_its_own_ringing_and_nothing_else():
    image = silence(np.random.default_rng(0), SECTOR, OPTICS).astype(float)
    assert image[at_ranges(3, 8)].mean() > 80
    # Noise alone: 48 dB below muscle, lifted by 1.5 dB a cm, from 30 dB below muscle on is black.
    assert image[at_ranges(40, 100)].mean() < 5
    assert image[at_ranges(130, 150)].mean() < 40


def test_picture_is_black_outside_the_fan():
    image = picture(uniform(Tissue.FAT))
    assert (image[~SECTOR.inside] == 0).all()
    # A fan of 90 degrees and 150 mm, less its blind tip, in square millimetres.
    area = np.pi / 4 * (150.0**2 - 3.0**2)
    edge = (2 * 150.0 + np.pi / 2 * 150.0) * SECTOR.pixel_mm
    assert SECTOR.inside.sum() * SECTOR.pixel_mm**2 == pytest.approx(area, abs=edge / 2)
