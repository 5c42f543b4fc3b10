"""What lies inside the cavities and walls at the R peak: papillary muscles, trabeculae, scar.

All of it is looked up only at points already inside a cavity or the left wall, so none of it can
reach out of the smooth bodies whose surfaces are the truth meshes.
"""

from __future__ import annotations

import math

from data_synth.kernels import Shape, Tubes, inner
from data_synth.primitives import box_distance, smooth_step, tube
from data_synth.profiles import is_round, scar_share
from data_synth.tissue import Tissue

LV_CAVITY = int(Tissue.LV_CAVITY)
LV_MYOCARDIUM = int(Tissue.LV_MYOCARDIUM)
RV_CAVITY = int(Tissue.RV_CAVITY)
PAPILLARY_MUSCLE = int(Tissue.PAPILLARY_MUSCLE)
RV_TRABECULA = int(Tissue.RV_TRABECULA)
SCAR = int(Tissue.SCAR)

SCAR_SHARE = 0.1
"""Muscle is scar where the infarct's share (1 in its middle, 0 at its rim) is above this."""
BOX_LEFT, BOX_RIGHT = 9, 11
"""Rows of Tubes.boxes: the first papillary muscle of the left, the moderator band."""


@inner
def ridges(x: float, y: float, z: float, count: float) -> float:
    """Uneven pattern of muscular ridges along the axis that lean, fork and cross: 0 to 1.

    ``count`` is about how many go round. The waves have no common period along the axis.
    """
    angle = math.atan2(y, x)
    lean = angle + 0.25 * math.sin(2 * angle + z / 11)
    first = math.cos(count * lean + z / 7.3)
    second = math.cos((count - 4) * lean - z / 5.1 + 1.0)
    third = math.cos((count + 5) * angle + z / 9.7 + 2.0)
    return 0.5 + (first + second + 0.8 * third) / 5.6


@inner
def lv_lining(x: float, y: float, z: float, depth: float, shape: Shape, tubes: Tubes) -> int:
    """Tissue ``depth`` mm inside the left cavity."""
    boxes = tubes.boxes
    if box_distance(x, y, z, boxes[BOX_LEFT]) == 0.0 and tube(x, y, z, tubes.anterolateral) < 0:
        return PAPILLARY_MUSCLE
    if box_distance(x, y, z, boxes[BOX_LEFT + 1]) == 0.0 and tube(x, y, z, tubes.posteromedial) < 0:
        return PAPILLARY_MUSCLE
    low = -z / shape.lv_length
    if low < 0.55 or depth > shape.trabeculae:
        return LV_CAVITY
    long = shape.trabeculae * smooth_step((low - 0.55) / 0.35)
    return PAPILLARY_MUSCLE if depth < 1.6 * long * (ridges(x, y, z, 9) - 0.45) else LV_CAVITY


@inner
def rv_lining(x: float, y: float, z: float, depth: float, shape: Shape, tubes: Tubes) -> int:
    """Tissue ``depth`` mm inside the right ventricle."""
    boxes = tubes.boxes
    if box_distance(x, y, z, boxes[BOX_RIGHT]) == 0.0 and tube(x, y, z, tubes.moderator) < 0:
        return RV_TRABECULA
    if (
        box_distance(x, y, z, boxes[BOX_RIGHT + 1]) == 0.0
        and tube(x, y, z, tubes.right_papillary) < 0
    ):
        return RV_TRABECULA
    low = -z / shape.lv_length
    longest = 1.5 * shape.trabeculae
    if low < 0.1 or depth > longest:
        return RV_CAVITY
    long = longest * (0.3 + 0.7 * smooth_step((low - 0.1) / 0.6)) * smooth_step((low - 0.1) / 0.15)
    return RV_TRABECULA if depth < 1.6 * long * (ridges(x, y, z, 19) - 0.4) else RV_CAVITY


@inner
def lv_wall(x: float, y: float, z: float, shape: Shape) -> int:
    """Tissue of the left wall: muscle or scar."""
    if is_round(shape):
        return LV_MYOCARDIUM
    share = scar_share(z, math.atan2(y, x), shape)[0]
    return SCAR if share > SCAR_SHARE else LV_MYOCARDIUM
