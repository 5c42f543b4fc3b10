"""Cine MR of a beating heart: short-axis stack, long-axis views and isotropic volume."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from data_synth.breathing import BREATHING_AXIS, Breathing, breath_hold_mm
from data_synth.bssfp import fresh_blood, steady_state_signal
from data_synth.coils import shading
from data_synth.flow import plane_inflow, valve_jets
from data_synth.heart import BeatingHeart
from data_synth.kernels import Float, Label
from data_synth.offresonance import off_resonance_hz
from data_synth.plan import (
    LONG_AXIS_VIEWS,
    count_slices,
    plan_long_axis,
    plan_stack,
    plan_volume,
)
from data_synth.protocol import MrSettings
from data_synth.sampling import Slice, SliceView, spread_samples
from data_synth.tissue import Tissue

__all__ = [
    "FULL_SCALE",
    "LONG_AXIS_VIEWS",
    "MrSettings",
    "SyntheticCine",
    "acquire_cine",
    "acquire_long_axis",
    "acquire_volume",
    "add_noise",
    "count_slices",
]

Float32 = npt.NDArray[np.float32]
Int16 = npt.NDArray[np.int16]
Progress = Callable[[int, int], None]

FULL_SCALE = 2800.0
"""Stored value of a voxel that gives the signal of all its protons, M0."""
THREADS = 4
"""Most slices that are worked on at the same time."""


@dataclass(frozen=True, slots=True)
class SyntheticCine:
    """A cine with its truth on the same pixels."""

    intensity: Int16
    """``(phase, z, y, x)``."""
    labels: Label
    """``(phase, z, y, x)`` values of TRUTH_LABELS at the middle of each voxel's slice."""
    mr_from_index: Float
    """4x4: voxel indices ``(x, y, z)`` to LPS mm."""
    rr_ms: Float
    """``(z,)`` RR interval while each slice was acquired."""
    shifts_mm: Float
    """``(z, 3)`` LPS shift of the heart while each slice was acquired."""
    slice_thickness_mm: float
    field_strength_t: float

    @property
    def phases(self) -> Float:
        """``(phase,)`` phase of every frame."""
        return np.arange(len(self.intensity)) / len(self.intensity)

    @property
    def trigger_times_ms(self) -> Float:
        """``(z, phase)`` times after the R peak."""
        return self.rr_ms[:, None] * self.phases

    @property
    def pixel_mm(self) -> float:
        """Distance between pixels, the same along rows and columns."""
        return float(np.linalg.norm(self.mr_from_index[:3, 0]))

    @property
    def slice_step_mm(self) -> float:
        """Distance from slice to slice."""
        return float(np.linalg.norm(self.mr_from_index[:3, 2]))


def acquire_cine(
    rng: np.random.Generator,
    heart: BeatingHeart,
    rr_ms: Sequence[float],
    settings: MrSettings,
    progress: Progress | None = None,
) -> SyntheticCine:
    """Acquire the short-axis stack, slice by slice, one breath-hold each.

    Parameters
    ----------
    rng
        Source of planning error, shifts and noise.
    heart
        What is imaged.
    rr_ms
        RR interval (ms) during each slice; their number is the number of slices.
    settings
        The protocol.
    progress
        Told (slices done, slices in all).
    """
    mr_from_index = plan_stack(rng, heart, settings)
    holds = Breathing(hold_sd_mm=settings.breath_hold_shift_mm)
    shifts_mm = breath_hold_mm(rng, len(rr_ms), holds)
    frames = [slice_frame(mr_from_index, z) for z in range(len(rr_ms))]
    images = _acquire_slices(rng, heart, frames, rr_ms, shifts_mm, settings, progress)
    return _cine(images, mr_from_index, rr_ms, shifts_mm, settings)


def acquire_long_axis(
    rng: np.random.Generator,
    heart: BeatingHeart,
    rr_ms: Sequence[float],
    settings: MrSettings,
    progress: Progress | None = None,
) -> dict[str, SyntheticCine]:
    """Acquire the views of LONG_AXIS_VIEWS, one slice and one breath-hold each.

    Parameters
    ----------
    rng
        Source of planning error, shifts and noise.
    heart
        What is imaged.
    rr_ms
        RR interval (ms) during each of the three views.
    settings
        The protocol, the same as the stack's.
    progress
        Told (views done, views in all).
    """
    frames = [plan_long_axis(rng, heart, view, settings) for view in LONG_AXIS_VIEWS]
    holds = Breathing(hold_sd_mm=settings.breath_hold_shift_mm)
    shifts_mm = breath_hold_mm(rng, len(frames), holds)
    images = _acquire_slices(rng, heart, frames, rr_ms, shifts_mm, settings, progress)
    return {
        view: _cine([image], frame, [rr], shift[None], settings)
        for view, image, frame, rr, shift in zip(
            LONG_AXIS_VIEWS, images, frames, rr_ms, shifts_mm, strict=True
        )
    }


def acquire_volume(
    rng: np.random.Generator,
    heart: BeatingHeart,
    rr_ms: Sequence[float],
    settings: MrSettings,
    progress: Progress | None = None,
) -> SyntheticCine:
    """Acquire an isotropic volume over many beats of gated free breathing.

    Blood in so thick a slab is excited wherever it goes, so nothing flows in fresh.

    Parameters
    ----------
    rng
        Source of planning error, breathing and noise.
    heart
        What is imaged.
    rr_ms
        RR intervals (ms) of the beats; the volume shows their mean, in whole ms.
    settings
        The protocol; ``volume_voxel_mm``, ``volume_snr`` and ``volume_gating_mm`` apply.
    progress
        Told (planes done, planes in all).
    """
    mr_from_index, (depth, rows, columns) = plan_volume(rng, heart, settings)
    voxel, rr = settings.volume_voxel_mm, float(np.rint(np.mean(rr_ms)))
    samples = spread_samples(mr_from_index[:3, :3] / voxel, settings, voxel, voxel, 0.0)
    count = len(samples.instants)
    breathing = ((rng.permutation(count) + 0.5) / count - 0.5) * settings.volume_gating_mm
    samples = samples._replace(shifts_mm=np.outer(breathing, BREATHING_AXIS))
    inflow = plane_inflow(heart, (np.zeros(3), np.eye(3)[2]), 1.0, 1.0, fresh_blood(settings), 0.0)
    jets = valve_jets(heart) if settings.flow_dephasing > 0 else ()
    views = [
        SliceView(
            slice_frame(mr_from_index, z), (rows, columns), samples, np.zeros(3), rr / 1000,
            inflow, jets,
        )
        for z in range(depth)
    ]  # fmt: skip
    images = _acquire(rng, heart, views, settings, settings.volume_snr, progress)
    still = np.zeros((depth, 3))
    return _cine(images, mr_from_index, [rr] * depth, still, settings, voxel)


def slice_frame(mr_from_index: Float, z: int) -> Float:
    """4x4 frame of slice z alone."""
    frame = mr_from_index.copy()
    frame[:3, 3] += z * frame[:3, 2]
    return frame


Image = tuple[Int16, Label]
"""Intensities and labels of one slice, ``(phase, y, x)`` each."""


def _acquire_slices(
    rng: np.random.Generator,
    heart: BeatingHeart,
    frames: Sequence[Float],
    rr_ms: Sequence[float],
    shifts_mm: Float,
    settings: MrSettings,
    progress: Progress | None,
) -> list[Image]:
    """Two-dimensional slices with their own profile, inflow and breath-hold."""
    fresh = fresh_blood(settings)
    jets = valve_jets(heart) if settings.flow_dephasing > 0 else ()
    thickness, side = settings.slice_thickness_mm, settings.matrix
    views = []
    for frame, rr, shift in zip(frames, rr_ms, shifts_mm, strict=True):
        axes = frame[:3, :3] / np.linalg.norm(frame[:3, :3], axis=0)
        samples = spread_samples(axes, settings, thickness, settings.pixel_mm, settings.slice_edge)
        middle = frame[:3, 3] + frame[:3, :2].sum(axis=1) * (side - 1) / 2 - shift
        plane = heart.into_heart(middle[None])[0], heart.rotation.T @ axes[:, 2]
        inflow = plane_inflow(heart, plane, thickness, rr / 1000, fresh, settings.inflow)
        views.append(SliceView(frame, (side, side), samples, shift, rr / 1000, inflow, jets))
    return _acquire(rng, heart, views, settings, settings.snr, progress)


def _acquire(
    rng: np.random.Generator,
    heart: BeatingHeart,
    views: Sequence[SliceView],
    settings: MrSettings,
    snr: float,
    progress: Progress | None,
) -> list[Image]:
    """Frames of all slices; every slice has its own random numbers, whatever the threads do."""

    def work(view: SliceView, own: np.random.Generator) -> Image:
        return _acquire_slice(own, heart, view, settings, snr)

    # What all slices share is worked out here, so that no two threads do it.
    off_resonance_hz(heart, settings, heart.centre_mm[None])
    heart.near_heart(heart.centre_mm[None])
    images = []
    with ThreadPoolExecutor(min(THREADS, os.cpu_count() or 1)) as pool:
        for image in pool.map(work, views, rng.spawn(len(views))):
            images.append(image)
            if progress:
                progress(len(images), len(views))
    return images


def _acquire_slice(
    rng: np.random.Generator,
    heart: BeatingHeart,
    view: SliceView,
    settings: MrSettings,
    snr: float,
) -> Image:
    plane = Slice(heart, settings, view)
    bias = coil_bias(heart, plane.points, view.shape, settings)
    shape = (settings.phases, *view.shape)
    intensity, labels = np.empty(shape, np.int16), np.empty(shape, np.uint8)
    for k in range(settings.phases):
        image, labels[k] = plane.frame(k / settings.phases)
        seen = gaussian_filter(image, settings.sharpness_pixels, mode="nearest")
        intensity[k] = add_noise(rng, seen * bias, settings, snr)
    return intensity, labels


def coil_bias(
    heart: BeatingHeart, points_mm: Float, shape: tuple[int, int], settings: MrSettings
) -> Float32:
    """Coil shading on a slice's pixels (row, column), worked out on every eighth of them."""
    from scipy.ndimage import map_coordinates

    if settings.coil_shading == 0:
        return np.ones(shape, np.float32)
    rows, columns = (np.linspace(0, size - 1, size // 8 + 2) for size in shape)
    corner = points_mm[0]
    down = (points_mm[shape[1]] - corner)[None, None]
    along = (points_mm[1] - corner)[None, None]
    places = corner + rows[:, None, None] * down + columns[None, :, None] * along
    coarse = np.log(shading(heart, places.reshape(-1, 3), settings.coil_shading))
    y, x = np.meshgrid(
        np.linspace(0, len(rows) - 1, shape[0]),
        np.linspace(0, len(columns) - 1, shape[1]),
        indexing="ij",
    )
    fine = map_coordinates(coarse.reshape(len(rows), -1), [y, x], order=3, mode="nearest")
    return np.asarray(np.exp(fine), dtype=np.float32)


def add_noise(
    rng: np.random.Generator, image: npt.NDArray[np.complex64], settings: MrSettings, snr: float
) -> Int16:
    """Magnitude of the image with complex Gaussian noise (Rician), as stored integers.

    Rice distribution: Gudbjartsson and Patz, Magn. Reson. Med. 34:910-914 (1995).
    """
    deviation = float(abs(steady_state_signal(settings)[Tissue.LV_CAVITY])) / snr
    noise = deviation * rng.standard_normal((2, *image.shape), dtype=np.float32)
    magnitude = np.hypot(image.real + noise[0], image.imag + noise[1])
    return np.asarray(np.clip(np.rint(magnitude * FULL_SCALE), 0, 32767), dtype=np.int16)


def _cine(
    images: Sequence[Image],
    mr_from_index: Float,
    rr_ms: Sequence[float],
    shifts_mm: Float,
    settings: MrSettings,
    thickness_mm: float | None = None,
) -> SyntheticCine:
    return SyntheticCine(
        np.stack([intensity for intensity, _ in images], axis=1),
        np.stack([labels for _, labels in images], axis=1),
        mr_from_index,
        np.array(rr_ms, float),
        shifts_mm,
        settings.slice_thickness_mm if thickness_mm is None else thickness_mm,
        settings.field_strength_t,
    )
