"""One B-mode picture from the tissues in front of a transducer.

The tissues are sampled in the transducer's own polar raster. Scatterers below the resolution give
fully developed speckle (complex Gaussian echoes, so a Rayleigh envelope), interfaces add a specular
echo that grows with the step of acoustic impedance and fades as the beam strikes them obliquely.
Echoes are attenuated on their way, blurred by a point-spread function that widens away from the
focus, amplified with depth, log-compressed and scan-converted. Acoustic values follow Szabo,
"Diagnostic Ultrasound Imaging: Inside Out" (2nd ed., 2014, appendix B), at about 2.5 MHz.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.fft import fft, fftfreq, ifft, next_fast_len
from scipy.ndimage import gaussian_filter, gaussian_filter1d, map_coordinates

from data_synth.tissue import Tissue

Float = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
Byte = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Acoustics:
    """What sound meets in one tissue."""

    scatter_db: float
    """Level of its speckle over that of heart muscle."""

    impedance_mrayl: float
    """Characteristic impedance."""

    attenuation_db_per_cm: float
    """One-way loss."""


_BLOOD = Acoustics(-32.0, 1.66, 0.3)
_HEART_MUSCLE = Acoustics(0.0, 1.71, 1.2)
# Aerated lung and bone let next to nothing through: their shadow is what one sees of them.
ACOUSTICS: dict[Tissue, Acoustics] = {
    Tissue.AIR: Acoustics(-60.0, 0.10, 40.0),
    Tissue.FAT: Acoustics(3.0, 1.55, 1.5),
    Tissue.MUSCLE: Acoustics(1.0, 1.70, 1.3),
    Tissue.LUNG: Acoustics(4.0, 0.60, 16.0),
    Tissue.BONE: Acoustics(6.0, 4.00, 20.0),
    Tissue.LIVER: Acoustics(-1.0, 1.65, 1.2),
    Tissue.BLOOD_VESSEL: _BLOOD,
    Tissue.LV_CAVITY: _BLOOD,
    Tissue.LV_MYOCARDIUM: _HEART_MUSCLE,
    Tissue.RV_CAVITY: _BLOOD,
    Tissue.RV_WALL: _HEART_MUSCLE,
    Tissue.LEFT_ATRIUM: _BLOOD,
    Tissue.RIGHT_ATRIUM: _BLOOD,
    Tissue.ATRIAL_WALL: Acoustics(3.0, 1.75, 1.2),
    Tissue.AORTA: _BLOOD,
    Tissue.VESSEL_WALL: Acoustics(5.0, 1.80, 1.2),
    Tissue.STOMACH: Acoustics(0.0, 1.40, 4.0),
    Tissue.PAPILLARY_MUSCLE: _HEART_MUSCLE,
    Tissue.RV_TRABECULA: _HEART_MUSCLE,
    Tissue.PERICARDIUM: Acoustics(8.0, 1.85, 1.5),
    Tissue.GAS: Acoustics(-60.0, 0.10, 40.0),
    Tissue.SPLEEN: Acoustics(-1.0, 1.66, 1.0),
    Tissue.LEAFLET: Acoustics(6.0, 1.80, 1.2),
    Tissue.SCAR: Acoustics(4.0, 1.75, 1.4),
}


def _table(values: list[float]) -> Float:
    """Values by tissue number, so that labels index it."""
    table = np.zeros(max(ACOUSTICS) + 1)
    table[[int(tissue) for tissue in ACOUSTICS]] = values
    return table


_SCATTER = 10 ** (_table([a.scatter_db for a in ACOUSTICS.values()]) / 20)
_IMPEDANCE = _table([a.impedance_mrayl for a in ACOUSTICS.values()])
_ATTENUATION = _table([a.attenuation_db_per_cm for a in ACOUSTICS.values()])

# The time-gain compensation of a cardiac preset: half blood, half muscle, there and back.
_COMPENSATION_DB_PER_CM = 1.4
# An amplifier cannot lift without end: what is below this under muscle's level is noise.
_NOISE_DB = -44.0


@dataclass(frozen=True)
class Sector:
    """The fan that a phased array scans, and the picture it is drawn into.

    Transducer frame (mm): origin at the tip, x across the picture, y along the middle beam away
    from the tip, z across the plane. Pixel ``(i, j)`` is at ``((i - centre) * pixel, j * pixel)``.
    """

    depth_mm: float
    angle_deg: float
    pixel_mm: float
    beams: int
    range_step_mm: float = 0.5
    tip_mm: float = 3.0
    """Blind range in front of the tip, where the ringing transducer hears nothing."""

    @cached_property
    def ranges_mm(self) -> Float:
        """Distances from the tip of the samples along every beam."""
        return np.arange(self.tip_mm, self.depth_mm + self.range_step_mm, self.range_step_mm)

    @cached_property
    def angles_rad(self) -> Float:
        """Angles of the beams off the middle one."""
        half = np.deg2rad(self.angle_deg) / 2
        return np.linspace(-half, half, self.beams)

    @cached_property
    def picture_shape(self) -> tuple[int, int]:
        """Rows and columns of the picture."""
        half = self.depth_mm * np.sin(np.deg2rad(self.angle_deg) / 2)
        return round(self.depth_mm / self.pixel_mm) + 1, 2 * round(half / self.pixel_mm) + 1

    @cached_property
    def points_mm(self) -> Float:
        """``(ranges, beams, 3)`` samples in the transducer frame."""
        across = np.outer(self.ranges_mm, np.sin(self.angles_rad))
        along = np.outer(self.ranges_mm, np.cos(self.angles_rad))
        return np.stack([across, along, np.zeros_like(along)], axis=-1)

    @cached_property
    def transducer_from_image(self) -> Float:
        """4x4 from pixel ``(i, j, 0)`` to transducer mm."""
        matrix = np.diag([self.pixel_mm, self.pixel_mm, self.pixel_mm, 1.0])
        matrix[0, 3] = -(self.picture_shape[1] // 2) * self.pixel_mm
        return matrix

    @cached_property
    def _polar_of_pixels(self) -> Float:
        """``(2, rows, columns)`` fractional range and beam number of every pixel."""
        rows, columns = self.picture_shape
        along, across = np.mgrid[0:rows, 0:columns] * self.pixel_mm
        across -= (columns // 2) * self.pixel_mm
        sample = (np.hypot(across, along) - self.tip_mm) / self.range_step_mm
        step = self.angles_rad[1] - self.angles_rad[0]
        beam = (np.arctan2(across, along) - self.angles_rad[0]) / step
        return np.stack([sample, beam])

    @cached_property
    def inside(self) -> npt.NDArray[np.bool_]:
        """``(rows, columns)`` True for the pixels that the beams reach."""
        sample, beam = self._polar_of_pixels
        last = len(self.ranges_mm) - 1
        heard = (sample >= 0) & (sample <= last) & (beam >= 0) & (beam <= self.beams - 1)
        return np.asarray(heard)

    def draw(self, polar: Float) -> Byte:
        """Scan-convert ``(ranges, beams)`` grey values in [0, 255]; 0 outside the fan."""
        picture = map_coordinates(polar, self._polar_of_pixels, order=1, mode="nearest")
        grey = np.clip(np.rint(picture), 0, 255)
        return np.where(self.inside, grey, 0).astype(np.uint8)


@dataclass(frozen=True, slots=True)
class Optics:
    """How sharply and how loudly the scanner shows what it hears."""

    pulse_mm: float = 0.55
    """Standard deviation of the pulse's envelope along the beam."""

    beam_rad: float = 0.011
    """Standard deviation of the beam across, at the focus."""

    aperture_mm: float = 12.0
    """Width of the array: sets how fast the beam widens off the focus."""

    focus_mm: float = 80.0
    dynamic_range_db: float = 58.0
    grey_of_muscle: float = 0.52
    """Grey value of heart muscle's mean level, as a share of white."""


def bmode(
    rng: np.random.Generator,
    labels: npt.NDArray[np.uint8],
    sector: Sector,
    contact_db: Float,
    optics: Optics,
) -> Byte:
    """The picture of the tissues ``labels`` (``(ranges, beams)``) as a scanner shows it.

    Parameters
    ----------
    contact_db
        ``(beams,)`` how much louder or softer each beam is, two-way.

    Returns
    -------
    ``(rows, columns)`` grey values.
    """
    echo = _scattered(rng, labels) + _specular(rng, labels, sector)
    echo *= 10 ** ((_path_db(labels, sector) + contact_db) / 20)
    echo = _blurred(echo, sector, optics)
    echo += _clutter(rng, sector) + _noise(rng, sector, optics)
    level_db = 20 * np.log10(np.abs(echo) + 1e-9)
    muscle = optics.grey_of_muscle
    grey = 255 * (muscle + level_db / optics.dynamic_range_db)
    return sector.draw(np.clip(grey, 0, 255))


def _unit_noise(rng: np.random.Generator, shape: tuple[int, ...]) -> Complex:
    """Circular complex Gaussian of unit mean power."""
    real, imaginary = rng.normal(scale=np.sqrt(0.5), size=(2, *shape))
    return np.asarray(real + 1j * imaginary)


def _scattered(rng: np.random.Generator, labels: npt.NDArray[np.uint8]) -> Complex:
    """Echoes of the scatterers too fine to see, unit power in heart muscle."""
    return np.asarray(_SCATTER[labels] * _unit_noise(rng, labels.shape))


def _specular(rng: np.random.Generator, labels: npt.NDArray[np.uint8], sector: Sector) -> Complex:
    """Echoes of interfaces: reflection coefficient per mm, times how squarely the beam hits."""
    log_impedance = np.log(_IMPEDANCE)[labels]
    beam_step_rad = sector.angles_rad[1] - sector.angles_rad[0]
    smooth = gaussian_filter(log_impedance, (0.7 / sector.range_step_mm, 1.0), mode="nearest")
    along = np.gradient(smooth, sector.range_step_mm, axis=0)
    across = np.gradient(smooth, beam_step_rad, axis=1) / sector.ranges_mm[:, None]
    steepness = np.hypot(along, across)
    squareness = np.abs(along) / np.maximum(steepness, 1e-9)
    # Half the step of log impedance is the reflection coefficient; speckle of muscle is about
    # 45 dB below a perfect mirror. Rough walls send a tenth of a square hit's echo back anyway.
    mirror = 10 ** (45 / 20)
    strength = 0.5 * steepness * mirror * (0.1 + 0.9 * squareness**4)
    # The interface is rough: its echo fluctuates around a steady part.
    return np.asarray(strength * (0.6 + 0.8 * _unit_noise(rng, labels.shape)))


def _path_db(labels: npt.NDArray[np.uint8], sector: Sector) -> Float:
    """``(ranges, beams)`` gain of the way there and back, after compensation; at most 12 dB up."""
    excess = 2 * (_ATTENUATION[labels] - _COMPENSATION_DB_PER_CM / 2)
    path_db = -np.cumsum(excess, axis=0) * sector.range_step_mm / 10
    return np.asarray(np.clip(path_db, -120.0, 12.0))


def _blurred(echo: Complex, sector: Sector, optics: Optics) -> Complex:
    """Convolve with the pulse along the beams and with the widening beam across them.

    Unit power stays unit power, so that speckle keeps its level at every depth.
    """
    echo = _pulse_filtered(echo, sector, optics)
    width_rad = _beam_width_rad(sector, optics)
    step_rad = sector.angles_rad[1] - sector.angles_rad[0]
    length = next_fast_len(sector.beams + int(8 * width_rad.max() / step_rad))
    frequency = 2 * np.pi * fftfreq(length, step_rad)
    transfer = np.exp(-0.5 * (width_rad[:, None] * frequency) ** 2)
    transfer /= np.sqrt(np.mean(transfer**2, axis=1, keepdims=True))
    spread = ifft(fft(echo, length, axis=1) * transfer, axis=1)
    return np.asarray(spread[:, : sector.beams])


def _pulse_filtered(echo: Complex, sector: Sector, optics: Optics) -> Complex:
    """Convolve along the beams with the pulse, scaled to keep the power of white noise."""
    sigma = optics.pulse_mm / sector.range_step_mm
    blurred = gaussian_filter1d(echo.real, sigma, axis=0) + 1j * gaussian_filter1d(
        echo.imag, sigma, axis=0
    )
    # The sum of the squares of a sampled Gaussian of unit sum is 1 / (2 sqrt(pi) sigma).
    return np.asarray(blurred * np.sqrt(2 * np.sqrt(np.pi) * sigma))


def _beam_width_rad(sector: Sector, optics: Optics) -> Float:
    """``(ranges,)`` standard deviation of the beam: diffraction, and the cone off the focus."""
    defocus = np.abs(1 / sector.ranges_mm - 1 / optics.focus_mm) * optics.aperture_mm / 4
    return np.hypot(optics.beam_rad, np.minimum(defocus, 0.15))


def _clutter(rng: np.random.Generator, sector: Sector) -> Complex:
    """Reverberation between tip and skin: a haze that dies out within 20 mm."""
    fade = 10 ** ((-6 - 1.6 * (sector.ranges_mm - sector.tip_mm)) / 20)
    shape = (len(sector.ranges_mm), sector.beams)
    haze = gaussian_filter(rng.normal(size=shape), (0.8, 6.0), mode="nearest")
    return np.asarray(fade[:, None] * haze / haze.std() + 0j)


def _noise(rng: np.random.Generator, sector: Sector, optics: Optics) -> Complex:
    """Electronic noise, lifted with depth by the compensation."""
    shape = (len(sector.ranges_mm), sector.beams)
    # The gain that compensates attenuation also lifts noise; 20 dB separate tip and bottom.
    rise_db = _NOISE_DB + 20 * sector.ranges_mm / sector.depth_mm
    noise = _pulse_filtered(_unit_noise(rng, shape), sector, optics)
    return np.asarray(10 ** (rise_db / 20)[:, None] * noise)
