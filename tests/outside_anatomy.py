"""A beating heart made of ellipsoids, half-spaces and tubes: shapes alone.

It shares nothing with the phantom of the project but the names of six structures. Frames: the
patient's LPS (mm) for the chest; for the heart its own ``(x, y, z)`` in mm, from the middle of
the mitral plane at end-diastole: x towards the right ventricle, y upwards in a short-axis image,
z from the apex to the base.

Sizes: left ventricle, right ventricle, muscle and their ejection fractions span what Petersen et
al. found in health (J. Cardiovasc. Magn. Reson. 19:18, 2017; 95 % of people) and some illness
beyond; falls of the mitral and tricuspid planes, wall and vessel sizes are set by eye.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator

from tests.outside_shapes import REACH_MM, Array, Waves, both, ellipsoid, tube

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


@dataclass(frozen=True, slots=True)
class Body:
    """Everything that is drawn of one person; lengths in mm, volumes in ml."""

    lv_length: float
    lv_ed_ml: float
    lv_ef: float
    muscle_ml: float
    squash: float
    mitral_fall: float
    mitral_tilt: float
    tricuspid_fall: float
    rv_reach: float
    rv_height: float
    rv_ef: float
    rv_apex: float
    outflow: tuple[float, float, float]
    root_radius: float
    atrium_left: tuple[float, float, float]
    atrium_right: tuple[float, float, float]
    systole: float
    apex_way: tuple[float, float, float]
    roll_deg: float
    fat_heart: float
    fat_skin: float
    half_width: float
    half_depth: float
    diaphragm: float
    arms: bool
    gas: float
    trabeculae: float
    bends: tuple[Waves, ...]
    fine: Waves
    coarse: Waves
    branches: tuple[Waves, ...]
    flat: float = 0.0
    """Share by which the left ventricle's cavity reaches less far towards the right one. Of its
    volume it loses up to 27 %, the muscle a sixth, which `left_ventricle` does not know of."""
    lopsided: float = 0.0
    """How far (mm) the left cavity lies off the middle of its muscle, away from the septum."""


ILLNESSES = ("overload", "thick", "wide")
"""What `made_ill` knows: a right ventricle under load, whose wide cavity flattens the septum; a
left one with a very thick septum, nearly shut at end-systole; a very wide left one, thin and weak.
"""


def made_ill(rng: np.random.Generator, body: Body, illness: str) -> Body:
    """The same person with an illness at its worst, beyond what `draw_body` draws."""
    spread = rng.uniform
    if illness == "overload":
        ill = replace(
            body, lv_ed_ml=spread(75, 140), muscle_ml=spread(60, 95), flat=spread(0.3, 0.75),
            rv_reach=spread(52, 78), rv_height=spread(1.3, 1.55), rv_apex=spread(0.92, 1.08),
            rv_ef=spread(0.22, 0.45), tricuspid_fall=spread(8, 18),
            atrium_right=(spread(26, 36), spread(32, 42), spread(42, 56)),
        )  # fmt: skip
    elif illness == "thick":
        ill = replace(
            body, lv_ed_ml=spread(80, 140), lv_ef=spread(0.68, 0.82), muscle_ml=spread(170, 270),
            lopsided=spread(2.0, 6.0),
        )  # fmt: skip
    elif illness == "wide":
        volume = spread(260, 400)
        ill = replace(
            body, lv_ed_ml=volume, lv_ef=spread(0.1, 0.3), muscle_ml=volume * spread(0.4, 0.55),
            mitral_fall=spread(3, 8),
        )  # fmt: skip
    else:
        raise ValueError(f"no illness {illness!r}")
    # Wide ventricles are rounder than others.
    return replace(ill, lv_length=86 * (ill.lv_ed_ml / 140) ** 0.27 * spread(0.93, 1.07))


def draw_body(rng: np.random.Generator) -> Body:
    """One person, healthy two times in three, else with a large weak or a thick left ventricle."""
    kind = rng.choice(4, p=[0.4, 0.27, 0.18, 0.15])
    spread = rng.uniform
    if kind == 2:
        volume, fraction, muscle = spread(180, 260), spread(0.2, 0.45), spread(110, 160)
    elif kind == 3:
        volume, fraction, muscle = spread(90, 150), spread(0.55, 0.75), spread(140, 200)
    else:
        volume, fraction, muscle = spread(95, 190), spread(0.5, 0.69), 0.0
        muscle = volume * spread(0.52, 0.75)
    length = 86 * (volume / 140) ** (1 / 3) * spread(0.93, 1.07)
    return Body(
        lv_length=length, lv_ed_ml=volume, lv_ef=fraction, muscle_ml=muscle,
        squash=spread(0.95, 1.06), mitral_fall=(4 + 16 * fraction) * spread(0.8, 1.2),
        mitral_tilt=spread(-0.3, 0.02), tricuspid_fall=spread(14, 25),
        rv_reach=spread(33, 50), rv_height=spread(1.15, 1.35), rv_ef=spread(0.42, 0.66),
        rv_apex=spread(0.78, 0.95), outflow=(spread(-4, 8), spread(40, 50), spread(8, 18)),
        root_radius=spread(12.5, 18),
        atrium_left=(spread(23, 33), spread(19, 28), spread(38, 56)),
        atrium_right=(spread(20, 28), spread(24, 34), spread(36, 50)),
        systole=spread(0.3, 0.42),
        apex_way=(spread(0.5, 0.75), spread(-0.68, -0.45), spread(-0.62, -0.3)),
        roll_deg=spread(-14, 10), fat_heart=spread(1.5, 7), fat_skin=spread(6, 32),
        half_width=spread(150, 180), half_depth=spread(104, 130), diaphragm=spread(-8, 6),
        arms=bool(rng.random() < 0.4), gas=spread(0.1, 0.7), trabeculae=spread(0.1, 0.9),
        bends=tuple(Waves.drawn(rng, 120) for _ in range(3)),
        fine=Waves.drawn(rng, 11, 6), coarse=Waves.drawn(rng, 45, 4),
        branches=tuple(Waves.drawn(rng, 38, 4) for _ in range(2)),
    )  # fmt: skip


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
    outer = np.full(len(p), 1e3, np.float32)
    plane = now.base + np.float32(body.mitral_tilt) * p[:, 0]
    above = plane - p[:, 2]
    right, artery = _right_ventricle(body, p, now)
    layers = [*_veins(body, p), (artery, Stuff.BLOOD, 1.2)]
    layers += _atria(body, p, now, above)
    aorta = tube(p, _root(body, now), body.root_radius * np.array([0.85, 1.05, 0.95, 1.0]))
    layers += [(np.maximum(aorta, above), Stuff.AORTA, 1.5), (right, Stuff.RV_BLOOD, 2.5)]
    walls = _ventricle_layers(body, p, now, above)
    _paint_fat(body, p, now, stuff, [gap for gap, _, _ in layers] + [walls[0]], outer)
    for gap, kind, wall in layers:
        # Where chamber opens into chamber stands no wall, but a leaflet.
        open_to = np.isin(stuff, OPEN_TO.get(kind, ()))
        stuff[gap < np.where(open_to, LEAFLET_MM, wall)] = Stuff.WALL
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
    r, long = now.radius, now.length
    thick = 4.0 * (1 + 0.25 * now.shut)
    muscle = np.zeros(len(p), bool)
    for x, y in ((-0.48 - body.lopsided / r, 0.45), (-0.2 - body.lopsided / r, -0.64)):
        foot = now.base - 0.78 * long
        way = [(0.75 * x * r, 0.75 * y * r, foot), (x * r, y * r, now.base - 0.38 * long)]
        muscle |= tube(p, way, (thick, 0.75 * thick)) < 0
    depth = 2.5 + 3.0 * body.trabeculae
    rim = (inner > -depth) & (inner < 0) & (p[:, 2] < now.base - 0.3 * long)
    some = np.flatnonzero(rim)
    muscle[some[body.fine.at(p[some]) > 1.5 - body.trabeculae]] = True
    return outer, inner, muscle


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
    body: Body, p: Array, now: Moment, stuff: Kind, gaps: list[Array], outer: Array
) -> None:
    """Fat around heart and vessels, thickest in the groove above the ventricles."""
    for gap in gaps:
        np.minimum(outer, gap, out=outer)
    some = np.flatnonzero(outer < REACH_MM)
    q, gap = p[some], outer[some]
    groove = np.exp(-(((q[:, 2] - now.base) / 14) ** 2))
    thick = body.fat_heart * (0.9 + 0.5 * body.coarse.at(q)) + 5 * groove
    # The lung lies against the side wall; fat gathers towards the right ventricle.
    thick = np.maximum(thick * np.clip(0.6 + q[:, 0] / 40, 0.1, 1.3), 0.8)
    stuff[some[gap < thick + 1.0]] = Stuff.PERICARDIUM
    stuff[some[gap < thick]] = Stuff.FAT
