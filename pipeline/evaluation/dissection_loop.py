"""The simulated dissection, tick by tick, compiled.

Each tick asks the field's own kernels, holds the force for the tick as a haptic device does, and
moves the handle by the midpoint rule. For that rule the work of every force over the step is its
midpoint value times the step, and the works sum to the change of kinetic and spring energy exactly.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.evaluation import dissection_forces, rod
from pipeline.evaluation.compiled import asked, inner
from pipeline.evaluation.dissection_values import MINDS, SUMS, TRACE_STEP_S, Mind, Sum
from pipeline.evaluation.operators import EFFECTIVE_WIDTH
from pipeline.field import kernels

_spline_at = kernels.spline_at
_nearest, _energy = dissection_forces.nearest, dissection_forces.energy
_force_on = dissection_forces.force_on
_across, _at_the_handle, _frame_of = rod.across, rod.at_the_handle, rod.frame_of

HYSTERESIS_MM = 0.3
"""A contact has ended when the tool is this far off."""

LEAST_MOVE_S = 0.1
PATIENCE_S = 0.1
"""Who is working on a pellet looks again after this."""

# What an operator is about to do when the time comes: reach, draw back, look where a reach ended.
DECIDED, ALARMED, MOVING = 0.0, 1.0, 2.0

# News of a tick: none, a pellet gone, the heart touched, the tip at work on a pellet.
NOTHING, GONE, TOUCHED, AT_WORK = 0, 1, 2, 3


@inner
def pellet_at(task, number, phase, place):  # type: ignore[no-untyped-def]
    """Where a pellet is, into three numbers; straight between the moments of the beat."""
    moments = task.pellets_mm.shape[1]
    at = (phase - math.floor(phase)) * moments
    first = int(at)
    share = at - first
    first %= moments
    then = (first + 1) % moments
    for k in range(3):
        one, two = task.pellets_mm[number, first, k], task.pellets_mm[number, then, k]
        place[k] = one + share * (two - one)


@inner
def _look(task, person, mind, draws, plan, tip, phase, time, aim):  # type: ignore[no-untyped-def]
    """See pellet and tip; where to go is ``aim``, and when is later by the delay.

    The eye is exact in the plane of the monitor, wrong in depth; the reach will scatter in the
    plane as Fitts' law says.
    """
    pellet_at(task, int(mind[Mind.PELLET]), phase, aim)
    first = int(mind[Mind.DRAWN])
    scatter = task.width_mm / EFFECTIVE_WIDTH
    depth = person.depth_bias_mm + person.depth_sd_mm * draws[first % len(draws)]
    mind[Mind.DRAWN] += 4
    meant_x, meant_y, meant_z = _across(plan[0] + plan[1], task.pivot_mm, task.rod_mm)
    off = (meant_x - tip[0], meant_y - tip[1], meant_z - tip[2])
    deep = 0.0
    noise_deep = 0.0
    for k in range(3):
        deep += off[k] * task.depth_axis[k]
        noise_deep += draws[(first + 1 + k) % len(draws)] * task.depth_axis[k]
    for k in range(3):
        noise = draws[(first + 1 + k) % len(draws)] - noise_deep * task.depth_axis[k]
        aim[k] += depth * task.depth_axis[k] + scatter * noise + off[k] - deep * task.depth_axis[k]
    mind[Mind.STATE] = DECIDED
    mind[Mind.GO] = max(time + person.delay_s, mind[Mind.START] + mind[Mind.LASTS])


@inner
def _set_out(task, person, mind, plan, aim, time):  # type: ignore[no-untyped-def]
    """Begin a movement of the hand towards where the tip is to go.

    ``plan`` has rows from and way, both of the hand. Lateral movement goes astray by the
    operator's turn and gain; the way takes as long as Fitts' law says.
    """
    for k in range(3):
        plan[0, k] += plan[1, k]
    base = plan[0]
    tip_x, tip_y, tip_z = _across(base, task.pivot_mm, task.rod_mm)
    distance = math.sqrt((aim[0] - tip_x) ** 2 + (aim[1] - tip_y) ** 2 + (aim[2] - tip_z) ** 2)
    goal = _across(aim, task.pivot_mm, task.rod_mm)
    wx, wy, wz = task.pivot_mm[0] - base[0], task.pivot_mm[1] - base[1], task.pivot_mm[2] - base[2]
    size = math.sqrt(wx * wx + wy * wy + wz * wz)
    wx, wy, wz = wx / size, wy / size, wz / size
    x, y, z = goal[0] - base[0], goal[1] - base[1], goal[2] - base[2]
    along = x * wx + y * wy + z * wz
    x, y, z = x - along * wx, y - along * wy, z - along * wz
    c, s = person.gain * math.cos(person.turn_rad), person.gain * math.sin(person.turn_rad)
    plan[1, 0] = c * x + s * (wy * z - wz * y) + along * wx
    plan[1, 1] = c * y + s * (wz * x - wx * z) + along * wy
    plan[1, 2] = c * z + s * (wx * y - wy * x) + along * wz
    mind[Mind.START] = time
    bits = math.log2(distance / task.width_mm + 1.0)
    mind[Mind.LASTS] = max(person.slope_s_per_bit * bits, LEAST_MOVE_S)


@inner
def _wish(mind, plan, waves, time, wish):  # type: ignore[no-untyped-def]
    """Where the hand wants to be: minimum jerk along the plan, and the tremor."""
    share = (time - mind[Mind.START]) / mind[Mind.LASTS]
    share = min(max(share, 0.0), 1.0)
    smooth = share * share * share * (10.0 - 15.0 * share + 6.0 * share * share)
    for k in range(3):
        shaken = 0.0
        for n in range(waves.shape[1]):
            shaken += waves[k, n, 0] * math.sin(
                2.0 * math.pi * waves[k, n, 1] * time + waves[k, n, 2]
            )
        wish[k] = plan[0, k] + smooth * plan[1, k] + shaken


@inner
def _move(person, handle, tick_s, hand, sums):  # type: ignore[no-untyped-def]
    """One tick of the handle; ``hand`` has rows place, speed, old wish, new wish, force held.

    Midpoint rule: 2 m (u - v) / tick = F + K (wish - x) + B (wish rate - u) - b u, all at half the
    tick, u the speed there.
    """
    mass = (handle.mass_kg + person.hand_kg) / 1000.0
    stiff, loss = person.stiffness_n_per_mm, handle.damping_ns_per_mm
    damp = 2.0 * person.damping_ratio * math.sqrt(stiff * mass)
    inertia = 2.0 * mass / tick_s
    kinetic, spring = 0.0, 0.0
    before = sums[Sum.KINETIC] + sums[Sum.SPRING]
    gained = 0.0
    for k in range(3):
        place, speed, old, new, force = hand[0, k], hand[1, k], hand[2, k], hand[3, k], hand[4, k]
        rate = (new - old) / tick_s
        pulled = force + stiff * (0.5 * (old + new) - place) + damp * rate + inertia * speed
        u = pulled / (inertia + loss + damp + 0.5 * stiff * tick_s)
        step = u * tick_s
        spring_force = stiff * (0.5 * (old + new) - place - 0.5 * step)
        damper_force = damp * (rate - u)
        work = (spring_force + damper_force) * (new - old)
        device, limb = loss * u * step, damper_force * (rate - u) * tick_s
        sums[Sum.WORK] += work
        sums[Sum.FIXTURE] += force * step
        sums[Sum.DEVICE_LOSS] += device
        sums[Sum.HAND_LOSS] += limb
        gained += work + force * step - device - limb
        hand[0, k] = place + step
        hand[1, k] = 2.0 * u - speed
        kinetic += 0.5 * mass * hand[1, k] * hand[1, k]
        spring += 0.5 * stiff * (new - hand[0, k]) * (new - hand[0, k])
    sums[Sum.KINETIC], sums[Sum.SPRING] = kinetic, spring
    sums[Sum.WORST] = max(sums[Sum.WORST], abs(kinetic + spring - before - gained))


@inner
def _watch(task, mind, tip, phase, clear_mm, place, sums):  # type: ignore[no-untyped-def]
    """Count contact, workspace and progress; what the operator must react to.

    Returns the tick's news: GONE before TOUCHED before AT_WORK before NOTHING.
    """
    news = NOTHING
    if clear_mm < 0.0:
        sums[Sum.CONTACT_TIME] += task.tick_s
        sums[Sum.DEPTH] = max(sums[Sum.DEPTH], -clear_mm)
        if mind[Mind.TOUCHING] == 0.0:
            mind[Mind.TOUCHING] = 1.0
            sums[Sum.CONTACTS] += 1
            news = TOUCHED
    elif clear_mm > HYSTERESIS_MM:
        mind[Mind.TOUCHING] = 0.0
    pellet_at(task, int(mind[Mind.PELLET]), phase, place)
    off = 0.0
    for k in range(3):
        off += (tip[k] - place[k]) ** 2
    if off <= 0.25 * task.width_mm**2:
        mind[Mind.PROGRESS] += task.tick_s
        news = AT_WORK if news == NOTHING else news
    if mind[Mind.PROGRESS] >= task.dwell_s:
        mind[Mind.PROGRESS] = 0.0
        mind[Mind.PELLET] += 1
        sums[Sum.REMOVED] += 1
        news = GONE
    return news


@inner
def _draw_back(task, plan, aim):  # type: ignore[no-untyped-def]
    """Aim up the rod, away from the heart."""
    x, y, z = _across(plan[0] + plan[1], task.pivot_mm, task.rod_mm)
    up = (task.pivot_mm[0] - x, task.pivot_mm[1] - y, task.pivot_mm[2] - z)
    share = task.withdraw_mm / math.sqrt(up[0] ** 2 + up[1] ** 2 + up[2] ** 2)
    aim[0], aim[1], aim[2] = x + share * up[0], y + share * up[1], z + share * up[2]


@inner
def _think(task, person, mind, draws, plan, tip, phase, time, news, aim, sums):  # type: ignore[no-untyped-def]
    """React to news; look, or begin a movement, when its time has come."""
    if news == GONE:
        _look(task, person, mind, draws, plan, tip, phase, time, aim)
    elif news == TOUCHED and mind[Mind.STATE] != ALARMED:
        mind[Mind.STATE] = ALARMED
        mind[Mind.GO] = max(time + person.delay_s, mind[Mind.START] + mind[Mind.LASTS])
    if time < mind[Mind.GO]:
        return
    if mind[Mind.STATE] == MOVING:
        _look(task, person, mind, draws, plan, tip, phase, time, aim)
        return
    if mind[Mind.STATE] == ALARMED:
        _draw_back(task, plan, aim)
    elif news == AT_WORK:
        mind[Mind.GO] = time + PATIENCE_S
        return
    _set_out(task, person, mind, plan, aim, time)
    sums[Sum.MOVES] += 1
    mind[Mind.STATE] = MOVING
    mind[Mind.GO] = mind[Mind.START] + mind[Mind.LASTS]


@asked
def dissect(task, guide, shape, person, handle, waves, draws, trace):  # type: ignore[no-untyped-def]
    """One trial of one operator.

    Parameters
    ----------
    task, guide, shape
        ``dissection_values.Task``, ``Guide`` and ``Shape``.
    person, handle, waves
        ``operators.Operator``, ``Handle``, and the tremor's waves.
    draws
        Standard normal numbers that the operator's looks use one after the other.
    trace
        ``(n, 9)`` rows of time, tip (3), clearance, force at the tip (3) and pellet, every 10 ms;
        no rows for none.

    Returns
    -------
    Array of ``SUMS`` numbers.
    """
    sums, mind, plan = np.zeros(SUMS), np.zeros(MINDS), np.zeros((2, 3))
    hand, tip, pose = np.zeros((5, 3)), np.zeros(3), np.eye(4)
    aim, place, room = np.zeros(3), np.zeros(3), np.zeros(6)
    _begin(task, waves, mind, plan, hand, tip, pose)
    phase, news = task.phase, GONE
    sums[Sum.STORED] = _energy(guide, shape, pose, phase) if guide.on else 0.0
    first_mj = sums[Sum.STORED]
    for tick in range(int(task.most_s / task.tick_s)):
        time = tick * task.tick_s
        force = (0.0, 0.0, 0.0)
        if guide.on:
            force = _force_on(guide, shape, tip, pose, phase, room)
        clear_mm = _nearest(guide.law, shape, pose, phase) + task.lift_mm
        if tick > 0:
            news = _watch(task, mind, tip, phase, clear_mm, place, sums)
        if mind[Mind.PELLET] >= len(task.pellets_mm):
            break
        _think(task, person, mind, draws, plan, tip, phase, time, news, aim, sums)
        _record(task, tick, mind, tip, clear_mm, force, trace)
        held = _at_the_handle(force, room[3:], hand[0], task.pivot_mm, task.rod_mm)
        hand[4, 0], hand[4, 1], hand[4, 2] = held
        _wish(mind, plan, waves, time + task.tick_s, hand[3])
        done = sums[Sum.FIXTURE]
        _move(person, handle, task.tick_s, hand, sums)
        _follow(task, guide, hand, tip, pose, phase, sums)
        sums[Sum.TIME] = time + task.tick_s
        if guide.on:
            worked = sums[Sum.FIXTURE] - done
            _account(guide, shape, pose, phase, sums, Sum.SAMPLING, worked)
        if task.beating:
            phase = task.phase + sums[Sum.TIME] / task.rr_s
            phase -= math.floor(phase)
            if guide.on:
                _account(guide, shape, pose, phase, sums, Sum.HEART, 0.0)
    sums[Sum.STORED] -= first_mj
    return sums


@inner
def _account(guide, shape, pose, phase, sums, source, worked):  # type: ignore[no-untyped-def]
    """Put down to a source what the fixture now holds more, and the work that it did meanwhile.

    While the heart rests that is what holding the force made; while the tool rests, the heart.
    """
    stored = _energy(guide, shape, pose, phase)
    sums[source] += worked + stored - sums[Sum.STORED]
    sums[Sum.STORED] = stored


@inner
def _begin(task, waves, mind, plan, hand, tip, pose):  # type: ignore[no-untyped-def]
    """The tip at rest at the start, the hand where it wants to be."""
    hx, hy, hz = _across(task.start_mm, task.pivot_mm, task.rod_mm)
    plan[0, 0], plan[0, 1], plan[0, 2] = hx, hy, hz
    mind[Mind.START], mind[Mind.LASTS] = -1.0, 1.0
    _wish(mind, plan, waves, 0.0, hand[2])
    for k in range(3):
        hand[0, k] = hand[2, k]
    tip[0], tip[1], tip[2] = _across(hand[0], task.pivot_mm, task.rod_mm)
    _frame_of(tip, task.pivot_mm, pose)


@inner
def _record(task, tick, mind, tip, clear_mm, force, trace):  # type: ignore[no-untyped-def]
    """Every 10 ms a row of the trace, while there are rows."""
    every = max(round(TRACE_STEP_S / task.tick_s), 1)
    if tick % every == 0 and tick // every < len(trace):
        row = trace[tick // every]
        row[0], row[4], row[8] = tick * task.tick_s, clear_mm, mind[Mind.PELLET]
        row[1], row[2], row[3] = tip[0], tip[1], tip[2]
        row[5], row[6], row[7] = force[0], force[1], force[2]


@inner
def _follow(task, guide, hand, tip, pose, phase, sums):  # type: ignore[no-untyped-def]
    """Bring the tip to where the handle is; count path, force and what lies outside."""
    size = math.sqrt(hand[4, 0] ** 2 + hand[4, 1] ** 2 + hand[4, 2] ** 2)
    sums[Sum.FORCE] = max(sums[Sum.FORCE], size)
    for k in range(3):
        hand[2, k] = hand[3, k]
    x, y, z = _across(hand[0], task.pivot_mm, task.rod_mm)
    way = math.sqrt((x - tip[0]) ** 2 + (y - tip[1]) ** 2 + (z - tip[2]) ** 2)
    sums[Sum.PATH] += way
    tip[0], tip[1], tip[2] = x, y, z
    _frame_of(tip, task.pivot_mm, pose)
    value, _, _, _ = _spline_at(guide.law[0], guide.law[1], guide.law[2], x, y, z, phase)
    if abs(value) > task.workspace_mm:
        sums[Sum.OUTSIDE] += task.tick_s
