"""Where a tip is put, what lies in front of it, and how an operator sweeps it."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from data_synth.echo import path_loss_db
from data_synth.errors import SynthError
from data_synth.probe import Probe, Window
from data_synth.sector import Sector
from data_synth.tissue import Tissue

Float = npt.NDArray[np.float64]
Byte = npt.NDArray[np.uint8]

HEART = (
    Tissue.LV_CAVITY,
    Tissue.LV_MYOCARDIUM,
    Tissue.RV_CAVITY,
    Tissue.RV_WALL,
    Tissue.LEFT_ATRIUM,
    Tissue.RIGHT_ATRIUM,
    Tissue.ATRIAL_WALL,
    Tissue.PAPILLARY_MUSCLE,
    Tissue.RV_TRABECULA,
    Tissue.LEAFLET,
    Tissue.SCAR,
)
"""Chambers and their walls."""

HARD = (Tissue.LUNG, Tissue.BONE, Tissue.AIR, Tissue.GAS)
"""What sound does not pass."""

CONTACT_DEG = 36.0
"""Half of the angle within which the heart lies against the chest wall, with no lung between."""
_SHADOW_DB = 18.0
"""Tissue that is darker by this than it ought to be is no use to an operator."""
LARGEST_GAP_MM = 60.0
"""A pad or a wall thicker than this is none."""


class Anatomy(Protocol):
    """What a transducer needs to know of the body in front of it."""

    @property
    def centre_mm(self) -> Float:
        """``(3,)`` centre of the mitral plane at the R peak, LPS."""

    @property
    def long_axis(self) -> Float:
        """``(3,)`` unit vector from apex to base, LPS."""

    def heart_tissue(self, points_mm: Float, phase: float) -> Byte:
        """Label of each of ``(n, 3)`` LPS points that belong to the heart; 0 elsewhere."""

    def chest_tissue(self, points_mm: Float) -> Byte:
        """Label of each of ``(n, 3)`` LPS points with the heart left out."""

    def reference(self, points_mm: Float, phase: float) -> Float:
        """Where ``(n, 3)`` LPS points of the heart at a phase are at the R peak."""

    def nominal_phase(self, phase: float, rr_s: float) -> float:
        """Phase of the nominal cycle that a beat of another RR interval shows."""


def aim(rng: np.random.Generator, heart: Anatomy, probe: Probe, window: Window) -> Float:
    """4x4 ``mr_from_transducer`` of the best of some tips near the wanted one.

    An operator slides the probe about until most of the heart shows: tips around the wanted
    direction are tried, first wide, then closely, and the one that hears the largest share of the
    heart is taken.

    Raises
    ------
    SynthError
        When there is no heart where the window looks.
    """
    target = heart.centre_mm - window.target_mm * np.asarray(heart.long_axis)
    roll = unit(rng.normal(size=3))
    if window.chamber is not None:
        middle = _middle_of(heart, window.chamber) + rng.normal(scale=1.5, size=3)
        bent = rng.normal(scale=0.05, size=3)
        return _look(heart, middle, target, window, roll, bent)
    rest = _on_skin if probe.medium == "chest wall" else _on_heart
    best = _direction(heart, window.direction)
    for off_deg in (8.0, 4.0, 2.0):
        tries = _around(roll, best, off_deg)
        tips = [rest(heart, target, way, probe) for way in tries]
        poses = [_look(heart, tip, target, window, roll, np.zeros(3)) for tip in tips]
        heard = [_share_of_heart_heard(heart, pose, probe) for pose in poses]
        best, pose = tries[int(np.argmax(heard))], poses[int(np.argmax(heard))]
    return pose


def _around(roll: Float, wanted: Float, off_deg: float) -> list[Float]:
    """The wanted direction and eight others at ``off_deg`` to it."""
    side = unit(np.cross(wanted, roll))
    turns = [Rotation.from_rotvec(k * np.pi / 4 * wanted).apply(side) for k in range(8)]
    off_rad = np.deg2rad(off_deg)
    return [wanted, *(Rotation.from_rotvec(off_rad * axis).apply(wanted) for axis in turns)]


def _direction(heart: Anatomy, weights: tuple[float, float, float, float]) -> Float:
    axes = np.vstack([np.asarray(heart.long_axis), np.eye(3)])
    return unit(np.array(weights) @ axes)


def _on_heart(heart: Anatomy, target: Float, direction: Float, probe: Probe) -> Float:
    """A tip off the heart's outside by the standoff."""
    ray_mm = target + np.arange(0.0, 160.0, 1.0)[:, None] * direction
    hits = np.flatnonzero(np.isin(heart.heart_tissue(ray_mm, 0.0), HEART))
    if not len(hits):
        raise SynthError(f"the heart has no tissue on the ray from {target} mm outwards")
    return np.asarray(ray_mm[hits[-1]] + probe.standoff_mm * direction)


def _on_skin(heart: Anatomy, target: Float, direction: Float, probe: Probe) -> Float:
    """A tip on the skin, pressed into it by a quarter of what lies over the heart there."""
    inner_mm = _on_heart(heart, target, direction, replace(probe, standoff_mm=0.0))
    ray_mm = inner_mm + np.arange(0.0, 200.0, 1.0)[:, None] * direction
    outside = np.flatnonzero(heart.chest_tissue(ray_mm) == Tissue.AIR)
    thick_mm = float(outside[0]) if len(outside) else LARGEST_GAP_MM
    return np.asarray(inner_mm + min(3 / 4 * thick_mm, LARGEST_GAP_MM) * direction)


def _middle_of(heart: Anatomy, chamber: Tissue) -> Float:
    """The point of a chamber that is farthest from its walls."""
    from scipy.ndimage import distance_transform_edt

    step_mm = 4.0
    line = np.arange(-120.0, 121.0, step_mm)
    box = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1)
    labels = heart.heart_tissue((heart.centre_mm + box).reshape(-1, 3), 0.0)
    inside = (labels == chamber).reshape(box.shape[:3])
    if not inside.any():
        raise SynthError(f"the heart has no {chamber.name}; choose another probe")
    deepest = np.unravel_index(np.argmax(distance_transform_edt(inside)), inside.shape)
    return np.asarray(heart.centre_mm + box[deepest])


def _look(
    heart: Anatomy, tip: Float, target: Float, window: Window, roll: Float, bent: Float
) -> Float:
    """4x4 of a transducer at ``tip`` whose middle beam meets ``target``, or is square to a shaft.

    ``roll`` sets the picture's x axis where no shaft does; ``bent`` is added to the shaft. A
    catheter looks sideways: its fan holds the shaft, and the beam is turned towards the target
    as far as the shaft allows; the tip's steering takes up half of what the shaft is off.
    """
    along = unit(target - tip)
    if window.shaft is None:
        across = unit(np.cross(along, roll))
    else:
        shaft = unit(_direction(heart, window.shaft) + bent)
        across = unit(shaft - 0.5 * (shaft @ along) * along)
        along = unit(along - (along @ across) * across)
    pose = np.eye(4)
    pose[:3, 3] = tip
    pose[:3, :3] = np.stack([across, along, np.cross(across, along)], axis=1)
    return pose


def _share_of_heart_heard(heart: Anatomy, pose: Float, probe: Probe) -> float:
    """Share of the samples of two crossed planes that lie in the heart and are not shadowed."""
    coarse = Sector(probe.sector.depth_mm, probe.sector.angle_deg, 4.0, 19, range_step_mm=4.0)
    lift_db = probe.optics.compensation * coarse.ranges_mm[:, None] / 10
    heard = []
    for turn in (0.0, 90.0):
        turned = pose @ rigid(np.deg2rad([0.0, turn, 0.0]), np.zeros(3))
        labels = labels_before(heart, place(coarse.points_mm, turned), 0.0, np.zeros(3))
        labels = opened(labels, coarse, probe)
        excess_db = path_loss_db(labels, coarse, probe.optics) - lift_db
        heard.append(np.isin(labels, HEART) & (excess_db < _SHADOW_DB))
    return float(np.mean(heard))


def place(points_mm: Float, target_from_source: Float) -> Float:
    """Points ``(..., 3)`` carried by a 4x4."""
    return np.asarray(points_mm @ target_from_source[:3, :3].T + target_from_source[:3, 3])


def labels_before(heart: Anatomy, points_mm: Float, phase: float, moved_mm: Float) -> Byte:
    """``(ranges, beams)`` tissues at ``(ranges, beams, 3)`` LPS points.

    ``moved_mm`` is the heart's shift by breathing; the chest stays.
    """
    flat = points_mm.reshape(-1, 3)
    labels = np.array(heart.heart_tissue(flat - moved_mm, phase))
    outside = labels == 0
    labels[outside] = heart.chest_tissue(flat[outside])
    return labels.reshape(points_mm.shape[:2])


def opened(labels: Byte, sector: Sector, probe: Probe) -> Byte:
    """What really lies between tip and heart once the probe has been put there.

    On the chest a patient on the left side holds the breath: the heart rests against the wall and
    the lung is out of the way within a cone. Elsewhere the probe pushes aside what was there.
    """
    heart = np.isin(labels, HEART)
    before = ~np.logical_or.accumulate(heart, axis=0) & heart.any(axis=0)
    filler = {
        "chest wall": Tissue.FAT,
        "oesophagus": Tissue.MUSCLE,
        "blood": Tissue.BLOOD_VESSEL,
        "pad": Tissue.BLOOD_VESSEL,
    }[probe.medium]
    if probe.medium == "chest wall":
        cone = np.abs(sector.angles_rad) < np.deg2rad(CONTACT_DEG)
        replaced = before & np.isin(labels, (Tissue.LUNG, Tissue.GAS)) & cone
    elif probe.medium == "pad":
        near = sector.ranges_mm < probe.standoff_mm + 25.0
        replaced = before & near[:, None]
        replaced |= (sector.ranges_mm < probe.standoff_mm)[:, None] & ~heart
    else:
        near = sector.ranges_mm < probe.standoff_mm + 15.0
        replaced = before & near[:, None] & np.isin(labels, HARD)
    return np.where(replaced, np.uint8(filler), labels)


def sweep_poses(
    rng: np.random.Generator,
    start: Float,
    times_s: Float,
    probe: Probe,
    hand_mm: float,
    hand_deg: float,
) -> Float:
    """``(n, 4, 4)`` true ``mr_from_transducer``: a slow turn of the fan, and the hand's sway."""
    passed = (times_s - times_s[0]) / max(times_s[-1] - times_s[0], 1e-9)
    swings = sway(rng, times_s, 6)
    # Ease in and out: the hand starts and ends at half its mean speed.
    eased = passed - np.sin(2 * np.pi * passed) / (4 * np.pi)
    axis = np.eye(3)[1 if probe.turn_about == "beam" else 0]
    turns = np.deg2rad(probe.turn_deg) * (eased - 0.5)
    poses = []
    for turn, swing in zip(turns, swings, strict=True):
        turned = start @ rigid(turn * axis, np.zeros(3))
        poses.append(turned @ rigid(np.deg2rad(hand_deg) * swing[:3], hand_mm * swing[3:]))
    return np.stack(poses)


def sway(rng: np.random.Generator, times_s: Float, channels: int) -> Float:
    """``(n, channels)`` smooth wander of about unit size: three waves of 0.1 to 1 Hz each."""
    rates_hz = rng.uniform(0.1, 1.0, (3, channels))
    phases = rng.uniform(0, 2 * np.pi, (3, channels))
    waves = np.sin(2 * np.pi * rates_hz * times_s[:, None, None] + phases)
    return np.asarray(waves.sum(axis=1) * np.sqrt(2 / 3))


def rigid(rotvec: Float, shift_mm: Float) -> Float:
    """4x4 of a rotation vector (radians) and a shift."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    matrix[:3, 3] = shift_mm
    return matrix


def unit(vector: Float) -> Float:
    """The vector at length 1."""
    return np.asarray(vector / np.linalg.norm(vector))
