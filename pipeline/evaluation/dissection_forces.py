"""What the fixture does to the tool in the simulated dissection, from the field's own kernels."""

from __future__ import annotations

import math

from pipeline.evaluation.compiled import inner
from pipeline.evaluation.dissection_values import ENERGY_STEP_MM
from pipeline.field import kernels
from pipeline.field.tool_kernels import tool_force

_spline_at, _felt_at = kernels.spline_at, kernels.felt_at


@inner
def _stored(guide, distance_mm):  # type: ignore[no-untyped-def]
    """Energy that the fixture holds at a distance from its surface, mJ."""
    side = guide.law[3]
    q = abs(distance_mm) if side == 0 else max(side * distance_mm, 0.0)
    at = min(q / ENERGY_STEP_MM, len(guide.stored_mj) - 1.001)
    n = int(at)
    share = at - n
    # Three parabolas' worth of exactness: the second difference is that of the force's slope.
    one, two = guide.stored_mj[n], guide.stored_mj[n + 1]
    before, after = (
        guide.stored_mj[max(n - 1, 0)],
        guide.stored_mj[min(n + 2, len(guide.stored_mj) - 1)],
    )
    if n == 0:
        before = two
    bend = (before - one - two + after) / 4.0
    return one + share * (two - one) - share * (1.0 - share) * bend


@inner
def nearest(law, shape, pose, phase):  # type: ignore[no-untyped-def]
    """Least distance of the tool's points from the lifted surface."""
    least = math.inf
    for n in range(len(shape.touching_mm)):
        x, y, z = _placed(shape.touching_mm, n, pose)
        value, _, _, _ = _spline_at(law[0], law[1], law[2], x, y, z, phase)
        least = min(least, value)
    return least


@inner
def _placed(points_mm, n, pose):  # type: ignore[no-untyped-def]
    a, b, c = points_mm[n, 0], points_mm[n, 1], points_mm[n, 2]
    return (
        pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c + pose[0, 3],
        pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c + pose[1, 3],
        pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * c + pose[2, 3],
    )


@inner
def energy(guide, shape, pose, phase):  # type: ignore[no-untyped-def]
    """Energy that the fixture holds with the tool there: the mean over its points."""
    total = 0.0
    law, count = guide.law, len(shape.touching_mm)
    for n in range(count):
        x, y, z = _placed(shape.touching_mm, n, pose)
        x, y, z = x + guide.shift_mm[0], y + guide.shift_mm[1], z + guide.shift_mm[2]
        value, _, _, _ = _spline_at(law[0], law[1], law[2], x, y, z, phase + guide.lag)
        total += _stored(guide, value)
    return total / count


@inner
def force_on(guide, shape, tip, pose, phase, room):  # type: ignore[no-untyped-def]
    """Force of the fixture on the tool, three newtons at the tip, and its torque into ``room[3:]``.

    The torque is about ``shape.handle_mm``, the tip; a tool that is a point has none.
    """
    phase += guide.lag
    if not shape.whole:
        x, y, z = tip[0] + guide.shift_mm[0], tip[1] + guide.shift_mm[1], tip[2] + guide.shift_mm[2]
        fx, fy, fz, _ = _felt_at(guide.law, x, y, z, phase)
        return fx, fy, fz
    for k in range(3):
        pose[k, 3] += guide.shift_mm[k]
    tool_force(
        guide.law, shape.points_mm, shape.starts, shape.handle_mm, pose, phase, shape.bound_n, room
    )
    for k in range(3):
        pose[k, 3] -= guide.shift_mm[k]
    return room[0], room[1], room[2]
