"""Simulated sweeps obey the physics of echoes and show the anatomy at the recorded place and phase.

Truth comes from bodies with known answers: a pulsating ball of blood in muscle, plates, and
uniform tissue, whose speckle has the statistics of a Rayleigh envelope.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
import SimpleITK as sitk
from scipy.ndimage import gaussian_filter

from data_synth.ecg import phase_at
from data_synth.echo import ACOUSTICS, Optics, Sector, bmode
from data_synth.errors import SynthError
from data_synth.population import draw_heart
from data_synth.tissue import Tissue
from data_synth.ultrasound import UltrasoundSettings, simulate_sweeps, write_sweep

R_TIMES_S = np.arange(0.3, 12.0, 0.8)
STILL = {"hand_mm": 0.0, "hand_deg": 0.0, "tracker_mm": 0.0, "tracker_deg": 0.0, "dropout": 0.0}
SECTOR = Sector(depth_mm=150.0, angle_deg=90.0, pixel_mm=0.8, beams=128)
OPTICS = Optics()
GREY_PER_DB = 255 / OPTICS.dynamic_range_db


@dataclass(frozen=True)
class Ball:
    """Blood of a radius that follows the phase, in a shell of muscle, in fat."""

    centre_mm: np.ndarray = field(default_factory=lambda: np.array([12.0, -40.0, 65.0]))
    long_axis: np.ndarray = field(default_factory=lambda: np.array([0.6, 0.0, 0.8]))

    def radius_mm(self, phase):
        return 24.0 + 6.0 * np.cos(2 * np.pi * np.asarray(phase))

    def tissue(self, points_mm, phase):
        distance_mm = np.linalg.norm(points_mm - self.centre_mm, axis=1)
        labels = np.full(len(points_mm), Tissue.FAT, dtype=np.uint8)
        labels[distance_mm < 45.0] = Tissue.LV_MYOCARDIUM
        labels[distance_mm < self.radius_mm(phase)] = Tissue.LV_CAVITY
        return labels


@dataclass(frozen=True)
class Nothing(Ball):
    """A body without a heart."""

    def tissue(self, points_mm, phase):
        return np.full(len(points_mm), Tissue.FAT, dtype=np.uint8)


def record(heart=None, seed=0, **settings):
    rng = np.random.default_rng(seed)
    return simulate_sweeps(rng, heart or Ball(), R_TIMES_S, UltrasoundSettings(**settings))


@pytest.fixture(scope="module")
def still_ball():
    return record(**STILL, frames=16, slice_mm=0.0)


def pixels_mm(sweep, k):
    """LPS place of every pixel of frame ``k``, ``(rows, columns, 3)``, by the recorded chain."""
    rows, columns = np.mgrid[0 : sweep.images.shape[1], 0 : sweep.images.shape[2]]
    indices = np.stack([columns, rows, 0 * rows, 0 * rows + 1], axis=-1).astype(float)
    mr_from_image = sweep.mr_from_tracker @ sweep.probe_to_tracker[k] @ sweep.image_to_probe
    return (indices @ mr_from_image.T)[..., :3]


def picture(labels, seed=0, contact_db=0.0, optics=OPTICS):
    contact_db = np.full(SECTOR.beams, contact_db)
    return bmode(np.random.default_rng(seed), labels, SECTOR, contact_db, optics).astype(float)


def uniform(tissue):
    return np.full(SECTOR.points_mm.shape[:2], tissue, dtype=np.uint8)


def at_ranges(lowest_mm, highest_mm, angle_rad=0.6):
    """Pixels between two ranges, near the middle beam."""
    rows, columns = np.indices(SECTOR.picture_shape)
    along = rows * SECTOR.pixel_mm
    across = (columns - SECTOR.picture_shape[1] // 2) * SECTOR.pixel_mm
    distance = np.hypot(along, across)
    off_axis = np.abs(np.arctan2(across, along))
    return (distance > lowest_mm) & (distance < highest_mm) & (off_axis < angle_rad)


def test_every_tissue_has_acoustic_values():
    assert set(ACOUSTICS) == set(Tissue)


def cavity(sweep, k):
    """``(n, 3)`` places of the dark pixels of frame ``k``, relative to the ball's centre."""
    place = pixels_mm(sweep, k) - Ball().centre_mm
    # The tip is 53 mm away and the fan's edge 53 sin(45 deg) = 37 mm: all of this is in the fan.
    near = np.linalg.norm(place, axis=-1) < 36.0
    # Grains are smoothed away, evenly to all sides: a single one may be as dark as blood.
    smooth = gaussian_filter(sweep.images[k].astype(float), 2.0)
    return place[near & (smooth < OPTICS.grey_of_muscle * 255 - 16 * GREY_PER_DB)]


def test_cavity_lies_where_the_recorded_pose_puts_it(still_ball):
    """The dark disc is centred on the ball: a wrong link in the chain would move it."""
    for sweep in still_ball:
        for k in range(0, len(sweep.times_s), 5):
            # The plane holds the centre. The blurs of pulse and beam (0.55 and 0.7 mm) are even on
            # both sides; half their sum, 0.6 mm, is left for walls that differ in brightness.
            assert np.linalg.norm(cavity(sweep, k).mean(axis=0)) < 0.6


def test_each_frame_shows_the_phase_of_its_own_time(still_ball):
    for sweep in still_ball:
        np.testing.assert_allclose(sweep.phases, phase_at(sweep.times_s, R_TIMES_S))
        area_mm2 = [len(cavity(sweep, k)) * SECTOR.pixel_mm**2 for k in range(len(sweep.phases))]
        offset_mm = np.sqrt(np.array(area_mm2) / np.pi) - Ball().radius_mm(sweep.phases)
        # The wall's blur moves the edge, equally in all frames up to one pixel; one frame of the
        # pulsation moves it by up to 2.4 mm.
        assert np.abs(offset_mm - offset_mm.mean()).max() < SECTOR.pixel_mm
        assert abs(offset_mm.mean()) < 2 * (0.55 + 0.7)


def test_planes_of_a_sweep_turn_and_windows_differ():
    sweeps = record(sweeps=3, frames=9)
    beams = []
    for sweep in sweeps:
        mr_from_image = sweep.mr_from_tracker @ sweep.probe_to_tracker @ sweep.image_to_probe
        normals = np.cross(mr_from_image[:, :3, 0], mr_from_image[:, :3, 1])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        turned_deg = np.degrees(np.arccos(np.abs(normals[0] @ normals[len(normals) // 2])))
        # Half of the 110 degrees, less the sway of the hand about three axes at both ends.
        assert turned_deg > 55 - 2 * 2.0 * np.sqrt(6) * np.sqrt(3)
        beams.append(mr_from_image[len(normals) // 2, :3, 1] / SECTOR.pixel_mm)
    for a in range(3):
        for b in range(a):
            assert np.degrees(np.arccos(beams[a] @ beams[b])) > 30.0


def test_frames_come_at_the_rate_and_within_the_beats():
    settings = UltrasoundSettings(frames=40, frame_rate_hz=20.0)
    first, second = record(**STILL, frames=40, beams=16, pixel_mm=3.0)
    assert R_TIMES_S[0] <= first.times_s[0]
    assert first.times_s[-1] + 1.0 <= second.times_s[0]
    assert second.times_s[-1] < R_TIMES_S[-1]
    steps_s = np.diff(first.times_s)
    # Each frame is early or late by a tenth of the period at most.
    assert (np.abs(steps_s * settings.frame_rate_hz - 1) <= 0.2 + 1e-9).all()


def test_tracker_noise_has_the_size_asked_for():
    clean = record(**STILL, frames=60, beams=16, pixel_mm=3.0)
    noisy = record(
        **STILL | {"tracker_mm": 0.2, "tracker_deg": 0.1}, frames=60, beams=16, pixel_mm=3.0
    )
    errors = np.concatenate(
        [
            np.linalg.inv(a.probe_to_tracker) @ b.probe_to_tracker
            for a, b in zip(clean, noisy, strict=True)
        ]
    )
    np.testing.assert_array_equal(clean[0].images, noisy[0].images)
    # 360 samples: a standard deviation is known to 1 / sqrt(2 * 360), here with four of those.
    room = 4 / np.sqrt(2 * 360)
    assert errors[:, :3, 3].std() == pytest.approx(0.2, rel=room)
    angles = np.stack([errors[:, 2, 1], errors[:, 0, 2], errors[:, 1, 0]])
    assert np.degrees(angles).std() == pytest.approx(0.1, rel=room)


def test_speckle_is_fully_developed():
    """The level of a Rayleigh envelope has a standard deviation of 5.57 dB, and is 2.51 dB low."""
    # On the middle beam of this fan pixels and samples coincide, so that nothing is interpolated.
    sector = Sector(depth_mm=60.0, angle_deg=60.0, pixel_mm=0.5, beams=65)
    labels = np.full(sector.points_mm.shape[:2], Tissue.LV_MYOCARDIUM, dtype=np.uint8)
    contact_db = np.zeros(sector.beams)
    columns = [
        bmode(np.random.default_rng(seed), labels, sector, contact_db, OPTICS)[60:100, 60]
        for seed in range(100)
    ]
    level_db = (np.array(columns, dtype=float) / 255 - OPTICS.grey_of_muscle) / (GREY_PER_DB / 255)
    # 20 mm hold about 20 mm / (2 sqrt(pi) 0.55 mm) = 10 grains, so 1000 in all; the log's fourth
    # moment makes a standard deviation known to about 1.05 / sqrt(1000), here with three of those.
    assert level_db.std(axis=0).mean() == pytest.approx(5.57, rel=0.1)
    # Muscle loses 0.5 dB a cm more than is compensated, there and back: 4 dB over 40 mm.
    assert level_db.mean() == pytest.approx(-2.51 - 4.0, abs=4 * 5.57 / np.sqrt(1000))


def test_speckle_widens_with_depth_beyond_the_focus():
    loud = picture(uniform(Tissue.LV_MYOCARDIUM))

    def likeness(rows):
        band = loud[rows, 100:167] - loud[rows, 100:167].mean()
        return np.mean(band[:, 3:] * band[:, :-3]) / np.mean(band**2)

    # Speckle of a beam of width s correlates by exp(-d^2 / (4 s^2)): at d = 2.4 mm by 0.16 where
    # s = 0.88 mm (80 mm deep), by 0.6 where s = 1.7 mm (140 mm).
    assert likeness(slice(165, 185)) > likeness(slice(88, 110)) + 0.2


def test_blood_is_darker_than_muscle_by_its_scatter():
    muscle, blood = picture(uniform(Tissue.LV_MYOCARDIUM)), picture(uniform(Tissue.LV_CAVITY))
    near = at_ranges(30, 40)
    difference_db = (muscle[near].mean() - blood[near].mean()) / GREY_PER_DB
    # 32 dB of scatter, less what muscle loses and blood does not, there and back over 35 mm; noise
    # under the blood fills at most the 3 dB of equal power, black cuts off a part of its tail.
    loss_db = 2 * (1.2 - 0.3) * 3.5
    assert difference_db == pytest.approx(32 - loss_db, abs=3.0)


@pytest.mark.parametrize("tissue", [Tissue.BONE, Tissue.LUNG, Tissue.AIR])
def test_plate_that_sound_does_not_pass_casts_a_shadow(tissue):
    labels = uniform(Tissue.LV_MYOCARDIUM)
    ranges = SECTOR.ranges_mm
    labels[(ranges > 50) & (ranges < 70), :64] = tissue
    image = picture(labels)
    behind = at_ranges(75, 110)
    left, right = image[behind & left_half()], image[behind & ~left_half()]
    # Two-way loss of 2 cm is 64 dB or more: nothing but noise, 44 dB below muscle and 20 dB of
    # lift at the far end, is left. Attenuation of muscle takes at most 14 dB off the other side.
    assert right.mean() - left.mean() > 12 * GREY_PER_DB
    wall = at_ranges(49, 52) & left_half()
    assert image[wall].mean() > image[at_ranges(40, 46)].mean() + 6 * GREY_PER_DB


def left_half():
    return np.indices(SECTOR.picture_shape)[1] < SECTOR.picture_shape[1] // 2 - 12


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
    # Noise and clutter at 30 to 40 mm lie over 35 dB below muscle, so 20 dB are seen in full.
    assert (full[bad] - poor[bad]).mean() == pytest.approx(20 * GREY_PER_DB, rel=0.1)
    np.testing.assert_allclose(poor[good], full[good], atol=1.0)


def test_picture_is_black_outside_the_fan():
    image = picture(uniform(Tissue.FAT))
    assert (image[~SECTOR.inside] == 0).all()
    # A fan of 90 degrees and 150 mm, less its blind tip, in square millimetres.
    area = np.pi / 4 * (150.0**2 - 3.0**2)
    edge = (2 * 150.0 + np.pi / 2 * 150.0) * SECTOR.pixel_mm
    assert SECTOR.inside.sum() * SECTOR.pixel_mm**2 == pytest.approx(area, abs=edge / 2)


@pytest.mark.parametrize("seed", range(3))
def test_every_frame_meets_the_heart(seed):
    heart = draw_heart(np.random.default_rng(seed))
    sweeps = record(heart, seed=seed, frames=6, beams=16, pixel_mm=3.0, tracker_mm=0, tracker_deg=0)
    for sweep in sweeps:
        for k, phase in enumerate(sweep.phases):
            labels = heart.tissue(pixels_mm(sweep, k).reshape(-1, 3), float(phase))
            seen = np.isin(labels, range(Tissue.LV_CAVITY, Tissue.ATRIAL_WALL + 1))
            inside = Sector(150.0, 90.0, 3.0, 16).inside.ravel()
            # A heart some 100 mm long fills 30 to 60 % of a fan of 150 mm.
            assert seen[inside].mean() > 0.15


def test_same_seed_gives_the_same_bytes_and_another_seed_others(tmp_path):
    small = {"frames": 3, "beams": 32, "pixel_mm": 2.0}
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        write_sweep(tmp_path / f"{name}.mha", record(seed=seed, **small)[0])
    a, b, c = ((tmp_path / f"{name}.mha").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_written_sequence_holds_every_frame_as_plus_names_it(tmp_path):
    sweep = record(frames=3, beams=32, pixel_mm=2.0)[1]
    write_sweep(tmp_path / "s.mha", sweep)
    image = sitk.ReadImage(str(tmp_path / "s.mha"))
    np.testing.assert_array_equal(sitk.GetArrayFromImage(image), sweep.images)
    for k in range(3):
        start = f"Seq_Frame{k:04d}_"
        assert float(image.GetMetaData(start + "Timestamp")) == sweep.times_s[k]
        assert image.GetMetaData(start + "ProbeToTrackerTransformStatus") == "OK"
        assert image.GetMetaData(start + "ImageToProbeTransformStatus") == "OK"
        for name, matrix in (
            ("ProbeToTracker", sweep.probe_to_tracker[k]),
            ("ImageToProbe", sweep.image_to_probe),
        ):
            words = image.GetMetaData(f"{start}{name}Transform").split()
            np.testing.assert_array_equal(np.array(words, float).reshape(4, 4), matrix)


def test_progress_counts_every_frame():
    told = []
    settings = UltrasoundSettings(frames=3, beams=16, pixel_mm=3.0)
    rng = np.random.default_rng(0)
    simulate_sweeps(
        rng, Ball(), R_TIMES_S, settings, lambda done, total: told.append((done, total))
    )
    assert told == [(k, 6) for k in range(1, 7)]


@pytest.mark.parametrize("r_times_s", [[], [1.0], [0.0, 0.8, 1.6]])
def test_recording_longer_than_the_ecg_is_refused(r_times_s):
    rng = np.random.default_rng(0)
    with pytest.raises(SynthError, match="longer ECG"):
        simulate_sweeps(rng, Ball(), np.array(r_times_s), UltrasoundSettings())


def test_body_without_a_heart_is_refused():
    with pytest.raises(SynthError, match="no tissue"):
        record(Nothing())


def test_unknown_settings_are_refused():
    with pytest.raises(ValueError, match="frame_rate"):
        UltrasoundSettings(frame_rate=20)
