"""R peaks and the phase clock against the phantom's own beats: the tables of docs/time.md.

Run ``python benchmarks/bench_clock.py`` (``--seeds 1`` for a quick look).
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np
from lost_leads import loss_table

from data_synth.beat import end_systole_phase, kick_onset_phase, warp_phase
from data_synth.ecg import EcgSettings, EcgSignal, LostLead, simulate_ecg
from pipeline.geometry import Float
from pipeline.registration.clock import PhaseClock
from pipeline.registration.rpeaks import RPeakDetector, find_beats
from pipeline.registration.time import phases_at

SAME_BEAT_S = 0.15
F_MAX_N, FORCE_RATE_N_PER_S = 3.3, 10.0
NOISY = {"magnetohydrodynamic_mv": 0.5, "muscle_snr_db": 6.0}
DISTURBANCES: dict[str, dict[str, object]] = {
    "clean": {},
    "scanner 1.5 T, 6 dB": NOISY,
    "scanner 3 T": {"magnetohydrodynamic_mv": 0.5, "field_strength_t": 3.0},
    "fibrillation": {"fibrillation": True},
    "early ventricular": {"ectopic_probability": 0.1},
}
RHYTHMS: dict[str, dict[str, object]] = {
    "regular": {},
    "regular, 50 /min": {"start_rate_bpm": 50, "end_rate_bpm": 50},
    "ramp 50 to 150 /min": {"start_rate_bpm": 50, "end_rate_bpm": 150},
    "ramp 150 to 50 /min": {"start_rate_bpm": 150, "end_rate_bpm": 50},
    "premature atrial": {"atrial_probability": 0.1},
    "premature ventricular": {"ectopic_probability": 0.1},
    "fibrillation 30-60 s": {"fibrillation": True, "fibrillation_s": (30, 60)},
    "all leads lost twice": {
        "lost": (
            LostLead(lead="all", start_s=30.3, end_s=40.0),
            LostLead(lead="all", start_s=60.5, end_s=63.0, kind="rail"),
        )
    },
    "one lead of three lost": {"lost": (LostLead(lead="II", start_s=30.3, end_s=60.0),)},
    "scanner 1.5 T, 6 dB": NOISY,
}
REGULAR_SHARE = 0.17
"""The most that a beat of a regular rhythm may be off, as a share of the interval."""


@dataclass
class Tally:
    """Beats found, missed and made up, and how late the found ones were timed."""

    found: int = 0
    missed: int = 0
    extra: int = 0
    late_s: tuple[float, ...] = ()

    def add(self, truth_s: Float, found_s: Float, end_s: float) -> None:
        """Count one record; a complex cut by its ends need not be seen."""
        inner_s = truth_s[(truth_s > 0.1) & (truth_s < end_s - 0.1)]
        late = [
            float(found_s[np.abs(found_s - r_s).argmin()] - r_s) if len(found_s) else np.inf
            for r_s in inner_s
        ]
        hits = tuple(one for one in late if abs(one) <= SAME_BEAT_S)
        self.found, self.missed = self.found + len(hits), self.missed + len(late) - len(hits)
        self.extra += sum(np.abs(truth_s - one).min() > SAME_BEAT_S for one in found_s)
        self.late_s += hits

    def row(self) -> str:
        """Sensitivity, positive predictivity, median and 99th percentile of the timing error."""
        off_ms = 1e3 * np.abs(np.array(self.late_s))
        return (
            f"{self.found + self.missed:6d} beats  sensitivity "
            f"{100 * self.found / (self.found + self.missed):7.3f} %  predictivity "
            f"{100 * self.found / (self.found + self.extra):7.3f} %  off {np.median(off_ms):5.2f} "
            f"ms, p99 {np.percentile(off_ms, 99):5.2f}"
        )


def detector_table(seeds: int) -> None:
    """By disturbance, sampling rate and polarity, over three heart rates."""
    print("R peaks (three leads)")
    for name, extra in DISTURBANCES.items():
        for rate_hz in (100.0, 250.0, 360.0, 1000.0, 2000.0):
            for sign in (1.0, -1.0):
                tally = Tally()
                for seed in range(seeds):
                    for rr_s in (0.5, 0.8, 1.4):
                        ecg = _record(seed, 30.0, rr_s, rate_hz, extra)
                        beats = find_beats(sign * ecg.signal_mv, rate_hz)
                        tally.add(ecg.r_times_s, np.array([one.time_s for one in beats]), 30.0)
                print(f"  {name:20s} {rate_hz:6.0f} Hz {'+' if sign > 0 else '-'} {tally.row()}")


def speed_table() -> None:
    """Microseconds a sample, pushed one by one, detector and clock together."""
    print("processor time of one sample, detector and clock")
    first = PhaseClock(0.8)
    first.beat(0.0)
    # Compiled now, if not before.
    first.at(0.1)
    for rate_hz in (100.0, 500.0, 2000.0):
        ecg = _record(0, 20.0, 0.8, rate_hz, {})
        detector, clock = RPeakDetector(rate_hz, 3), PhaseClock(0.8)
        start_s = time.process_time()
        for number, sample in enumerate(ecg.signal_mv):
            for beat in detector.push(sample):
                clock.beat(beat.time_s, beat.strange)
            clock.at(number / rate_hz, detector.usable)
        each_us = 1e6 * (time.process_time() - start_s) / len(ecg.signal_mv)
        print(f"  {rate_hz:6.0f} Hz {each_us:6.1f} us")


def clock_table(seeds: int) -> None:
    """Phase against truth while valid, time valid, and the largest step of force."""
    print("phase clock, 90 s each after 10 s")
    for name, extra in RHYTHMS.items():
        errors_ms, delays_ms, valid, force = [], [], [], 0.0
        for seed in range(seeds):
            one_ms, one_delays_ms, one_valid, one_force = _run_clock(seed, extra)
            errors_ms.append(one_ms)
            delays_ms.extend(one_delays_ms)
            valid.append(one_valid)
            force = max(force, one_force)
        off = np.concatenate(errors_ms)
        shown = np.percentile(off, [50, 95]) if len(off) else (np.nan, np.nan)
        print(
            f"  {name:22s} valid {100 * np.mean(valid):5.1f} %  off {shown[0]:5.1f} ms, "
            f"p95 {shown[1]:6.1f}  force {force:5.2f} of {FORCE_RATE_N_PER_S:g} N/s"
            + (f"  invalid {max(delays_ms):.0f} ms after it can be known" if delays_ms else "")
        )


def _run_clock(seed: int, extra: dict[str, object]) -> tuple[Float, list[float], float, float]:
    """What one record comes to.

    Errors (ms) while valid; how long (ms) the phase was still called valid after it can be known
    that it is not; share of time valid; fastest change of a full force (N/s).
    """
    rate_hz, cycle_s = 250.0, 0.8
    ecg = _record(seed, 90.0, 0.8, rate_hz, extra)
    detector = RPeakDetector(rate_hz, 3)
    clock = PhaseClock(cycle_s, f_max_n=F_MAX_N, force_rate_n_per_s=FORCE_RATE_N_PER_S)
    rows = []
    for number, sample in enumerate(ecg.signal_mv):
        for beat in detector.push(sample):
            clock.beat(beat.time_s, beat.strange)
        tick = clock.at(number / rate_hz, detector.usable)
        rows.append((number / rate_hz, tick.phase, tick.valid, tick.fade))
    table = np.array(rows, dtype=float)
    late = table[table[:, 0] > 10.0]
    truth = true_phase(late[:, 0], ecg.r_times_s, cycle_s)
    used = (late[:, 2] > 0) & np.isfinite(truth)
    off_ms = 1e3 * cycle_s * np.abs((late[used, 1] - truth[used] + 0.5) % 1 - 0.5)
    force = float(np.abs(np.diff(table[:, 3])).max() * rate_hz * F_MAX_N)
    delays_ms = [1e3 * _still_valid_s(table, moment) for moment in _upsets_s(ecg)]
    return off_ms, delays_ms, float(late[:, 2].mean()), force


def _upsets_s(ecg: EcgSignal) -> list[float]:
    """When it can be known that what the phase relies on broke down.

    An early beat: at its R peak. A lost lead that stays still: when it comes off. Fibrillation: as
    `_disorder_s` says.
    """
    early = [
        float(time_s)
        for time_s, kind in zip(ecg.r_times_s, ecg.kinds, strict=True)
        if kind not in ("normal", "fibrillation")
    ]
    lost = [one.start_s for one in ecg.lost if one.lead == "all"]
    return early + lost + [_disorder_s(ecg.r_times_s, one[0]) for one in ecg.fibrillation_s]


def _disorder_s(r_times_s: Float, start_s: float) -> float:
    """The first beat after a moment that is off by more than a regular one may be: its R peak where
    it is early, the end of what may be late where it is late."""
    for k in range(int(np.searchsorted(r_times_s, start_s)), len(r_times_s)):
        usual_s = float(np.mean(np.diff(r_times_s[k - 4 : k])))
        due_s = r_times_s[k - 1] + usual_s
        if abs(r_times_s[k] - due_s) > REGULAR_SHARE * usual_s:
            return float(min(r_times_s[k], due_s + REGULAR_SHARE * usual_s))
    return float(r_times_s[-1])


def _still_valid_s(table: Float, moment_s: float) -> float:
    """How long after a moment the clock goes on calling its phase valid."""
    after = table[table[:, 0] >= moment_s]
    invalid = np.flatnonzero(after[:, 2] == 0)
    return float(after[invalid[0], 0] - moment_s) if len(invalid) else np.inf


def true_phase(times_s: Float, r_times_s: Float, cycle_s: float) -> Float:
    """The phantom's own phase on the axis of one nominal beat; not a number outside its beats."""
    beat = np.searchsorted(r_times_s, times_s, side="right") - 1
    truth = np.full(len(times_s), np.nan)
    for i in np.flatnonzero((beat >= 0) & (beat < len(r_times_s) - 1)):
        start_s, length_s = r_times_s[beat[i]], r_times_s[beat[i] + 1] - r_times_s[beat[i]]
        share = min((times_s[i] - start_s) / length_s, 1 - 1e-9)
        truth[i] = warp_phase(share, _places(length_s), _places(cycle_s))
    return truth


def _places(rr_s: float) -> tuple[float, float, float]:
    return 0.0, end_systole_phase(60 / rr_s), kick_onset_phase(60 / rr_s)


def frame_table(seeds: int) -> None:
    """Phase of ultrasound frames, from the recorded ECG alone, in regular rhythm."""
    off = []
    for seed in range(2 * seeds):
        ecg = _record(seed, 40.0, 0.8, 500.0, {})
        found_s = np.array([one.time_s for one in find_beats(ecg.signal_mv, 500.0)])
        times_s = np.arange(2.0, 38.0, 0.04)
        truth = true_phase(times_s, ecg.r_times_s, 0.8)
        off.append(np.abs((phases_at(times_s, found_s, 0.8) - truth + 0.5) % 1 - 0.5))
    share = 100 * np.percentile(np.concatenate(off), [50, 95])
    print(f"phase of frames: off {share[0]:.2f} % of the cycle, p95 {share[1]:.2f} %")


def _record(
    seed: int, duration_s: float, rr_s: float, rate_hz: float, extra: dict[str, object]
) -> EcgSignal:
    rng = np.random.default_rng(seed)
    settings = EcgSettings.model_validate(extra)
    return simulate_ecg(rng, duration_s, rr_s, rate_hz, settings)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3, help="records of each kind")
    seeds = parser.parse_args().seeds
    detector_table(seeds)
    speed_table()
    clock_table(seeds)
    loss_table(4 * seeds)
    frame_table(seeds)


if __name__ == "__main__":
    main()
