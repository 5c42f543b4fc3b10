"""What each illness changes in a person's measures, the heart's outlines and its motion.

Defining measures:

- dilated cardiomyopathy: left ventricle larger than normal by more than two deviations, ejection
  fraction below 40 %. Cohorts imaged by MR had 32 +- 12 % (Mikami et al., J. Cardiovasc. Magn.
  Reson. 18:82, 2016) and 29 +- 12 % (Shams and Sultan, J. Clin. Imaging Sci. 11:40, 2021).
- hypertrophic cardiomyopathy: a wall of 15 mm or more that load does not explain, here the septum
  (definition of Elliott et al., Eur. Heart J. 35:2733-2779, 2014).
- dilated right ventricle: end-diastolic volume of at least 110 ml/m2 in men, 100 ml/m2 in women,
  the task force's major criterion of 2010, with an ejection fraction of at most 45 %, the end of
  its minor one (te Riele et al., J. Cardiovasc. Magn. Reson. 16:50, 2014); the task force asks for
  either, beside a wall that moves wrongly. The volume is drawn so; the fraction follows from the
  stroke, and is more than 45 % in one in eight.
- infarct: a segment in the territory of one coronary artery that does not contract, its wall
  scarred and thinned to less than 5.5 mm, which speaks against viability (Lopez-Lereu et al.,
  Rev. Esp. Cardiol. 57:826-833, 2004).
- enlarged atrium: left atrium larger than normal by more than two deviations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from data_synth.beat import Pulse
from data_synth.kernels import Shape

PATHOLOGIES: tuple[str, ...] = (
    "healthy",
    "dilated_cardiomyopathy",
    "hypertrophic_cardiomyopathy",
    "rv_dilation",
    "infarct",
    "enlarged_atrium",
)
"""Names that ``draw_heart`` knows."""

TERRITORIES = {"anterior": math.radians(65), "lateral": math.radians(180), "inferior": -math.pi / 2}
"""Middle of each coronary territory about the long axis: front with septum, side, back below."""


class Person(NamedTuple):
    """Measures that a person's heart is to have; atria are given at their largest."""

    male: bool
    body_surface_m2: float
    lv_ml: float
    lv_mass_g: float
    lv_ejection: float
    rv_ml: float
    rv_ejection: float
    la_ml: float
    la_emptying: float
    ra_ml: float
    ra_emptying: float
    sinus_mm: float
    ascending_mm: float

    @property
    def stroke_ml(self) -> float:
        """Volume that the left ventricle ejects."""
        return self.lv_ml * self.lv_ejection


Ill = tuple[Person, Shape, Pulse]


def make_ill(
    rng: np.random.Generator, pathology: str, person: Person, shape: Shape, pulse: Pulse
) -> Ill:
    """Change a healthy person's measures, outlines and motion by a pathology's name."""
    if pathology == "dilated_cardiomyopathy":
        return _dilated(rng, person, shape, pulse)
    if pathology == "hypertrophic_cardiomyopathy":
        return _hypertrophic(rng, person, shape, pulse)
    if pathology == "rv_dilation":
        return _right_dilated(rng, person, shape, pulse)
    if pathology == "infarct":
        return _infarct(rng, person, shape, pulse)
    if pathology == "enlarged_atrium":
        return _large_atrium(rng, person, shape, pulse)
    return person, shape, pulse


def _dilated(rng: np.random.Generator, person: Person, shape: Shape, pulse: Pulse) -> Ill:
    """Large, round, weak left ventricle; the right one ejects as little, or as much as it can where
    that is less."""
    # Two deviations above the mean: 218 ml in men, 187 ml in women (Hudsmith et al. 2005).
    lv_ml = (218 if person.male else 187) * rng.uniform(1.08, 1.4)
    longer = (lv_ml / person.lv_ml) ** 0.22
    person = person._replace(
        lv_ml=lv_ml,
        lv_ejection=rng.uniform(0.18, 0.34),
        lv_mass_g=person.lv_mass_g * rng.uniform(1.3, 1.5),
        la_ml=person.la_ml * rng.uniform(1.15, 1.4),
        la_emptying=rng.uniform(0.3, 0.4),
    )
    shape = _moved_aside(shape._replace(lv_length=shape.lv_length * longer), 1.12)
    weak = rng.uniform(0.4, 0.6)
    pulse = pulse._replace(
        descent_lv=pulse.descent_lv * weak,
        descent_rv=pulse.descent_rv * (0.4 + 0.6 * weak),
        twist_apex=pulse.twist_apex * weak,
        twist_base=pulse.twist_base * weak,
    )
    return _equal_strokes(person), shape, pulse


def _hypertrophic(rng: np.random.Generator, person: Person, shape: Shape, pulse: Pulse) -> Ill:
    """Thick septum, other walls as they were; small cavity that empties well."""
    person = person._replace(
        lv_ml=person.lv_ml * rng.uniform(0.82, 0.92),
        lv_ejection=rng.uniform(0.66, 0.74),
        lv_mass_g=person.lv_mass_g * rng.uniform(1.45, 1.65),
        la_ml=person.la_ml * rng.uniform(1.15, 1.35),
    )
    shape = shape._replace(septal_bulge=rng.uniform(17.0, 22.0))
    return _equal_strokes(person), shape, pulse


def _right_dilated(rng: np.random.Generator, person: Person, shape: Shape, pulse: Pulse) -> Ill:
    """Large right ventricle and atrium; what the left ventricle ejects is kept."""
    index = rng.uniform(118, 138) if person.male else rng.uniform(108, 128)
    person = person._replace(
        rv_ml=index * person.body_surface_m2, ra_ml=person.ra_ml * rng.uniform(1.2, 1.4)
    )
    shape = shape._replace(
        ra_x=shape.ra_x + 6.0, tricuspid_radius=1.12 * shape.tricuspid_radius, rv_reach=0.97
    )
    pulse = pulse._replace(descent_rv=pulse.descent_rv * rng.uniform(0.7, 0.85))
    return _equal_strokes(person), shape, pulse


def _infarct(rng: np.random.Generator, person: Person, shape: Shape, pulse: Pulse) -> Ill:
    """One territory thinned, scarred and still."""
    angle = TERRITORIES[str(rng.choice(list(TERRITORIES)))] + rng.uniform(-0.15, 0.15)
    half_angle, height = rng.uniform(0.85, 1.1), rng.uniform(0.5, 0.6)
    half_height = rng.uniform(0.3, 0.38)
    person = person._replace(
        lv_ml=person.lv_ml * rng.uniform(1.08, 1.2), lv_ejection=rng.uniform(0.36, 0.46)
    )
    shape = shape._replace(
        scar_angle=angle,
        scar_half_angle=1.15 * half_angle,
        scar_height=height,
        scar_half_height=1.15 * half_height,
        scar_thinning=rng.uniform(0.42, 0.52),
    )
    pulse = pulse._replace(
        infarct_angle=angle,
        infarct_half_angle=half_angle,
        infarct_height=height,
        infarct_half_height=half_height,
        infarct_strength=1.0,
        descent_lv=pulse.descent_lv * 0.75,
    )
    return _equal_strokes(person), shape, pulse


def _large_atrium(rng: np.random.Generator, person: Person, shape: Shape, pulse: Pulse) -> Ill:
    """Left atrium far above the normal range, stretched and weak."""
    # Two deviations above the mean: 163 ml in men, 131 ml in women (Hudsmith et al. 2005).
    person = person._replace(
        la_ml=(163 if person.male else 131) * rng.uniform(1.06, 1.3),
        la_emptying=rng.uniform(0.28, 0.4),
        ra_ml=person.ra_ml * rng.uniform(1.05, 1.2),
    )
    shape = shape._replace(la_x=shape.la_x - 3.0, la_y=shape.la_y - 3.0, ra_x=shape.ra_x + 4.0)
    return person, shape, pulse._replace(kick=0.6 * pulse.kick)


def _equal_strokes(person: Person) -> Person:
    """Let the right ventricle eject what the left one does, as far as it is filled."""
    return person._replace(rv_ejection=min(person.stroke_ml / person.rv_ml, 0.72))


def _moved_aside(shape: Shape, ratio: float) -> Shape:
    """Right parts farther from the axis of a wide left ventricle."""
    return shape._replace(ra_x=shape.ra_x * ratio, la_x=shape.la_x * ratio)
