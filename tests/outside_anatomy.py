"""A beating heart made of ellipsoids, half-spaces and tubes: shapes alone.

It shares nothing with the phantom of the project but the names of six structures. Frames: the
patient's LPS (mm) for the chest; for the heart its own ``(x, y, z)`` in mm, from the middle of
the mitral plane at end-diastole: x towards the right ventricle, y upwards in a short-axis image,
z from the apex to the base.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator

from tests.outside_people import Body, Scar
from tests.outside_shapes import REACH_MM, Array, both, ellipsoid, tube

Kind = npt.NDArray[np.uint8]


class Stuff(IntEnum):
    """What a point is made of."""

    NONE = 0
    LUNG = 1
    FAT = 2
    MUSCLE = 3
    LIVER = 4
    SPLEEN = 5
    STOMACH = 6
    MARROW = 7
    SPINAL_FLUID = 8
    BLOOD = 9
    WALL = 10
    PERICARDIUM = 11
    LV_BLOOD = 12
    LV_MUSCLE = 13
    LV_PAPILLARY = 14
    RV_BLOOD = 15
    RV_TRABECULA = 16
    LEFT_ATRIUM = 17
    RIGHT_ATRIUM = 18
    AORTA = 19


def bent(body: Body, points_mm: Array, by_mm: float = 2.0) -> Array:
    """Points where the bodies are regular: what is drawn becomes as crooked as nature."""
    return points_mm + np.stack([np.float32(by_mm) * w.at(points_mm) for w in body.bends], axis=1)


BASE_MM = np.array([6.0, -10.0, 0.0])
"""Where the mitral plane's middle lies in the chest, LPS."""


def heart_axes(body: Body) -> npt.NDArray[np.float64]:
    """``(3, 3)`` rows: the heart's x, y, z in LPS."""
    up = -np.array(body.apex_way) / np.linalg.norm(body.apex_way)
    across = np.array([-1.0, 0, 0]) - (np.array([-1.0, 0, 0]) @ up) * up
    across /= np.linalg.norm(across)
    other = np.cross(up, across)
    c, s = np.cos(np.radians(body.roll_deg)), np.sin(np.radians(body.roll_deg))
    return np.stack([c * across + s * other, c * other - s * across, up])


def squeeze(body: Body, phase: float) -> float:
    """How far the ventricles are emptied: 0 at end-diastole, 1 at end-systole."""
    times = np.array([0, 0.2, 0.5, 0.85, 1.0]) * body.systole
    rest = 1 - body.systole
    times = np.concatenate([times, body.systole + rest * np.array([0.12, 0.3, 0.7, 0.85, 1.0])])
    shut = [0, 0.1, 0.55, 0.96, 1.0, 0.85, 0.3, 0.2, 0.1, 0.0]
    return float(PchipInterpolator(times, shut)(phase % 1.0))


@dataclass(frozen=True, slots=True)
class Moment:
    """Sizes of the left ventricle at one phase."""

    shut: float
    base: float
    radius: float
    wall: float
    length: float


TRUNCATED = 0.28
"""Share of the ventricle's length that lies between its widest place and the base."""


def _half_ellipsoid_ml(radius: float, length: float) -> float:
    half = (1 - TRUNCATED) * length
    k = TRUNCATED / (1 - TRUNCATED)
    return float(np.pi * radius**2 * half * (k - k**3 / 3 + 2 / 3) / 1000)


def left_ventricle(body: Body, phase: float) -> Moment:
    """The cavity that holds the volume of that phase, and the wall that keeps the muscle's."""
    shut = squeeze(body, phase)
    base = -body.mitral_fall * shut
    length = body.lv_length + base
    volume = body.lv_ed_ml * (1 - body.lv_ef * shut)
    radius = np.sqrt(volume / _half_ellipsoid_ml(1.0, length))
    low, high = 1.0, 40.0
    for _ in range(40):
        wall = (low + high) / 2
        outer = _half_ellipsoid_ml(radius + wall, length + 0.6 * wall)
        low, high = (wall, high) if outer - volume < body.muscle_ml else (low, wall)
    return Moment(shut, base, float(radius), float(low), float(length))


def _rest_size(body: Body) -> float:
    now = left_ventricle(body, 0.0)
    return now.radius + now.wall


def _right_ventricle(body: Body, p: Array, now: Moment) -> tuple[Array, Array]:
    """Distance outside the right ventricle, and outside the lung artery that continues it."""
    side, rest = now.radius + now.wall, _rest_size(body)
    thinner = 1 - 0.8 * now.shut * (1 - (1 - body.rv_ef) / 0.78)
    reach = body.rv_reach * thinner
    base = -3 - body.tricuspid_fall * now.shut
    middle = 0.45 * side
    deep = 0.15 * body.lv_length
    half = (
        side + reach - middle,
        body.rv_height * rest * (1 - 0.12 * now.shut),
        body.rv_apex * body.lv_length - deep,
    )
    sac = ellipsoid(p, (middle, -4.0, -deep), half)
    sac = both(sac, 0.25 * side - p[:, 0])
    sac = both(sac, p[:, 2] - base - 0.15 * (p[:, 1] + 10))
    valve = np.add(body.outflow, (0, rest - 34, 0.25 * base))
    start = np.array([side + 0.4 * reach, 0.45 * half[1], -0.35 * body.lv_length])
    turn = np.array([0.75 * side, 0.85 * rest, -14 + 0.6 * base])
    narrow = 1 - 0.15 * now.shut
    outflow = tube(p, [start, turn, valve], np.array([15, 15, 12.5]) * narrow)
    ahead = np.add(valve, (-14, 6, 34))
    left, behind, far = (np.add(ahead, to) for to in ((-22, -22, 22), (14, -26, 16), (60, -26, 40)))
    artery = tube(p, [valve, ahead, left], (12.5, 12.5, 11))
    branch = tube(p, [ahead, behind, far], (11, 10, 9))
    # The valve's own plane parts the ventricle from the artery.
    beyond = (p - valve.astype(np.float32)) @ np.array([-0.3, 0.2, 0.93], np.float32)
    return np.minimum(sac, np.maximum(outflow, beyond)), np.minimum(
        np.maximum(artery, -beyond), branch
    )


def _root(body: Body, now: Moment) -> npt.NDArray[np.float64]:
    """Middle line of the aorta from below its valve to the arch's beginning."""
    r = 0.42 * left_ventricle(body, 0.0).radius
    up = heart_axes(body) @ (0.0, 0.0, 1.0)
    bend = np.array([r + 3, r + 15, 36])
    return np.stack(
        [[r - body.lopsided, r, now.base - 10], [r + 1, r + 5, now.base + 12], bend, bend + 45 * up]
    )


OPEN_TO: dict[Stuff, tuple[Stuff, ...]] = {
    Stuff.RV_BLOOD: (Stuff.RIGHT_ATRIUM, Stuff.BLOOD),
    Stuff.RIGHT_ATRIUM: (Stuff.BLOOD,),
    Stuff.LEFT_ATRIUM: (Stuff.BLOOD,),
}
"""What a chamber has a valve or a mouth to, among what is painted before it."""

LEAFLET_MM = 0.5


def heart_stuff(body: Body, p: Array, phase: float) -> Kind:
    """What the heart and its great vessels are made of at ``(n, 3)`` points of its own frame."""
    now = left_ventricle(body, phase)
    stuff = np.zeros(len(p), np.uint8)
    # What is painted later covers what came before: chambers push their neighbours' walls aside.
    plane = now.base + np.float32(body.mitral_tilt) * p[:, 0]
    above = plane - p[:, 2]
    right, artery = _right_ventricle(body, p, now)
    layers = [*_veins(body, p), (artery, Stuff.BLOOD, 1.2)]
    layers += _atria(body, p, now, above)
    aorta = tube(p, _root(body, now), body.root_radius * np.array([0.85, 1.05, 0.95, 1.0]))
    layers += [(np.maximum(aorta, above), Stuff.AORTA, 1.5), (right, Stuff.RV_BLOOD, body.rv_wall)]
    walls = _ventricle_layers(body, p, now, above)
    # Fat lies on the right ventricle's wall, however thick that is.
    gaps = {kind: gap for gap, kind, _ in layers if kind != Stuff.BLOOD}
    gaps[Stuff.RV_BLOOD] = right - np.float32(body.rv_wall - 2.5)
    gaps[Stuff.LV_MUSCLE] = walls[0]
    vessels = [gap for gap, kind, _ in layers if kind == Stuff.BLOOD]
    _paint_fat(body, p, now, stuff, gaps, vessels)
    for gap, kind, wall in layers:
        # Where chamber opens into chamber stands no wall, but a leaflet.
        open_to = np.isin(stuff, OPEN_TO.get(kind, ()))
        beside = np.isin(stuff, (Stuff.AORTA, Stuff.LEFT_ATRIUM))
        thick = np.where(beside, min(wall, 2.5), wall)
        stuff[gap < np.where(open_to, LEAFLET_MM, thick)] = Stuff.WALL
        stuff[gap < 0] = kind
    rim = np.flatnonzero((right < 0) & (right > -5))
    knotty = body.fine.at(p[rim]) + body.coarse.at(p[rim]) > 2.1 - body.trabeculae
    stuff[rim[knotty]] = Stuff.RV_TRABECULA
    stuff[walls[0] < 0] = Stuff.LV_MUSCLE
    tract = (aorta < 0) & (above > 0) & (walls[0] < 0)
    cavity = (walls[1] < 0) | tract
    stuff[cavity] = Stuff.LV_BLOOD
    stuff[cavity & ~tract & walls[2]] = Stuff.LV_PAPILLARY
    return stuff


def _ventricle_layers(
    body: Body, p: Array, now: Moment, above: Array
) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
    """Distances outside the epicardium and the cavity; where muscle stands inside the latter."""

    def shell(wall: float, length: float, aside: float = 0.0) -> Array:
        radius = now.radius + wall
        middle = (-aside, 0.0, now.base - TRUNCATED * length)
        half = (radius * body.squash, radius / body.squash, (1 - TRUNCATED) * length)
        return np.maximum(ellipsoid(_flattened(body, p, now, wall), middle, half), -above)

    outer = shell(now.wall, now.length + 0.6 * now.wall)
    inner = shell(0.0, now.length, body.lopsided)
    if body.scar is not None:
        outer, inner = _scarred(body, body.scar, p, now, outer, inner)
        outer, inner = np.maximum(outer, -above), np.maximum(inner, -above)
    r, long = now.radius, now.length
    thick = 4.0 * (1 + 0.25 * now.shut)
    muscle = np.zeros(len(p), bool)
    for x, y in ((-0.48 - body.lopsided / r, 0.45), (-0.2 - body.lopsided / r, -0.64)):
        foot = now.base - 0.78 * long
        way = [(0.75 * x * r, 0.75 * y * r, foot), (x * r, y * r, now.base - 0.38 * long)]
        muscle |= tube(p, way, (thick, 0.75 * thick)) < 0
    depth = 2.5 + 3.0 * body.trabeculae + body.sponge
    rim = (inner > -depth) & (inner < 0) & (p[:, 2] < now.base - 0.3 * long)
    some = np.flatnonzero(rim)
    muscle[some[body.fine.at(p[some]) > 1.5 - body.trabeculae - 0.08 * body.sponge]] = True
    return outer, inner, muscle


def _scarred(
    body: Body, scar: Scar, p: Array, now: Moment, outer: Array, inner: Array
) -> tuple[Array, Array]:
    """Distances outside epicardium and cavity where an infarct has thinned the wall."""
    middle = np.array([0.0, 0.0, now.base - 0.45 * now.length])
    size = np.array([now.radius + now.wall] * 2 + [0.55 * now.length + now.wall])
    place = middle + size * scar.way
    away = np.linalg.norm(p - place.astype(np.float32), axis=1)
    # At the valves the ring stays whole.
    share = np.clip((scar.reach - away) / 12, 0, 1) * np.clip((now.base - 12 - p[:, 2]) / 10, 0, 1)
    share = (share * share * (3 - 2 * share)).astype(np.float32)
    # A millimetre counts for less towards the tip, as `ellipsoid` measures.
    long, radius = now.length + 0.6 * now.wall, now.radius + now.wall
    half = np.array([radius * body.squash, radius / body.squash, (1 - TRUNCATED) * long])
    off = (p - np.array([0, 0, now.base - TRUNCATED * long])) / half
    steep = half.min() * np.linalg.norm(off / half, axis=1) / np.linalg.norm(off, axis=1)
    bulge_mm = scar.bulge * (0.3 + 0.7 * now.shut)
    outer = np.asarray(outer - bulge_mm * steep * share, np.float32)
    thin = (1 - share) * inner + share * (outer + scar.wall * steep)
    return outer, np.minimum(inner, thin.astype(np.float32))


def _flattened(body: Body, p: Array, now: Moment, wall: float) -> Array:
    """Where points would lie if the septum were round: its wall keeps its thickness."""
    if not body.flat:
        return p
    # Below the valves alone: the way out to the aorta stays open.
    flat = body.flat * np.clip((now.base - 10 - p[:, 2]) / 15, 0, 1)
    shrunk = (now.radius * (1 - flat) + wall) / (now.radius + wall)
    round_x = np.where(p[:, 0] > 0, p[:, 0] / shrunk, p[:, 0])
    return np.stack([round_x, p[:, 1], p[:, 2]], axis=1).astype(np.float32)


def _atria(body: Body, p: Array, now: Moment, above: Array) -> list[tuple[Array, Stuff, float]]:
    """Right and left atrium; their floors move with the valves, their roofs hardly."""
    rest = _rest_size(body)
    grown = 1 + 0.12 * now.shut
    wide, high, roof = body.atrium_right
    low = -3 - body.tricuspid_fall * now.shut
    middle = (rest + 0.3 * body.rv_reach, -8.0, (low + roof) / 2 - 3)
    right = ellipsoid(p, middle, (wide * grown, high * grown, (roof - low) / 2 + 4))
    right = np.maximum(right, low + 0.15 * (p[:, 1] + 10) - p[:, 2])
    wide, high, roof = body.atrium_left
    middle = (-4.0, -9.0, (now.base + roof) / 2 - 4)
    left = ellipsoid(p, middle, (wide * grown, high * grown, (roof - now.base) / 2 + 6))
    ear = tube(p, [(-18, 4, 18), (-34, 20, 12), (-32, 34, 8)], (8, 7, 4))
    left = np.maximum(np.minimum(left, ear), above)
    return [(right, Stuff.RIGHT_ATRIUM, 1.8), (left, Stuff.LEFT_ATRIUM, 1.8)]


def _veins(body: Body, p: Array) -> list[tuple[Array, Stuff, float]]:
    """Veins of body and lungs, and the arch of the aorta with what follows: unlabelled blood."""
    axes = heart_axes(body)
    place = np.array([_rest_size(body) + 0.3 * body.rv_reach, -8, 24])
    up = axes @ (0.0, 0.0, 1.0)
    cava = tube(p, [place - 70 * up, place, place + 80 * up], (12, 12, 9))
    lungs = [
        tube(p, [(-15, -12, 28), end], (7, 5))
        for end in [(-45, -40, 42), (-40, 0, 60), (30, -20, 55), (25, -45, 45)]
    ]
    top = _root(body, left_ventricle(body, 0.0))[-1]
    spine = 0.62 * body.half_depth
    down = [axes @ (np.array(q) - BASE_MM) for q in [(20, spine - 25, 60), (22, spine - 22, -150)]]
    arch = tube(p, [top, top + 18 * up, *down], (12, 12, 11, 10))
    return [(gap, Stuff.BLOOD, 1.0) for gap in (cava, *lungs, arch)]


def _paint_fat(
    body: Body, p: Array, now: Moment, stuff: Kind, gaps: dict[Stuff, Array], vessels: list[Array]
) -> None:
    """Fat around heart and vessels, thickest in the groove above the ventricles; and fluid."""
    outer = np.minimum.reduce([*gaps.values(), *vessels])
    some = np.flatnonzero(outer < REACH_MM)
    q, gap = p[some], outer[some]
    groove = np.exp(-(((q[:, 2] - now.base) / 14) ** 2))
    thick = body.fat_heart * (0.9 + 0.5 * body.coarse.at(q)) + 5 * groove
    # The lung lies against the side wall; fat gathers towards the right ventricle.
    thick = np.maximum(thick * np.clip(0.6 + q[:, 0] / 40, 0.1, 1.3), 0.8)
    stuff[some[gap < thick + 1.0]] = Stuff.PERICARDIUM
    if body.fluid:
        # It gathers below and behind, and hardly above the ventricles; none about the vessels.
        fluid = body.fluid * np.clip(0.7 - q[:, 1] / 80 + 0.3 * body.coarse.at(q), 0.1, 1.4)
        fluid *= np.clip((now.base + 25 - q[:, 2]) / 20, 0, 1)
        wet = np.minimum(thick + fluid, REACH_MM - 1.5)
        chambers = np.minimum.reduce([one[some] for one in gaps.values()])
        stuff[some[chambers < wet + 1.0]] = Stuff.PERICARDIUM
        stuff[some[chambers < wet]] = Stuff.SPINAL_FLUID
    stuff[some[gap < thick]] = Stuff.FAT
