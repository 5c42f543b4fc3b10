"""Find the rigid pose at which frames and model agree best: first roughly, then finely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.geometry import Float, MovingSurface, transform_points
from pipeline.registration.similarity import Expansion

ROUGHLY_MM = 0.3
"""How near an optimum is enough where it is only compared with others."""

# Damping in units of the mean curvature, most steps, and the longest of them: a bowl is some
# millimetres wide.
_LEAST_DAMPING, _MOST_STEPS, _LONGEST_MM = 1e-3, 40, 5.0


class Landscape(Protocol):
    """Frames and model, as a search sees them."""

    def score(self, mr_from_tracker: Float, /) -> float:
        """Agreement at a pose; more is better."""

    def expansion(self, mr_from_tracker: Float, pivot: Pivot, /) -> Expansion:
        """The frames' losses about a pose."""


@dataclass(frozen=True, slots=True)
class Pivot:
    """The point and the lever that make rotations and shifts comparable."""

    centre_mm: Float
    """``(3,)`` what is turned about: the middle of the heart."""

    lever_mm: float
    """Root mean square distance of the heart from it: a turn by angle a moves what lies so far from
    its axis by a levers, and a heart as wide in every direction by the root of 2/3 of that."""

    def move(self, mr_from_tracker: Float, step_mm: Float) -> Float:
        """The pose shifted by ``step_mm[:3]`` and turned by the rotation vector
        ``step_mm[3:] / lever``, both in the MR frame."""
        rotation = Rotation.from_rotvec(step_mm[3:] / self.lever_mm).as_matrix()
        motion = np.eye(4)
        motion[:3, :3] = rotation
        motion[:3, 3] = self.centre_mm - rotation @ self.centre_mm + step_mm[:3]
        return np.asarray(motion @ mr_from_tracker)

    def step_between(self, mr_from_tracker: Float, other: Float) -> Float:
        """``(6,)`` the step by which `move` brings a pose to another."""
        motion = other @ np.linalg.inv(mr_from_tracker)
        shift_mm = transform_points(motion, self.centre_mm) - self.centre_mm
        turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
        return np.concatenate([shift_mm, turn * self.lever_mm])

    def distance(self, pose: Float, other: Float) -> tuple[float, float]:
        """How far two poses lie apart: shift of the pivot in millimetres, and degrees."""
        step_mm = self.step_between(other, pose)
        turn = np.linalg.norm(step_mm[3:]) / self.lever_mm
        return float(np.linalg.norm(step_mm[:3])), float(np.degrees(turn))


def pivot_of(surfaces: Sequence[MovingSurface]) -> Pivot:
    """The middle and the size of what the surfaces enclose, over the beat."""
    points = np.concatenate([surface.vertices_mm.reshape(-1, 3) for surface in surfaces])
    centre_mm = points.mean(axis=0)
    return Pivot(centre_mm, float(np.sqrt(((points - centre_mm) ** 2).sum(axis=1).mean())))


def poses_around(
    pose: Float, pivot: Pivot, reach_mm: float, reach_deg: float, count: int, seed: int
) -> list[Float]:
    """The pose itself and ``count - 1`` others up to the given shift and rotation away."""
    rng = np.random.default_rng(seed)
    reach = np.repeat([reach_mm, np.radians(reach_deg) * pivot.lever_mm], 3)
    poses = [pose]
    while len(poses) < count:
        directions = rng.normal(size=(2, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        # The cube root would spread evenly over the ball; the start is worth more than its rim.
        lengths = np.repeat(rng.uniform(size=2), 3)
        poses.append(pivot.move(pose, reach * lengths * directions.ravel()))
    return poses


def poses_anywhere(
    seen_mm: Float, pivot: Pivot, reach_mm: float, count: int, seed: int
) -> list[Float]:
    """Poses that put the pivot into the middle of ``seen_mm``, turned in any way.

    Parameters
    ----------
    seen_mm
        ``(n, 3)`` tracker millimetres: what the frames cover.
    reach_mm
        How far the pivot may lie from their middle.
    """
    rng = np.random.default_rng(seed)
    middle = seen_mm.mean(axis=0)
    rotations = Rotation.from_quat(rng.normal(size=(count, 4))).as_matrix()
    ways = rng.normal(size=(count, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    # The cube root spreads evenly over the ball.
    offsets = reach_mm * np.cbrt(rng.uniform(size=(count, 1))) * ways
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = pivot.centre_mm + offsets - rotations @ middle
    return list(poses)


def climb_from_best(
    landscape: Landscape, candidates: list[Float], pivot: Pivot, starts: int, kept: int
) -> list[Float]:
    """The best poses reached, to about a millimetre, from the ``starts`` best candidates.

    At most ``kept``, the best first, no two within 4 mm and 4 degrees of each other.
    """
    ranked = sorted(candidates, key=landscape.score, reverse=True)[:starts]
    reached = [climb(landscape, pose, pivot, ROUGHLY_MM) for pose in ranked]
    apart: list[Float] = []
    for pose in sorted(reached, key=landscape.score, reverse=True):
        if all(max(pivot.distance(pose, other)) > 4.0 for other in apart):
            apart.append(pose)
    return apart[:kept]


def climb(landscape: Landscape, pose: Float, pivot: Pivot, within_mm: float = 0.02) -> Float:
    """The optimum uphill of ``pose``, by Gauss and Newton's steps, shorter where they do not help
    (D. W. Marquardt, J Soc Indust Appl Math 11 (1963) 431-441).

    Parameters
    ----------
    within_mm
        A step this short, in each of the six parameters, is the last.
    """
    damping, here = _LEAST_DAMPING, landscape.expansion(pose, pivot)
    for _ in range(_MOST_STEPS):
        mean = np.trace(here.bending) / 6
        if not mean > 0:
            break
        damped = here.bending + damping * mean * np.eye(6)
        step_mm = -np.linalg.solve(damped, here.slopes.sum(axis=0))
        step_mm *= _LONGEST_MM / max(_LONGEST_MM, np.abs(step_mm).max())
        moved = pivot.move(pose, step_mm)
        there = landscape.expansion(moved, pivot)
        if there.losses.sum() < here.losses.sum():
            pose, here, damping = moved, there, max(damping / 10, _LEAST_DAMPING)
        else:
            damping *= 10
        if np.abs(step_mm).max() < within_mm:
            break
    return pose
