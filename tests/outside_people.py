"""People of `tests.outside_anatomy`, healthy and ill, with all that is drawn of them.

Sizes: left ventricle, right ventricle, muscle and their ejection fractions span what Petersen et
al. found in health (J. Cardiovasc. Magn. Reson. 19:18, 2017; 95 % of people) and some illness
beyond; falls of the mitral and tricuspid planes, wall and vessel sizes are set by eye.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tests.outside_shapes import Waves


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
    scar: Scar | None = None
    sponge: float = 0.0
    """How much deeper (mm) trabeculae fill the left cavity, and how much denser they stand."""
    rv_wall: float = 2.5
    fluid: float = 0.0
    """Fluid (mm) about the ventricles, inside the pericardium; some then lies in the chest, too."""


@dataclass(frozen=True, slots=True)
class Scar:
    """Where an infarct has left the left ventricle's wall thin and still; lengths in mm."""

    way: tuple[float, float, float]
    """From the middle of the cavity, a unit vector in the heart's frame."""
    reach: float
    wall: float
    bulge: float
    """How far it bulges out at end-systole."""


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


ILLNESSES = ("overload", "thick", "wide", "scar", "spongy", "right", "fluid")
"""What `made_ill` knows: a right ventricle under load, whose wide cavity flattens the septum; a
left one with a very thick septum, nearly shut at end-systole; a very wide left one, thin and weak;
one with an infarct that bulges at end-systole; one whose trabeculae fill much of the cavity; a
right one with a wall as thick as the left one's; fluid about the heart and behind the lungs.
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
    elif illness == "scar":
        way = np.array([*(rng.standard_normal(2) * 0.8), -abs(rng.normal(0.6, 0.4))])
        way /= np.linalg.norm(way)
        ill = replace(
            body, lv_ed_ml=spread(130, 280), lv_ef=spread(0.3, 0.55), muscle_ml=spread(90, 150),
            scar=Scar(tuple(way), spread(22, 45), spread(2.5, 4.5), spread(1, 10)),
        )  # fmt: skip
    elif illness == "spongy":
        volume = spread(140, 260)
        ill = replace(
            body, lv_ed_ml=volume, lv_ef=spread(0.25, 0.55), muscle_ml=volume * spread(0.4, 0.6),
            sponge=spread(5, 12), trabeculae=spread(0.6, 0.9),
        )  # fmt: skip
    elif illness == "right":
        ill = replace(
            body, rv_wall=spread(3.2, 6.0), rv_reach=spread(36, 58), rv_height=spread(1.2, 1.5),
            flat=spread(0.0, 0.4), rv_apex=spread(0.85, 1.02), rv_ef=spread(0.3, 0.6),
        )  # fmt: skip
    elif illness == "fluid":
        ill = replace(body, fluid=spread(4, 11))
    else:
        raise ValueError(f"no illness {illness!r}")
    # Wide ventricles are rounder than others.
    return replace(ill, lv_length=86 * (ill.lv_ed_ml / 140) ** 0.27 * spread(0.93, 1.07))
