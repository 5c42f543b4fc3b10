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


def spoil(rng: np.random.Generator, image: Float32, filters: bool = True) -> Float32:
    """Give ``(3, row, column)`` images the faults of one acquisition, each drawn at random.

    ``filters``: and what a console's filters make of some of them.
    """
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
    image = _noisy(rng, image)
    if filters:
        image = filtered(rng, image)
    image = np.stack([normalise(channel) for channel in image])
    if rng.random() < 0.7:
        image = np.sign(image) * np.abs(image) ** np.float32(np.exp(rng.uniform(-0.4, 0.4)))
    gain, offset = rng.uniform(0.8, 1.25), rng.uniform(-0.08, 0.08)
    return np.asarray(image * np.float32(gain) + np.float32(offset), np.float32)


def spoil_little(rng: np.random.Generator, image: Float32) -> Float32:
    """Noise alone, for comparison with `spoil`."""
    return np.stack([normalise(channel) for channel in _noisy(rng, image)])


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


def _noisy(rng: np.random.Generator, image: Float32) -> Float32:
    """Magnitude of an image with complex Gaussian noise (Rice), fine or coarse in grain."""
    sigma = abs(rng.normal(0.0, 0.045))
    side = image.shape[-1]
    grain = side if rng.random() < 0.65 else side * 2 // 3
    noise = rng.standard_normal((6, grain, grain), np.float32)
    if grain != side:
        # Interpolation averages noise; the factor gives back its strength.
        noise = np.stack([1.3 * cv2.resize(one, (side, side)) for one in noise])
    return np.asarray(np.hypot(image + sigma * noise[:3], sigma * noise[3:]), np.float32)
