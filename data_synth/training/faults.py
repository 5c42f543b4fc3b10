"""What a scanner does to an image: coil shading, blur, ghosts, noise and its own grey scale."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]


def smooth_noise(rng: np.random.Generator, side: int, knots: int) -> Float32:
    """A smooth random field of about unit variance, ``(side, side)``, from ``knots**2`` values."""
    coarse = rng.standard_normal((knots, knots), np.float32)
    return np.asarray(cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC))


def spoil(
    rng: np.random.Generator, image: Float32, filters: bool = True, mishaps: bool = True
) -> Float32:
    """Give ``(3, row, column)`` images the faults of one acquisition, each drawn at random.

    ``filters``: and what a console's filters make of some of them. ``mishaps``: and what spoils
    one image in many: metal, the body folded over, spikes, noise of uneven strength, and blocks.
    """
    if mishaps and rng.random() < 0.06:
        image = with_metal(rng, image)
    image = image * _shading(rng, image.shape[-1])
    image = image * np.exp(rng.normal(0.0, 0.06, (3, 1, 1))).astype(np.float32)
    sigma = rng.uniform(0.0, 1.1)
    if sigma > 0.3:
        image = np.stack([cv2.GaussianBlur(channel, (0, 0), sigma) for channel in image])
    if rng.random() < 0.15:
        image = _moved(rng, image)
    if rng.random() < 0.12:
        image = image * _bands(rng, image.shape[-1])
    if rng.random() < 0.3:
        image = _through_frequency_space(rng, image)
    if mishaps and rng.random() < 0.06:
        image = folded_over(rng, image)
    if mishaps and rng.random() < 0.08:
        image = with_spikes(rng, image)
    image = _noisy(rng, image, uneven=mishaps and rng.random() < 0.25)
    if filters:
        image = filtered(rng, image)
    image = np.stack([normalise(channel) for channel in image])
    if mishaps and rng.random() < 0.06:
        image = in_blocks(rng, image)
    if rng.random() < 0.7:
        image = np.sign(image) * np.abs(image) ** np.float32(np.exp(rng.uniform(-0.4, 0.4)))
    gain, offset = rng.uniform(0.8, 1.25), rng.uniform(-0.08, 0.08)
    return np.asarray(image * np.float32(gain) + np.float32(offset), np.float32)


def spoil_little(rng: np.random.Generator, image: Float32) -> Float32:
    """Noise alone, for comparison with `spoil`."""
    return np.stack([normalise(channel) for channel in _noisy(rng, image, uneven=False)])


def normalise(image: Float32) -> Float32:
    """Grey values with the 1st percentile at 0 and the 99th at 1, cut off at -0.2 and 1.6."""
    # Every fourth pixel in a row gives the percentiles to well under a grey level.
    low, high = np.percentile(image[:, ::4], [1, 99])
    scaled = (image - low) / max(float(high - low), 1e-6)
    return np.asarray(np.clip(scaled, -0.2, 1.6), np.float32)


def _shading(rng: np.random.Generator, side: int) -> Float32:
    """Coil sensitivity: a slope across the image and slow hills, as a factor."""
    hills = smooth_noise(rng, side, int(rng.integers(2, 5))) * rng.uniform(0.0, 0.4)
    slope = np.linspace(-0.5, 0.5, side) * rng.uniform(0.0, 1.4)
    turn = rng.uniform(0.0, 2 * np.pi)
    tilt = np.cos(turn) * slope[None, :] + np.sin(turn) * slope[:, None]
    return np.asarray(np.exp(hills + tilt), np.float32)


def _moved(rng: np.random.Generator, image: Float32) -> Float32:
    """The average over a motion along a line, as while the frame was taken."""
    length_px, turn = rng.uniform(1.0, 4.0), rng.uniform(0.0, np.pi)
    line = np.zeros((9, 9), np.float32)
    for along in np.linspace(-0.5, 0.5, 9) * length_px:
        line[round(4 + along * np.sin(turn)), round(4 + along * np.cos(turn))] += 1 / 9
    return np.stack([cv2.filter2D(channel, -1, line) for channel in image])


def _bands(rng: np.random.Generator, side: int) -> Float32:
    """Dark bands of balanced steady state, where the phase between pulses nears half a turn."""
    slope = smooth_noise(rng, side, 3) * rng.uniform(1.0, 4.0) + rng.uniform(-np.pi, np.pi)
    width = rng.uniform(0.1, 0.4)
    return np.asarray(1 - np.exp(-((np.cos(slope / 2) / width) ** 2)), np.float32)


def _through_frequency_space(rng: np.random.Generator, image: Float32) -> Float32:
    """Cut off high spatial frequencies, and weigh lines periodically, which makes ghosts."""
    side = image.shape[-1]
    spectrum = np.fft.fft2(image)
    frequency = np.abs(np.fft.fftfreq(side)) * 2
    if rng.random() < 0.6:
        spectrum = spectrum * (frequency <= rng.uniform(0.5, 1.0))[None, :, None]
        spectrum = spectrum * (frequency <= rng.uniform(0.5, 1.0))[None, None, :]
    if rng.random() < 0.6:
        period = int(rng.integers(2, 6))
        wave = 1 + rng.uniform(0, 0.12) * np.cos(2 * np.pi * np.arange(side) / period)
        spectrum = spectrum * (wave[None, :, None] if rng.random() < 0.5 else wave[None, None, :])
    return np.abs(np.fft.ifft2(spectrum)).astype(np.float32)


def windowed(rng: np.random.Generator, image: Float32) -> Float32:
    """What is left of ``(3, row, column)`` images within a window of frequencies.

    The sharper the window's edge, the more the image rings beside edges.
    """
    frequency = np.abs(np.fft.fftfreq(image.shape[-1])) * 2
    soft = rng.uniform(0.02, 0.4)
    rows, columns = (
        np.clip((cut - frequency) / soft + 0.5, 0, 1) for cut in rng.uniform(0.55, 1.0, 2)
    )
    spectrum = np.fft.fft2(image) * rows[:, None] * columns
    return np.abs(np.fft.ifft2(spectrum)).astype(np.float32)


def filtered(rng: np.random.Generator, image: Float32) -> Float32:
    """``(3, row, column)`` images as a scanner's console may show them.

    Sharpened, so that edges have a bright and a dark seam, or freed of what is finer than some
    pixels; and with all that is brighter than some share of the pixels cut off alike.
    """
    chance = rng.random()
    if chance < 0.3:
        amount, reach_px = rng.uniform(0.2, 1.6), rng.uniform(0.7, 2.5)
        soft = np.stack([cv2.GaussianBlur(channel, (0, 0), reach_px) for channel in image])
        image = np.maximum(image + np.float32(amount) * (image - soft), 0)
    elif chance < 0.4:
        side = int(rng.choice([3, 5]))
        image = np.stack([cv2.medianBlur(channel, side) for channel in image])
    if rng.random() < 0.12:
        image = np.minimum(image, np.quantile(image, rng.uniform(0.8, 0.97)))
    return np.asarray(image, np.float32)


def with_metal(rng: np.random.Generator, image: Float32) -> Float32:
    """``(3, row, column)`` images with the dark blot of a wire or clip, bright at its rim."""
    side = image.shape[-1]
    rows, columns = np.ogrid[:side, :side]
    row, column = rng.uniform(0, side, 2)
    radius_px, longer, turn = rng.uniform(2.0, 10.0), rng.uniform(1.0, 2.5), rng.uniform(0.0, np.pi)
    along = np.cos(turn) * (rows - row) + np.sin(turn) * (columns - column)
    across = np.cos(turn) * (columns - column) - np.sin(turn) * (rows - row)
    away = np.hypot(along / longer, across) / radius_px
    # Signal lost within the radius is piled up around it.
    rim = rng.uniform(0.0, 1.5) * np.exp(-(((away - 1.25) / 0.2) ** 2))
    return np.asarray(image * (1 - np.exp(-(away**6)) + rim), np.float32)


def folded_over(rng: np.random.Generator, image: Float32) -> Float32:
    """``(3, row, column)`` images with what lies beyond one side shown at the other as well."""
    side = image.shape[-1]
    width, strength = int(rng.uniform(0.1, 0.3) * side), np.float32(rng.uniform(0.3, 1.0))
    turns = int(rng.integers(4))
    turned = np.rot90(image, turns, axes=(1, 2)).copy()
    # The picture's own edge stands in for what lies beyond it.
    turned[:, :width] += strength * turned[:, side - width :]
    return np.ascontiguousarray(np.rot90(turned, -turns, axes=(1, 2)))


def with_spikes(rng: np.random.Generator, image: Float32) -> Float32:
    """``(3, row, column)`` images with the stripes of spikes among their frequencies."""
    side = image.shape[-1]
    at = np.arange(side, dtype=np.float32) * np.float32(2 * np.pi / side)
    stripes = np.zeros((side, side), np.complex64)
    for _ in range(int(rng.integers(1, 4))):
        down, right = rng.uniform(-0.5, 0.5, 2) * side
        wave = np.exp(1j * down * at)[:, None] * np.exp(1j * right * at)
        stripes += rng.uniform(0.03, 0.25) * np.exp(2j * np.pi * rng.random()) * wave
    # A spike spoils the one image that was taken at the moment; a fault of the scanner spoils all.
    spoilt = np.ones(3, bool) if rng.random() < 0.5 else np.arange(3) == rng.integers(3)
    return np.where(spoilt[:, None, None], np.abs(image + stripes), image).astype(np.float32)


def in_blocks(rng: np.random.Generator, image: Float32) -> Float32:
    """``(3, row, column)`` images of grey values from -0.2 to 1.6 after lossy compression."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(8, 50))]
    bytes_ = np.rint((image + 0.2) * (255 / 1.8)).astype(np.uint8)
    coded = [cv2.imencode(".jpg", one, quality)[1] for one in bytes_]
    shown = np.stack([np.asarray(cv2.imdecode(one, cv2.IMREAD_GRAYSCALE)) for one in coded])
    return np.asarray(shown * (1.8 / 255) - 0.2, np.float32)


def _noisy(rng: np.random.Generator, image: Float32, uneven: bool) -> Float32:
    """Magnitude of an image with complex Gaussian noise (Rice), fine or coarse in grain.

    ``uneven``: stronger in some places than in others, as coils far from one another leave it.
    """
    sigma = abs(rng.normal(0.0, 0.045))
    side = image.shape[-1]
    grain = side if rng.random() < 0.65 else side * 2 // 3
    noise = rng.standard_normal((6, grain, grain), np.float32)
    if grain != side:
        # Interpolation averages noise; the factor gives back its strength.
        noise = np.stack([1.3 * cv2.resize(one, (side, side)) for one in noise])
    if uneven:
        noise *= np.exp(rng.uniform(0.3, 1.0) * smooth_noise(rng, side, int(rng.integers(2, 6))))
    return np.asarray(np.hypot(image + sigma * noise[:3], sigma * noise[3:]), np.float32)
