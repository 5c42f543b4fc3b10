"""What surrounds the heart of `tests.outside_anatomy`: chest wall, lungs, belly, spine, arms."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tests.outside_anatomy import Kind, Stuff
from tests.outside_people import Body
from tests.outside_shapes import Array, ellipsoid


def chest_stuff(body: Body, p: Array) -> Kind:
    """What the chest is made of at ``(n, 3)`` LPS points, mm, as if it held no heart."""
    x, y, z = p.T
    half = (body.half_width, body.half_depth)
    ring = ((np.abs(x) / half[0]) ** 2.4 + (np.abs(y) / half[1]) ** 2.4) ** (1 / 2.4)
    depth = (1 - ring) * min(half)
    stuff = np.zeros(len(p), np.uint8)
    uneven = body.coarse.at(p)
    skin = body.fat_skin * (0.9 + 0.3 * y / half[1] + 0.05 * uneven)
    stuff[depth > -skin] = Stuff.FAT
    stuff[depth > -1 - 6 * np.exp(-(((np.abs(x) - 60) / 35) ** 2))] = Stuff.MUSCLE
    rib = np.sin((z + 0.35 * np.abs(x) - 0.3 * y + 3 * uneven) * (2 * np.pi / 27))
    shell = (depth > 3) & (depth < 12)
    stuff[shell & (rib > 0.2)] = Stuff.NONE
    stuff[shell & (rib > 0.45) & (depth > 4.5) & (depth < 10.5)] = Stuff.MARROW
    inside = depth > 14
    branch = [w.at(p) for w in body.branches]
    vessel = branch[0] ** 2 + branch[1] ** 2 < 0.03
    stuff[inside] = np.where(vessel, Stuff.BLOOD, Stuff.LUNG)[inside]
    between = np.abs(x - 6 - 6 * uneven) < 5 + 29 / (1 + np.exp((10 - y) / 14))
    if body.fluid:
        stuff[inside & (y > half[1] * (0.75 - 0.04 * body.fluid) + 4 * uneven)] = Stuff.SPINAL_FLUID
    stuff[inside & between] = Stuff.FAT
    _paint_belly(body, p, inside, vessel, stuff)
    _paint_spine(body, p, stuff)
    return stuff


def _paint_belly(
    body: Body, p: Array, inside: npt.NDArray[np.bool_], vessel: npt.NDArray[np.bool_], stuff: Kind
) -> None:
    x, y, z = p.T
    dome = 30 * np.exp(-(((x + 75) / 60) ** 2) - ((y - 10) / 70) ** 2)
    dome += 16 * np.exp(-(((x - 85) / 50) ** 2) - ((y - 30) / 60) ** 2)
    low = z + 60 - body.diaphragm - dome
    belly = inside & (low < 0)
    stuff[belly] = Stuff.MUSCLE
    belly &= low < -3
    stuff[belly] = Stuff.FAT
    liver = belly & (x < 30 + 0.25 * (z + 60) - 0.4 * y + 9 * body.coarse.at(p))
    stuff[liver] = np.where(vessel, Stuff.BLOOD, Stuff.LIVER)[liver]
    spleen = belly & (ellipsoid(p, (108, 48, -95), (30, 45, 48)) < 0)
    stuff[spleen] = Stuff.SPLEEN
    stomach = belly & (ellipsoid(p, (66, -12, -98), (44, 52, 46)) < 0)
    stuff[stomach] = Stuff.STOMACH
    stuff[stomach & (y < -60 + 100 * body.gas)] = Stuff.NONE


def _paint_spine(body: Body, p: Array, stuff: Kind) -> None:
    x, y, z = p.T
    back = 0.62 * body.half_depth
    disc = np.abs(np.mod(z, 28) - 14) < 3.5
    body_gap = np.hypot(x / 1.15, y - back) - 17
    stuff[body_gap < 0] = Stuff.MUSCLE
    stuff[(body_gap < -1.5) & ~disc] = Stuff.MARROW
    stuff[np.hypot(x, y - back - 27) < 15] = Stuff.MARROW
    stuff[np.hypot(x, y - back - 26) < 9] = Stuff.SPINAL_FLUID
    stuff[np.hypot(x, y - back - 26) < 5] = Stuff.MUSCLE
    for side in (-1, 1):
        stuff[np.hypot(x - side * 30, (y - back - 24) / 0.7) < 22] = Stuff.MUSCLE
        if body.arms:
            gap = np.hypot(x - side * (body.half_width + body.fat_skin + 42), y - 12) - 38
            for depth, kind in ((0, Stuff.FAT), (-8, Stuff.MUSCLE), (-26, Stuff.MARROW)):
                stuff[gap < depth] = kind
