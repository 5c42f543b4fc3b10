"""Transducers with their presets, and the windows through which each sees the heart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from data_synth.echo import Optics
from data_synth.sector import Sector
from data_synth.tissue import Tissue

Medium = Literal["chest wall", "oesophagus", "blood", "pad"]


@dataclass(frozen=True, slots=True)
class Window:
    """Where a tip is put and what it looks at.

    Directions are weights of (from apex to base, left, posterior, superior); they are summed and
    scaled to unit length.
    """

    direction: tuple[float, float, float, float]
    """From the target to the tip."""

    target_mm: float = 0.0
    """What the middle beam points at: this far from the mitral plane towards the apex."""

    chamber: Tissue | None = None
    """The tip floats in the middle of this chamber; None: it rests on the heart or the skin."""

    shaft: tuple[float, float, float, float] | None = None
    """Direction of the picture's x axis, that of a catheter's shaft; None: any."""


@dataclass(frozen=True, slots=True)
class Probe:
    """A transducer with its preset, and the windows of its sweeps in their order."""

    optics: Optics
    sector: Sector
    medium: Medium
    """What lies between the tip and the heart."""

    standoff_mm: float
    """Thickness of that medium where the tip does not rest on the skin."""

    turn_about: Literal["beam", "shaft"]
    """A sweep turns the fan about its middle beam, or about the shaft that lies in the fan."""

    turn_deg: float
    windows: tuple[Window, Window, Window]
    rides: bool
    """It moves with the heart as the patient breathes, rather than with the chest."""


_TOWARDS_APEX = (-1.0, 0.0, 0.0, 0.0)
# The oesophagus runs behind the left atrium, to the base side of the middle.
_BEHIND = (0.4, 0.0, 1.0, 0.0)

PROBES: dict[str, Probe] = {
    "surface": Probe(
        optics=Optics(),
        sector=Sector(depth_mm=180.0, angle_deg=90.0, pixel_mm=0.8, beams=128),
        medium="chest wall",
        standoff_mm=0.0,
        turn_about="beam",
        turn_deg=110.0,
        windows=(
            Window(_TOWARDS_APEX),
            Window((0.0, 0.3, -1.0, 0.0), target_mm=20.0),
            Window((0.0, 0.0, -0.7, -0.7), target_mm=20.0),
        ),
        rides=False,
    ),
    "transoesophageal": Probe(
        optics=Optics(
            frequency_mhz=5.0,
            aperture_mm=11.0,
            focus_mm=65.0,
            slice_aperture_mm=9.0,
            slice_focus_mm=60.0,
            noise_db=-64.0,
        ),
        sector=Sector(130.0, 90.0, 0.6, 128, range_step_mm=0.3),
        medium="oesophagus",
        standoff_mm=4.0,
        turn_about="beam",
        turn_deg=150.0,
        windows=(
            Window(_BEHIND),
            Window((0.9, 0.0, 1.0, 0.3)),
            Window((-0.1, 0.1, 1.0, -0.2), target_mm=30.0),
        ),
        rides=True,
    ),
    "intracardiac": Probe(
        optics=Optics(
            frequency_mhz=8.0,
            aperture_mm=7.0,
            focus_mm=45.0,
            slice_aperture_mm=2.5,
            slice_focus_mm=40.0,
            # Most of the way is through blood.
            compensation_db_per_cm=3.5,
            noise_db=-66.0,
        ),
        sector=Sector(110.0, 90.0, 0.5, 128, range_step_mm=0.25, tip_mm=2.0),
        medium="blood",
        standoff_mm=0.0,
        turn_about="shaft",
        turn_deg=80.0,
        windows=(
            Window((0.0, 0.0, 0.0, 0.0), 10.0, Tissue.RIGHT_ATRIUM, (0.0, 0.0, 0.0, 1.0)),
            Window((0.0, 0.0, 0.0, 0.0), 35.0, Tissue.RV_CAVITY, (1.0, 0.0, 0.0, 0.0)),
            Window((0.0, 0.0, 0.0, 0.0), -15.0, Tissue.RIGHT_ATRIUM, (0.0, 0.0, 0.3, 1.0)),
        ),
        rides=True,
    ),
    "epicardial": Probe(
        optics=Optics(
            frequency_mhz=7.0,
            aperture_mm=14.0,
            focus_mm=50.0,
            slice_aperture_mm=8.0,
            slice_focus_mm=50.0,
            noise_db=-70.0,
        ),
        sector=Sector(110.0, 90.0, 0.5, 128, range_step_mm=0.25),
        medium="pad",
        standoff_mm=8.0,
        turn_about="shaft",
        turn_deg=50.0,
        windows=(
            Window((0.0, 0.3, -1.0, 0.0), target_mm=30.0),
            Window(_TOWARDS_APEX, target_mm=30.0),
            Window((0.0, -0.8, -0.6, 0.0), target_mm=20.0),
        ),
        rides=True,
    ),
}
"""Transducers by name."""

EXAMINATIONS: dict[str, tuple[tuple[str, int], ...]] = {
    "combined": (("surface", 0), ("transoesophageal", 0), ("surface", 1)),
    **{name: tuple((name, window) for window in range(3)) for name in PROBES},
}
"""Probe and number of its window, sweep by sweep. ``combined`` looks from the apex and from behind,
so that each sweep sees well what is far from the other."""
