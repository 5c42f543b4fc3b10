"""A population of hearts: sizes, motion, place and chest, drawn at random.

A person is drawn first: sex, body size, and from them the volumes, mass and ejection fractions
that a reader would measure. The shape that has these volumes is then solved for. So the draws
follow the published distributions below whatever the shape's outlines look like.

Means and standard deviations, men / women:

=================  =================  =================  ==========================================
measure            men                women              source
=================  =================  =================  ==========================================
LV end-diastolic   160 +- 29 ml       135 +- 26 ml       Hudsmith et al. 2005
RV end-diastolic   190 +- 33 ml       148 +- 35 ml       Hudsmith et al. 2005
LA largest         103 +- 30 ml       89 +- 21 ml        Hudsmith et al. 2005
LV ejection        58 +- 5 %          61 +- 5 %          Petersen et al. 2017
LV mass / BSA      53 +- 9 g/m2       42 +- 7 g/m2       Petersen et al. 2017
LV wall, middle    6.3 +- 1.1 mm      5.3 +- 0.9 mm      Kawel et al. 2012
RA largest / BSA   77 +- 11 ml/m2     77 +- 11 ml/m2     Radiology 1994 (both sexes)
aortic sinus       32.4 +- 3.9 mm     27.6 +- 2.9 mm     Davis et al. 2014 (2 SD given)
ascending aorta    26.7 +- 3.9 mm     25.5 +- 3.7 mm     Davis et al. 2014 (2 SD given)
body surface       1.83 +- 0.18 m2    (both sexes)       Maceira et al. 2013
=================  =================  =================  ==========================================

Hudsmith, J. Cardiovasc. Magn. Reson. 7:775-782; Petersen, ibid. 19:18; Davis, ibid. 16:9; Maceira,
ibid. 15:29; Kawel, Circ. Cardiovasc. Imaging 5:500-508; Radiology 191:137-142 (eight subjects).
Papillary muscles and trabeculae belong to the cavity here, as in Petersen et al.

Drawn means lie within half a deviation of these and drawn deviations are smaller, so that every
draw at spread 1 is inside the normal range of two deviations, but for the aortic sinus, whose
deviation is drawn up to a quarter larger, and the right atrium. The right ventricle is drawn as a
multiple of the left one and ejects as much, within 3.4 %; the right atrium is drawn at 60
ml/m2, between the three-dimensional measure above and the lower two-dimensional ones in common use:
down to 51 ml/m2, where that range begins at 55. Body surface by
sex (1.95 and 1.71 m2) and the atria's emptying of 51 and 44 % are chosen, not published, values.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from data_synth.beat import Pulse, end_systole_phase, kick_onset_phase
from data_synth.errors import SynthError
from data_synth.heart import BeatingHeart, Matrix
from data_synth.kernels import Shape
from data_synth.measures import MUSCLE_G_ML
from data_synth.meshes import body_volumes_ml
from data_synth.pathology import PATHOLOGIES, Person, make_ill
from data_synth.thorax import Thorax

EX, EZ = (-0.72, -0.66, -0.16), (-0.62, 0.58, 0.53)
"""Mean directions, LPS: towards the right ventricle, and from apex to base."""
CENTRE_MM = (18.0, -4.0, 2.0)
"""Mean place of the mitral plane in the chest."""
CUT = 1.7
"""Draws end at this many deviations at spread 1, inside the normal range of two."""
SHARED = 0.6
"""Correlation of every size with the body's."""
LEAST_RV_EJECTION = 0.48
"""A healthy right ventricle is filled so far at most that the left one's stroke is this share."""
HEART_RATES_BPM = (30.0, 220.0)
ROUNDS_MM = (6.0, 6.0, 6.0, 4.0, 4.0)
"""Grid of each round in which a shape is fitted to its volumes."""


class _Draws(NamedTuple):
    """A generator with the spread of its draws."""

    rng: np.random.Generator
    spread: float

    def share(self, body: float = 0.0, shared: float = 0.0) -> float:
        """Deviations from the mean, partly those of the body, cut at CUT."""
        own = float(self.rng.standard_normal())
        both = shared * body + math.sqrt(1 - shared * shared) * own
        return self.spread * min(max(both, -CUT), CUT)

    def of(self, mean: float, deviation: float) -> float:
        """Normal draw about a mean."""
        return mean + deviation * self.share()


def draw_heart(
    rng: np.random.Generator,
    spread: float = 1.0,
    pathology: str = "healthy",
    heart_rate_bpm: float = 75.0,
) -> BeatingHeart:
    """Draw a heart: sizes, motion, place and chest.

    Parameters
    ----------
    rng
        Source of all draws; a healthy and an ill heart of the same generator are of one person.
    spread
        Scales every deviation from the mean heart: 0 gives the mean of men and women, 1 healthy
        adults inside the normal ranges of the table above (right atria may be smaller, aortic
        sinuses 0.7 deviations farther off), 2 a wider population for training.
    pathology
        One of ``PATHOLOGIES``.
    heart_rate_bpm
        Sets the RR interval, and with it the share of systole in the beat.

    Raises
    ------
    SynthError
        When ``spread`` lies outside [0, 3], the rate outside 30 to 220, or the pathology is none.
    """
    if not 0 <= spread <= 3:
        raise SynthError(f"spread is {spread}; give a number from 0 (mean heart) to 3")
    low, high = HEART_RATES_BPM
    if not low <= heart_rate_bpm <= high:
        raise SynthError(f"heart_rate_bpm is {heart_rate_bpm}; give a rate from {low} to {high}")
    if pathology not in PATHOLOGIES:
        known = ", ".join(PATHOLOGIES)
        raise SynthError(f"pathology is {pathology!r}, which is not known; give one of {known}")
    draws = _Draws(rng, spread)
    person = draw_person(rng, spread)
    shape = _draw_outlines(draws, person)
    pulse = _draw_pulse(draws, person, heart_rate_bpm)
    chest = _draw_chest(draws, person)
    place = _draw_place(draws)
    person, shape, pulse = make_ill(rng, pathology, person, shape, pulse)
    pulse = pulse._replace(
        lv_ejection=person.lv_ejection,
        rv_ejection=person.rv_ejection,
        la_emptying=person.la_emptying,
        ra_emptying=person.ra_emptying,
    )
    return BeatingHeart(fit_shape(shape, person), pulse, chest, place, 60 / heart_rate_bpm)


def draw_person(rng: np.random.Generator, spread: float = 1.0) -> Person:
    """Draw the measures that a healthy person's heart is to have, by sex and body size."""
    draws = _Draws(rng, spread)
    sex = 1.0 if rng.random() < 0.5 else -1.0
    man = 0.5 + 0.5 * sex * min(spread, 1.0)
    body = float(np.clip(rng.standard_normal(), -CUT, CUT))

    def size(men: tuple[float, float], women: tuple[float, float]) -> float:
        mean = man * men[0] + (1 - man) * women[0]
        deviation = man * men[1] + (1 - man) * women[1]
        return mean + deviation * draws.share(body, SHARED)

    def both(men: float, women: float, deviation: float) -> float:
        return man * men + (1 - man) * women + deviation * draws.share()

    area = man * 1.95 + (1 - man) * 1.71 + 0.13 * spread * body
    lv_ml = size((160, 24), (132, 20))
    lv_ejection = both(0.59, 0.61, 0.028)
    stroke_ml = lv_ml * lv_ejection
    rv_ml = min(lv_ml * both(1.13, 1.08, 0.035), stroke_ml / LEAST_RV_EJECTION)
    return Person(
        male=sex > 0,
        body_surface_m2=area,
        lv_ml=lv_ml,
        lv_mass_g=area * both(55, 44, 4.0) * (lv_ml / (84 * area)) ** 0.3,
        lv_ejection=lv_ejection,
        rv_ml=rv_ml,
        rv_ejection=stroke_ml * both(1.0, 1.0, 0.02) / rv_ml,
        la_ml=size((92, 14), (80, 12)),
        la_emptying=both(0.51, 0.51, 0.02),
        ra_ml=area * both(62, 58, 4.0),
        ra_emptying=both(0.44, 0.44, 0.025),
        sinus_mm=size((32.0, 2.4), (28.0, 2.0)),
        ascending_mm=size((27.0, 2.0), (25.5, 1.9)),
    )


def _draw_outlines(draws: _Draws, person: Person) -> Shape:
    """Draw proportions; lengths scale with the left ventricle."""
    mean = Shape()
    scale = (person.lv_ml / 146) ** (1 / 3)
    lengths = {
        "lv_length": 3.0, "rv_wall": 0.2, "la_x": 1.5, "la_y": 1.5, "la_radius_x": 0.8,
        "la_radius_y": 0.8, "ra_x": 1.5, "ra_y": 2.0, "ra_radius_x": 0.9, "ra_radius_y": 0.9,
        "mitral_radius": 0.6, "tricuspid_radius": 0.7, "appendage_radius": 0.6, "vein_radius": 0.4,
    }  # fmt: skip
    shares = {
        "lv_widest": 0.03, "lv_narrowing": 0.03, "rv_half_angle": 0.04, "rv_angle": 0.06,
        "rv_reach": 0.02, "atrial_wall": 0.15, "appendage_length": 0.07, "fat_depth": 0.4,
        "papillary_radius": 0.4, "trabeculae": 0.5,
    }  # fmt: skip
    drawn = {name: draws.of(getattr(mean, name), sd) * scale for name, sd in lengths.items()}
    drawn |= {name: draws.of(getattr(mean, name), sd) for name, sd in shares.items()}
    drawn["fat_depth"] = max(drawn["fat_depth"], 1.0)
    drawn["aorta_radius"] = person.ascending_mm / 2
    drawn["sinus_radius"] = max(person.sinus_mm / 2, drawn["aorta_radius"] + 0.5)
    return mean._replace(**drawn)


@lru_cache(maxsize=16)
def fit_shape(shape: Shape, person: Person) -> Shape:
    """Solve for the radii, walls and widths that give a person's volumes, within a percent.

    Each round scales what a volume depends on most by the share it misses: the left radius and
    wall, the right width, the atrial radii. The atria are sized for the R peak, where they are
    smallest.
    """
    thickest = shape.septal_bulge
    for spacing_mm in ROUNDS_MM:
        found = body_volumes_ml(shape, spacing_mm)
        radius = shape.lv_radius * math.sqrt(person.lv_ml / found["lv_endocardium"])
        outer_ml = person.lv_ml + person.lv_mass_g / MUSCLE_G_ML
        outer = (shape.lv_radius + shape.lv_wall) * math.sqrt(outer_ml / found["epicardium"])
        wall = max(outer - radius, 3.5)
        la = (person.la_ml * (1 - person.la_emptying) / found["left_atrium"]) ** 0.45
        ra = (person.ra_ml * (1 - person.ra_emptying) / found["right_atrium"]) ** 0.38
        shape = shape._replace(
            lv_radius=radius,
            lv_wall=wall,
            apex_wall=0.62 * wall,
            rv_width=shape.rv_width * (person.rv_ml / found["rv_endocardium"]) ** 1.1,
            septal_bulge=min(max(thickest - wall, 0.0), 0.55 * radius) if thickest else 0.0,
            **_scaled(shape, "la", la),
            **_scaled(shape, "ra", ra),
        )
    return shape


def _scaled(shape: Shape, atrium: str, ratio: float) -> dict[str, float]:
    """An atrium's radii times ``ratio``, and its middle, which rests on the valve plane."""
    radii = {f"{atrium}_radius_{axis}": 0.0 for axis in "xyz"}
    radii = {name: getattr(shape, name) * ratio for name in radii}
    height = radii[f"{atrium}_radius_z"]
    return radii | {f"{atrium}_z": height - (5.0 if atrium == "ra" else 0.0)}


def _draw_pulse(draws: _Draws, person: Person, heart_rate_bpm: float) -> Pulse:
    """Draw motion amplitudes and timing."""
    scale = (person.lv_ml / 146) ** (1 / 3)
    return Pulse(
        descent_lv=draws.of(13.0, 1.0) * scale,
        descent_rv=draws.of(19.0, 1.3) * scale,
        twist_apex=draws.of(-0.16, 0.025),
        twist_base=draws.of(0.07, 0.012),
        kick=draws.of(0.2, 0.02),
        end_systole=end_systole_phase(heart_rate_bpm) * draws.of(1.0, 0.02),
        kick_onset=kick_onset_phase(heart_rate_bpm),
    )


def _draw_chest(draws: _Draws, person: Person) -> Thorax:
    girth = math.sqrt(person.body_surface_m2 / 1.83) * draws.of(1.0, 0.03)
    return Thorax(
        half_width=172 * girth,
        half_depth=draws.of(118, 4) * girth,
        skin_fat=max(draws.of(15, 4), 4.0),
        mediastinum=draws.of(30, 2),
        diaphragm_z=draws.of(-72, 4),
        aorta_radius=draws.of(10, 0.8),
    )


def _draw_place(draws: _Draws) -> Matrix:
    """Draw the heart's position and direction in the chest."""
    from scipy.spatial.transform import Rotation

    ez = np.array(EZ) / math.sqrt(sum(v * v for v in EZ))
    ex = np.array(EX) - np.dot(EX, ez) * ez
    ex /= np.linalg.norm(ex)
    home = np.column_stack([ex, np.cross(ez, ex), ez])
    lean = np.deg2rad([draws.of(0, 5) for _ in range(3)])
    rotation = Rotation.from_rotvec(lean).as_matrix() @ home
    centre = np.array([draws.of(mean, 4) for mean in CENTRE_MM])
    matrix = np.vstack([np.column_stack([rotation, centre]), (0, 0, 0, 1)])
    return tuple(tuple(float(v) for v in row) for row in matrix)
