"""Tracked 2D ultrasound sweeps of the beating heart, as a research tracker would record them.

An operator finds a window onto the heart, points the fan at it and turns it slowly while the heart
beats and the patient holds the breath. Each frame shows the anatomy at the true phase of its own
time. The picture is formed at the true pose; what is recorded carries the faults of the tracker,
of the calibration and of the clock, and the truth about each is kept.
"""

from __future__ import annotations

import errno
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import SimpleITK as sitk
from scipy.spatial.transform import Rotation

from data_synth.breathing import breath_hold_mm, free_breathing_mm
from data_synth.ecg import phase_at
from data_synth.echo import silence
from data_synth.errors import SynthError
from data_synth.probe import EXAMINATIONS, PROBES, Probe
from data_synth.sector import Sector
from data_synth.tracker import frozen, off_by, stretch, unsteady
from data_synth.ultrasound_settings import UltrasoundSettings
from data_synth.view import View, draw_view, show
from data_synth.window import Anatomy, aim, sway, sweep_poses

Float = npt.NDArray[np.float64]
Byte = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
Progress = Callable[[int, int], None]

__all__ = ["Sweep", "UltrasoundSettings", "fitted_probe", "simulate_sweeps", "write_sweep"]


@dataclass(frozen=True, slots=True)
class Sweep:
    """One recorded run of frames, and the truth about it."""

    name: str
    """Stem of its file."""

    images: Byte
    """``(n, rows, columns)`` grey values."""

    times_s: Float
    """``(n,)`` time stamps as written: the ultrasound's own clock, jitter included."""

    phases: Float
    """``(n,)`` true phase of each frame: share of its own RR interval that has passed."""

    image_to_probe: Float
    """4x4 from pixel ``(i, j, 0)`` to mm of the probe's marker, as written."""

    probe_to_tracker: Float
    """``(n, 4, 4)`` as recorded, noise and outliers included."""

    mr_from_tracker: Float
    """4x4 truth from tracker mm to LPS mm; one for all sweeps of a study."""

    true_times_s: Float
    """``(n,)`` on the clock of the ECG."""

    nominal_phases: Float
    """``(n,)`` phase of the nominal cycle that the heart shows: `Anatomy.nominal_phase`."""

    true_image_to_probe: Float
    """4x4 without the calibration's error."""

    true_probe_to_tracker: Float
    """``(n, 4, 4)`` without noise and outliers."""

    displacement_mm: Float
    """``(n, 3)`` shift of the heart by breathing, LPS."""

    clock_offset_s: float
    """Time stamp less time on the ECG's clock, jitter aside."""

    outlier: Mask
    """``(n,)`` True where the recorded pose is far off."""

    lost: Mask
    """``(n,)`` True where the probe was off the body, so that the picture shows nothing."""

    untracked: Mask
    """``(n,)`` True where the tracker did not see the marker: written as INVALID."""


def simulate_sweeps(
    rng: np.random.Generator,
    heart: Anatomy,
    r_times_s: Float,
    settings: UltrasoundSettings | None = None,
    progress: Progress | None = None,
) -> list[Sweep]:
    """Record every sweep of one study, one after the other, within the span of the R peaks.

    Pictures, tracker and clock draw from streams of their own: a tracker's fault changes no
    picture.

    Raises
    ------
    SynthError
        When the R peaks span less time than the sweeps need, or no heart is in view.
    """
    settings = settings or UltrasoundSettings()
    scene, light, faults = rng.spawn(3)
    starts_s = _start_times(scene, r_times_s, settings)
    all_times_s = [_frame_times(scene, start_s, settings) for start_s in starts_s]
    all_moved_mm = _breaths_mm(scene, all_times_s, settings)
    mr_from_tracker = _random_rigid(scene, 400.0)
    kits: dict[str, _Kit] = {}
    sweeps = []
    for number, (name, window) in enumerate(EXAMINATIONS[settings.probe][: settings.sweeps]):
        if name not in kits:
            kits[name] = _equip(scene, faults, heart, fitted_probe(name, settings), settings)
        run = _Run(number, window, all_times_s[number], r_times_s, all_moved_mm[number])
        take = _take(scene, kits[name], run, settings)
        images = _pictures(light, kits[name].view, take, settings.sweeps, progress)
        sweeps.append(_recorded(faults, kits[name], mr_from_tracker, take, images, settings))
    return sweeps


def fitted_probe(name: str, settings: UltrasoundSettings) -> Probe:
    """The named probe with the values that the settings ask for."""
    probe = PROBES[name]
    sector = replace(probe.sector, **_asked(settings, "depth_mm", "angle_deg", "pixel_mm", "beams"))
    sound = ("frequency_mhz", "compensation_db_per_cm", "gain_db", "dynamic_range_db")
    optics = replace(probe.optics, **_asked(settings, *sound))
    return replace(
        probe, sector=sector, optics=optics, **_asked(settings, "standoff_mm", "turn_deg")
    )


def _asked(settings: UltrasoundSettings, *names: str) -> dict[str, Any]:
    """The named settings that are not None."""
    values = {name: getattr(settings, name) for name in names}
    return {name: value for name, value in values.items() if value is not None}


def write_sweep(path: Path, sweep: Sweep) -> None:
    """Write a PLUS / SlicerIGT sequence (``.mha``); the same sweep gives the same bytes."""
    image = sitk.GetImageFromArray(sweep.images)
    image.SetMetaData("UltrasoundImageOrientation", "MF")
    image.SetMetaData("UltrasoundImageType", "BRIGHTNESS")
    for number, time_s in enumerate(sweep.times_s):
        fields = {
            "FrameNumber": str(number),
            "Timestamp": repr(float(time_s)),
            "ImageStatus": "OK",
            "ImageToProbeTransform": _matrix_text(sweep.image_to_probe),
            "ImageToProbeTransformStatus": "OK",
            "ProbeToTrackerTransform": _matrix_text(sweep.probe_to_tracker[number]),
            "ProbeToTrackerTransformStatus": "INVALID" if sweep.untracked[number] else "OK",
        }
        for key, value in fields.items():
            image.SetMetaData(f"Seq_Frame{number:04d}_{key}", value)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        sitk.WriteImage(image, str(path), useCompression=False)
    except RuntimeError as error:
        # The library's own words, for it does not say why.
        raise OSError(errno.EIO, "the image library failed to write", str(path)) from error


@dataclass(frozen=True, slots=True)
class _Kit:
    """One probe with its marker, used for one or more sweeps."""

    view: View
    probe_from_transducer: Float
    calibration_error: Float


@dataclass(frozen=True, slots=True)
class _Run:
    """What is settled before the operator takes up the probe."""

    number: int
    window: int
    times_s: Float
    r_times_s: Float
    moved_mm: Float


@dataclass(frozen=True, slots=True)
class _Take:
    """What truly happens during a run."""

    run: _Run
    phases: Float
    nominal_phases: Float
    poses: Float
    """``(n, 4, 4)`` true ``mr_from_transducer``."""

    lost: Mask
    contact_db: Float
    """``(n, beams)``."""


def _equip(
    scene: np.random.Generator,
    faults: np.random.Generator,
    heart: Anatomy,
    probe: Probe,
    settings: UltrasoundSettings,
) -> _Kit:
    """A probe in front of this heart, with a marker fixed to it and calibrated."""
    return _Kit(
        draw_view(scene, heart, probe, settings.slice_mm),
        _random_rigid(scene, 60.0),
        off_by(faults, settings.calibration_mm, settings.calibration_deg),
    )


def _take(rng: np.random.Generator, kit: _Kit, run: _Run, settings: UltrasoundSettings) -> _Take:
    """Find the window, move the probe, let the heart beat and the contact come and go."""
    probe, heart, times_s = kit.view.probe, kit.view.heart, run.times_s
    start = aim(rng, heart, probe, probe.windows[run.window])
    poses = sweep_poses(rng, start, times_s, probe, settings.hand_mm, settings.hand_deg)
    if probe.rides:
        poses[:, :3, 3] += run.moved_mm
    phases = phase_at(times_s, run.r_times_s)
    beat = np.searchsorted(run.r_times_s, times_s, side="right") - 1
    rr_s = np.diff(run.r_times_s)[beat]
    nominal = [heart.nominal_phase(float(p), float(rr)) for p, rr in zip(phases, rr_s, strict=True)]
    lost = stretch(rng, len(times_s), settings.lifted, settings.lifted_frames)
    contact_db = _contact_db(rng, probe.sector, times_s, settings)
    return _Take(run, phases, np.array(nominal), poses, lost, contact_db)


def _pictures(
    rng: np.random.Generator, view: View, take: _Take, sweeps: int, progress: Progress | None
) -> Byte:
    """``(n, rows, columns)`` pictures of one run."""
    count = len(take.phases)
    images = []
    for k in range(count):
        if take.lost[k]:
            images.append(silence(rng, view.probe.sector, view.probe.optics))
        else:
            phase, moved_mm = float(take.nominal_phases[k]), take.run.moved_mm[k]
            images.append(show(rng, view, take.poses[k], phase, moved_mm, take.contact_db[k]))
        if progress:
            progress(take.run.number * count + k + 1, sweeps * count)
    return np.stack(images)


def _recorded(
    rng: np.random.Generator,
    kit: _Kit,
    mr_from_tracker: Float,
    take: _Take,
    images: Byte,
    settings: UltrasoundSettings,
) -> Sweep:
    """A run as tracker and scanner write it down, and the truth."""
    run, count = take.run, len(take.phases)
    transducer_from_probe = np.linalg.inv(kit.probe_from_transducer)
    exact = np.linalg.inv(mr_from_tracker) @ take.poses @ transducer_from_probe
    found = exact @ unsteady(rng, count, settings.tracker_mm, settings.tracker_deg)
    found, outlier = _with_outliers(rng, found, kit.probe_from_transducer, settings)
    untracked = stretch(rng, count, settings.untracked, settings.untracked_frames)
    transducer_from_image = kit.view.probe.sector.transducer_from_image
    calibrated = kit.probe_from_transducer @ kit.calibration_error
    return Sweep(
        name=f"sweep_{run.number:03d}",
        images=images,
        times_s=run.times_s + settings.clock_offset_s + _jitter_s(rng, count, settings),
        phases=take.phases,
        image_to_probe=calibrated @ transducer_from_image,
        probe_to_tracker=frozen(found, untracked),
        mr_from_tracker=mr_from_tracker,
        true_times_s=run.times_s,
        nominal_phases=take.nominal_phases,
        true_image_to_probe=kit.probe_from_transducer @ transducer_from_image,
        true_probe_to_tracker=exact,
        displacement_mm=run.moved_mm,
        clock_offset_s=settings.clock_offset_s,
        outlier=outlier,
        lost=take.lost,
        untracked=untracked,
    )


def _with_outliers(
    rng: np.random.Generator,
    tracker_from_probe: Float,
    probe_from_transducer: Float,
    settings: UltrasoundSettings,
) -> tuple[Float, Mask]:
    """Recorded poses, some far off: the probe seems elsewhere, turned about its own tip."""
    outlier = rng.random(len(tracker_from_probe)) < settings.outliers
    away = [off_by(rng, settings.outlier_mm, settings.outlier_deg) for _ in outlier]
    far = probe_from_transducer @ np.stack(away) @ np.linalg.inv(probe_from_transducer)
    moved = tracker_from_probe @ far
    return np.where(outlier[:, None, None], moved, tracker_from_probe), outlier


def _start_times(
    rng: np.random.Generator, r_times_s: Float, settings: UltrasoundSettings
) -> list[float]:
    """Start of every sweep: at any phase, a second or more after the end of the one before."""
    length_s = settings.frames / settings.frame_rate_hz
    starts_s = []
    clock_s = float(r_times_s[0]) if len(r_times_s) else 0.0
    for _ in range(settings.sweeps):
        starts_s.append(clock_s + rng.uniform(0.05, 1.0))
        clock_s = starts_s[-1] + length_s + 1.0
    if len(r_times_s) < 2 or clock_s - 1.0 >= r_times_s[-1]:
        span = f"{r_times_s[0]:.1f} to {r_times_s[-1]:.1f} s" if len(r_times_s) else "no time"
        raise SynthError(
            f"{settings.sweeps} sweeps of {length_s:.1f} s end at {clock_s - 1.0:.1f} s, but the "
            f"R peaks span {span}; record a longer ECG or fewer frames"
        )
    return starts_s


def _frame_times(rng: np.random.Generator, start_s: float, settings: UltrasoundSettings) -> Float:
    """Times of the frames: a steady rate, early or late by up to a tenth of a period."""
    period_s = 1 / settings.frame_rate_hz
    unsteady = rng.uniform(-0.1, 0.1, settings.frames)
    unsteady[[0, -1]] = 0.0
    return np.asarray(start_s + period_s * (np.arange(settings.frames) + unsteady))


def _jitter_s(rng: np.random.Generator, count: int, settings: UltrasoundSettings) -> Float:
    """Error of each time stamp, so small that stamps still rise."""
    most_s = 0.25 / settings.frame_rate_hz
    return np.clip(settings.jitter_ms / 1000 * rng.normal(size=count), -most_s, most_s)


def _breaths_mm(
    rng: np.random.Generator, all_times_s: list[Float], settings: UltrasoundSettings
) -> list[Float]:
    """``(n, 3)`` shift of the heart in the frames of each sweep."""
    held_mm = breath_hold_mm(rng, len(all_times_s), settings.breathing)
    start = rng.random()
    if settings.breath == "free":
        return [free_breathing_mm(times_s, settings.breathing, start) for times_s in all_times_s]
    return [
        np.tile(held, (len(times_s), 1)) for held, times_s in zip(held_mm, all_times_s, strict=True)
    ]


def _random_rigid(rng: np.random.Generator, reach_mm: float) -> Float:
    """A rotation out of all, and a shift of up to ``reach_mm`` along each axis."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    matrix[:3, 3] = rng.uniform(-reach_mm, reach_mm, 3)
    return matrix


def _contact_db(
    rng: np.random.Generator, sector: Sector, times_s: Float, settings: UltrasoundSettings
) -> Float:
    """``(n, beams)`` gain of each beam: a gentle ripple, and wedges where the tip lifts off."""
    angles = sector.angles_rad
    level_db = 1.5 * np.sin(np.outer(np.ones(len(times_s)), 3 * angles) + rng.uniform(0, 6.3))
    for _ in range(2):
        centre, width = rng.uniform(angles[0], angles[-1]), rng.uniform(0.04, 0.10)
        depth_db = rng.uniform(8.0, 25.0) * (rng.random() < settings.dropout)
        drift = centre + 0.08 * sway(rng, times_s, 1)
        level_db -= depth_db * np.exp(-0.5 * ((angles - drift) / width) ** 2)
    return np.asarray(level_db)


def _matrix_text(matrix: Float) -> str:
    """Sixteen numbers row by row, exact when read back."""
    return " ".join(repr(float(value)) for value in matrix.ravel())
