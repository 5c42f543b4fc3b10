"""Pictures of curves: volumes through the beat and strips of the ECG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from data_synth.ecg import EcgSignal
from data_synth.kernels import Float
from data_synth.preview.style import STYLES, edged, words

STRIP_S = 8.0
CURVES = {
    "lv_endocardium": "lv_cavity",
    "rv_endocardium": "rv_cavity",
    "left_atrium": "left_atrium",
    "right_atrium": "right_atrium",
    "lv_myocardium": "lv_myocardium",
}
"""Truth volume -> label whose colour it bears."""
KIND_MARKS = {
    "normal": "N",
    "premature_ventricular": "V",
    "premature_atrial": "A",
    "fibrillation": "f",
}


def volume_curves(phases: Float, volumes_ml: Mapping[str, Sequence[float]]) -> Figure:
    """Volume of each chamber and of the left muscle through the cycle."""
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    axis = figure.subplots()
    for name, label in CURVES.items():
        colour, style = STYLES[label]
        closed = [*volumes_ml[name], volumes_ml[name][0]]
        (line,) = axis.plot([*phases, 1.0], closed, style, color=colour, label=words(label))
        line.set(linewidth=2, path_effects=edged(2))
    axis.set(xlabel="phase of the cycle (0 at the R peak)", ylabel="volume (ml)")
    axis.set(xlim=(0, 1), ylim=(0, None))
    axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axis.grid(alpha=0.3)
    return figure


def ecg_strip(ecg: EcgSignal, start_s: float, frames_s: Float | None = None) -> Figure:
    """Eight seconds of all leads; R peaks by their kind, and when frames were recorded."""
    times_s = np.arange(len(ecg.signal_mv)) / ecg.sampling_rate_hz
    part = np.flatnonzero((times_s >= start_s) & (times_s < start_s + STRIP_S))
    # More points than pixels would be drawn otherwise; 250 a second keep the R peak's height.
    part = part[:: max(round(ecg.sampling_rate_hz / 250), 1)]
    figure = Figure(figsize=(10, 1.0 + 1.1 * len(ecg.leads)), layout="constrained")
    axes = figure.subplots(len(ecg.leads), 1, sharex=True, squeeze=False)[:, 0]
    for axis, lead, column in zip(axes, ecg.leads, ecg.signal_mv.T, strict=True):
        axis.plot(times_s[part], column[part], color="#222", linewidth=0.8)
        axis.set_ylabel(f"{lead} (mV)", fontsize=8)
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.3)
    _mark_beats(list(axes), ecg, start_s)
    if frames_s is not None:
        low = axes[-1].get_ylim()[0]
        shown = frames_s[(frames_s >= start_s) & (frames_s < start_s + STRIP_S)]
        axes[-1].plot(shown, np.full(len(shown), low), "|", color="#0072B2", markersize=9)
    axes[-1].set(xlabel="time (s)", xlim=(start_s, start_s + STRIP_S))
    return figure


def _mark_beats(axes: Sequence[Axes], ecg: EcgSignal, start_s: float) -> None:
    for time_s, kind in zip(ecg.r_times_s, ecg.kinds, strict=True):
        if not start_s <= time_s < start_s + STRIP_S:
            continue
        for axis in axes:
            axis.axvline(time_s, color="#D55E00", linewidth=0.7, linestyle=":")
        axes[0].annotate(
            KIND_MARKS[kind],
            (time_s, 1.0),
            xycoords=("data", "axes fraction"),
            ha="center",
            va="bottom",
            fontsize=8,
        )
