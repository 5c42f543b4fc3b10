"""Slices across the left ventricle, drawn through those that lie another way: reformation.

The network knows short-axis slices. A 3D cine may be acquired in any planes, and so are some
stacks. The axis is found by looking: the left ventricle that shows even in slices along it has a
principal axis, slices drawn across that show it better, and so on until the axis changes no more.
How much of its cavity lies in a ring of muscle tells how well slices show it.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from pipeline.errors import StageError
from pipeline.geometry import Float, Float32, Label, Mask, transform_points
from pipeline.imaging.cine import Cine
from pipeline.imaging.cleanup import THREADS
from pipeline.imaging.faults import LEAST_VIEW_MM
from pipeline.imaging.inference import PlaneProbability, label_probability, move_in_time
from pipeline.imaging.interpolation import class_margins
from pipeline.imaging.labels import CAVITY, MUSCLE, most_probable
from pipeline.imaging.locating import in_a_ring, locate_heart, tried_phases
from pipeline.imaging.network import CLASSES
from pipeline.imaging.settings import THIN_MM
from pipeline.imaging.view import Orientation, canonical_axes
from pipeline.progress import Progress

USUAL_AXIS = np.array([-1.0, 1.0, 1.0]) / np.sqrt(3)
"""From the apex to the base: right, posterior and up, as in most people lying in the scanner."""

FARTHEST_DEG = 40.0
"""Slices whose normal is nearer to the usual axis were planned across the heart; 55 degrees off is
that of transverse, sagittal and coronal ones, and of those of files that tell no directions."""

ALONG_DEG = 35.0
"""Slices whose normal is nearer to the left ventricle's axis as it shows in them are left as they
are: by up to 13 degrees in short axis, 50 to 75 in slices across the body."""

RINGED = 0.8
"""So are slices in which more of the cavity is ringed by muscle: in short axis 0.9 and more is, in
slices across the body 0.4 to 0.7."""

WIDEST_MM = 12.0
"""Through slices farther apart none are drawn; 10 mm were tried."""

COARSE_MM, COARSE_STEP_MM = 2.0, 8.0
"""Pixels, and distance of the slices, in which the axis is sought."""

STEP_MM, THIN_STEP_MM = 3.0, 2.0
"""Distance of the slices drawn along the axis found, half the thickness that the network knows, and
a third of it where those that they are drawn through are thin, too: by that muscle, atria and right
ventricle gain 0.002 of Dice."""

OWN_SHARE = 0.3
"""Of what the acquired slices themselves show, where they are thin, in the mean with slices drawn
through them: sharper, and seen from another side. Of four phantoms and three people of another
renderer the right atrium gains 0.004 to 0.010 of Dice, the right ventricle -0.001 to 0.006, muscle
-0.003 to 0.013; at 0.5 the ventricles lose."""

SETTLED_DEG, MOST_LOOKS = 3.0, 4
"""The axis is found when a look would change it by less, or after so many."""

AS_MUCH = 0.9
"""A look along a better axis may show less in rings, by chance, than the one that told it: which
slices cut the valves changes with it."""

ALONG_MM, ASIDE_MM = 15.0, 60.0
"""Room drawn along the axis and across it around the heart that was seen."""


@dataclass(frozen=True, slots=True)
class Reformation:
    """A cine as slices across the left ventricle."""

    cine: Cine
    """Slices `STEP_MM` or `THIN_STEP_MM` apart, from the apex to the base; beyond what was
    acquired, what is seen at its sides."""

    acquired: Cine
    """As it was given."""

    tilt_deg: float
    """Angle between the normal of the acquired slices and the left ventricle's axis."""


def reformat_to_short_axis(cine: Cine) -> Reformation | None:
    """Slices across the left ventricle, drawn through a cine whose own lie another way.

    None where its own lie across the left ventricle, show none, or are too far apart or too few,
    and where none drawn through them show it better.
    """
    if _angle_deg(_normal(cine), USUAL_AXIS) < FARTHEST_DEG:
        return None
    step_mm = float(cine.spacing_mm[2])
    if step_mm > WIDEST_MM or step_mm * cine.intensity.shape[1] < LEAST_VIEW_MM:
        return None
    few = _of_two_phases(cine)
    own = _look(_of_few_slices(few), _normal(cine))
    if own is None or own.tilt_deg < ALONG_DEG or own.ringed_mm3 > RINGED * own.cavity_mm3:
        return None
    best = _best_look(few, own)
    if best is None or best.ringed_mm3 < AS_MUCH * own.ringed_mm3:
        return None
    room_mm = (ASIDE_MM, ASIDE_MM, ALONG_MM)
    low_mm, high_mm = _extent_within(cine, best.heart_mm, best.along, room_mm)
    pixel_mm = float(cine.spacing_mm.min())
    steps_mm = (pixel_mm, pixel_mm, THIN_STEP_MM if step_mm <= THIN_MM else STEP_MM)
    across = _drawn_along(_of_one_beat(cine), best.along, low_mm, high_mm, steps_mm)
    return Reformation(across, cine, _angle_deg(own.along, best.along))


@dataclass(frozen=True, slots=True)
class _Look:
    """What a first look at some slices shows."""

    along: Float
    """Normal of the slices, a unit vector."""

    axis: Float
    """Principal axis of the left ventricle's cavity, a unit vector."""

    cavity_mm3: float
    """Its volume, of both phases together."""

    ringed_mm3: float
    """As much of it as muscle encloses in the slices."""

    heart_mm: Float
    """``(n, 3)`` points of the heart, LPS."""

    @property
    def tilt_deg(self) -> float:
        """Angle between the slices' normal and the left ventricle's axis."""
        return _angle_deg(self.along, self.axis)


def _look(cine: Cine, along: Float, acquired: Cine | None = None) -> _Look | None:
    """Look at slices, drawn through ``acquired`` ones or acquired themselves; None where they show
    no left ventricle."""
    try:
        place = locate_heart(cine)
    except StageError:
        return None
    found = label_probability(cine, place.view, 1)
    if acquired is not None:
        clear_beyond(found, acquired)
    drawn = found.drawn()
    ventricle = _largest_body((drawn == CAVITY) | (drawn == MUSCLE))
    cavity = ventricle & (drawn == CAVITY)
    if cavity.any(axis=0).sum() < 2:
        return None
    mr_from_planes = _mr_from_planes(found)
    # Of the planes of a slice, labels are those of the middle one.
    mr_from_slices = mr_from_planes.copy()
    mr_from_slices[:3, 2] *= found.planes_a_slice
    mr_from_slices[:3, 3] += found.planes_a_slice // 2 * mr_from_planes[:3, 2]

    def places_mm(mask: Mask) -> Float:
        return transform_points(mr_from_slices, np.argwhere(mask)[:, ::-1].astype(float))

    axis = np.linalg.eigh(np.cov(places_mm(cavity.any(axis=0)).T))[1][:, -1]
    images = drawn.reshape(-1, *drawn.shape[2:])
    ringed = cavity & np.stack([in_a_ring(one) for one in images]).reshape(drawn.shape)
    voxel_mm3 = float(np.abs(np.linalg.det(mr_from_slices[:3, :3])))
    parts, _ = ndimage.label((drawn > 0).any(axis=0))
    of_heart = np.unique(parts[ventricle.any(axis=0)])
    return _Look(
        along,
        np.asarray(axis if axis @ along >= 0 else -axis),
        float(cavity.sum()) * voxel_mm3,
        float(ringed.sum()) * voxel_mm3,
        places_mm(np.isin(parts, of_heart)),
    )


def _best_look(few: Cine, own: _Look) -> _Look | None:
    """Of looks along two axes, the one that shows most of the left ventricle's cavity in a ring;
    then along the axis that it shows, as long as that shows about as much."""
    first = [_look_along(few, axis, own) for axis in (own.axis, USUAL_AXIS)]
    best = max(filter(None, first), key=lambda one: one.ringed_mm3, default=None)
    for _ in range(MOST_LOOKS):
        if best is None or best.tilt_deg < SETTLED_DEG:
            break
        seen = _look_along(few, best.axis, own)
        if seen is None or seen.ringed_mm3 < AS_MUCH * best.ringed_mm3:
            break
        best = seen
    return best


def _look_along(few: Cine, axis: Float, own: _Look) -> _Look | None:
    """Look at slices across an axis, drawn through those of two phases about where their own showed
    a heart; None where these show none."""
    low_mm, high_mm = _extent_within(few, own.heart_mm, axis, (ASIDE_MM, ASIDE_MM, ASIDE_MM))
    drawn = _drawn_along(few, axis, low_mm, high_mm, (COARSE_MM, COARSE_MM, COARSE_STEP_MM))
    return _look(drawn, axis, few)


def _of_two_phases(cine: Cine) -> Cine:
    chosen = tried_phases(cine)
    return replace(cine, intensity=cine.intensity[chosen], phases=cine.phases[chosen], moments=None)


def _of_few_slices(cine: Cine) -> Cine:
    """Slices about `COARSE_STEP_MM` apart, where they lie closer."""
    by = max(1, round(COARSE_STEP_MM / float(cine.spacing_mm[2])))
    mr_from_index = cine.mr_from_index.copy()
    mr_from_index[:3, 2] *= by
    few = cine.intensity[:, ::by]
    return replace(cine, intensity=few, mr_from_index=mr_from_index, interpolated=())


def _of_one_beat(cine: Cine) -> Cine:
    """All slices at the phases of the mean beat, for slices across them show one moment."""
    if cine.moments is None:
        return cine
    intensity = cine.intensity.copy()
    for number, seen in enumerate(cine.moments):
        move_in_time(intensity[:, number], seen, cine.phases)
    return replace(cine, intensity=intensity, moments=None)


def _normal(cine: Cine) -> Float:
    across, down = cine.mr_from_index[:3, :2].T
    return np.asarray(canonical_axes(np.cross(across, down))[2])


def _angle_deg(one: Float, other: Float) -> float:
    return float(np.degrees(np.arccos(np.clip(one @ other, -1, 1))))


def _largest_body(mask: Mask) -> Mask:
    """In each phase the largest connected part of ``(phase, slice, row, column)``."""
    best = np.zeros_like(mask)
    for phase, one in enumerate(mask):
        parts, count = ndimage.label(one)
        if count:
            best[phase] = parts == np.bincount(parts.ravel())[1:].argmax() + 1
    return best


def _corners_mm(cine: Cine) -> Float:
    last = np.array(cine.intensity.shape[:0:-1]) - 1
    return transform_points(cine.mr_from_index, np.array(list(np.ndindex(2, 2, 2))) * last)


def _extent_within(
    cine: Cine, points_mm: Float, axis: Float, room_mm: tuple[float, float, float]
) -> tuple[Float, Float]:
    """Least and largest place of points along the axes of slices across ``axis``, with room as far
    as the cine reaches."""
    axes = canonical_axes(axis)
    along_mm, known_mm = points_mm @ axes.T, _corners_mm(cine) @ axes.T
    return (
        np.maximum(along_mm.min(axis=0) - room_mm, known_mm.min(axis=0)),
        np.minimum(along_mm.max(axis=0) + room_mm, known_mm.max(axis=0)),
    )


def _drawn_along(
    cine: Cine, axis: Float, low_mm: Float, high_mm: Float, steps_mm: tuple[float, float, float]
) -> Cine:
    """Slices across ``axis`` through others, by cubic splines, apex first."""
    axes = canonical_axes(axis)
    shape = np.ceil((high_mm - low_mm) / steps_mm).astype(int) + 1
    mr_from_index = np.eye(4)
    mr_from_index[:3, :3] = axes.T * steps_mm
    mr_from_index[:3, 3] = low_mm @ axes
    index_from_drawn = np.linalg.inv(cine.mr_from_index) @ mr_from_index
    places = _places(index_from_drawn, shape[::-1].tolist())
    # Beyond them goes on what is seen at its sides.
    last = np.array(cine.intensity.shape[1:]) - 1
    places = np.clip(places, 0, last[:, None, None, None])

    def drawn(image: Float32) -> Float32:
        coefficients = ndimage.spline_filter(image, output=np.float32)
        return np.asarray(
            ndimage.map_coordinates(coefficients, places, np.float32, prefilter=False)
        )

    with ThreadPoolExecutor(THREADS) as pool:
        intensity = np.stack(list(pool.map(drawn, cine.intensity)))
    return Cine(intensity, mr_from_index, cine.phases, cine.rr_s)


def _places(target_from_index: Float, shape: Sequence[int]) -> Float:
    """Of a grid ``(plane, row, column)``: places ``(3, ...)`` along a target's ``z, y, x``."""
    z, y, x = np.indices(shape, float)
    points = transform_points(target_from_index, np.stack([x, y, z], axis=-1))
    return np.moveaxis(points[..., ::-1], -1, 0)


def _lie_on(shape: Sequence[int], places: Float, beside: float = 0.0) -> Mask:
    """Which places ``(3, ...)`` lie on an array ``(z, y, x)``, or ``beside`` pixels off at most."""
    last = np.reshape(shape, (3, 1, 1, 1)) - 1
    return np.asarray(((places >= -beside) & (places <= last + beside)).all(axis=0))


def _shape_of_planes(found: PlaneProbability) -> tuple[int, int, int]:
    planes, _, rows, columns = found.value.shape[1:]
    return planes, rows, columns


def _mr_from_planes(found: PlaneProbability) -> Float:
    """4x4: ``(column, row, plane)`` of the labelled planes to LPS mm."""
    view = found.view
    step_mm = view.slice_step_mm / found.planes_a_slice
    mr_from_planes = np.eye(4)
    mr_from_planes[:3, :3] = view.axes.T * (view.pixel_mm, view.pixel_mm, step_mm)
    mr_from_planes[:3, 3] = view.corner_mm + found.plane_mm[0] * view.axes[2]
    return mr_from_planes


def clear_beyond(found: PlaneProbability, acquired: Cine) -> None:
    """Make background certain where nothing was acquired, in place."""
    index_from_planes = np.linalg.inv(acquired.mr_from_index) @ _mr_from_planes(found)
    places = _places(index_from_planes, _shape_of_planes(found))
    beyond = ~_lie_on(acquired.intensity.shape[1:], places, 0.5)
    for plane, none in enumerate(beyond):
        found.value[:, plane, :, none] = np.eye(CLASSES, dtype=np.float32)[0]


def mix_in_own(
    found: PlaneProbability,
    acquired: Cine,
    orientation: Orientation,
    progress: Progress | None = None,
) -> None:
    """Take the mean with what thin acquired slices themselves show, in place.

    Nothing is mixed in where they show no heart as they are, or one that lies otherwise than that
    in the slices drawn through them (``orientation``). One phase is in memory at a time;
    ``progress`` is told of the phases done.
    """
    acquired = _of_one_beat(acquired)
    try:
        place = locate_heart(acquired)
    except StageError:
        return
    if place.orientation != orientation:
        return
    places = None
    for phase, drawn in enumerate(found.value):
        only = slice(phase, phase + 1)
        one = replace(acquired, intensity=acquired.intensity[only], phases=acquired.phases[only])
        own = label_probability(one, place.view, 1)
        if places is None:
            own_from_planes = np.linalg.inv(_mr_from_planes(own)) @ _mr_from_planes(found)
            places = _places(own_from_planes, _shape_of_planes(found))
            share = OWN_SHARE * _lie_on(_shape_of_planes(own), places)
        for number in range(CLASSES):
            seen = ndimage.map_coordinates(own.value[0, :, number], places, np.float32, order=1)
            drawn[:, number] += share * (seen - drawn[:, number])
        if progress is not None:
            progress(phase + 1, len(found.value))


def labels_on_acquired(found: PlaneProbability, acquired: Cine) -> Label:
    """Labels ``(phase, z, y, x)`` on the acquired pixels, from those of slices drawn through them.

    By how much each class leads is interpolated from plane to plane, as outlines are.
    """
    planes_from_index = np.linalg.inv(_mr_from_planes(found)) @ acquired.mr_from_index
    places = _places(planes_from_index, acquired.intensity.shape[1:])
    within = _lie_on(_shape_of_planes(found), places)
    shown = places[:, within]

    def labels(planes: Float32) -> Label:
        margins = np.stack([class_margins(plane) for plane in planes], axis=1)
        lead = [ndimage.map_coordinates(one, shown, np.float32, order=1) for one in margins]
        drawn = np.zeros(within.shape, np.uint8)
        drawn[within] = most_probable(np.stack(lead), axis=0)
        return drawn

    with ThreadPoolExecutor(THREADS) as pool:
        return np.stack(list(pool.map(labels, found.value)))


def confidence_on_acquired(
    confidence: Float, found: PlaneProbability, acquired: Cine, labels: Label
) -> Float:
    """Confidence ``(phase, z)`` of the acquired slices: the mean of that of the drawn ones
    ``(phase, slice)`` over the heart on them; where they show none, over all their pixels.
    """
    view = found.view
    heights = np.array([*view.axes[2] @ acquired.mr_from_index[:3, :3], 0.0])
    heights[3] = view.axes[2] @ (acquired.mr_from_index[:3, 3] - view.corner_mm)
    slices, rows, columns = acquired.intensity.shape[1:]
    z, y, x = np.ogrid[:slices, :rows, :columns]
    number = (heights[0] * x + heights[1] * y + heights[2] * z + heights[3]) / view.slice_step_mm
    nearest = np.clip(np.rint(number).astype(int), 0, confidence.shape[1] - 1)
    own = np.empty((len(labels), labels.shape[1]))
    for phase, drawn in enumerate(labels):
        sure, heart = confidence[phase][nearest], drawn > 0
        count = heart.sum(axis=(1, 2))
        mean = (sure * heart).sum(axis=(1, 2)) / np.maximum(count, 1)
        own[phase] = np.where(count > 0, mean, sure.mean(axis=(1, 2)))
    return own
