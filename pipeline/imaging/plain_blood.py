"""Plain blood of which the network is unsure, told by the blood around it.

Beside a thick or an overloaded left ventricle the right one may reach farther about it than in
training, and left atria may be larger. There the network's probability fades out within the
chamber, though nothing ends in the image. So where it is unsure in plain blood, over more than an
outline's width, it is averaged along ways that cross no edge: a random walk from each pixel ends
where the network is sure, and each kind of end counts as often as it is met (Grady, "Random walks
for image segmentation", IEEE TPAMI 28:1768-1783, 2006; with priors as in his "Multilabel random
walker image segmentation using prior models", CVPR 2005). What the network takes for a chamber
stays so.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from pipeline.geometry import Float32, Mask
from pipeline.imaging.cine import Cine
from pipeline.imaging.cleanup import THREADS
from pipeline.imaging.inference import PlaneProbability, darkest_grey, sampled_slice
from pipeline.imaging.labels import LABELS, MUSCLE

RIGHT = LABELS["rv_cavity"]
CHAMBERS = (RIGHT, LABELS["left_atrium"])
"""Not the right atrium: venae cavae as wide as it open into it, and no edge parts them."""

LIKELY = 0.5
"""A pixel is a chamber or background if it is so with this probability."""

WHOLE_RING = 0.8
"""Share of a phase's largest cut of muscle that a slice has in which a right ventricle may go on:
nearer the base vessels and atria are plain blood beside it."""

UNSURE, SURE = 0.03, 0.002
"""Shares of background or chamber between which a pixel may change, and beyond which it is an
end of the walk."""

WIDEST_OUTLINE_PX = 5
"""Across an outline the network is as unsure as it is wide; what is wider is no outline."""

LIKE_BLOOD, FLAT = 0.35, 0.25
"""Of the chamber's median grey: how far plain blood is off it, and from one pixel to the next."""

RIM = 0.6
"""Of the same: pixels brighter than this that touch plain blood are half of it."""

EDGE, LEAST_EDGE = 3.0, 0.02
"""A difference between two pixels is an edge at three times the usual one, in deviations, or at
that share of the grey."""

PRIOR, PRIOR_POWER = 0.01, 8
"""What the network's own opinion of a pixel counts beside one of its neighbours, where it is sure;
by that power of its certainty elsewhere."""

LEAKAGE = 1e-4
"""Weight of a way across an edge."""

LEAST_SURE = 20
"""Pairs of pixels of which greys and their differences can be known."""


def settle_plain_blood(found: PlaneProbability, cine: Cine) -> None:
    """Give the right ventricle and the left atrium plain blood that goes on from them, in place.

    What was background alone becomes chamber; a slice tells of its own planes.
    """
    nothing = darkest_grey(cine.intensity)
    whole = _whole_slices(found)

    def one(place: tuple[int, int]) -> None:
        phase, number = place
        planes = found.of_slice(phase, number)
        chambers = [
            chamber
            for chamber in CHAMBERS
            if (chamber != RIGHT or whole[place]) and _wide(_unsure(planes, chamber)).any()
        ]
        if chambers:
            image = sampled_slice(cine, found.view, phase, number) - nothing
            for chamber in chambers:
                _settle_slice(planes, chamber, image)

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(one, np.ndindex(whole.shape)))


def _whole_slices(found: PlaneProbability) -> Mask:
    """Where nearly the largest ring of muscle of its phase is cut, ``(phase, slice)``."""
    cuts = (found.drawn() == MUSCLE).sum(axis=(2, 3))
    return np.asarray(cuts >= WHOLE_RING * cuts.max(axis=1, keepdims=True))


def _unsure(planes: Float32, chamber: int) -> Mask:
    """Pixels of a slice that may be chamber or background."""
    share = _share(planes[len(planes) // 2], chamber)
    return np.asarray((share > UNSURE) & (share < 1 - UNSURE))


def _wide(mask: Mask) -> Mask:
    """The parts of a mask that are wider than an outline."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (WIDEST_OUTLINE_PX, WIDEST_OUTLINE_PX))
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, disc) > 0)


def _settle_slice(planes: Float32, chamber: int, image: Float32) -> None:
    """Make more of the planes ``(plane, class, row, column)`` of a slice chamber, in place."""
    share = _share(planes[len(planes) // 2], chamber)
    plain, rim, edge = _plain_blood(share, image)
    unsure = plain & _unsure(planes, chamber)
    wide = cv2.dilate(_wide(unsure).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    # What is unsure for an outline's sake says nothing about the blood beside it.
    plain &= ~unsure | wide
    rim |= unsure & ~wide
    unsure = plain & wide & (share > SURE) & (share < 1 - SURE)
    if not unsure.any():
        return
    gain = np.zeros_like(share)
    gain[unsure] = _logit(walked(share, image / edge, plain, unsure)) - _logit(share[unsure])
    gain = np.maximum(gain, 0)
    gain = np.where(rim, cv2.dilate(gain, np.ones((3, 3), np.uint8)), gain)
    for plane in planes:
        either = plane[0] + plane[chamber]
        more = 1 / (1 + np.exp(-_logit(_share(plane, chamber)) - gain))
        larger = np.clip(either * more, plane[chamber], either)
        plane[chamber] = np.where(gain > 0, larger, plane[chamber])
        plane[0] = np.where(gain > 0, either - plane[chamber], plane[0])


def _share(plane: Float32, chamber: int) -> Float32:
    """Of a plane's ``(class, row, column)`` probabilities: a chamber's share of it and background,
    0 where neither is likely."""
    either = plane[0] + plane[chamber]
    share = plane[chamber] / np.maximum(either, LIKELY)
    return np.asarray(np.where(either > LIKELY, share, 0), np.float32)


def _logit(share: Float32) -> Float32:
    share = np.clip(share, 1e-4, 1 - 1e-4)
    return np.asarray(np.log(share / (1 - share)))


def _plain_blood(share: Float32, image: Float32) -> tuple[Mask, Mask, float]:
    """Pixels of blood as the chamber's, those half of it, and the difference that is an edge.

    None, where too little is surely chamber.
    """
    sure = share > 1 - UNSURE
    usual = np.concatenate(
        [np.abs(np.diff(image, axis=axis))[_pairs(sure, axis)] for axis in (0, 1)]
    )
    none = np.zeros(share.shape, bool)
    if len(usual) < LEAST_SURE:
        return none, none, 1.0
    grey = float(np.median(image[sure]))
    brush = np.ones((3, 3), np.uint8)
    step = np.maximum(cv2.dilate(image, brush) - image, image - cv2.erode(image, brush))
    plain = (np.abs(image - grey) < LIKE_BLOOD * grey) & (step < FLAT * grey)
    edge = EDGE * max(1.4826 * float(np.median(usual)), LEAST_EDGE * grey)
    return plain & (share > 0), ~plain & (image > RIM * grey), edge


def _pairs(mask: Mask, axis: int) -> Mask:
    """Where a pixel and the next along an axis are both in a mask."""
    first, second = np.moveaxis(mask, axis, 0)[:-1], np.moveaxis(mask, axis, 0)[1:]
    return np.asarray(np.moveaxis(first & second, 0, axis))


def walked(share: Float32, image: Float32, within: Mask, unsure: Mask) -> Float32:
    """Shares at which walks from unsure pixels end, ``(n,)``, in the order of ``unsure``.

    The solution x of (L + G) x = G p of a graph whose neighbours i and j within the mask are joined
    by exp(-(I_i - I_j)^2 / 2), L its Laplacian, p and G the network's own shares and how sure it is
    of them; where it is not unsure, x is p.

    Parameters
    ----------
    share
        ``(row, column)`` in [0, 1].
    image
        ``(row, column)``, in units of an edge.
    within, unsure
        ``(row, column)``; the second lies in the first.
    """
    number = np.cumsum(within).reshape(within.shape) - 1
    ends, ways = [], []
    for axis in (0, 1):
        pairs = _pairs(within, axis)
        beside = [np.moveaxis(number, axis, 0)[part] for part in (slice(-1), slice(1, None))]
        ends.append(np.stack([np.moveaxis(one, 0, axis)[pairs] for one in beside]))
        ways.append(np.exp(-np.square(np.diff(image, axis=axis)[pairs].astype(float)) / 2))
    first, second = np.concatenate(ends, axis=1)
    way = np.concatenate(ways) + LEAKAGE
    both = (np.concatenate([first, second]), np.concatenate([second, first]))
    count = int(within.sum())
    graph = sparse.csr_matrix((np.concatenate([way, way]), both), (count, count))
    laplacian = sparse.diags(np.asarray(graph.sum(axis=1)).ravel()) - graph
    known, asked = share[within].astype(float), unsure[within]
    prior = PRIOR * np.abs(2 * known[asked] - 1) ** PRIOR_POWER + 1e-6
    rows = laplacian.tocsr()[asked]
    matrix = rows[:, asked] + sparse.diags(prior)
    wanted = prior * known[asked] - rows[:, ~asked] @ known[~asked]
    return np.asarray(np.clip(spsolve(matrix.tocsc(), wanted), 0, 1), np.float32)
