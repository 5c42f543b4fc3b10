"""Tracked 2D ultrasound sweeps of the beating heart, as a research tracker would record them.

An operator finds a window onto the heart, points the fan at it and turns it slowly while the heart
beats. Each frame shows the anatomy at the true phase of its own time. The recorded poses carry the
tracker's noise; the picture is formed at the true pose.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt
import SimpleITK as sitk
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial.transform import Rotation

from data_synth.ecg import phase_at
from data_synth.echo import ACOUSTICS, Optics, Sector, bmode
from data_synth.errors import SynthError
from data_synth.tissue import Tissue

Float = npt.NDArray[np.float64]
Byte = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

_HEART = (
    Tissue.LV_CAVITY,
    Tissue.LV_MYOCARDIUM,
    Tissue.RV_CAVITY,
    Tissue.RV_WALL,
    Tissue.LEFT_ATRIUM,
    Tissue.RIGHT_ATRIUM,
    Tissue.ATRIAL_WALL,
)


class Anatomy(Protocol):
    """What a transducer needs to know of the body in front of it."""

    @property
    def centre_mm(self) -> Float:
        """``(3,)`` middle of the heart, LPS."""

    @property
    def long_axis(self) -> Float:
        """``(3,)`` unit vector from apex to base, LPS."""

    def tissue(self, points_mm: Float, phase: float) -> Byte:
        """Label of each of ``(n, 3)`` LPS points at one phase."""


class UltrasoundSettings(BaseModel):
    """The scanner's preset, the operator's hand and the tracker's noise."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    sweeps: int = Field(default=2, ge=1, le=3)
    """Windows used, in this order: apical, posterior (transoesophageal), parasternal."""
    frames: int = Field(default=40, ge=1)
    frame_rate_hz: float = Field(default=20.0, gt=0)
    depth_mm: float = Field(default=150.0, ge=40, le=250)
    angle_deg: float = Field(default=90.0, ge=20, le=120)
    pixel_mm: float = Field(default=0.8, gt=0.1, le=3)
    beams: int = Field(default=128, ge=16)
    slice_mm: float = Field(default=1.2, ge=0, le=5)
    """Standard deviation of the beam across the picture's plane: what makes walls fuzzy."""
    standoff_mm: float = Field(default=8.0, ge=0, le=30)
    """Depth of the coupling pad between tip and heart; whatever was there is pushed aside."""
    turn_deg: float = Field(default=110.0, ge=0, le=180)
    """How far the fan is turned about its middle beam during a sweep."""
    hand_mm: float = Field(default=2.0, ge=0)
    """Swing of the hand along each axis."""
    hand_deg: float = Field(default=2.0, ge=0)
    """Swing of the hand about each axis."""
    tracker_mm: float = Field(default=0.2, ge=0)
    """Standard deviation of a recorded position along each axis."""
    tracker_deg: float = Field(default=0.1, ge=0)
    """Standard deviation of a recorded rotation about each axis."""
    dropout: float = Field(default=0.6, ge=0, le=1)
    """Chance of each of two wedges of poor contact in a sweep."""


@dataclass(frozen=True, slots=True)
class Sweep:
    """One recorded run of frames."""

    name: str
    """Stem of its file."""

    images: Byte
    """``(n, rows, columns)`` grey values."""

    times_s: Float
    """``(n,)`` on the clock of the ECG."""

    phases: Float
    """``(n,)`` true phase of each frame."""

    image_to_probe: Float
    """4x4 from pixel ``(i, j, 0)`` to mm of the probe's marker."""

    probe_to_tracker: Float
    """``(n, 4, 4)`` as recorded, noise included."""

    mr_from_tracker: Float
    """4x4 truth from tracker mm to LPS mm; one for all sweeps of a study."""


def simulate_sweeps(
    rng: np.random.Generator,
    heart: Anatomy,
    r_times_s: Float,
    settings: UltrasoundSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Sweep]:
    """Record every sweep of one study, one after the other, within the span of the R peaks.

    Raises
    ------
    SynthError
        When the R peaks span less time than the sweeps need.
    """
    settings = settings or UltrasoundSettings()
    starts_s = _start_times(rng, r_times_s, settings)
    mr_from_tracker = _random_rigid(rng, 400.0)
    probe_from_transducer = _random_rigid(rng, 60.0)
    sweeps = []
    for number, start_s in enumerate(starts_s):
        recorder = _Recorder(heart, settings, mr_from_tracker, probe_from_transducer)
        times_s = _frame_times(rng, start_s, settings)
        phases = phase_at(times_s, r_times_s)
        sweeps.append(recorder.sweep(rng, number, times_s, phases, progress))
    return sweeps


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
            "ProbeToTrackerTransformStatus": "OK",
        }
        for key, value in fields.items():
            image.SetMetaData(f"Seq_Frame{number:04d}_{key}", value)
    path.parent.mkdir(parents=True, exist_ok=True)
    sitk.WriteImage(image, str(path), useCompression=False)


@dataclass(frozen=True, slots=True)
class _Recorder:
    """Everything that stays the same through one study."""

    heart: Anatomy
    settings: UltrasoundSettings
    mr_from_tracker: Float
    probe_from_transducer: Float

    def sweep(
        self,
        rng: np.random.Generator,
        number: int,
        times_s: Float,
        phases: Float,
        progress: Callable[[int, int], None] | None,
    ) -> Sweep:
        """Record one sweep."""
        settings = self.settings
        sector = _sector(settings)
        poses = _hand_motion(rng, _aim(rng, self.heart, number, settings), times_s, settings)
        contact_db = _contact_db(rng, sector, times_s, settings)
        images = []
        for k, (pose, phase) in enumerate(zip(poses, phases, strict=True)):
            # A beam hears a slice, not a plane: each sample comes from somewhere across it.
            across_mm = settings.slice_mm * rng.normal(size=sector.points_mm.shape[:2])
            labels = _labels(
                self.heart, pose, float(phase), sector, settings.standoff_mm, across_mm
            )
            images.append(bmode(rng, labels, sector, contact_db[k], Optics()))
            if progress:
                progress(number * len(times_s) + k + 1, settings.sweeps * len(times_s))
        transducer_from_probe = np.linalg.inv(self.probe_from_transducer)
        exact = np.linalg.inv(self.mr_from_tracker) @ poses @ transducer_from_probe
        return Sweep(
            name=f"sweep_{number:03d}",
            images=np.stack(images),
            times_s=times_s,
            phases=phases,
            image_to_probe=self.probe_from_transducer @ sector.transducer_from_image,
            probe_to_tracker=exact @ _tracker_noise(rng, len(times_s), settings),
            mr_from_tracker=self.mr_from_tracker,
        )


def _sector(settings: UltrasoundSettings) -> Sector:
    return Sector(settings.depth_mm, settings.angle_deg, settings.pixel_mm, settings.beams)


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


def _random_rigid(rng: np.random.Generator, reach_mm: float) -> Float:
    """A rotation out of all, and a shift of up to ``reach_mm`` along each axis."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    matrix[:3, 3] = rng.uniform(-reach_mm, reach_mm, 3)
    return matrix


def _window_direction(heart: Anatomy, number: int) -> Float:
    """Unit vector (LPS) from the heart's centre to the window of sweep ``number``."""
    long_axis = np.asarray(heart.long_axis)
    left, posterior = np.eye(3)[:2]
    wanted = (
        -long_axis,
        # The oesophagus runs behind the left atrium, to the base side of the middle.
        posterior + 0.4 * long_axis,
        -posterior + 0.3 * left,
    )[number]
    return np.asarray(wanted / np.linalg.norm(wanted))


def _aim(
    rng: np.random.Generator, heart: Anatomy, number: int, settings: UltrasoundSettings
) -> Float:
    """4x4 ``mr_from_transducer`` of the best of the windows near the wanted one."""
    nominal = _window_direction(heart, number)
    directions = [nominal]
    for _ in range(6):
        about = _unit(np.cross(nominal, _unit(rng.normal(size=3))))
        directions.append(Rotation.from_rotvec(np.deg2rad(18.0) * about).apply(nominal))
    poses = [_pose_on(rng, heart, direction, settings) for direction in directions]
    return max(poses, key=lambda pose: _share_of_heart_heard(heart, pose, settings))


def _pose_on(
    rng: np.random.Generator, heart: Anatomy, direction: Float, settings: UltrasoundSettings
) -> Float:
    """A transducer outside the heart in ``direction``, its middle beam on the heart's centre."""
    reach_mm = np.arange(0.0, 160.0, 1.0)
    ray_mm = heart.centre_mm + reach_mm[:, None] * direction
    hits = np.flatnonzero(np.isin(heart.tissue(ray_mm, 0.0), _HEART))
    if not len(hits):
        raise SynthError(f"the heart has no tissue on the ray from {heart.centre_mm} mm outwards")
    pose = np.eye(4)
    pose[:3, 3] = ray_mm[hits[-1]] + settings.standoff_mm * direction
    across = _unit(np.cross(direction, _unit(rng.normal(size=3))))
    pose[:3, :3] = np.stack([across, -direction, np.cross(across, -direction)], axis=1)
    return pose


def _share_of_heart_heard(heart: Anatomy, pose: Float, settings: UltrasoundSettings) -> float:
    """Share of the samples of two crossed planes that lie in the heart and are not shadowed."""
    coarse = Sector(settings.depth_mm, settings.angle_deg, 4.0, 24, range_step_mm=2.5)
    loss = np.array([ACOUSTICS[tissue].attenuation_db_per_cm for tissue in Tissue])
    heard = []
    for turn in (0.0, 90.0):
        turned = pose @ _rigid(np.deg2rad([0.0, turn, 0.0]), np.zeros(3))
        labels = _labels(heart, turned, 0.0, coarse, settings.standoff_mm)
        path_db = np.cumsum(2 * loss[labels], axis=0) * coarse.range_step_mm / 10
        heard.append(np.isin(labels, _HEART) & (path_db < 45.0))
    return float(np.mean(heard))


def _hand_motion(
    rng: np.random.Generator, start: Float, times_s: Float, settings: UltrasoundSettings
) -> Float:
    """``(n, 4, 4)`` true ``mr_from_transducer``: a slow turn about the middle beam, and sway."""
    passed = (times_s - times_s[0]) / max(times_s[-1] - times_s[0], 1e-9)
    sway = _sway(rng, times_s, 6)
    rotvec = np.deg2rad(settings.hand_deg * sway[:, :3])
    shift_mm = settings.hand_mm * sway[:, 3:]
    # Ease in and out: the hand starts and ends at rest.
    eased = passed - np.sin(2 * np.pi * passed) / (4 * np.pi)
    turn = np.deg2rad(settings.turn_deg) * (eased - 0.5)
    poses = []
    for k in range(len(times_s)):
        turned = start @ _rigid(np.array([0.0, turn[k], 0.0]), np.zeros(3))
        poses.append(turned @ _rigid(rotvec[k], shift_mm[k]))
    return np.stack(poses)


def _sway(rng: np.random.Generator, times_s: Float, channels: int) -> Float:
    """``(n, channels)`` smooth wander of about unit size: three waves of 0.1 to 1 Hz each."""
    rates_hz = rng.uniform(0.1, 1.0, (3, channels))
    phases = rng.uniform(0, 2 * np.pi, (3, channels))
    waves = np.sin(2 * np.pi * rates_hz * times_s[:, None, None] + phases)
    return np.asarray(waves.sum(axis=1) * np.sqrt(2 / 3))


def _tracker_noise(rng: np.random.Generator, count: int, settings: UltrasoundSettings) -> Float:
    """``(n, 4, 4)`` small motions of the marker that the tracker wrongly reports."""
    rotvec = np.deg2rad(settings.tracker_deg) * rng.normal(size=(count, 3))
    shift_mm = settings.tracker_mm * rng.normal(size=(count, 3))
    return np.stack([_rigid(r, s) for r, s in zip(rotvec, shift_mm, strict=True)])


def _contact_db(
    rng: np.random.Generator, sector: Sector, times_s: Float, settings: UltrasoundSettings
) -> Float:
    """``(n, beams)`` gain of each beam: a gentle ripple, and wedges where the tip lifts off."""
    angles = sector.angles_rad
    level_db = 1.5 * np.sin(np.outer(np.ones(len(times_s)), 3 * angles) + rng.uniform(0, 6.3))
    for _ in range(2):
        centre, width = rng.uniform(angles[0], angles[-1]), rng.uniform(0.04, 0.10)
        depth_db = rng.uniform(8.0, 25.0) * (rng.random() < settings.dropout)
        drift = centre + 0.08 * _sway(rng, times_s, 1)
        level_db -= depth_db * np.exp(-0.5 * ((angles - drift) / width) ** 2)
    return np.asarray(level_db)


def _labels(
    heart: Anatomy,
    mr_from_transducer: Float,
    phase: float,
    sector: Sector,
    standoff_mm: float,
    across_mm: Float | float = 0.0,
) -> Byte:
    """``(ranges, beams)`` tissues in front of a transducer; the coupling pad carries sound well.

    ``across_mm`` ``(ranges, beams)`` shifts each sample out of the picture's plane.
    """
    local = sector.points_mm.copy()
    local[..., 2] += across_mm
    points_mm = local.reshape(-1, 3) @ mr_from_transducer[:3, :3].T + mr_from_transducer[:3, 3]
    labels = np.array(heart.tissue(points_mm, phase)).reshape(local.shape[:2])
    pad = (sector.ranges_mm < standoff_mm)[:, None] & ~np.isin(labels, _HEART)
    labels[pad] = Tissue.BLOOD_VESSEL
    return labels


def _rigid(rotvec: Float, shift_mm: Float) -> Float:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    matrix[:3, 3] = shift_mm
    return matrix


def _unit(vector: Float) -> Float:
    return np.asarray(vector / np.linalg.norm(vector))


def _matrix_text(matrix: Float) -> str:
    """Sixteen numbers row by row, exact when read back."""
    return " ".join(repr(float(value)) for value in matrix.ravel())
