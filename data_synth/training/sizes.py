"""The same hearts with chambers of other sizes: what a plane shows, seen through moved pixels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from data_synth.tissue import Tissue
from data_synth.training.contrast import among

Float = npt.NDArray[np.floating]
Label = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
Places = tuple[Float, Float]
"""Row and column in a plane at which each pixel of an image is taken."""

_LEFT = (Tissue.LV_CAVITY, Tissue.PAPILLARY_MUSCLE, Tissue.LV_MYOCARDIUM, Tissue.SCAR)
_RIGHT = (Tissue.RV_CAVITY, Tissue.RV_TRABECULA)

_LEAST_AREA = 150
"""Pixels of a chamber that is well in the plane."""

_LEAST_ROUND = 0.75
"""Share of the circle about it that a ventricle fills where a plane is its short axis."""

_SIZES = {
    Tissue.RV_CAVITY: 0.1,
    Tissue.LEFT_ATRIUM: 0.15,
    Tissue.RIGHT_ATRIUM: 0.15,
    Tissue.AORTA: 0.22,
}
"""How widely the sizes of structures are drawn, apart from the left ventricle's cavity."""


def other_sizes(rng: np.random.Generator, plane: Label, rows: Float, columns: Float) -> Places:
    """Positions that make each other chamber and the aorta wider or narrower, some of the time."""
    for tissue, sd in _SIZES.items():
        if rng.random() < 0.35:
            rows, columns = swollen(rng, plane, rows, columns, tissue, sd)
    return rows.astype(np.float32), columns.astype(np.float32)


def swollen(
    rng: np.random.Generator,
    plane: Label,
    rows: Float,
    columns: Float,
    tissue: Tissue = Tissue.LV_CAVITY,
    sd: float = 0.18,
    factor: float | None = None,
    offset: float = 0.15,
    reach: tuple[float, float] = (0.7, 2.0),
) -> Places:
    """Positions that make a cavity wider or narrower than what surrounds it.

    A radial scaling that fades out: r (1 + a exp(-(r / reach)^2)) rises everywhere while
    -1 < a < 2.2, so nothing folds. ``factor`` is a, positive where the cavity shrinks; by default
    drawn with deviation ``sd``. ``offset``: how far off the cavity's middle that lies, as a
    deviation, and ``reach``: least and most of it, both in radii of the cavity.
    """
    cavity = np.argwhere(plane[::2, ::2] == tissue) * 2.0
    if not len(cavity):
        return rows, columns
    radius = np.sqrt(4 * len(cavity) / np.pi)
    middle = cavity.mean(axis=0) + rng.normal(0.0, offset * radius, 2)
    away_rows, away_columns = rows - middle[0], columns - middle[1]
    reach_px = max(radius, 4.0) * rng.uniform(*reach)
    square = (away_rows**2 + away_columns**2) / reach_px**2
    most = np.clip(rng.normal(0.0, sd), -0.35, 0.5) if factor is None else factor
    change = most * np.exp(-square)
    return rows + change * away_rows, columns + change * away_columns


def ill_shape(rng: np.random.Generator, plane: Label, rows: Float, columns: Float) -> Places:
    """Positions that draw an illness at its worst, some of the time.

    A right ventricle under load, wide and with a flat septum; a left one nearly shut, thicker on
    one side; a wide left one, whose wall is thin.
    """
    chance = rng.random()
    if chance < 0.18:
        if rng.random() < 0.8:
            rows, columns = flat_septum(plane, rows, columns, rng.uniform(0.15, 0.75))
        if rng.random() < 0.8:
            wider = rng.uniform(-0.45, -0.05)
            rows, columns = swollen(rng, plane, rows, columns, Tissue.RV_CAVITY, factor=wider)
    elif chance < 0.28:
        # Within the cavity's own radius: the muscle around it takes the room.
        shut, near = rng.uniform(0.6, 2.0), (0.7, 1.0)
        rows, columns = swollen(rng, plane, rows, columns, factor=shut, offset=0.3, reach=near)
    elif chance < 0.34:
        wide, near = rng.uniform(-0.5, -0.2), (0.9, 1.4)
        rows, columns = swollen(rng, plane, rows, columns, factor=wide, reach=near)
    return rows.astype(np.float32), columns.astype(np.float32)


def flat_septum(plane: Label, rows: Float, columns: Float, flatness: float) -> Places:
    """Positions that push the septum into the left ventricle until it is flat.

    Along the way from the left ventricle's middle to the right one, the arc that faces the right
    ventricle becomes a chord, and what lies on it moves as it is: along that way the septum keeps
    its thickness. The move fades out towards both free walls: nothing folds.

    Parameters
    ----------
    plane
        ``(row, column)`` tissue.
        Unless it cuts the left ventricle across and the right one beside it, nothing moves.
    flatness
        How far the chord lies inside the arc, in radii of the left ventricle, below 1.
    """
    cut = _short_axis(plane)
    if cut is None:
        return rows, columns
    right, middle, towards, radius = cut
    wall = radius - np.sqrt(among(plane, _LEFT[:2]).sum() / np.pi)
    reach = ((np.argwhere(right) - middle) @ towards).max()
    chord = (1 - flatness) * radius
    along = (rows - middle[0]) * towards[0] + (columns - middle[1]) * towards[1]
    across = (columns - middle[1]) * towards[0] - (rows - middle[0]) * towards[1]
    pushed = np.maximum(np.sqrt(np.maximum(radius**2 - across**2, 0)) - chord, 0)
    # The right ventricle's side needs more room than the push is long.
    far = max(reach, chord + 1.5 * flatness * radius)
    fading = np.interp(along, [-radius, chord - wall, chord, far], [0.0, 1.0, 1.0, 0.0])
    moved = pushed * fading
    return rows + moved * towards[0], columns + moved * towards[1]


def other_span(rng: np.random.Generator, plane: Label, rows: Float, columns: Float) -> Places:
    """Positions that let the right ventricle reach farther about the left one, or less far.

    Around the left ventricle's middle angles are stretched on the right ventricle's side, on
    either side of its middle by another factor, and shrunk on the other; that fades out beyond the
    right ventricle. Angles keep their order at every distance: nothing folds.
    """
    cut = _short_axis(plane)
    if cut is None:
        return rows, columns
    right, middle, towards, _ = cut
    across = np.array([-towards[1], towards[0]])
    pixels = np.argwhere(right) - middle
    angles = np.arctan2(pixels @ across, pixels @ towards)
    ends = np.clip(np.percentile(angles, [2, 98]), [-2.6, 0.3], [-0.3, 2.6])
    farther = np.radians(rng.uniform(-15.0, 45.0, 2)) * (-1, 1)
    drawn = np.clip(ends + farther, [-2.9, 0.25], [-0.25, 2.9])
    far = np.percentile(np.linalg.norm(pixels, axis=1), 95)
    away_rows, away_columns = rows - middle[0], columns - middle[1]
    away = np.hypot(away_rows, away_columns)
    angle = np.arctan2(
        away_rows * across[0] + away_columns * across[1],
        away_rows * towards[0] + away_columns * towards[1],
    )
    knots = [-np.pi, drawn[0], 0.0, drawn[1], np.pi]
    turned = np.interp(angle, knots, [-np.pi, ends[0], 0.0, ends[1], np.pi])
    angle += (turned - angle) * np.interp(away, [far, 2 * far], [1.0, 0.0])
    along, beside = away * np.cos(angle), away * np.sin(angle)
    return (
        (middle[0] + along * towards[0] + beside * across[0]).astype(np.float32),
        (middle[1] + along * towards[1] + beside * across[1]).astype(np.float32),
    )


def _short_axis(plane: Label) -> tuple[Mask, Float, Float, float] | None:
    """The right ventricle, the left one's middle, the way from that to the right one's, and the
    left one's radius; None unless the plane cuts the left one across and the right one beside it.
    """
    left, right = among(plane, _LEFT), among(plane, _RIGHT)
    if min(left.sum(), right.sum()) < _LEAST_AREA:
        return None
    middle = np.argwhere(left).mean(axis=0)
    farthest = np.linalg.norm(np.argwhere(left) - middle, axis=1).max()
    if left.sum() < _LEAST_ROUND * np.pi * farthest**2:
        return None
    towards = np.argwhere(right).mean(axis=0) - middle
    towards /= max(float(np.linalg.norm(towards)), 1e-6)
    return right, middle, towards, float(np.sqrt(left.sum() / np.pi))
