"""How the heart lies in a stack, told from the heart itself where the file says it wrongly.

Short-axis stacks often lose their directions on the way from the scanner: identity matrices,
flipped or exchanged axes, slices stored base first. The network knows the ventricles almost
whichever way they are turned: where the right one lies beside the left, and towards which end both
taper, tells how they are turned, and the network's doubt tells whether they are mirrored. The file
is believed unless the heart clearly contradicts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry import Float, Label, Mask
from pipeline.imaging.labels import CAVITY, LABELS, MUSCLE
from pipeline.imaging.view import AS_THE_FILE_SAYS, Orientation

RIGHT_DEG = -165.0
"""Where the right ventricle lies from the left, from columns towards rows, in a canonical view."""

FARTHEST_DEG = 70.0
"""The file's directions stand while the right ventricle is found within this of `RIGHT_DEG`."""

LEAST_TURN_DEG = 30.0
"""Hearts differ by as much among patients: a smaller turn is none."""

LEAST_RISE = -0.25
"""The file's order of slices stands while the heart does not taper the other way by more."""

LEAST_PIXELS = 30
"""A smaller cut through a ventricle tells no direction."""

TURNS_DEG = tuple(range(0, 360, 45))
"""In-plane turns of the views that vote on how the ventricles lie."""

LESS_DOUBT = 0.85
"""Where ventricles lie as the file says, they are taken for mirrored, or for stored base first,
when the network's doubt falls below this share by mirroring or exchanging them back."""

LEVEL_RISE = 0.0
"""Only a heart that does not taper towards its apex may have been stored base first."""

NO_MORE_DOUBT = 1.1
"""No view is better than the file's in which the network's doubt grows by more."""

Look = Callable[[Orientation], tuple[Label, float]]
"""Labels ``(slice, row, column)``, apex first, of a few slices seen in an orientation, and the
network's doubt: the entropy of its probabilities, summed over all pixels. The fewer of the images'
features are unlike what it was trained on, the smaller it is; unlike the certainty of the labels
chosen, it also counts the heart that the network half misses."""


@dataclass(frozen=True, slots=True)
class Lie:
    """How labelled ventricles lie in the view that they were labelled in."""

    right: Float
    """``(2,)`` mean unit vector (column, row) from the left to the right ventricle, its length the
    share of slices that agree; zero where no slice shows both."""

    rise: float
    """From -1 to 1: how much the heart's cut grows from the first slice to the last, its atria
    and aorta counting as more."""

    @property
    def off_deg(self) -> float:
        """How far the right ventricle is from where a canonical view has it, 0 to 180."""
        if not self.right.any():
            return 0.0
        return abs(_wrapped(_angle_deg(self.right[0], self.right[1]) - RIGHT_DEG))

    @property
    def is_canonical(self) -> bool:
        """Whether nothing clearly contradicts the view."""
        return self.off_deg <= FARTHEST_DEG and self.rise >= LEAST_RISE


def lie_of(labels: Label) -> Lie:
    """How the ventricles lie, from labels ``(slice, row, column)``."""
    left = np.isin(labels, (CAVITY, MUSCLE))
    right = labels == LABELS["rv_cavity"]
    weights, vectors = [0.0], [np.zeros(2)]
    for one, other in zip(left, right, strict=True):
        least = min(one.sum(), other.sum())
        if least >= LEAST_PIXELS:
            vector = _centre(other) - _centre(one)
            weights.append(float(least))
            vectors.append(vector / max(float(np.linalg.norm(vector)), 1e-6))
    mean = np.average(vectors, axis=0, weights=weights) if sum(weights) else np.zeros(2)
    return Lie(mean, _rise(left | right, labels >= LABELS["left_atrium"]))


def find_orientation(look: Look) -> Orientation:
    """The file's orientation, or a clearly better one.

    Parameters
    ----------
    look
        Labels and doubt on a few slices in a given orientation.

    Returns
    -------
    Orientation
        The file's where the heart seen in it lies about as it should, or lies so in no other.
    """
    labels, doubt = look(AS_THE_FILE_SAYS)
    lie = lie_of(labels)
    if lie.is_canonical:
        others = [_orientation(lie.right, True, False)] if lie.right.any() else []
        if lie.rise < LEVEL_RISE:
            others += [_orientation(lie.right, mirrored, True) for mirrored in (False, True)]
        return _less_doubted(look, AS_THE_FILE_SAYS, doubt, others)
    right, rise = _vote(look)
    upside_down = rise < LEAST_RISE
    candidates = [_orientation(right, mirrored, upside_down) for mirrored in (False, True)]
    doubts = [_doubt_if_canonical(look, one) for one in candidates]
    best = int(np.argmin(doubts))
    if doubts[best] >= NO_MORE_DOUBT * doubt:
        return AS_THE_FILE_SAYS
    if upside_down or rise >= LEVEL_RISE:
        return candidates[best]
    exchanged = [_orientation(right, mirrored, True) for mirrored in (False, True)]
    return _less_doubted(look, candidates[best], doubts[best], exchanged)


def _less_doubted(
    look: Look, usual: Orientation, doubt: float, others: Sequence[Orientation]
) -> Orientation:
    """An orientation, or another in which the network's doubt is clearly less."""
    doubts = [_doubt_if_canonical(look, one) for one in others]
    if not others or min(doubts) >= LESS_DOUBT * doubt:
        return usual
    return others[int(np.argmin(doubts))]


def _doubt_if_canonical(look: Look, orientation: Orientation) -> float:
    """The doubt in an orientation; infinite where the heart does not lie as it should in it."""
    labels, doubt = look(orientation)
    return doubt if lie_of(labels).is_canonical else np.inf


def _vote(look: Look) -> tuple[Float, float]:
    """Right ventricle's direction and the rise in the file's view, agreed on over turned views."""
    weights, rights, rises = [], [], []
    for turn_deg in TURNS_DEG:
        labels, doubt = look(Orientation(turn_deg))
        lie = lie_of(labels)
        angle = np.radians(turn_deg)
        back = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        weights.append(1 / max(doubt, 1e-6))
        rights.append(back @ lie.right)
        rises.append(lie.rise)
    right = np.average(rights, axis=0, weights=weights)
    return right, float(np.average(rises, weights=weights))


def _orientation(right: Float, mirrored: bool, upside_down: bool) -> Orientation:
    """The orientation that brings the right ventricle, seen in the file's view, to its place."""
    seen_deg = _angle_deg(-right[0] if mirrored else right[0], right[1])
    turn_deg = _wrapped(seen_deg - RIGHT_DEG)
    known = bool(right.any()) and abs(turn_deg) > LEAST_TURN_DEG
    return Orientation(turn_deg if known else 0.0, mirrored, upside_down)


def _rise(ventricles: Mask, above: Mask) -> float:
    """Slope of the cut's size along the stack, over its mean and half the stack's length."""
    size = ventricles.sum(axis=(1, 2)).astype(float)
    atria = above.sum(axis=(1, 2)).astype(float)
    count = len(size)
    if count < 2 or not size.any():
        return 0.0
    place = np.linspace(-1, 1, count)
    # Ventricles end at the atria, not at a tip: only slices without any tell of tapering.
    taper = size > 0.5 * (size + atria)
    rise = 0.0
    if taper.sum() >= 2:
        here = place[taper] - place[taper].mean()
        slope = (here * size[taper]).sum() / max((here**2).sum(), 1e-6)
        rise = slope * (here.max() - here.min()) / 2 / size[taper].mean()
    if atria.sum() > 0.1 * size.sum():
        lead = (atria @ place) / atria.sum() - (size @ place) / size.sum()
        rise += lead * min(1.0, 2 * atria.sum() / size.sum())
    return float(np.clip(rise, -1, 1))


def _centre(mask: Mask) -> Float:
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean(), rows.mean()])


def _angle_deg(column: float, row: float) -> float:
    """Direction from columns towards rows."""
    return float(np.degrees(np.arctan2(row, column)))


def _wrapped(angle_deg: float) -> float:
    """Into -180 to 180 degrees."""
    return (angle_deg + 180) % 360 - 180
