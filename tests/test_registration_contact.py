"""Frames of a probe in air are told from those of a body, and change nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ellipsoid_heart import record

from data_synth.ecg import simulate_ecg
from data_synth.echo import silence
from data_synth.population import draw_heart
from data_synth.probe import PROBES
from data_synth.ultrasound import UltrasoundSettings, simulate_sweeps
from pipeline.errors import UnregistrableError
from pipeline.registration.contact import Contact, _apex_mm
from pipeline.registration.frames import sample_frames

LENGTHS_MM = 4.0, 1.5, 20.0


def in_air(rng: np.random.Generator, sector: np.ndarray) -> np.ndarray:
    """What a lifted probe of `ellipsoid_heart` shows: rings, and noise that depth lifts."""
    j, i = np.mgrid[: sector.shape[0], : sector.shape[1]]
    reach = np.hypot(i - sector.shape[1] / 2, j)
    noise_db = 20 * np.log10(rng.rayleigh(size=sector.shape) + 1e-3)
    rings_db = 60 - 2 * reach + 10 * np.cos(reach)
    level_db = np.logaddexp(rings_db, 0.2 * reach + noise_db)
    return (np.clip(20 + 3 * level_db, 1, 255).round() * sector).astype(np.float32)


@pytest.fixture(scope="module")
def recording():
    return record(seed=2, frames=8)


@pytest.mark.parametrize("name", list(PROBES))
def test_every_probe_in_air_is_known_and_on_the_heart_too(name):
    """Truth is the phantom's own: which frames it lifted off."""
    rng = np.random.default_rng(4)
    heart = draw_heart(rng)
    r_times_s = simulate_ecg(rng, 6.0, 0.8).r_times_s
    settings = UltrasoundSettings(probe=name, sweeps=1, frames=8, beams=96, lifted=1.0)
    (sweep,) = simulate_sweeps(rng, heart, r_times_s, settings)
    pixel_mm = np.full(2, PROBES[name].sector.pixel_mm)
    contact = Contact.of(sweep.images.max(axis=0) > 0, pixel_mm)
    assert 0 < sweep.lost.sum() < 8
    np.testing.assert_array_equal(contact.touching(sweep.images.astype(np.float32)), ~sweep.lost)


def test_a_curve_of_grey_changes_nothing():
    """A scanner's curve from echo to grey keeps the order of grey values, not their steps."""
    rng = np.random.default_rng(1)
    probe = PROBES["surface"]
    image = silence(rng, probe.sector, probe.optics).astype(np.float32)
    contact = Contact.of(probe.sector.inside, np.full(2, probe.sector.pixel_mm))
    for gamma in (0.5, 1.0, 2.0):
        assert not contact.touching(255 * (image[None] / 255) ** gamma).any()


@pytest.mark.parametrize("pixel_mm", [(1.0, 1.0), (0.5, 1.0), (1.0, 0.5)])
@pytest.mark.parametrize("widening", [0.0, 0.7])
def test_depth_alone_is_air_and_a_heart_is_not(widening, pixel_mm):
    """Parallel beams and a fan; a dark disc of 50 mm beside the middle is a heart."""
    i, j = np.meshgrid(np.arange(0, 160, pixel_mm[0]), np.arange(0, 120, pixel_mm[1]))
    across_mm = i - 80.0
    sector = (np.abs(across_mm) <= 25 + widening * j) & (j > 0)
    # Beams that widen by 0.7 to either side meet 25 / 0.7 mm above the picture.
    reach_mm = j if widening == 0 else np.hypot(across_mm, j + 25 / widening)
    air = sector * (40 + 30 * np.cos(reach_mm / 12)) + sector * 60
    body = np.where(np.hypot(across_mm + 10, j - 60) < 25, sector * 5.0, air)
    contact = Contact.of(sector, np.array(pixel_mm))
    images = np.stack([air, body]).astype(np.float32)
    np.testing.assert_array_equal(contact.touching(images), [False, True])


@pytest.mark.parametrize("pixel_mm", [(1.0, 1.0), (0.5, 1.0), (1.0, 0.5)])
def test_beams_meet_where_the_edges_of_a_fan_do(pixel_mm):
    """A width told too small by a pixel, 1 mm at most, puts that by 1 / 1.4 mm too low."""
    i, j = np.meshgrid(np.arange(0, 240, pixel_mm[0]), np.arange(0, 120, pixel_mm[1]))
    sector = np.abs(i - 120.0) <= 25 + 0.7 * j
    assert _apex_mm(sector, np.array(pixel_mm)) == pytest.approx(-25 / 0.7, abs=0.8)


def test_frames_in_air_leave_the_samples_of_the_others_as_they_are(recording):
    rng = np.random.default_rng(3)
    sweep, phases = recording.sweeps[0], recording.phases[0]
    images = sweep.images.copy()
    sector = images.max(axis=0) > 0
    for lost in (2, 3, 6):
        images[lost] = in_air(rng, sector)
    kept = [0, 1, 4, 5, 7]
    fewer = replace(sweep, images=images[kept], tracker_from_image=sweep.tracker_from_image[kept])

    samples = sample_frames([replace(sweep, images=images)], [phases], *LENGTHS_MM)
    without = sample_frames([fewer], [phases[kept]], *LENGTHS_MM)

    np.testing.assert_array_equal(samples.number, kept)
    np.testing.assert_array_equal(samples.grey, without.grey)
    np.testing.assert_array_equal(samples.points_mm, without.points_mm)


def test_a_study_all_in_air_is_refused(recording):
    rng = np.random.default_rng(5)
    sector = recording.sweeps[0].images.max(axis=0) > 0
    sweeps = [
        replace(sweep, images=np.stack([in_air(rng, sector) for _ in sweep.images]))
        for sweep in recording.sweeps
    ]
    with pytest.raises(UnregistrableError, match="none of the 16 frames shows a body"):
        sample_frames(sweeps, recording.phases, *LENGTHS_MM)
