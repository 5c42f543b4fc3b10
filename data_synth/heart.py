"""A beating heart in its chest: what is where at every phase, and how each point travels."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from data_synth.anatomy import BODY_NAMES, BOX_MM, label_points
from data_synth.beat import (
    PLACES,
    Amounts,
    Pulse,
    beat_at,
    beat_of,
    calibrate,
    check_pulse,
    end_systole_phase,
    kick_onset_phase,
    warp_phase,
)
from data_synth.errors import SynthError
from data_synth.kernels import Float, Label, Shape, Tubes
from data_synth.meshes import Mesh, enclosed_ml, reference_meshes, tubes_of
from data_synth.motion import Beat, carry_points, reference_points, volume_ratios
from data_synth.thorax import Thorax, chest_points

Matrix = tuple[tuple[float, ...], ...]

CELL_MM = 5.0
_BOX_LOW = np.array(BOX_MM)[:, 0]


@dataclass(frozen=True)
class BeatingHeart:
    """One heart: sizes, motion, place. Points are LPS mm; phase is cyclic in [0, 1), 0 at R."""

    shape: Shape
    pulse: Pulse
    chest: Thorax
    mr_from_heart: Matrix
    """Rows of the rigid 4x4 (or 3x4) transform from the heart frame to LPS."""
    rr_s: float = 0.8
    """RR interval at which the motion is as ``pulse`` says."""
    amounts: Amounts = field(init=False)
    """Motions that give the ejection fractions which ``pulse`` asks for."""

    def __post_init__(self) -> None:
        check_pulse(self.pulse)
        if not (math.isfinite(self.rr_s) and self.rr_s > 0):
            raise SynthError(f"RR interval is {self.rr_s} s; give a positive number of seconds")
        object.__setattr__(self, "amounts", calibrate(self.shape, self.pulse))

    @property
    def rotation(self) -> Float:
        """(3, 3): columns are the heart frame's axes in LPS."""
        return np.array(self.mr_from_heart)[:3, :3]

    @property
    def centre_mm(self) -> Float:
        """Centre of the mitral plane at the R peak, LPS."""
        return np.array(self.mr_from_heart)[:3, 3]

    @property
    def long_axis(self) -> Float:
        """Unit vector from apex to base, LPS."""
        return self.rotation[:, 2]

    @property
    def tubes(self) -> Tubes:
        """Vessels and appendage in the heart frame."""
        return tubes_of(self.shape)

    def nominal_phase(self, phase: float, rr_s: float) -> float:
        """Phase of the nominal cycle that a beat of another RR interval shows at ``phase``.

        Systole changes with the heart rate as :func:`~data_synth.beat.systole_s` says, the atria
        contract a fixed time before the next R peak, and diastole takes the rest. Analytic,
        monotone and cyclic in ``phase``; the identity at the heart's own RR interval.

        Raises
        ------
        SynthError
            When ``rr_s`` is not a positive number.
        """
        if not (math.isfinite(rr_s) and rr_s > 0):
            raise SynthError(f"RR interval is {rr_s} s; give a positive number of seconds")
        own, rate, usual = self.pulse, 60 / rr_s, 60 / self.rr_s
        longer = end_systole_phase(rate) / end_systole_phase(usual)
        later = (1 - kick_onset_phase(rate)) / (1 - kick_onset_phase(usual))
        end = own.end_systole * longer
        source = (0.0, end, max(1 - (1 - own.kick_onset) * later, end + 0.05))
        return warp_phase(phase, source, (0.0, own.end_systole, own.kick_onset))

    def beat(self, phase: float) -> Beat:
        """Amounts of motion at a phase."""
        return beat_at(self.shape, self.pulse, self.amounts, phase)

    def into_heart(self, points_mm: Float) -> Float:
        """LPS points (n, 3) in the heart frame."""
        return np.ascontiguousarray((_points(points_mm) - self.centre_mm) @ self.rotation)

    def into_patient(self, points_mm: Float) -> Float:
        """Heart-frame points (n, 3) in LPS."""
        return np.asarray(points_mm @ self.rotation.T + self.centre_mm)

    def carry(self, reference_points_mm: Float, phase: float) -> Float:
        """Where material points (n, 3), given at the R peak, are at a phase."""
        here = carry_points(self.into_heart(reference_points_mm), self.shape, self.beat(phase))
        return self.into_patient(here)

    def reference(self, points_mm: Float, phase: float) -> Float:
        """Where points (n, 3) at a phase are at the R peak: exact inverse of carry."""
        here = reference_points(self.into_heart(points_mm), self.shape, self.beat(phase))
        return self.into_patient(here)

    def displacement_mm(
        self, reference_points_mm: Float, phase: float, rr_s: float | None = None
    ) -> Float:
        """Way (n, 3) of material points (n, 3), given at the R peak, to where they are then.

        ``phase`` is that of a beat which lasts ``rr_s``, the heart's own RR interval if None.
        """
        return self.carry(reference_points_mm, self._nominal(phase, rr_s)) - _points(
            reference_points_mm
        )

    def velocity_mm_s(self, points_mm: Float, phase: float, rr_s: float | None = None) -> Float:
        """Velocity (n, 3), LPS, of the material that is at the points (n, 3) at a phase.

        ``phase`` is that of a beat which lasts ``rr_s``, the heart's own RR interval if None.
        Five-point differences of :meth:`carry`: good to 0.01 mm/s.
        """
        rest = self.reference(points_mm, self._nominal(phase, rr_s))
        step = 2e-4
        ahead = [self.carry(rest, self._nominal(phase + k * step, rr_s)) for k in (-2, -1, 1, 2)]
        slope = (ahead[0] - 8 * ahead[1] + 8 * ahead[2] - ahead[3]) / (12 * step)
        return np.asarray(slope / (self.rr_s if rr_s is None else rr_s))

    def volume_ratio(self, reference_points_mm: Float, phase: float) -> Float:
        """Volume (n,) of tissue at a phase over that at the R peak, where points (n, 3) lie."""
        here = self.into_heart(reference_points_mm)
        return volume_ratios(here, self.shape, self.beat(phase))

    def _nominal(self, phase: float, rr_s: float | None) -> float:
        return phase if rr_s is None else self.nominal_phase(phase, rr_s)

    def tissue(self, points_mm: Float, phase: float) -> Label:
        """Tissue value of every LPS point (n, 3): the heart where it is, else the chest."""
        labels = self.heart_tissue(points_mm, phase)
        outside = labels == 0
        labels[outside] = self.chest_tissue(_points(points_mm)[outside])
        return labels

    def heart_tissue(self, points_mm: Float, phase: float) -> Label:
        """Tissue of LPS points (n, 3) that belong to the heart; 0 elsewhere."""
        here = self.into_heart(points_mm)
        near = self._near(here)
        labels = np.zeros(len(here), np.uint8)
        rest = reference_points(here[near], self.shape, self.beat(phase))
        labels[near] = label_points(rest, self.shape, self.tubes)
        return labels

    def near_heart(self, points_mm: Float) -> npt.NDArray[np.bool_]:
        """Which LPS points (n, 3) may belong to the heart at some phase."""
        return self._near(self.into_heart(points_mm))

    def _near(self, here: Float) -> npt.NDArray[np.bool_]:
        reach = envelope(self.shape, self.pulse)
        cell = np.floor((here - _BOX_LOW) / CELL_MM).astype(np.intp)
        inside = ((cell >= 0) & (cell < reach.shape)).all(axis=1)
        i, j, k = cell[inside].T
        inside[inside] = reach[i, j, k]
        return np.asarray(inside)

    def chest_tissue(self, points_mm: Float) -> Label:
        """Tissue of LPS points (n, 3) with the heart left out: the same at every phase."""
        return chest_points(np.ascontiguousarray(points_mm, float), self.chest)

    def surfaces(self, phase: float, names: Collection[str] = BODY_NAMES) -> dict[str, Mesh]:
        """Closed truth meshes, normals outwards: name -> (LPS vertices (n, 3), triangles (m, 3)).

        Those of ``names``, which are lv_endocardium, epicardium, rv_endocardium, left_atrium,
        right_atrium, aorta, heart. ``epicardium`` is the outside of the left muscle, closed by the
        mitral plane; ``heart`` the outside of all labelled parts, clefts filled, without the thin
        outer walls.
        Vertex i is the same material point in every phase.
        """
        beat = self.beat(phase)
        return {
            name: (self.into_patient(carry_points(vertices, self.shape, beat)), triangles)
            for name, (vertices, triangles) in reference_meshes(self.shape).items()
            if name in names
        }

    def volumes_ml(self, phase: float) -> dict[str, float]:
        """Volumes enclosed by the truth meshes, and the left muscle's (ml)."""
        return enclosed_ml(self.surfaces(phase))


def _points(points_mm: Float) -> Float:
    points = np.asarray(points_mm, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise SynthError(f"points must be (n, 3) LPS mm, got an array of shape {points.shape}")
    return points


@lru_cache(maxsize=8)
def envelope(shape: Shape, pulse: Pulse) -> npt.NDArray[np.bool_]:
    """Cells (x, y, z) of the heart frame's box that the heart touches at some phase.

    Tissue at the centres of the cells at the R peak is carried to 18 places of the cycle; the
    cells where it comes to grow by two, 10 mm. That covers half a cell, which motion makes no
    wider than 4.4 mm, and the way between a place and any instant near it (an eighth of the
    longest ways, 20 mm down and 20 mm sideways: 3.6 mm).
    """
    from scipy.ndimage import binary_dilation

    axes = [np.arange(low, high, CELL_MM) + CELL_MM / 2 for low, high in BOX_MM]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    tissue = centres[label_points(centres, shape, tubes_of(shape)) > 0]
    grid = np.zeros([len(axis) for axis in axes], bool)
    for place in PLACES:
        beat = beat_of(shape, pulse, calibrate(shape, pulse), place)
        cell = np.floor((carry_points(tissue, shape, beat) - _BOX_LOW) / CELL_MM).astype(np.intp)
        i, j, k = cell[((cell >= 0) & (cell < grid.shape)).all(axis=1)].T
        grid[i, j, k] = True
    return np.asarray(binary_dilation(grid, np.ones((3, 3, 3), bool), iterations=2))
