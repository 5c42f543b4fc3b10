"""One synthetic study in memory: the heart, and every recording of it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from data_synth.ecg import EcgSignal, simulate_ecg
from data_synth.errors import SynthError
from data_synth.heart import BeatingHeart
from data_synth.kernels import Float
from data_synth.mr import (
    LONG_AXIS_VIEWS,
    SyntheticCine,
    acquire_cine,
    acquire_long_axis,
    acquire_volume,
    count_slices,
)
from data_synth.population import draw_heart
from data_synth.protocol import BREATH_HOLD_S, VOLUME_S
from data_synth.settings import PhantomSettings, check_settings
from data_synth.ultrasound import Sweep, simulate_sweeps

Progress = Callable[[int, int], None]

SWEEP_PAUSE_S = 3.0
"""Time between two ultrasound sweeps that the recorded ECG has to leave room for."""
START_MM, START_DEG = 10.0, 10.0
"""How far the first guess of the tracker's place is from the truth."""
HEART, MR_ECG, CINE, ULTRASOUND_ECG, ULTRASOUND, START, LONG_AXIS = range(7)
"""Numbers of the random streams: each part of a study draws from its own."""


@dataclass(frozen=True)
class SyntheticStudy:
    """A patient, and what was recorded of it."""

    settings: PhantomSettings
    heart: BeatingHeart
    cine: SyntheticCine
    """The short-axis stack, or the isotropic volume."""
    views: Mapping[str, SyntheticCine]
    """Long-axis views, one slice each, by name."""
    mr_ecg: EcgSignal
    """Recorded during MR."""
    us_ecg: EcgSignal | None
    """Recorded during ultrasound; None when that was left out."""
    sweeps: tuple[Sweep, ...]
    initial_mr_from_tracker: Float | None
    """First guess of the tracker's place, 10 mm and 10 degrees off."""


def stream(settings: PhantomSettings, part: int) -> np.random.Generator:
    """Random numbers of one part of a study, whatever the other parts draw."""
    return np.random.default_rng([settings.seed, part])


def load_heart(settings: PhantomSettings) -> BeatingHeart:
    """The heart that a study with these settings shows.

    It tells tissue, place, displacement and velocity of any point at any phase.
    """
    return draw_heart(
        stream(settings, HEART), settings.spread, settings.pathology, settings.heart_rate_bpm
    )


def settings_of(study: Path) -> PhantomSettings:
    """Settings with which the study in this folder was made, from its ``truth/truth.json``.

    Raises
    ------
    SynthError
        When there is no such file, or it holds no settings that this version reads.
    """
    path = study / "truth" / "truth.json"
    try:
        content = json.loads(path.read_text())["settings"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise SynthError(f"{path}: holds no phantom's settings ({error!r})") from error
    if not isinstance(content, dict):
        raise SynthError(f"{path}: holds no phantom's settings (settings: {content!r})")
    return check_settings(content, str(path))


def simulate_study(
    settings: PhantomSettings, progress: Progress | None = None, done: int = 100
) -> SyntheticStudy:
    """Make one study.

    Parameters
    ----------
    settings
        The patient and the recordings.
    progress
        Told (parts done, 100).
    done
        What ``progress`` is told at the end.

    Raises
    ------
    SynthError
        When the settings ask for what cannot be recorded, such as a lead that comes off after the
        ECG's end, or sweeps longer than the ECG; see `simulate_ecg` and `simulate_sweeps`.
    """
    heart = load_heart(settings)
    middle = done * 55 // 100
    # What cannot be recorded is refused before minutes are spent on the rest.
    us_ecg = None if settings.cine_only else _ultrasound_ecg(settings)
    mr_ecg, cine, views = _magnetic_resonance(settings, heart, share(progress, 0, middle))
    if us_ecg is None:
        return SyntheticStudy(settings, heart, cine, views, mr_ecg, None, (), None)
    told, r_times_s = share(progress, middle, done), us_ecg.r_times_s
    rng = stream(settings, ULTRASOUND)
    sweeps = tuple(simulate_sweeps(rng, heart, r_times_s, settings.ultrasound, told))
    truth = sweeps[0].mr_from_tracker
    start = first_guess(stream(settings, START), truth, heart.centre_mm)
    return SyntheticStudy(settings, heart, cine, views, mr_ecg, us_ecg, sweeps, start)


def share(progress: Progress | None, start: int, end: int) -> Progress | None:
    """Progress of one part, told as the percentage of the whole between ``start`` and ``end``."""
    if progress is None:
        return None
    return lambda done, total: progress(start + (end - start) * done // total, 100)


def record_ecg(settings: PhantomSettings, part: int, needed_s: float) -> EcgSignal:
    """ECG during MR or during ultrasound, with room for what is recorded beside it."""
    asked = (settings.ecg.start_rate_bpm, settings.ecg.end_rate_bpm)
    slowest_bpm = min([settings.heart_rate_bpm, *(rate for rate in asked if rate)])
    # Two beats more at each end, for a phase needs an R peak on both sides.
    duration_s = needed_s + 4 * 60 / slowest_bpm
    ecg = settings.ecg.away_from_scanner() if part == ULTRASOUND_ECG else settings.ecg
    mean_rr_s = 60 / settings.heart_rate_bpm
    try:
        return simulate_ecg(stream(settings, part), duration_s, mean_rr_s, settings=ecg)
    except SynthError as error:
        beside = "ultrasound" if part == ULTRASOUND_ECG else "MR"
        raise SynthError(f"ECG beside {beside}: {error}") from error


def _magnetic_resonance(
    settings: PhantomSettings, heart: BeatingHeart, progress: Progress | None
) -> tuple[EcgSignal, SyntheticCine, dict[str, SyntheticCine]]:
    """ECG, stack or volume, and long-axis views, in the order in which they are acquired."""
    volume = settings.mr.acquisition == "volume"
    slices = 0 if volume else count_slices(heart, settings.mr)
    views = len(LONG_AXIS_VIEWS) if settings.long_axis else 0
    first_s = VOLUME_S if volume else slices * BREATH_HOLD_S
    ecg = record_ecg(settings, MR_ECG, first_s + views * BREATH_HOLD_S)
    rng, told = stream(settings, CINE), share(progress, 0, 85)
    if volume:
        beats_ms = 1000 * np.diff(ecg.r_times_s[ecg.r_times_s < VOLUME_S])
        cine = acquire_volume(rng, heart, beats_ms.tolist(), settings.mr, told)
    else:
        rr_ms = hold_rr_ms(ecg.r_times_s, 0.0, slices)
        cine = acquire_cine(rng, heart, rr_ms, settings.mr, told)
    if not views:
        return ecg, cine, {}
    rr_ms = hold_rr_ms(ecg.r_times_s, first_s, views)
    told = share(progress, 85, 100)
    views_of = acquire_long_axis(stream(settings, LONG_AXIS), heart, rr_ms, settings.mr, told)
    return ecg, cine, views_of


def _ultrasound_ecg(settings: PhantomSettings) -> EcgSignal:
    preset = settings.ultrasound
    run_s = preset.frames / preset.frame_rate_hz
    return record_ecg(settings, ULTRASOUND_ECG, preset.sweeps * (run_s + SWEEP_PAUSE_S))


def first_guess(rng: np.random.Generator, mr_from_tracker: Float, centre_mm: Float) -> Float:
    """A start for registration: the truth turned about the heart's centre, then shifted.

    Turn (10 degrees) and shift (10 mm) have their set size and a random direction.
    """
    axis, way = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    off = np.eye(4)
    off[:3, :3] = Rotation.from_rotvec(np.deg2rad(START_DEG) * axis).as_matrix()
    off[:3, 3] = centre_mm - off[:3, :3] @ centre_mm + START_MM * way
    return np.asarray(off @ mr_from_tracker)


def hold_rr_ms(r_times_s: Float, start_s: float, holds: int) -> list[float]:
    """RR interval of each of a row of breath-holds: the mean while it lasted.

    In whole ms, as DICOM holds it.
    """
    middles = (r_times_s[1:] + r_times_s[:-1]) / 2
    intervals = np.diff(r_times_s)
    which = (middles - start_s) // BREATH_HOLD_S
    return [float(np.rint(1000 * intervals[which == z].mean())) for z in range(holds)]
