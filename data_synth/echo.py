"""One B-mode picture from the tissues in front of a transducer.

The tissues are sampled in the transducer's own polar raster. Scatterers below the resolution give
fully developed speckle (complex Gaussian echoes, so a Rayleigh envelope), interfaces add a specular
echo that grows with the step of acoustic impedance and fades as the beam strikes them obliquely.
Echoes lose strength on their way there and back and reverberate between tip and reflectors; they
are blurred by a point-spread function that widens with depth, drowned in noise, amplified with
depth, log-compressed and scan-converted. Acoustic values follow Szabo, "Diagnostic Ultrasound
Imaging: Inside Out" (2nd ed., 2014, appendix B), at 2.5 MHz; losses grow with frequency.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.fft import fft, fftfreq, ifft, next_fast_len
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from data_synth.sector import Sector
from data_synth.tissue import Tissue

Float = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
Byte = npt.NDArray[np.uint8]

TABLE_MHZ = 2.5
"""Frequency of the losses below; they grow with frequency to the power of 1.1."""


@dataclass(frozen=True, slots=True)
class Acoustics:
    """What sound meets in one tissue."""

    scatter_db: float
    """Level of its speckle over that of heart muscle."""

    impedance_mrayl: float
    """Characteristic impedance."""

    attenuation_db_per_cm: float
    """One-way loss at 2.5 MHz."""


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


@dataclass(frozen=True, slots=True, eq=False)
class Echoes:
    """What sound meets in every tissue: `ACOUSTICS` as ``(tissues,)`` arrays by tissue number."""

    scatter: Float
    """Amplitude of speckle over that of heart muscle."""

    impedance_mrayl: Float
    attenuation_db_per_cm: Float


ECHOES = Echoes(
    10 ** (_table([a.scatter_db for a in ACOUSTICS.values()]) / 20),
    _table([a.impedance_mrayl for a in ACOUSTICS.values()]),
    _table([a.attenuation_db_per_cm for a in ACOUSTICS.values()]),
)
"""Of the tissues as they are."""


@dataclass(frozen=True, slots=True)
class Optics:
    """How sharply and how loudly the scanner shows what it hears.

    Widths are standard deviations of Gaussians. An array of width D hears a wavelength L within
    ``0.51 L / D`` rad (the Gaussian as wide at half height as the sinc of a uniform aperture).
    """

    frequency_mhz: float = 2.5
    aperture_mm: float = 20.0
    """Width of the array within the picture's plane."""

    focus_mm: float = 80.0
    """Range at which the transmitted beam is narrowest; reception is in focus everywhere."""

    slice_aperture_mm: float = 13.0
    """Width of the array across the picture's plane."""

    slice_focus_mm: float = 75.0
    """Range of the lens that focuses across the plane, both ways."""

    dynamic_range_db: float = 58.0
    gain_db: float = 0.0
    compensation_db_per_cm: float | None = None
    """Time-gain compensation; None: half blood, half muscle, there and back."""

    noise_db: float = -48.0
    """Level of the amplifier's own noise under that of heart muscle at the tip."""

    grey_of_muscle: float = 0.52
    """Grey value of heart muscle's mean level at gain 0, as a share of white."""

    @property
    def wavelength_mm(self) -> float:
        """In soft tissue, at 1540 m/s."""
        return 1.54 / self.frequency_mhz

    @property
    def pulse_mm(self) -> float:
        """Standard deviation of the echo's envelope in range: 4.2 periods at half height.

        A period is half a wavelength of range, for sound goes there and back.
        """
        return 0.9 * self.wavelength_mm

    @property
    def loss_scale(self) -> float:
        """How much more than at the table's frequency is lost on the way."""
        return float((self.frequency_mhz / TABLE_MHZ) ** 1.1)

    @property
    def compensation(self) -> float:
        """dB per cm of range that the amplifier adds."""
        usual = _USUAL_COMPENSATION * self.loss_scale
        return usual if self.compensation_db_per_cm is None else self.compensation_db_per_cm

    def beam_rad(self, ranges_mm: Float) -> Float:
        """Width of the beam there and back, across it within the plane.

        Transmission is diffraction and the cone off the focus (a uniform one of width w has a
        deviation of w / sqrt(12)); reception opens its aperture with range up to the whole array.
        """
        sharp = _SINC * self.wavelength_mm
        opened_mm = np.minimum(self.aperture_mm, ranges_mm / _F_NUMBER)
        cone = self.aperture_mm * np.abs(1 / ranges_mm - 1 / self.focus_mm) / np.sqrt(12)
        sent = np.hypot(sharp / self.aperture_mm, cone)
        received = sharp / opened_mm
        return np.asarray(1 / np.hypot(1 / sent, 1 / received))

    def slice_mm(self, ranges_mm: Float) -> Float:
        """Width of the beam there and back, across the picture's plane: a fixed lens both ways.

        The standard deviation of its amplitude; what tissue is heard varies by it too, which makes
        walls rather more blurred than the power of such a beam alone would.
        """
        far = np.abs(1 / ranges_mm - 1 / self.slice_focus_mm)
        cone = self.slice_aperture_mm * far / np.sqrt(12)
        one_way = np.hypot(_SINC * self.wavelength_mm / self.slice_aperture_mm, cone)
        return np.asarray(ranges_mm * one_way / np.sqrt(2))


_SINC = 0.51
_F_NUMBER = 1.5
_USUAL_COMPENSATION = 1.5
# No amplifier lifts without end.
_LARGEST_LIFT_DB = 70.0
# Level of a perfect mirror's echo over muscle's speckle; share that the tip throws back again.
_MIRROR_DB, _TIP_DB = 45.0, -20.0
# Side lobes: this high, this many times as wide as the beam.
_SIDE_DB, _SIDE_WIDTH = -40.0, 8.0


def bmode(
    rng: np.random.Generator,
    labels: npt.NDArray[np.uint8],
    sector: Sector,
    contact_db: Float,
    optics: Optics,
    scatterers: Complex | None = None,
    echoes: Echoes = ECHOES,
) -> Byte:
    """The picture of the tissues ``labels`` (``(ranges, beams)``) as a scanner shows it.

    Parameters
    ----------
    contact_db
        ``(beams,)`` how much louder or softer each beam is, two-way.
    scatterers
        ``(ranges, beams)`` complex echoes of unit mean power after :func:`point_spread`; fresh
        ones, independent of any other picture, if None.
    echoes
        What sound meets in the tissues.

    Returns
    -------
    ``(rows, columns)`` grey values.
    """
    if scatterers is None:
        scatterers = unit_noise(rng, labels.shape)
    lines = received(rng, labels, sector, contact_db, optics, scatterers, echoes)
    return sector.draw(compressed(lines, sector, optics))


def silence(rng: np.random.Generator, sector: Sector, optics: Optics) -> Byte:
    """The picture of a probe lifted into air: the tip's own ringing, and noise."""
    haze = 10 ** (8.0 / 20) * _clutter(rng, sector, optics)
    # All sound is thrown back at the tip: it echoes in the lens, 6 dB weaker each time.
    spacing_mm = 5 * optics.wavelength_mm
    depth_mm = sector.ranges_mm[:, None] - sector.tip_mm
    rings = 10.0 * np.cos(np.pi * depth_mm / spacing_mm) ** 8 * 0.5 ** (depth_mm / spacing_mm)
    lines = haze + rings + _noise(rng, sector, optics)
    return sector.draw(compressed(lines, sector, optics))


def received(
    rng: np.random.Generator,
    labels: npt.NDArray[np.uint8],
    sector: Sector,
    contact_db: Float,
    optics: Optics,
    scatterers: Complex,
    echoes: Echoes = ECHOES,
) -> Complex:
    """What the array hears, ``(ranges, beams)``, before any amplifier; muscle at the tip is 1."""
    log_impedance = np.log(echoes.impedance_mrayl)[labels]
    echo = echoes.scatter[labels] * scatterers + _specular(log_impedance, sector, scatterers)
    loss_db = path_loss_db(labels, sector, optics, echoes)
    echo = echo * 10 ** ((contact_db - loss_db) / 20)
    echo = point_spread(echo, sector, optics)
    echo += _reverberation(echo, sector)
    return echo + _clutter(rng, sector, optics) + _noise(rng, sector, optics)


def compressed(lines: Complex, sector: Sector, optics: Optics) -> Float:
    """Grey values in [0, 255] of what is heard, amplified with depth and log-compressed."""
    lift_db = np.minimum(optics.compensation * sector.ranges_mm / 10, _LARGEST_LIFT_DB)
    level_db = 20 * np.log10(np.abs(lines) + 1e-9) + lift_db[:, None] + optics.gain_db
    grey = 255 * (optics.grey_of_muscle + level_db / optics.dynamic_range_db)
    return np.asarray(np.clip(grey, 0, 255))


def unit_noise(rng: np.random.Generator, shape: tuple[int, ...]) -> Complex:
    """Circular complex Gaussian of unit mean power."""
    real, imaginary = rng.normal(scale=np.sqrt(0.5), size=(2, *shape))
    return np.asarray(real + 1j * imaginary)


def path_loss_db(
    labels: npt.NDArray[np.uint8], sector: Sector, optics: Optics, echoes: Echoes = ECHOES
) -> Float:
    """``(ranges, beams)`` loss on the way there and back."""
    each = 2 * optics.loss_scale * echoes.attenuation_db_per_cm[labels]
    return np.asarray(np.cumsum(each, axis=0) * sector.range_step_mm / 10)


def _specular(log_impedance: Float, sector: Sector, scatterers: Complex) -> Complex:
    """Echoes of interfaces: reflection coefficient per mm, times how squarely the beam hits."""
    beam_step_rad = sector.angles_rad[1] - sector.angles_rad[0]
    smooth = gaussian_filter(log_impedance, (0.7 / sector.range_step_mm, 1.0), mode="nearest")
    along = np.gradient(smooth, sector.range_step_mm, axis=0)
    across = np.gradient(smooth, beam_step_rad, axis=1) / sector.ranges_mm[:, None]
    steepness = np.hypot(along, across)
    squareness = np.abs(along) / np.maximum(steepness, 1e-9)
    # Half the step of log impedance is the reflection coefficient. Rough walls send a tenth of a
    # square hit's echo back anyway.
    mirror = 10 ** (_MIRROR_DB / 20)
    strength = 0.5 * steepness * mirror * (0.1 + 0.9 * squareness**4)
    # The interface is rough: its echo fluctuates around a steady part.
    return np.asarray(strength * (0.6 + 0.8 * scatterers))


def point_spread(echo: Complex, sector: Sector, optics: Optics) -> Complex:
    """Convolve with the pulse along the beams and with the widening beam across them.

    White noise of unit power keeps unit power, so that speckle keeps its level at every depth.
    """
    echo = _pulse_filtered(echo, sector, optics)
    width_rad = np.minimum(optics.beam_rad(sector.ranges_mm), 0.15)
    step_rad = sector.angles_rad[1] - sector.angles_rad[0]
    # Beyond the fan's edges the body goes on: mirrored, so that the edges are not dimmed.
    margin = min(int(4 * width_rad.max() / step_rad) + 1, sector.beams - 1)
    wide = np.pad(echo, ((0, 0), (margin, margin)), mode="reflect")
    length = next_fast_len(wide.shape[1])
    frequency = 2 * np.pi * fftfreq(length, step_rad)
    transfer = _beam_transfer(width_rad[:, None] * frequency)
    spread = ifft(fft(wide, length, axis=1) * transfer, axis=1)
    return np.asarray(spread[:, margin : margin + sector.beams])


def _beam_transfer(phase: Float) -> Float:
    """Spectrum of the beam's profile, main lobe and side lobes, that keeps white noise's power.

    ``phase``: ``(ranges, n)`` frequency times width.
    """
    side = 10 ** (_SIDE_DB / 20) * _SIDE_WIDTH
    transfer = np.exp(-0.5 * phase**2) + side * np.exp(-0.5 * (_SIDE_WIDTH * phase) ** 2)
    return np.asarray(transfer / np.sqrt(np.mean(transfer**2, axis=1, keepdims=True)))


def _pulse_filtered(echo: Complex, sector: Sector, optics: Optics) -> Complex:
    """Convolve along the beams with the pulse, scaled to keep the power of white noise."""
    sigma = optics.pulse_mm / sector.range_step_mm
    blurred = gaussian_filter1d(echo.real, sigma, axis=0) + 1j * gaussian_filter1d(
        echo.imag, sigma, axis=0
    )
    reach = np.arange(-int(4 * sigma + 0.5), int(4 * sigma + 0.5) + 1)
    kernel = np.exp(-0.5 * (reach / sigma) ** 2)
    return np.asarray(blurred * kernel.sum() / np.sqrt((kernel**2).sum()))


def _reverberation(echo: Complex, sector: Sector) -> Complex:
    """Echoes that took the way twice, between reflector and tip: at twice the range.

    A reflector as loud as ``echo`` throws back ``echo / mirror`` of what meets it, again.
    """
    half = (sector.ranges_mm / 2 - sector.tip_mm) / sector.range_step_mm
    late = half >= 0
    first = echo[np.rint(half[late]).astype(int)]
    twice = np.zeros_like(echo)
    twice[late] = 10 ** ((_TIP_DB - _MIRROR_DB) / 20) * np.abs(first) * first
    return twice


def _clutter(rng: np.random.Generator, sector: Sector, optics: Optics) -> Complex:
    """Reverberation between tip and skin: a haze that dies out within some 30 wavelengths."""
    drop_db_per_mm = 1.6 * optics.frequency_mhz / TABLE_MHZ
    fade = 10 ** ((-6 - drop_db_per_mm * (sector.ranges_mm - sector.tip_mm)) / 20)
    shape = (len(sector.ranges_mm), sector.beams)
    haze = gaussian_filter(rng.normal(size=shape), (0.8, 6.0), mode="nearest")
    return np.asarray(fade[:, None] * haze / haze.std() + 0j)


def _noise(rng: np.random.Generator, sector: Sector, optics: Optics) -> Complex:
    """The amplifier's own noise, in the pulse's band."""
    shape = (len(sector.ranges_mm), sector.beams)
    level = 10 ** (optics.noise_db / 20)
    return np.asarray(level * _pulse_filtered(unit_noise(rng, shape), sector, optics))
