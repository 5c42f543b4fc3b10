"""Simulated sweeps show the anatomy at the recorded place and phase, and keep the truth of faults.

Truth comes from a body with known answers, a pulsating ball of blood in muscle, from the settings
themselves, and from what the phantom's hearts say of the place of a tip.
"""

from __future__ import annotations

import numpy as np
import pytest
import SimpleITK as sitk
from pulsating_ball import FAULTLESS, PIXEL_MM, R_TIMES_S, SMALL, STILL, TINY, Ball, Nothing, record
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from data_synth.breathing import BREATHING_AXIS
from data_synth.ecg import phase_at
from data_synth.errors import SynthError
from data_synth.population import draw_heart
from data_synth.probe import PROBES
from data_synth.tissue import Tissue
from data_synth.ultrasound import UltrasoundSettings, fitted_probe, simulate_sweeps, write_sweep
from data_synth.window import HEART
from pipeline.imaging.ultrasound import read_sweep


@pytest.fixture(scope="module")
def still_ball():
    return record(**STILL, frames=16)


def pixels_mm(sweep, k):
    """LPS place of every pixel of frame ``k``, ``(rows, columns, 3)``, by the recorded chain."""
    rows, columns = np.mgrid[0 : sweep.images.shape[1], 0 : sweep.images.shape[2]]
    indices = np.stack([columns, rows, 0 * rows, 0 * rows + 1], axis=-1).astype(float)
    mr_from_image = sweep.mr_from_tracker @ sweep.probe_to_tracker[k] @ sweep.image_to_probe
    return (indices @ mr_from_image.T)[..., :3]


def cavity(sweep, k):
    """``(n, 3)`` places of the dark pixels of frame ``k``, relative to the moved ball's centre."""
    place = pixels_mm(sweep, k) - Ball().centre_mm - sweep.displacement_mm[k]
    # The tip is 53 mm away and the fan's edge 53 sin(45 deg) = 37 mm: all of this is in the fan.
    near = np.linalg.norm(place, axis=-1) < 36.0
    # Grains are smoothed away, evenly to all sides: a single one may be as dark as blood.
    smooth = gaussian_filter(sweep.images[k].astype(float), 2.0)
    # Muscle is at 133 (52 % of 255) and loses 4 dB on the way; blood is 32 dB lower: 16 between.
    return place[near & (smooth < 133 - 16 * 255 / 58)]


def centre_in_plane(sweep, k):
    """``(3,)`` the point of frame ``k``'s plane next to the moved centre, relative to it."""
    plane = sweep.mr_from_tracker @ sweep.probe_to_tracker[k] @ sweep.image_to_probe
    normal = np.cross(plane[:3, 0], plane[:3, 1]) / PIXEL_MM**2
    return normal * (normal @ (plane[:3, 3] - Ball().centre_mm - sweep.displacement_mm[k]))


# The smoothed picture falls through 16 dB some two deviations of the beam (0.7 mm near the tip,
# 1.1 mm behind the ball) inside the cavity, and deeper on the far side, which blood leaves 4 dB
# brighter: 1.3 mm more than on the near one. The dark disc is off by half of that, and by as much
# again for walls that differ.
CENTRED_MM = 1.3


def test_cavity_lies_where_the_recorded_pose_puts_it(still_ball):
    """The dark disc is centred on the ball: a wrong link in the chain would move it."""
    for sweep in still_ball:
        for k in range(0, len(sweep.times_s), 5):
            off_mm = cavity(sweep, k).mean(axis=0) - centre_in_plane(sweep, k)
            assert np.linalg.norm(off_mm) < CENTRED_MM


def test_each_frame_shows_the_phase_of_its_own_time_and_beat(still_ball):
    """Beats of unequal length are carried to the nominal cycle, each by its own length."""
    for sweep in still_ball:
        np.testing.assert_array_equal(sweep.phases, phase_at(sweep.true_times_s, R_TIMES_S))
        beat = np.searchsorted(R_TIMES_S, sweep.true_times_s, side="right") - 1
        nominal = sweep.phases ** (0.8 / np.diff(R_TIMES_S)[beat])
        np.testing.assert_allclose(sweep.nominal_phases, nominal)
        area_mm2 = [len(cavity(sweep, k)) * PIXEL_MM**2 for k in range(len(sweep.phases))]
        offset_mm = np.sqrt(np.array(area_mm2) / np.pi) - Ball().radius_mm(nominal)
        # The wall's blur moves the edge, equally in all frames up to one pixel; one frame of the
        # pulsation moves it by up to 2.4 mm, the other way to count phases by up to 4 mm.
        assert np.abs(offset_mm - offset_mm.mean()).max() < PIXEL_MM
        assert abs(offset_mm.mean()) < 2 * 1.1 + PIXEL_MM


@pytest.mark.parametrize("probe", ["transoesophageal", "surface"])
def test_breath_holds_move_the_heart_and_are_told(probe):
    """The cavity lies beside its place by the shift, whether the probe rides along or not."""
    asked = STILL | {"probe": probe, "sweeps": 1, "breathing": {"hold_sd_mm": 4.0}}
    for seed in (3, 4):
        sweep = record(**asked, frames=2, seed=seed)[0]
        shift_mm = sweep.displacement_mm
        assert (shift_mm == shift_mm[0]).all()
        np.testing.assert_allclose(np.cross(shift_mm[0], BREATHING_AXIS), 0, atol=1e-9)
        assert np.linalg.norm(shift_mm[0]) > 1.5 * CENTRED_MM
        off_mm = cavity(sweep, 1).mean(axis=0) - centre_in_plane(sweep, 1)
        assert np.linalg.norm(off_mm) < CENTRED_MM


def test_free_breathing_moves_the_heart_within_a_sweep():
    breathing = {"amplitude_mm": 10.0, "period_s": 3.0}
    first, second = record(breath="free", breathing=breathing, frames=60, **TINY)
    depth_mm = np.concatenate([s.displacement_mm @ BREATHING_AXIS for s in (first, second)])
    # Two sweeps of three seconds hold a whole breath each.
    assert depth_mm.min() == pytest.approx(0.0, abs=0.1)
    assert depth_mm.max() == pytest.approx(10.0, abs=0.1)


@pytest.mark.parametrize("probe", ["combined", *PROBES])
def test_planes_of_a_sweep_turn(probe):
    heart = draw_heart(np.random.default_rng(0))
    for number, sweep in enumerate(record(heart, probe=probe, sweeps=3, frames=9, **TINY)):
        mr_from_image = sweep.mr_from_tracker @ sweep.probe_to_tracker @ sweep.image_to_probe
        normals = np.cross(mr_from_image[:, :3, 0], mr_from_image[:, :3, 1])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        turned_deg = np.degrees(np.arccos(np.abs(normals[0] @ normals[len(normals) // 2])))
        name = ("surface", "transoesophageal", "surface")[number] if probe == "combined" else probe
        # Half of the whole turn, less the sway of the hand about three axes at both ends.
        half_deg = PROBES[name].turn_deg / 2
        assert turned_deg > half_deg - 2 * 2.0 * np.sqrt(6) * np.sqrt(3)


@pytest.mark.parametrize("probe", ["combined", "surface", "epicardial"])
def test_windows_look_from_different_sides(probe):
    sweeps = record(draw_heart(np.random.default_rng(4)), probe=probe, frames=1, **TINY)
    tips = [
        (s.mr_from_tracker @ s.true_probe_to_tracker[0] @ s.true_image_to_probe)[:3, 1]
        for s in sweeps
    ]
    a, b = (tip / np.linalg.norm(tip) for tip in tips)
    # Windows are meant 40 degrees apart or more; the operator slides each by up to 14.
    assert np.degrees(np.arccos(a @ b)) > 40 - 2 * 14


def tip_of(sweep, settings):
    """LPS place of the tip in the first frame: the middle of the picture's upper edge."""
    name = "surface" if settings.probe == "combined" else settings.probe
    centre = fitted_probe(name, settings).sector.picture_shape[1] // 2
    chain = sweep.mr_from_tracker @ sweep.true_probe_to_tracker[0] @ sweep.true_image_to_probe
    return (chain @ [centre, 0, 0, 1])[:3], chain[:3, 1] / np.linalg.norm(chain[:3, 1])


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("probe", sorted(PROBES))
def test_tip_is_where_such_a_probe_is_held(probe, seed):
    heart = draw_heart(np.random.default_rng(seed))
    settings = UltrasoundSettings(
        **FAULTLESS, **TINY, probe=probe, frames=1, turn_deg=0.0, hand_mm=0.0, hand_deg=0.0
    )
    rng = np.random.default_rng(seed)
    sweeps = simulate_sweeps(rng, heart, R_TIMES_S, settings)
    for number, sweep in enumerate(sweeps):
        tip_mm, beam = tip_of(sweep, settings)
        here = heart.heart_tissue(tip_mm[None], 0.0)[0]
        if probe == "intracardiac":
            assert here == (Tissue.RIGHT_ATRIUM, Tissue.RV_CAVITY)[number]
            continue
        assert here not in HEART
        way_mm = tip_mm + np.arange(0.0, 80.0, 0.5)[:, None] * beam
        met = heart.heart_tissue(way_mm, 0.0)
        first = int(np.flatnonzero(np.isin(met, HEART))[0])
        if probe == "transoesophageal":
            # Left atrium within 10 mm, from behind.
            assert first < 20
            assert beam[1] < -0.5
            assert (met[first : first + 30] == Tissue.LEFT_ATRIUM).any() or number
        elif probe == "epicardial":
            # The pad: 8 mm to the nearest tissue along the beam, 1 mm of search.
            assert first * 0.5 == pytest.approx(8.0, abs=1.5)
        else:
            # Skin is near: air within a third of the wall's thickness outwards.
            out = heart.chest_tissue(tip_mm - np.arange(0.0, 40.0)[:, None] * beam)
            assert (out == Tissue.AIR).any()
            assert first * 0.5 > 8.0


@pytest.mark.parametrize("probe", ["combined", *PROBES])
def test_every_frame_meets_the_heart(probe):
    heart = draw_heart(np.random.default_rng(1))
    for sweep in record(heart, probe=probe, frames=4, **SMALL, **FAULTLESS):
        inside = sweep.images.max(axis=0).ravel() > 0
        for k, phase in enumerate(sweep.nominal_phases):
            labels = heart.heart_tissue(pixels_mm(sweep, k).reshape(-1, 3), float(phase))
            # A heart some 100 mm long fills 30 to 60 % of a fan of 110 to 180 mm, where the fan
            # is not tilted past it.
            assert np.isin(labels, HEART)[inside].mean() > 0.1


def test_frames_come_at_the_rate_and_within_the_beats():
    settings = UltrasoundSettings(frames=40, frame_rate_hz=20.0)
    first, second = record(**STILL | TINY, frames=40)
    assert R_TIMES_S[0] <= first.times_s[0]
    assert first.times_s[-1] + 1.0 <= second.times_s[0]
    assert second.times_s[-1] < R_TIMES_S[-1]
    steps_s = np.diff(first.times_s)
    # Each frame is early or late by a tenth of the period at most.
    assert (np.abs(steps_s * settings.frame_rate_hz - 1) <= 0.2 + 1e-9).all()


def both(settings, **faults):
    """The same recording without and with a fault; its pictures do not change."""
    clean, faulty = record(**settings), record(**settings | faults)
    for a, b in zip(clean, faulty, strict=True):
        np.testing.assert_array_equal(a.images, b.images)
        np.testing.assert_array_equal(a.true_probe_to_tracker, b.true_probe_to_tracker)
    return clean, faulty


def test_tracker_noise_has_the_size_asked_for():
    _, noisy = both(STILL | TINY | {"frames": 60}, tracker_mm=0.2, tracker_deg=0.1)
    errors = np.concatenate(
        [np.linalg.inv(s.true_probe_to_tracker) @ s.probe_to_tracker for s in noisy]
    )
    # 360 samples: a standard deviation is known to 1 / sqrt(2 * 360), here with four of those.
    room = 4 / np.sqrt(2 * 360)
    assert errors[:, :3, 3].std() == pytest.approx(0.2, rel=room)
    angles = np.stack([errors[:, 2, 1], errors[:, 0, 2], errors[:, 1, 0]])
    assert np.degrees(angles).std() == pytest.approx(0.1, rel=room)


def test_outliers_are_as_many_and_as_far_off_as_asked_and_told():
    clean, faulty = both(
        STILL | TINY | {"frames": 60}, outliers=0.1, outlier_mm=25.0, outlier_deg=15.0
    )
    told = np.concatenate([s.outlier for s in faulty])
    # Binomial of 120: twelve, with four deviations of 3.3.
    assert 0 < told.sum() < 12 + 4 * 3.3
    assert not any(s.outlier.any() for s in clean)
    for sweep in faulty:
        centre = sweep.images.shape[2] // 2
        tip = sweep.true_image_to_probe @ [centre, 0, 0, 1]
        apart_mm = np.linalg.norm(
            (sweep.probe_to_tracker @ tip - sweep.true_probe_to_tracker @ tip)[:, :3], axis=1
        )
        np.testing.assert_allclose(apart_mm, np.where(sweep.outlier, 25.0, 0.0), atol=1e-6)
        off = np.linalg.inv(sweep.true_probe_to_tracker) @ sweep.probe_to_tracker
        turn_deg = np.degrees(Rotation.from_matrix(off[:, :3, :3]).magnitude())
        np.testing.assert_allclose(turn_deg, np.where(sweep.outlier, 15.0, 0.0), atol=1e-5)


def test_calibration_is_off_by_the_size_asked_for():
    _, faulty = both(STILL | TINY | {"frames": 2}, calibration_mm=0.7, calibration_deg=0.4)
    for sweep in faulty:
        off = sweep.image_to_probe @ np.linalg.inv(sweep.true_image_to_probe)
        tip = sweep.true_image_to_probe @ [sweep.images.shape[2] // 2, 0, 0, 1]
        assert np.linalg.norm(off @ tip - tip) == pytest.approx(0.7)
        turn_deg = np.degrees(Rotation.from_matrix(off[:3, :3]).magnitude())
        assert turn_deg == pytest.approx(0.4)


def test_time_stamps_carry_offset_and_jitter_and_still_rise():
    _, faulty = both(STILL | TINY | {"frames": 60}, clock_offset_s=1.5, jitter_ms=4.0)
    for sweep in faulty:
        off_s = sweep.times_s - sweep.true_times_s - sweep.clock_offset_s
        assert sweep.clock_offset_s == 1.5
        # 60 samples: known to 1 / sqrt(120), here with four of those.
        assert off_s.std() == pytest.approx(0.004, rel=4 / np.sqrt(120))
        assert (np.diff(sweep.times_s) > 0).all()
        np.testing.assert_array_equal(sweep.phases, phase_at(sweep.true_times_s, R_TIMES_S))
    wild = record(**STILL | TINY | {"frames": 20, "jitter_ms": 50.0})
    assert all((np.diff(s.times_s) > 0).all() for s in wild)


def test_lifted_probe_shows_nothing_but_its_ringing_for_a_stretch():
    sweeps = record(**STILL | {"beams": 48, "pixel_mm": 1.5}, frames=12, lifted=1.0)
    for sweep in sweeps:
        assert sweep.lost.sum() == 5
        assert np.ptp(np.flatnonzero(sweep.lost)) == 4
        deep = sweep.images[:, 15:60].mean(axis=(1, 2))
        near = sweep.images[:, 1:5].mean(axis=(1, 2))
        assert deep[sweep.lost].max() < 0.3 * deep[~sweep.lost].min()
        assert near[sweep.lost].min() > 5 * deep[sweep.lost].max()
    assert not any(s.lost.any() for s in record(**STILL | SMALL, frames=2))


def test_frames_that_the_tracker_missed_are_written_as_invalid_and_left_out_by_the_reader(tmp_path):
    sweep = record(**STILL | SMALL, frames=12, untracked=1.0, untracked_frames=3)[0]
    missed = np.flatnonzero(sweep.untracked)
    assert len(missed) == 3
    stale = sweep.probe_to_tracker[missed[0] - 1] if missed[0] else np.eye(4)
    np.testing.assert_array_equal(sweep.probe_to_tracker[missed], [stale] * 3)
    write_sweep(tmp_path / "s.mha", sweep)
    image = sitk.ReadImage(str(tmp_path / "s.mha"))
    for k in range(12):
        status = image.GetMetaData(f"Seq_Frame{k:04d}_ProbeToTrackerTransformStatus")
        assert status == ("INVALID" if k in missed else "OK")
        assert image.GetMetaData(f"Seq_Frame{k:04d}_ImageStatus") == "OK"
    read = read_sweep(tmp_path / "s.mha")
    assert read.remarks[0].startswith("3 of 12 frames left out")
    np.testing.assert_array_equal(read.times_s, sweep.times_s[~sweep.untracked])


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
    settings = UltrasoundSettings(frames=3, **SMALL)
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


@pytest.mark.parametrize("probe", ["surface", "transoesophageal", "intracardiac"])
def test_body_without_a_heart_is_refused(probe):
    with pytest.raises(SynthError, match="the heart has no"):
        record(Nothing(), probe=probe)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("frame_rate", 20),
        ("probe", "rectal"),
        ("frames", 0),
        ("depth_mm", -10.0),
        ("outliers", 0.9),
        ("gain_db", float("nan")),
        ("clock_offset_s", float("inf")),
        ("hand_mm", -1.0),
        ("breathing", {"amplitude": 3}),
    ],
)
def test_settings_that_make_no_sense_are_refused(key, value):
    with pytest.raises(ValueError, match=key):
        UltrasoundSettings(**{key: value})


def test_every_number_asked_for_has_bounds():
    """A setting without a largest value would let a typing error through."""
    schema = UltrasoundSettings.model_json_schema()["properties"]
    for name, one in schema.items():
        for option in one.get("anyOf", [one]):
            if option.get("type") in ("number", "integer"):
                assert "maximum" in option, name
                assert "minimum" in option or "exclusiveMinimum" in option, name
