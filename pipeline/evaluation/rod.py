"""A rod through a fixed pivot: the remote centre of motion, as compiled formulas.

Handle and tip lie on a line through the pivot, a rod's length apart. The map from one to the other
is its own inverse: lateral movements are mirrored and scaled by the lever, axial ones are not.
"""

from __future__ import annotations

import math

from pipeline.evaluation.compiled import inner


@inner
def across(point, pivot, length):  # type: ignore[no-untyped-def]
    """The other end of the rod, three numbers (mm), for one end beyond the pivot."""
    x, y, z = pivot[0] - point[0], pivot[1] - point[1], pivot[2] - point[2]
    near = math.sqrt(x * x + y * y + z * z)
    share = (length - near) / near
    return pivot[0] + share * x, pivot[1] + share * y, pivot[2] + share * z


@inner
def at_the_handle(force, torque, handle, pivot, length):  # type: ignore[no-untyped-def]
    """Force at the handle (N) that does the same work as a force and a torque (N mm) at the tip.

    The tip moves by J dh for a movement dh of the handle, with J = w w' - (r / l)(1 - w w'),
    w the rod's direction, l and r its lengths outside and inside; J is symmetric. The rod turns by
    dh x w / l meanwhile, so a torque does the work of the force w x torque / l.
    """
    x, y, z = pivot[0] - handle[0], pivot[1] - handle[1], pivot[2] - handle[2]
    outside = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / outside, y / outside, z / outside
    lever = (length - outside) / outside
    along = force[0] * x + force[1] * y + force[2] * z
    axial = (1.0 + lever) * along
    return (
        axial * x - lever * force[0] + (y * torque[2] - z * torque[1]) / outside,
        axial * y - lever * force[1] + (z * torque[0] - x * torque[2]) / outside,
        axial * z - lever * force[2] + (x * torque[1] - y * torque[0]) / outside,
    )


@inner
def frame_of(tip, pivot, pose):  # type: ignore[no-untyped-def]
    """Pose of a tool on the rod, into a 4x4: z from the tip up the shaft, x square to LPS y, or to
    LPS x where the rod lies along y."""
    zx, zy, zz = pivot[0] - tip[0], pivot[1] - tip[1], pivot[2] - tip[2]
    size = math.sqrt(zx * zx + zy * zy + zz * zz)
    zx, zy, zz = zx / size, zy / size, zz / size
    # An axis that the rod does not lie along, so that the frame never degenerates.
    ax, ay, az = (0.0, 1.0, 0.0) if abs(zy) < 0.9 else (1.0, 0.0, 0.0)
    xx, xy, xz = ay * zz - az * zy, az * zx - ax * zz, ax * zy - ay * zx
    size = math.sqrt(xx * xx + xy * xy + xz * xz)
    xx, xy, xz = xx / size, xy / size, xz / size
    pose[0, 0], pose[1, 0], pose[2, 0] = xx, xy, xz
    pose[0, 1], pose[1, 1], pose[2, 1] = zy * xz - zz * xy, zz * xx - zx * xz, zx * xy - zy * xx
    pose[0, 2], pose[1, 2], pose[2, 2] = zx, zy, zz
    pose[0, 3], pose[1, 3], pose[2, 3] = tip[0], tip[1], tip[2]
