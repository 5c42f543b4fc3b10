"""What the compiled loop of the simulated dissection works on: tuples and named places in arrays.

Lengths are mm, times s, forces N, so energies are mJ; everything is in the frame of the field.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple

from pipeline.geometry import Float


class Task(NamedTuple):
    """The place of work: pellets, rod, monitor and clock."""

    pellets_mm: Float
    """``(pellet, moment, 3)``, moments evenly over one beat, in the order of removal."""

    start_mm: Float
    """``(3,)``, where the tip rests at first."""

    pivot_mm: Float
    """``(3,)``, the remote centre of motion."""

    rod_mm: float
    """Length of the rod from tip to handle."""

    depth_axis: Float
    """``(3,)`` unit vector into the monitor: depth."""

    width_mm: float
    """Diameter of a pellet; the tip works on it within half of that."""

    dwell_s: float
    """How long, in all, the tip must have worked on a pellet to remove it."""

    lift_mm: float
    """How far outside the heart the fixture's surface lies."""

    workspace_mm: float
    """Farther than this from the fixture's surface, the tip is outside the workspace."""

    withdraw_mm: float
    """How far an operator who sees the heart touched draws back along the rod."""

    rr_s: float
    """Duration of a heartbeat."""

    phase: float
    """Of the heart at the start."""

    beating: bool
    """Whether the heart moves at all."""

    most_s: float
    """Who takes longer has not finished."""

    tick_s: float
    """The loop's period."""


class Guide(NamedTuple):
    """The fixture as the device renders it."""

    law: Any
    """First seven arguments of ``kernels.force_at``; the distance is from the lifted surface."""

    stored_mj: Float
    """Energy that the fixture holds at a depth or distance q of n ``ENERGY_STEP_MM``."""

    on: bool
    """Whether there is any force."""

    shift_mm: Float
    """``(3,)``: what a wrong registration adds to the tool's place."""

    lag: float
    """What a wrong clock adds to the phase."""


class Shape(NamedTuple):
    """The tool at the end of the rod."""

    points_mm: Float
    starts: Any
    handle_mm: Any
    """``Lines`` of ``pipeline.field.tool`` and the point of their torque."""

    whole: bool
    """Whether the whole tool feels the field; else its tip alone."""

    touching_mm: Float
    """``(n, 3)`` points in the tool's frame, whose contact and energy are counted."""

    bound_n: float
    """Error that the tool's force may have."""


ENERGY_STEP_MM = 0.02
TRACE_STEP_S = 0.01
"""From row to row of a trial's trace."""


class Mind(IntEnum):
    """Places in the operator's array of numbers."""

    START = 0
    LASTS = 1
    GO = 2
    STATE = 3
    DRAWN = 4
    PELLET = 5
    PROGRESS = 6
    TOUCHING = 7


class Sum(IntEnum):
    """Places in the array of what a trial comes to."""

    TIME = 0
    REMOVED = 1
    PATH = 2
    CONTACTS = 3
    DEPTH = 4
    CONTACT_TIME = 5
    OUTSIDE = 6
    MOVES = 7
    WORK = 8
    """Done by the operator's will on the hand, mJ."""
    FIXTURE = 9
    """Done by the fixture on the handle."""
    HEART = 10
    """Put into the fixture by the heart's motion."""
    SAMPLING = 11
    """Made by holding the force for a tick: fixture's work less what it lost."""
    DEVICE_LOSS = 12
    HAND_LOSS = 13
    KINETIC = 14
    SPRING = 15
    STORED = 16
    """In the fixture, at the end."""
    WORST = 17
    """Largest amount by which the balance of any tick up to then did not close."""
    FORCE = 18
    """Largest force at the handle, N."""


SUMS, MINDS = len(Sum), len(Mind)
