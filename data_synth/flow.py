"""What moving blood does to the signal: fresh blood flows in, jets behind valves go dark.

Blood is not simulated as a fluid. Its speed along a chamber follows from the volumes that the
moving walls enclose; jets behind the valves have the speed that the same volumes ask for.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from data_synth.heart import BeatingHeart
from data_synth.kernels import Float
from data_synth.tissue import Tissue

CELL_MM = 5.0
"""Distance of the points that areas are counted on."""
INSTANTS = 16
"""Phases at which areas are counted."""
HARMONICS = 6
"""Harmonics of the heart beat that the areas keep; counting noise lies above."""
STEPS = 96
"""Instants of a cycle at which speeds and freshness are known."""
LEAST_ACROSS = 0.25
"""Share of the speed along a chamber that crosses even a plane along it: blood swirls."""
TURBULENCE = 0.2
"""Standard deviation of speed inside a voxel at a jet's edge, as a share of the jet's speed."""
OPEN = 0.9
"""Radius of the stream through an open valve, as a share of the ring's or the vessel's."""
CHAMBERS = (Tissue.LV_CAVITY, Tissue.RV_CAVITY, Tissue.LEFT_ATRIUM, Tissue.RIGHT_ATRIUM)
LEFT, RIGHT, LEFT_ATRIUM, RIGHT_ATRIUM = range(4)
COUNTED = {
    Tissue.LV_CAVITY: LEFT,
    Tissue.PAPILLARY_MUSCLE: LEFT,
    Tissue.RV_CAVITY: RIGHT,
    Tissue.RV_TRABECULA: RIGHT,
    Tissue.LEFT_ATRIUM: LEFT_ATRIUM,
    Tissue.RIGHT_ATRIUM: RIGHT_ATRIUM,
}


class Chambers(NamedTuple):
    """Areas of the four chambers across the long axis."""

    heights_mm: Float
    """``(height,)`` along the long axis, from apex to roof."""
    areas_mm2: Float
    """``(chamber, instant, height)``, order of CHAMBERS, STEPS instants of a cycle."""

    def outflow_mm3(self, chamber: int) -> Float:
        """``(instant,)`` volume that leaves a chamber in one whole cycle at this instant's rate."""
        volume = self.areas_mm2[chamber].sum(axis=1) * CELL_MM
        return -slope(volume)


def slope(values: Float) -> Float:
    """Derivative by phase of cyclic values along the first axis (central differences)."""
    return (np.roll(values, -1, axis=0) - np.roll(values, 1, axis=0)) * len(values) / 2


def smooth_cycle(values: Float, count: int) -> Float:
    """Cyclic values (instant, ...) at ``count`` instants, without their highest harmonics."""
    spectrum = np.fft.rfft(values, axis=0)[: HARMONICS + 1]
    return np.asarray(np.fft.irfft(spectrum, count, axis=0) * count / len(values))


@lru_cache(maxsize=4)
def chamber_areas(heart: BeatingHeart) -> Chambers:
    """Count the chambers' areas at every height and phase."""
    low = -heart.shape.lv_length - 8.0
    heights = np.arange(low, 70.0, CELL_MM)
    x, y = np.arange(-60.0, 90.0, CELL_MM), np.arange(-65.0, 65.0, CELL_MM)
    grid = np.stack(np.meshgrid(heights, y, x, indexing="ij")[::-1], axis=-1).reshape(-1, 3)
    # Neighbouring columns lie at different depths, or flat valve planes would count in jumps.
    shift = 0.75488 * grid[:, 0] / CELL_MM + 0.56984 * grid[:, 1] / CELL_MM
    grid[:, 2] += CELL_MM * (shift % 1 - 0.5)
    points = heart.into_patient(grid)
    chamber = np.full(len(Tissue), -1)
    for tissue, number in COUNTED.items():
        chamber[tissue] = number
    areas = np.empty((INSTANTS, len(CHAMBERS), len(heights)))
    for k in range(INSTANTS):
        found = chamber[heart.heart_tissue(points, k / INSTANTS)].reshape(len(heights), -1)
        for number in range(len(CHAMBERS)):
            areas[k, number] = (found == number).sum(axis=1) * CELL_MM**2
    smooth = smooth_cycle(areas, STEPS)
    return Chambers(heights, np.maximum(np.moveaxis(smooth, 0, 1), 0.0))


def axial_speed(known: Chambers, chamber: int, height_mm: float) -> Float:
    """Mean speed (instant,) of blood through a chamber at a height, mm per cycle.

    What is below a height in a ventricle can only have come or gone through it. Through an
    atrium passes what it stores itself, and what it hands on while its ventricle fills.
    """
    place = int(np.clip(np.searchsorted(known.heights_mm, height_mm), 0, len(known.heights_mm) - 1))
    area = known.areas_mm2[chamber]
    flux = np.abs(slope(area[:, : place + 1].sum(axis=1) * CELL_MM))
    if chamber in (LEFT_ATRIUM, RIGHT_ATRIUM):
        flux = flux + np.maximum(-known.outflow_mm3(chamber - 2), 0.0)
    # Where a chamber's end is thinner than a few cells, its area is not known well.
    return np.asarray(flux / np.maximum(area[:, place], 8 * CELL_MM**2))


def unsaturated_share(
    speed: Float, thickness_mm: float, rr_s: float, memory_s: float, entering: float
) -> Float:
    """Share (instant,) of a slice's blood that the pulses have not brought to the steady state.

    Blood enters by ``speed / thickness`` (speed in mm per cycle), of which the share ``entering``
    is fresh; what is in the slice forgets within ``memory_s``. The periodic solution of this
    linear equation, stepped exactly for a rate that is constant within a step.
    """
    step = 1 / len(speed)
    exchange, loss = speed / thickness_mm, rr_s / memory_s
    keep = np.exp(-(exchange + loss) * step)
    goal = entering * exchange / (exchange + loss)
    end = 0.0
    # The whole cycle is an affine map of its start; its fixed point is the periodic state.
    for a, b in zip(keep, goal, strict=True):
        end = a * end + (1 - a) * b
    value = end / (1 - np.prod(keep))
    share = np.empty(len(speed))
    for k, (a, b) in enumerate(zip(keep, goal, strict=True)):
        share[k] = value
        value = a * value + (1 - a) * b
    return share


class Inflow(NamedTuple):
    """Factor that fresh blood puts on the signal of every tissue in one plane."""

    gains: Float
    """``(instant, tissue)``"""

    def at(self, phase: float) -> Float:
        """``(tissue,)`` factors at a phase."""
        place = (phase % 1.0) * len(self.gains)
        k = int(place)
        part = place - k
        after = self.gains[(k + 1) % len(self.gains)]
        return np.asarray((1 - part) * self.gains[k % len(self.gains)] + part * after)


def plane_inflow(
    heart: BeatingHeart,
    plane: tuple[Float, Float],
    thickness_mm: float,
    rr_s: float,
    fresh: tuple[float, float],
    entering: float,
) -> Inflow:
    """Inflow through a plane.

    Parameters
    ----------
    heart
        Its chambers' volumes tell the speeds.
    plane
        A point of it and its unit normal, in the heart frame.
    thickness_mm, rr_s
        Of the slice, and of the beat.
    fresh
        Signal of fresh blood over settled blood's, and the memory (s): see bssfp.Freshness.
    entering
        Share of the entering blood that is fresh.
    """
    gains = np.ones((STEPS, len(Tissue)))
    if entering == 0:
        return Inflow(gains)
    known = chamber_areas(heart)
    height, normal = plane[0][2], plane[1]
    across = {tissue: abs(float(normal[2])) for tissue in CHAMBERS}
    ejected = np.maximum(known.outflow_mm3(LEFT), 0.0)
    vessel = ejected / (np.pi * heart.shape.aorta_radius**2)
    speeds = {c: axial_speed(known, n, height) for n, c in enumerate(CHAMBERS)}
    speeds |= {Tissue.AORTA: vessel, Tissue.BLOOD_VESSEL: vessel}
    for tissue, speed in speeds.items():
        crossing = speed * max(across.get(tissue, 0.7), LEAST_ACROSS)
        share = unsaturated_share(crossing, thickness_mm, rr_s, fresh[1], entering)
        gains[:, tissue] = 1 + (fresh[0] - 1) * share
    return Inflow(gains)


class Jet(NamedTuple):
    """A stream behind a valve."""

    start: Float
    """Middle of the valve at the R peak, heart frame."""
    way: Float
    """Unit vector downstream."""
    radius_mm: float
    flow_mm3: Float
    """``(instant,)`` volume per cycle through the valve, never negative."""


def valve_jets(heart: BeatingHeart) -> tuple[Jet, ...]:
    """Streams through the mitral, tricuspid and aortic valves."""
    known, shape = chamber_areas(heart), heart.shape
    left, right = known.outflow_mm3(LEFT), known.outflow_mm3(RIGHT)
    root = heart.tubes.aorta[:2, :3]
    up = (root[1] - root[0]) / np.linalg.norm(root[1] - root[0])
    down = np.array([0.0, 0.0, -1.0])
    return (
        Jet(np.zeros(3), down, OPEN * shape.mitral_radius, np.maximum(-left, 0.0)),
        Jet(
            np.array([shape.ra_x, shape.ra_y, 0.0]),
            down,
            OPEN * shape.tricuspid_radius,
            np.maximum(-right, 0.0),
        ),
        Jet(root[0], up, OPEN * shape.aorta_radius, np.maximum(left, 0.0)),
    )


def jet_loss(
    heart: BeatingHeart,
    jets: tuple[Jet, ...],
    points: Float,
    phase: float,
    cycle_s: float,
    moment: float,
) -> npt.NDArray[np.float32]:
    """Factor (n,) by which swirling blood has lost signal at heart-frame points (n, 3).

    ``phase`` is of the nominal cycle, which would last ``cycle_s`` at the pace of this moment.

    Speeds inside a voxel at a jet's edge spread normally by a share of the jet's own; their
    phases, ``moment`` radians per m/s, then average to ``exp(-(moment * spread)^2 / 2)``.
    """
    log_loss = np.zeros(len(points))
    for jet in jets:
        flow = jet.flow_mm3[int((phase % 1.0) * STEPS) % STEPS] / cycle_s
        speed_m_s = flow / (np.pi * jet.radius_mm**2) / 1000
        if speed_m_s * moment < 0.1:
            continue
        start = heart.into_heart(heart.carry(heart.into_patient(jet.start[None]), phase))[0]
        off = points - start
        along = off @ jet.way
        near = np.flatnonzero((along > 0) & (along < 60.0))
        aside = np.linalg.norm(off[near] - along[near, None] * jet.way, axis=1)
        # The edge of the stream broadens as it goes, and the stream dies out.
        width = 2.5 + 0.12 * along[near]
        edge = np.exp(-0.5 * ((aside - jet.radius_mm) / width) ** 2)
        spread = TURBULENCE * speed_m_s * edge * np.exp(-along[near] / 30.0)
        log_loss[near] -= (moment * spread) ** 2 / 2
    return np.exp(log_loss).astype(np.float32)
