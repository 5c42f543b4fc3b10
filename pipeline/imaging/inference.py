"""Run the network over a cine: label all slices and phases of a view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np

from pipeline.geometry import Float, Float32, Integer, Label
from pipeline.imaging.cine import Cine
from pipeline.imaging.flicker import doubted_planes
from pipeline.imaging.labels import LABELS, most_probable
from pipeline.imaging.network import (
    CLASSES,
    PLANES,
    neighbour_steps,
    neighbours,
    normalise,
    normalise_locally,
    predict,
    side_by_side,
)
from pipeline.imaging.phases import around_phases
from pipeline.imaging.view import View
from pipeline.progress import Progress

THICKNESS_MM = 6.0
"""Slices that lie closer are averaged over this, the thickness that the network knows."""

MOST_AT_ONCE = 16
"""Slices that a thread looks at, at most: what it holds meanwhile is some 100 MB."""

LOOKS = 700
"""Images that the network is shown in a study, about, where some can be shown in several ways."""


TURNS_DEG = (10.0, -20.0, 0.0, -10.0, 20.0)
"""In-plane turns in which images are shown, in the order in which they are taken; every other
phase is turned the other way, so that what is mixed with its neighbours in time (`blend_phases`)
has been seen in up to twice as many ways. Well within the turns of training. Other scales, shifts
of half a pixel and other grey scales were tried and gain less or nothing."""

ALONE_DEG = 0.0
"""Of several turns, the one in which the half of the slices nearest the apex is shown without the
neighbour towards it, as if the stack began with each: what lies beyond the tip misleads. Muscle
gains up to 0.004 of Dice; the atria, which lie in the other half, would lose by it."""


BRIEF = 12
"""The right atrium reaches a place for longer than this part of a beat: one of so many."""

ONE_MOMENT = 0.01
"""Share of a beat, some 8 ms, by which slices are at one moment."""

GAP = 0.1
"""Share of a beat from phase to phase over which walls move by more than their blur."""

LEAST_PASSED = 0.1
"""Where either right chamber is never so probable their valve does not pass."""


@dataclass(frozen=True, slots=True)
class PlaneProbability:
    """Class probabilities on parallel planes through the cycle."""

    value: Float32
    """``(phase, plane, class, row, column)``, the plane nearest the apex first."""

    view: View
    """Where rows, columns and slices lie in the patient."""

    planes_a_slice: int
    """3 where the network's planes between slices are used, else 1."""

    @property
    def plane_mm(self) -> Float:
        """Heights of the planes along the view's normal above its corner, ``(plane,)``."""
        step_mm, count = self.view.slice_step_mm, self.planes_a_slice
        first_mm = -(count // 2) * step_mm / count
        return np.asarray(first_mm + step_mm / count * np.arange(self.value.shape[1]))

    def at_slices(self, phase: int) -> Float32:
        """Probabilities on the slices themselves, ``(slice, class, row, column)``."""
        middle = self.planes_a_slice // 2
        return self.value[phase, middle :: self.planes_a_slice]

    def of_slice(self, phase: int, number: int) -> Float32:
        """Probabilities on the planes of a slice, ``(plane, class, row, column)``, to be changed.

        ``number`` counts slices from the apex.
        """
        first = number * self.planes_a_slice
        return self.value[phase, first : first + self.planes_a_slice]

    def drawn(self) -> Label:
        """Most probable labels on the slices, ``(phase, slice, row, column)``."""
        return np.stack([most_probable(self.at_slices(k)) for k in range(len(self.value))])


def darkest_grey(intensity: Float32) -> np.float32:
    """What stands for no signal: one value in a hundred is darker.

    Programs that shift grey values leave it anywhere; greys are shares of muscle's or blood's only
    above it.
    """
    return np.float32(np.percentile(intensity[..., ::2, ::3], 1))


def sampled_slice(cine: Cine, view: View, phase: int, number: int) -> Float32:
    """One slice's image on the view; where slices are thin, the average over a thickness."""
    together = max(1, round(THICKNESS_MM / view.slice_step_mm))
    near = range(max(0, number - together // 2), min(len(view.order), number + together // 2 + 1))
    # An even number of slices lies evenly about the one when the outer two count half.
    weights = [min(1.0, (together + 1) / 2 - abs(one - number)) for one in near]
    images = [view.sample(cine.intensity[phase, view.order[one]], one) for one in near]
    return np.asarray(np.average(images, axis=0, weights=weights), np.float32)


def network_images(
    cine: Cine,
    view: View,
    phase: int,
    chosen: Sequence[int],
    local: bool = False,
    alone: bool = False,
) -> Float32:
    """What `predict` takes for some slices, counted from the apex.

    ``local`` is for a whole field, where grey values are normalised part by part; ``alone`` shows
    each slice of the half nearest the apex in place of its neighbour towards it.
    """
    step, last = neighbour_steps(view.slice_step_mm), len(view.order) - 1
    needed = {near for one in chosen for near in neighbours(one, step, last)}
    images = {}
    for number in sorted(needed):
        known = view.holds(number, cine.intensity.shape[2:])
        image = sampled_slice(cine, view, phase, number)
        images[number] = (normalise_locally if local else normalise)(image, known)
    shown = []
    for one in chosen:
        before, own, after = neighbours(one, step, last)
        shown.append((own if alone and 2 * own < last else before, own, after))
    return np.stack([np.stack([images[near] for near in three]) for three in shown])


def label_probability(
    cine: Cine, view: View, most_views: int, progress: Progress | None = None
) -> PlaneProbability:
    """Probabilities of all classes in all phases on the planes that the slices give.

    Each slice gives three planes where its neighbours are the stack's own; where slices lie
    closer than that, only its own. Images are shown turned in up to ``most_views`` ways
    (`turns_deg`), whose probabilities are averaged: in as many as there is time for, and in more,
    all of them where few images are doubted, where labels come and go from phase to phase
    (`doubted_planes`).
    """
    step = neighbour_steps(view.slice_step_mm)
    planes = PLANES if step == 1 else 1
    phases, slices = len(cine.intensity), len(view.order)
    count = count_turns(phases * slices, most_views)
    value = np.zeros((phases, slices * planes, CLASSES, *view.shape), np.float32)
    total = value.reshape(phases, slices, planes, CLASSES, *view.shape)

    def look(phase: int, chosen: Sequence[int], turns: Sequence[float], before: int = 0) -> None:
        """Take turns into the mean over the ``before`` that were seen."""
        seen = total[phase, chosen] * np.float32(before)
        for turn_deg in turns:
            alone = count > 1 and turn_deg == ALONE_DEG
            chance = _predicted(cine, view, phase, chosen, turn_deg, alone)
            seen += chance[:, _kept(planes)]
        total[phase, chosen] = seen / np.float32(before + len(turns))

    def look_first(piece: tuple[int, Sequence[int]]) -> None:
        phase, chosen = piece
        look(phase, chosen, turns_deg(phase, count))

    def look_again(piece: tuple[int, Sequence[int]]) -> None:
        phase, chosen = piece
        look(phase, chosen, more_turns_deg(phase, count, most_views, phases * len(doubted)), count)

    parts = _parts(range(slices))
    with side_by_side() as pool:
        done = pool.map(look_first, product(range(phases), parts))
        for number, _ in enumerate(done, start=1):
            if progress is not None and number % len(parts) == 0:
                progress(number // len(parts), phases)
        every = doubted_planes(value, view.pixel_mm).reshape(slices, planes).any(axis=1)
        doubted = np.flatnonzero(every)
        list(pool.map(look_again, product(range(phases), _parts(doubted))))
    return PlaneProbability(value, view, planes)


def _parts(slices: Sequence[int] | Integer) -> list[list[int]]:
    """Slices shared out among threads: in halves, so that of an odd number of phases as much falls
    to each of two; many in smaller parts, for memory."""
    count = min(max(2, -(-len(slices) // MOST_AT_ONCE)), len(slices))
    return [part.tolist() for part in np.array_split(slices, count)] if count else []


def count_turns(images: int, most: int) -> int:
    """In how many ways each of ``images`` is shown, at most ``most``, at least 1."""
    return int(np.clip(round(LOOKS / images), 1, min(most, len(TURNS_DEG))))


def turns_deg(phase: int, count: int) -> tuple[float, ...]:
    """The ``count`` turns in which the images of a phase are shown; a single one is none."""
    if count == 1:
        return (0.0,)
    way = -1 if phase % 2 else 1
    return tuple(way * turn_deg for turn_deg in TURNS_DEG[:count])


def more_turns_deg(phase: int, count: int, most: int, images: int) -> tuple[float, ...]:
    """Turns in which the doubted among a phase's images are shown, too, after ``count`` others.

    ``images`` are doubted in all; they are shown up to about twice `LOOKS` times more, and each at
    least once.
    """
    others = [one for one in turns_deg(phase, most) if one not in turns_deg(phase, count)]
    return tuple(others[: max(1, round(2 * LOOKS / images))])


def _kept(planes: int) -> slice:
    """Which of the network's planes are used: all, or the middle one."""
    return slice(None) if planes == PLANES else slice(PLANES // 2, PLANES // 2 + 1)


def _predicted(
    cine: Cine, view: View, phase: int, chosen: Sequence[int], turn_deg: float, alone: bool
) -> Float32:
    """Probabilities ``(slice, plane, class, row, column)`` on the view, seen turned."""
    seen = view.varied(turn_deg) if turn_deg else view
    chance = predict(network_images(cine, seen, phase, chosen, alone=alone))
    if not turn_deg:
        return chance
    matrix = view.pixels_of(seen)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    carried = np.empty_like(chance)
    for place in np.ndindex(*chance.shape[:3]):
        carried[place] = cv2.warpAffine(chance[place], matrix, view.shape[::-1], flags=flags)
    # Outside what was seen nothing is probable: there background is what remains of 1.
    carried[:, :, 0] = 1 - carried[:, :, 1:].sum(axis=2)
    return carried


def settle_tricuspid(value: Float32) -> None:
    """Give the right ventricle what its atrium reaches for a moment alone, in place.

    The valve goes towards the apex once a beat and stays there for a while, but as it opens its
    leaflets look like the ventricle's end. Where the atrium's share in what the two have is larger
    than its median over two twelfths of the beat, that median is taken. Of cines of fewer phases
    than twelve nothing is taken. The mitral valve is left alone: there nothing is gained.

    Parameters
    ----------
    value
        ``(phase, plane, class, row, column)``, all phases of a beat.
    """
    reach = len(value) // BRIEF
    if not reach:
        return
    around = np.arange(len(value)) + np.arange(-reach, reach + 1)[:, None]
    pair = [LABELS["right_atrium"], LABELS["rv_cavity"]]
    ever = [value[:, :, k].max(axis=0) for k in pair]
    passed = np.minimum(*ever) > LEAST_PASSED
    for plane in np.flatnonzero(passed.any(axis=(1, 2))):
        rows, columns = np.nonzero(passed[plane])
        atrium, ventricle = (value[:, plane, k][:, rows, columns] for k in pair)
        both = atrium + ventricle
        share = atrium / np.maximum(both, 1e-6)
        usual = np.median(share[around % len(value)], axis=0)
        spare = np.where(both > 0.5, np.maximum(share - usual, 0) * both, 0)
        value[:, plane, pair[0], rows, columns] = atrium - spare
        value[:, plane, pair[1], rows, columns] = ventricle + spare


UNEVEN = 1.5
"""Times the usual step between phases; where one nearby is longer or shorter by more, a difference
of the fourth order tells nothing."""


def blend_phases(value: Float32, share: float, phases: Float) -> None:
    """Mix each phase ``(phase,)`` in [0, 1) with two neighbours on either side in the cycle, in
    place, but beside a gap, as where a scanner stops before the beat ends.

    2 B - B B with B the mean in which either neighbour has ``share``; that is, without ``share^2``
    times the fourth difference in time. Where B alone draws what turns back, as volumes do at
    end-systole, short of where it turns, this does not; noise falls as much.
    """
    steps = np.diff(phases, append=phases[0] + 1)
    usual = np.median(steps)
    even = (steps <= UNEVEN * usual) & (UNEVEN * steps >= usual)
    # Of phase k, the steps from k - 2 to k + 2.
    amid = np.all([np.roll(even, by) for by in (2, 1, 0, -1)], axis=0)
    weights = np.where(amid, np.float32(share**2), np.float32(0))
    for plane in range(value.shape[1]):
        # Plane by plane what is at work stays in the processor's cache.
        _blend(value[:, plane], weights)


def bring_to_one_axis(found: PlaneProbability, cine: Cine) -> bool:
    """Move slices whose beats were longer or shorter to the phases of the mean beat, in place.

    Systole does not stretch as the beat does: at one share of their own RR intervals slices show
    the heart at different moments of its cycle (`Cine.moments`). Between
    its own phases a slice is a mean of the two. Slices less than `ONE_MOMENT` off stay as they
    are; and phases beside a gap, where that mean would be two hearts.

    Returns
    -------
    Whether any was moved.
    """
    if cine.moments is None:
        return False
    seen = np.repeat(cine.moments[list(found.view.order)], found.planes_a_slice, axis=0)
    moved = [
        move_in_time(found.value[:, plane], one, cine.phases) for plane, one in enumerate(seen)
    ]
    return any(moved)


def move_in_time(value: Float32, seen: Float, phases: Float) -> bool:
    """Bring what was seen at some phases (``(phase,)`` in [0, 1)) to others, in place.

    What is less than `ONE_MOMENT` off stays, and where phases do not rise. Whether any was moved.
    """
    if np.abs(seen - phases).max() <= ONE_MOMENT or (np.diff(seen) <= 0).any():
        return False
    low, high, share = around_phases(phases, seen)
    beside_gap = np.diff(seen, append=seen[0] + 1)[low] > GAP
    before = value.copy()
    for phase in np.flatnonzero(~beside_gap):
        one, other = before[low[phase]], before[high[phase]]
        value[phase] = one + share[phase] * (other - one)
    return True


def _blend(value: Float32, weights: Float32) -> None:
    """Take ``weights`` times the fourth difference along the first axis off, in place."""
    count = len(value)
    first = value[:2].copy()
    before = [value[-2 % count].copy(), value[-1].copy()]
    for phase in range(count):
        now = value[phase].copy()
        after = [
            value[phase + step] if phase + step < count else first[(phase + step) % count]
            for step in (1, 2)
        ]
        fourth = before[0] + after[1] - 4 * (before[1] + after[0]) + 6 * now
        np.maximum(now - weights[phase] * fourth, 0, out=value[phase])
        before = [before[1], now]
