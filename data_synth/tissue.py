"""Names of everything the phantom is made of."""

from enum import IntEnum

import numpy as np
import numpy.typing as npt


class Tissue(IntEnum):
    """What a point of the phantom is made of."""

    AIR = 0
    FAT = 1
    MUSCLE = 2
    LUNG = 3
    BONE = 4
    LIVER = 5
    BLOOD_VESSEL = 6
    LV_CAVITY = 7
    LV_MYOCARDIUM = 8
    RV_CAVITY = 9
    RV_WALL = 10
    LEFT_ATRIUM = 11
    RIGHT_ATRIUM = 12
    ATRIAL_WALL = 13
    AORTA = 14
    VESSEL_WALL = 15
    STOMACH = 16
    PAPILLARY_MUSCLE = 17
    RV_TRABECULA = 18
    PERICARDIUM = 19
    GAS = 20
    SPLEEN = 21
    LEAFLET = 22
    SCAR = 23


TRUTH_LABELS: dict[str, tuple[int, Tissue]] = {
    "lv_cavity": (1, Tissue.LV_CAVITY),
    "lv_myocardium": (2, Tissue.LV_MYOCARDIUM),
    "rv_cavity": (3, Tissue.RV_CAVITY),
    "left_atrium": (4, Tissue.LEFT_ATRIUM),
    "right_atrium": (5, Tissue.RIGHT_ATRIUM),
    "aorta": (6, Tissue.AORTA),
}
"""Name -> (value in label files, tissue); every other tissue is background, 0."""

COUNTED_AS: dict[Tissue, Tissue] = {
    Tissue.PAPILLARY_MUSCLE: Tissue.LV_CAVITY,
    Tissue.RV_TRABECULA: Tissue.RV_CAVITY,
    Tissue.SCAR: Tissue.LV_MYOCARDIUM,
}
"""Tissues that readers count to another: papillary muscles and trabeculae lie inside the smooth
contour of the cavity, as reference ranges are measured (Petersen et al., 2017)."""


def truth_values() -> npt.NDArray[np.uint8]:
    """Value in the label files of every tissue, indexed by tissue value."""
    table = np.zeros(len(Tissue), np.uint8)
    for value, tissue in TRUTH_LABELS.values():
        table[tissue] = value
    for part, whole in COUNTED_AS.items():
        table[part] = table[whole]
    return table
