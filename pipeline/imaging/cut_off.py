"""Where structures of the heart end because the images do."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from pipeline.geometry import Float32, Label, Mask
from pipeline.imaging.labels import LABELS

BODIES: dict[str, tuple[str, ...]] = {
    "left ventricle": ("lv_cavity", "lv_myocardium"),
    "right ventricle": ("rv_cavity",),
    "left atrium": ("left_atrium",),
    "right atrium": ("right_atrium",),
    "aorta": ("aorta",),
}
"""What a stack may cut off, by name for people."""

LEAST_CUT = 0.1
"""A smaller share of a body's largest cut, on the outermost slice, is its tip."""

GOES_ON, BLUNT = 2 / 3, 0.9
"""Shares of the cut before it that the outermost slice shows of a body that goes on. A paraboloid's
cuts fall in a straight line: two thirds are left two slices from its end. A tip is blunter, but of
40 whole stacks one alone showed more than 0.61 in the median phase."""

EDGE, FEW = 2, 4
"""Pixels from the edge of an image within which what is cut off by it ends, and how many of a body
may lie there for another reason."""


FILLS, SWINGS, STEADY = 0.2, 0.01, 0.005
"""Share of the pixels at the images' sides that a value has in all phases which fills them up; and
of the range of all values by which what splines leave beside it may differ from it, and between
phases: noise differs more, even in the dark of a lung."""


def cut_off(labels: Label) -> dict[str, dict[int, int]]:
    """Where the stack's ends cut structures off: ``{body: {slice: phases in which it goes on}}``.

    A body goes on beyond the outermost slice where its cut there is more than `GOES_ON` of the one
    before: it would end some two slices farther. It is told where it does in half of the phases,
    for a tip comes and goes with noise, or leaves the stack with hardly a smaller cut in any.

    Parameters
    ----------
    labels
        ``(phase, z, y, x)`` on the cine's slices.
    """
    found: dict[str, dict[int, int]] = {}
    last = labels.shape[1] - 1
    for body, names in BODIES.items():
        area = np.isin(labels, [LABELS[name] for name in names]).sum(axis=(2, 3))
        for end, inner in ((0, 1), (last, last - 1)):
            share = area[:, end] / np.maximum(area[:, inner], 1)
            share[area[:, end] < LEAST_CUT * area.max()] = 0
            if (share > GOES_ON).mean() >= 0.5 or share.max() > BLUNT:
                found.setdefault(body, {})[end] = int((share > GOES_ON).sum())
    return found


def cut_sideways(labels: Label, intensity: Float32) -> dict[str, int]:
    """Which structures the edge of the images cuts off, ``{body: phases in which it does}``.

    The edge is that of what was recorded: where pixels are blank throughout, as programs leave them
    that turn, cut or mask images, there is no image.

    Parameters
    ----------
    labels, intensity
        ``(phase, z, y, x)`` on the cine's slices.
    """
    seen = _not_blank(intensity)
    recorded = [ndimage.binary_fill_holes(one) for one in seen]
    rim = ~np.stack([ndimage.binary_erosion(one, iterations=EDGE) for one in recorded])
    found = {}
    for body, names in BODIES.items():
        at_rim = np.isin(labels, [LABELS[name] for name in names]) & rim
        phases = int((at_rim.sum(axis=(2, 3)) > FEW).any(axis=1).sum())
        if phases:
            found[body] = phases
    return found


def _not_blank(intensity: Float32) -> Mask:
    """``(z, y, x)``: what differs in any phase from the value that fills the images' sides, by more
    than a spline swings beside it; without such a value, from the darkest."""
    most, least = intensity.max(axis=0), intensity.min(axis=0)
    sides = np.s_[:, [0, -1], :], np.s_[:, :, [0, -1]]
    top, low = (np.concatenate([one[side].ravel() for side in sides]) for one in (most, least))
    values, counts = np.unique(top[top == low], return_counts=True)
    if not len(values) or counts.max() < FILLS * len(top):
        return np.asarray(most > intensity.min())
    fill = values[counts.argmax()]
    dark, bright = np.percentile(intensity[..., ::2, ::3], [1, 99])
    off = np.maximum(most - fill, fill - least)
    blank = (off <= SWINGS * (bright - dark)) & (most - least <= STEADY * (bright - dark))
    return np.asarray(~blank)
