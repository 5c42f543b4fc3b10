"""One slice of a beating heart, averaged over its thickness, its pixels and its time window."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from data_synth.bssfp import BLOOD_TISSUES, steady_state_signal
from data_synth.flow import Inflow, Jet, jet_loss
from data_synth.heart import BeatingHeart
from data_synth.kernels import Float, Label
from data_synth.offresonance import off_resonance_hz
from data_synth.protocol import MrSettings
from data_synth.tissue import Tissue, truth_values

Complex64 = npt.NDArray[np.complex64]

FREQUENCY_STEP_HZ = 1.0
"""Width of the bins in which the off-resonance of a pixel is looked up."""
LATTICE_MM, LATTICE_PHASES, MARGIN_MM = 4.2, 12, 4.0
"""Mesh and phases of the first look at where in a slice the heart is, and what is added to it: at
12 phases of 0.8 s, a border that moves at 100 mm/s is never more than 3.3 mm off."""
LONGEST_WINDOW = 0.04
"""Share of the cycle beyond which a frame's acquisition window does not grow."""

SEQUENCES = (0.7548776662466927, 0.5698402909980532, 0.6180339887498949)
"""Steps, modulo 1, of the orders in which samples take places along x, along y, and in time."""
BLOOD = np.isin(np.arange(len(Tissue)), BLOOD_TISSUES)


def acquisition_window(phases: int) -> float:
    """Share of the cycle in which a frame of a cine of so many phases is acquired."""
    # Few phases are a long cine of which few are kept, not frames of a third of a heartbeat.
    return min(1 / phases, LONGEST_WINDOW)


class Samples(NamedTuple):
    """Where and when a voxel is looked at."""

    offsets_mm: Float
    """``(sample, 3)`` LPS, from the voxel's middle."""
    instants: Float
    """``(sample,)`` after the frame's own instant, as shares of the acquisition window."""
    shifts_mm: Float
    """``(sample, 3)`` LPS, of the heart off its mean place, as breathing brings it there."""


def spread_samples(
    axes: Float, settings: MrSettings, thickness_mm: float, pixel_mm: float, edge: float
) -> Samples:
    """Points that stand for a voxel and its acquisition window, all with the same weight.

    A Latin hypercube: depth and both places in the pixel each take every one of their levels once,
    and the instant each of the ``window_samples`` equally often, or as nearly as it can, in orders
    given by low-discrepancy sequences (the plastic number's, Roberts 2018, and the golden
    ratio's). Depths are quantiles of the slice profile, a box of the given thickness whose edges
    are blurred by a normal distribution of ``edge`` thicknesses. There are as many points as the
    larger of ``through_plane_samples`` and ``window_samples`` says.
    """
    count = max(settings.through_plane_samples, settings.window_samples)
    k = np.arange(1, count + 1)
    x, y, instant = (np.argsort(np.argsort(k * step % 1)) for step in SEQUENCES)
    depths = profile_quantiles((k - 0.5) / count, edge)
    offsets = np.stack([(x + 0.5) / count - 0.5, (y + 0.5) / count - 0.5, depths], axis=1)
    window = settings.window_samples
    instants = (instant * window // count + 0.5) / window - 0.5
    offsets_mm = offsets * (pixel_mm, pixel_mm, thickness_mm) @ axes.T
    return Samples(offsets_mm, instants, np.zeros((count, 3)))


def profile_quantiles(shares: Float, edge: float) -> Float:
    """Depths, in thicknesses, below which the slice profile gives these shares of its signal."""
    from scipy.special import ndtr

    if edge == 0:
        return shares - 0.5
    depths = np.linspace(-0.5 - 5 * edge, 0.5 + 5 * edge, 2001)
    profile = ndtr((depths + 0.5) / edge) - ndtr((depths - 0.5) / edge)
    return np.interp(shares, np.cumsum(profile) / profile.sum(), depths)


class SliceView(NamedTuple):
    """What one slice looks at, and how."""

    mr_from_index: Float
    """4x4, voxels of this slice at z = 0."""
    shape: tuple[int, int]
    """Rows and columns."""
    samples: Samples
    shift_mm: Float
    """LPS shift of the heart while it was acquired."""
    rr_s: float
    inflow: Inflow
    jets: tuple[Jet, ...]


class Slice:
    """One slice; the chest around the heart and the field's error are looked up once."""

    def __init__(self, heart: BeatingHeart, settings: MrSettings, view: SliceView) -> None:
        self.heart, self.settings, self.view = heart, settings, view
        self.truth = truth_values()
        rows, columns = view.shape
        y, x = np.mgrid[:rows, :columns].reshape(2, -1).astype(float)
        frame = view.mr_from_index
        self.points = np.outer(x, frame[:3, 0]) + np.outer(y, frame[:3, 1]) + frame[:3, 3]
        self._look_up_field()
        self._look_up_chest()

    def _look_up_field(self) -> None:
        """Signal of every tissue at every frequency in the slice, and each pixel's frequency."""
        offset = off_resonance_hz(self.heart, self.settings, self.points)
        low = math.floor(offset.min())
        count = math.ceil((offset.max() - low) / FREQUENCY_STEP_HZ) + 1
        frequencies = low + FREQUENCY_STEP_HZ * np.arange(count)
        self.signal = steady_state_signal(self.settings, frequencies).astype(np.complex64)
        self.bin = np.rint((offset - low) / FREQUENCY_STEP_HZ).astype(np.int32)

    def _look_up_chest(self) -> None:
        """Tissue of the chest at all samples, its mean signal, and pixels the heart may touch."""
        heart, view = self.heart, self.view
        offsets = np.vstack([view.samples.offsets_mm, np.zeros(3)])
        chest = np.stack([heart.chest_tissue(self.points + offset) for offset in offsets])
        # Vessels outside the heart pulse too, so their share of the signal is kept apart.
        vessel = chest[:-1] == Tissue.BLOOD_VESSEL
        signal = self.signal[chest[:-1], self.bin]
        self.rest = np.where(vessel, np.complex64(0), signal).mean(axis=0)
        self.rest_vessels = np.where(vessel, signal, np.complex64(0)).mean(axis=0)
        moved = self.points - view.shift_mm
        touched = np.zeros(len(self.points), bool)
        self.offsets_mm = view.samples.offsets_mm - view.samples.shifts_mm
        for offset in np.vstack([self.offsets_mm, np.zeros(3)]):
            touched |= heart.near_heart(moved + offset)
        self.near = self._touched(moved, np.flatnonzero(touched))
        self.moved = moved[self.near]
        self.chest = chest[:, self.near]
        self.in_heart = heart.into_heart(self.moved)
        row, column = np.divmod(self.near, view.shape[1])
        self.even, self.odd = (np.flatnonzero((row + column) % 2 == k) for k in (0, 1))

    def _touched(self, moved: Float, near: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
        """Those of the near pixels that the heart comes to in some frame.

        Looked up on a lattice at some phases and grown by its mesh and by MARGIN_MM, which covers
        the way of the heart's border from one of the phases to the next.
        """
        import cv2

        pixel_mm = float(np.linalg.norm(self.view.mr_from_index[:3, 0]))
        mesh = max(round(LATTICE_MM / pixel_mm), 1)
        row, column = np.divmod(near, self.view.shape[1])
        knots = near[(row % mesh == 0) & (column % mesh == 0)]
        seen = np.zeros(len(knots), bool)
        for offset in (self.offsets_mm[0], self.offsets_mm[-1]):
            for k in range(LATTICE_PHASES):
                seen |= self.heart.heart_tissue(moved[knots] + offset, k / LATTICE_PHASES) > 0
        reach_mm = MARGIN_MM + float(np.abs(self.view.samples.shifts_mm).max())
        reach = mesh + math.ceil(reach_mm / pixel_mm)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        mask = np.zeros(self.view.shape, np.uint8)
        mask.ravel()[knots[seen]] = 1
        return near[np.asarray(cv2.dilate(mask, disc)).ravel()[near] > 0]

    def frame(self, phase: float) -> tuple[Complex64, Label]:
        """Noise-free complex image and truth labels of one frame, ``(row, column)`` each."""
        tissue, middle = self._tissues(phase)
        nominal = self._nominal(phase)
        gains = self.view.inflow.at(nominal).astype(np.float32)
        signal = self.signal * gains[:, None]
        values = signal[tissue, self.bin[self.near]]
        if self.settings.flow_dephasing > 0 and self.view.jets:
            values *= np.where(BLOOD[tissue], self._jet_loss(phase, nominal), np.float32(1))
        image = self.rest + gains[Tissue.BLOOD_VESSEL] * self.rest_vessels
        image[self.near] = values.mean(axis=0)
        labels = np.zeros(len(self.points), np.uint8)
        labels[self.near] = self.truth[middle]
        return image.reshape(self.view.shape), labels.reshape(self.view.shape)

    def _nominal(self, phase: float) -> float:
        return float(self.heart.nominal_phase(phase % 1.0, self.view.rr_s))

    def _jet_loss(self, phase: float, nominal: float) -> npt.NDArray[np.float32]:
        view, step = self.view, 1e-3
        passed = (self._nominal(phase + step) - self._nominal(phase - step)) % 1.0
        # As long as the nominal cycle would last at the pace of this moment.
        cycle_s = view.rr_s * 2 * step / passed
        moment = self.settings.flow_dephasing
        return jet_loss(self.heart, view.jets, self.in_heart, nominal, cycle_s, moment)

    def _tissues(self, phase: float) -> tuple[Label, Label]:
        """Tissue of all samples at the near pixels, (sample, pixel); and of their middles.

        The middle of every voxel is looked up, and its shallowest or deepest sample, in turns as
        on a chessboard. The rest is looked up only where these differ within nine pixels: a part
        that shows in none of them is narrower than two pixels and thinner than the slice.
        """
        count = len(self.view.samples.instants)
        middle = self._look(-1, phase, np.arange(len(self.near)))
        probe = np.empty_like(middle)
        for sample, which in ((0, self.even), (count - 1, self.odd)):
            probe[which] = self._look(sample, phase, which)
        tissue = np.where(middle > 0, middle, self.chest[:-1])
        mixed = self._mixed(middle, probe)
        for k in range(count):
            here = self._look(k, phase, mixed)
            tissue[k, mixed] = np.where(here > 0, here, self.chest[k, mixed])
        return tissue, middle

    def _look(self, sample: int, phase: float, which: npt.NDArray[np.intp]) -> Label:
        """Heart tissue of one sample (-1: the middle, at the frame's instant) at near pixels."""
        offset, instant = np.zeros(3), 0.0
        if sample >= 0:
            offset = self.offsets_mm[sample]
            instant = float(self.view.samples.instants[sample])
        nominal = self._nominal(phase + instant * acquisition_window(self.settings.phases))
        return self.heart.heart_tissue(self.moved[which] + offset, nominal)

    def _mixed(self, middle: Label, probe: Label) -> npt.NDArray[np.intp]:
        """Near pixels in whose neighbourhood heart tissues differ, and what is seen differs too."""
        chest = self.chest[-1]
        seen = [np.where(part > 0, part, chest) for part in (middle, probe)]
        return np.flatnonzero(self._varies(middle, probe) & self._varies(*seen))

    def _varies(self, one: Label, other: Label) -> npt.NDArray[np.bool_]:
        """Near pixels whose nine neighbours do not all hold one value in both arrays."""
        import cv2

        kernel = np.ones((3, 3), np.uint8)
        low, high = np.zeros((2, *self.view.shape), np.uint8)
        low.ravel()[self.near] = np.minimum(one, other)
        high.ravel()[self.near] = np.maximum(one, other)
        differ = np.asarray(cv2.erode(low, kernel) != cv2.dilate(high, kernel))
        return np.asarray(differ.ravel()[self.near])
