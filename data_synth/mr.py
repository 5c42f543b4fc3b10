"""Cine MR of a beating heart: a short-axis stack as a balanced steady-state sequence sees it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field
from scipy.ndimage import gaussian_filter

from data_synth.heart import BeatingHeart
from data_synth.kernels import Float, Label
from data_synth.tissue import Tissue, truth_values

Float32 = npt.NDArray[np.float32]
Int16 = npt.NDArray[np.int16]
Progress = Callable[[int, int], None]

BLOOD, FLESH = (1441.0, 290.0, 1.0), (1008.0, 44.0, 0.9)
RELAXATION: dict[Tissue, tuple[float, float, float]] = {
    Tissue.AIR: (1000.0, 40.0, 0.0),
    Tissue.FAT: (343.0, 58.0, 0.9),
    Tissue.MUSCLE: FLESH,
    Tissue.LUNG: (1200.0, 40.0, 0.17),
    Tissue.BONE: (549.0, 49.0, 0.6),
    Tissue.LIVER: (576.0, 46.0, 0.85),
    Tissue.BLOOD_VESSEL: BLOOD,
    Tissue.LV_CAVITY: BLOOD,
    Tissue.LV_MYOCARDIUM: (1030.0, 40.0, 0.95),
    Tissue.RV_CAVITY: BLOOD,
    Tissue.RV_WALL: (1030.0, 40.0, 0.95),
    Tissue.LEFT_ATRIUM: BLOOD,
    Tissue.RIGHT_ATRIUM: BLOOD,
    Tissue.ATRIAL_WALL: (1030.0, 40.0, 0.9),
    Tissue.AORTA: BLOOD,
    Tissue.VESSEL_WALL: FLESH,
    Tissue.STOMACH: (900.0, 70.0, 0.8),
    Tissue.PAPILLARY_MUSCLE: (1030.0, 40.0, 0.95),
    Tissue.RV_TRABECULA: (1030.0, 40.0, 0.95),
    Tissue.PERICARDIUM: (1000.0, 20.0, 0.4),
    Tissue.GAS: (1000.0, 40.0, 0.0),
    Tissue.SPLEEN: (1057.0, 79.0, 0.85),
    Tissue.LEAFLET: (1000.0, 25.0, 0.6),
    Tissue.SCAR: (1100.0, 50.0, 0.95),
}
"""T1 (ms), T2 (ms) and proton density (relative) at 1.5 T.

Blood, muscle, heart and liver: Stanisz et al., Magn. Reson. Med. 54:507-512 (2005). Fat and bone
marrow: de Bazelaire et al., Radiology 230:652-659 (2004). Lung and stomach are set by eye.
"""
FULL_SCALE = 2800.0
"""Stored value of a voxel that gives the sequence's unit signal times ten."""


class MrSettings(BaseModel):
    """How the cine is planned and acquired."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    phases: int = Field(default=25, ge=2, le=100)
    slices: int | None = Field(default=None, ge=3, le=60)
    """Number of slices, counted from the apex; by default as many as reach the atrial roof."""
    slice_thickness_mm: float = Field(default=8.0, gt=0, le=20)
    slice_gap_mm: float = Field(default=2.0, ge=0, le=20)
    pixel_mm: float = Field(default=1.4, ge=0.4, le=5)
    matrix: int = Field(default=192, ge=32, le=512)
    """Pixels along both sides of an image."""
    snr: float = Field(default=30.0, gt=0)
    """Signal of blood over the noise's standard deviation in each channel."""
    flip_angle_deg: float = Field(default=50.0, gt=0, le=90)
    repetition_ms: float = Field(default=3.0, gt=0, le=10)
    coil_shading: float = Field(default=0.25, ge=0, le=1)
    """Standard deviation, in natural logarithm, of the receive coils' shading across the image."""
    sharpness_pixels: float = Field(default=0.45, ge=0, le=3)
    """Standard deviation of the in-plane point spread."""
    through_plane_samples: int = Field(default=5, ge=1, le=20)
    window_samples: int = Field(default=1, ge=1, le=9)
    """Instants averaged over the acquisition window of a frame (one phase step wide)."""
    breath_hold_shift_mm: float = Field(default=1.5, ge=0, le=10)
    """Standard deviation of the heart's head-foot place from one slice's breath-hold to another."""
    planning_error_deg: float = Field(default=3.0, ge=0, le=30)
    """Standard deviation of the stack's tilt off the heart's short axis."""


@dataclass(frozen=True, slots=True)
class SyntheticCine:
    """A short-axis cine with its truth on the same pixels."""

    intensity: Int16
    """``(phase, z, y, x)``."""
    labels: Label
    """``(phase, z, y, x)`` values of TRUTH_LABELS at the middle of each voxel's slice."""
    mr_from_index: Float
    """4x4: voxel indices ``(x, y, z)`` to LPS mm."""
    rr_ms: Float
    """``(z,)`` RR interval while each slice was acquired."""
    shifts_mm: Float
    """``(z, 3)`` LPS shift of the patient while each slice was acquired."""

    @property
    def phases(self) -> Float:
        """``(phase,)`` phase of every frame."""
        return np.arange(len(self.intensity)) / len(self.intensity)

    @property
    def trigger_times_ms(self) -> Float:
        """``(z, phase)`` times after the R peak."""
        return self.rr_ms[:, None] * self.phases


def steady_state_signal(settings: MrSettings) -> Float:
    """Signal of every tissue in a balanced steady-state sequence, indexed by tissue value.

    M0 sin(a) (1 - E1) / (1 - (E1 - E2) cos(a) - E1 E2) exp(-TE / T2) with E = exp(-TR / T) and
    TE = TR / 2, on resonance with alternating pulses (Freeman and Hill, J. Magn. Reson.
    4:366-383, 1971).
    """
    t1, t2, density = np.array([RELAXATION[tissue] for tissue in Tissue]).T
    angle = math.radians(settings.flip_angle_deg)
    e1, e2 = np.exp(-settings.repetition_ms / t1), np.exp(-settings.repetition_ms / t2)
    below = 1 - (e1 - e2) * math.cos(angle) - e1 * e2
    decay = np.exp(-settings.repetition_ms / 2 / t2)
    return np.asarray(density * math.sin(angle) * (1 - e1) / below * decay)


def plan_stack(rng: np.random.Generator, heart: BeatingHeart, settings: MrSettings) -> Float:
    """Place a short-axis stack as an operator would: 4x4 LPS mm from voxel indices.

    Columns run from the right ventricle to the lateral wall, rows from the anterior wall down,
    slices from apex to base.
    """
    from scipy.spatial.transform import Rotation

    tilt = Rotation.from_rotvec(np.deg2rad(settings.planning_error_deg) * rng.standard_normal(3))
    axes = tilt.as_matrix() @ heart.rotation @ np.diag([-1.0, -1.0, 1.0])
    step = settings.slice_thickness_mm + settings.slice_gap_mm
    apex = -heart.shape.lv_length - heart.shape.apex_wall
    first = apex + 0.3 * step + rng.uniform(-1, 1)
    half = (settings.matrix - 1) / 2 * settings.pixel_mm
    middle = np.array([8.0, 4.0, 0.0]) + np.append(rng.normal(0, 4, 2), 0.0)
    middle_mm = heart.centre_mm + heart.rotation @ middle
    corner = middle_mm + axes @ np.array([-half, -half, first])
    mr_from_index = np.eye(4)
    mr_from_index[:3, :3] = axes * (settings.pixel_mm, settings.pixel_mm, step)
    mr_from_index[:3, 3] = corner
    return mr_from_index


def count_slices(heart: BeatingHeart, settings: MrSettings) -> int:
    """Slices that reach from the apex over the roof of the atria."""
    if settings.slices is not None:
        return settings.slices
    shape = heart.shape
    roof = max(shape.la_z + shape.la_radius_z, shape.ra_z + shape.ra_radius_z) + 6
    reach = roof + shape.lv_length + shape.apex_wall
    return math.ceil(reach / (settings.slice_thickness_mm + settings.slice_gap_mm)) + 1


def acquire_cine(
    rng: np.random.Generator,
    heart: BeatingHeart,
    rr_ms: Sequence[float],
    settings: MrSettings,
    progress: Progress | None = None,
) -> SyntheticCine:
    """Acquire the stack, slice by slice, one breath-hold each.

    Parameters
    ----------
    rng
        Source of planning error, shifts, shading and noise.
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
    count = len(rr_ms)
    # A diaphragm carries the heart mostly head-foot and somewhat front-back.
    shifts_mm = settings.breath_hold_shift_mm * rng.standard_normal((count, 1)) * (0.1, -0.3, 1.0)
    shading = draw_shading(rng, settings)
    shape = (settings.phases, count, settings.matrix, settings.matrix)
    intensity, labels = np.empty(shape, np.int16), np.empty(shape, np.uint8)
    for z in range(count):
        view = _Slice(heart, settings, mr_from_index, z, shifts_mm[z])
        for k in range(settings.phases):
            image, labels[k, z] = view.frame(k / settings.phases)
            intensity[k, z] = add_noise(rng, image * shading, settings)
        if progress:
            progress(z + 1, count)
    return SyntheticCine(intensity, labels, mr_from_index, np.array(rr_ms, float), shifts_mm)


class _Slice:
    """One slice, sampled at several depths; the chest around the heart is looked up once."""

    def __init__(
        self, heart: BeatingHeart, settings: MrSettings, mr_from_index: Float, z: int, shift: Float
    ) -> None:
        self.heart, self.settings = heart, settings
        self.signal = steady_state_signal(settings).astype(np.float32)
        self.truth = truth_values()
        count = settings.through_plane_samples
        step = settings.slice_thickness_mm + settings.slice_gap_mm
        depths = ((np.arange(count) + 0.5) / count - 0.5) * settings.slice_thickness_mm / step
        planes = [(depth, _spot(k)) for k, depth in enumerate(depths)] + [(0.0, (0.0, 0.0))]
        points = [self._plane(mr_from_index, z + d, spot) - shift for d, spot in planes]
        self.points = np.concatenate(points)
        self.rest = heart.chest_tissue(self.points)
        self.near = np.flatnonzero(heart.near_heart(self.points))
        self.middle = len(points[0]) * count

    def _plane(self, mr_from_index: Float, z: float, spot: tuple[float, float]) -> Float:
        y, x = np.mgrid[: self.settings.matrix, : self.settings.matrix].astype(float)
        index = np.stack([x.ravel() + spot[0], y.ravel() + spot[1], np.full(x.size, z)], axis=1)
        return np.asarray(index @ mr_from_index[:3, :3].T + mr_from_index[:3, 3])

    def tissue(self, phase: float, near: npt.NDArray[np.intp]) -> Label:
        """Tissue of all samples, the heart looked up at ``near`` alone."""
        tissue = self.rest.copy()
        here = self.heart.heart_tissue(self.points[near], phase)
        tissue[near] = np.where(here > 0, here, tissue[near])
        return tissue

    def frame(self, phase: float) -> tuple[Float32, Label]:
        """Noise-free image and truth labels of one frame, ``(y, x)`` each."""
        side = self.settings.matrix
        count = self.settings.window_samples
        image = np.zeros((side, side), np.float32)
        for k in range(count):
            instant = phase + ((k + 0.5) / count - 0.5) / self.settings.phases
            tissue = self.tissue(instant, self.near)[: self.middle]
            image += self.signal[tissue].reshape(-1, side, side).mean(axis=0) / count
        inside = self.near[self.near >= self.middle]
        labels = self.truth[self.tissue(phase, inside)[self.middle :]].reshape(side, side)
        blurred = gaussian_filter(image, self.settings.sharpness_pixels, mode="nearest")
        return blurred, np.asarray(labels)


def _spot(k: int) -> tuple[float, float]:
    """Where in its pixel sample k lies: all depths together cover the pixel evenly.

    Steps of the plastic number's low-discrepancy sequence (Roberts, 2018), centred on the pixel.
    """
    x, y = (0.7548776662466927 * (k + 1)) % 1, (0.5698402909980532 * (k + 1)) % 1
    return x - 0.5, y - 0.5


def draw_shading(rng: np.random.Generator, settings: MrSettings) -> Float32:
    """Smooth receive sensitivity over the image, mean 1: exp of a random quadratic."""
    v, u = np.mgrid[-1 : 1 : settings.matrix * 1j, -1 : 1 : settings.matrix * 1j]
    terms = np.stack([u, v, u * u, u * v, v * v])
    field = np.tensordot(rng.standard_normal(5), terms - terms.mean(axis=(1, 2), keepdims=True), 1)
    sensitivity = np.exp(settings.coil_shading * field / max(float(field.std()), 1e-9))
    return np.asarray(sensitivity / sensitivity.mean(), dtype=np.float32)


def add_noise(rng: np.random.Generator, image: Float32, settings: MrSettings) -> Int16:
    """Magnitude of the image with complex Gaussian noise (Rician), as stored integers.

    Rice distribution: Gudbjartsson and Patz, Magn. Reson. Med. 34:910-914 (1995).
    """
    deviation = float(steady_state_signal(settings)[Tissue.LV_CAVITY]) / settings.snr
    noise = deviation * rng.standard_normal((2, *image.shape), dtype=np.float32)
    magnitude = np.hypot(image + noise[0], noise[1])
    return np.asarray(np.clip(np.rint(magnitude * FULL_SCALE), 0, 32767), dtype=np.int16)
