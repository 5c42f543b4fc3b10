"""Tables of segmentation_figures.py: how good, where it is worst, and what was asked."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import spearmanr

SURFACES = {
    "lv_endocardium": "LV cavity",
    "epicardium": "LV muscle",
    "rv_endocardium": "RV cavity",
    "left_atrium": "left atrium",
    "right_atrium": "right atrium",
    "aorta": "aorta",
    "heart": "whole heart",
}
"""Surface -> what its label is called; Dice is the label's, distances are the surface's."""

LEAST_DICE = {
    "lv_endocardium": 0.95,
    "epicardium": 0.89,
    "rv_endocardium": 0.93,
    "left_atrium": 0.90,
    "right_atrium": 0.90,
}
MOST_DISTANCE_MM = {"lv_endocardium": 1.0, "epicardium": 1.1, "rv_endocardium": 1.5}
MOST_HAUSDORFF_MM = dict.fromkeys(LEAST_DICE, 3.5)
MOST_NORMAL_MM = 1.0
EJECTION_POINTS, EJECTION_SHARE = 3.0, 0.95
CONFIDENCES = (0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0)
WRONG_DICE = 0.8
"""A slice whose labels overlap truth by less counts as wrong in the table of confidence."""

WORST_SLICES = 12

Key = Callable[["Patient"], str]


@dataclass(frozen=True)
class Patient:
    """One phantom and what came of it."""

    name: str
    pathology: str
    snr: float
    metrics: dict[str, Any] | None = None
    """Content of ``metrics.json``; None where the run failed."""

    confidence: Sequence[Sequence[float | None]] = ()
    """``[phase][slice]``."""

    failure: str = ""


class Value(NamedTuple):
    """One figure of one phase, or of a whole patient where ``phase`` is -1."""

    size: float
    patient: str
    phase: int = -1

    @property
    def place(self) -> str:
        """Whose it is, and of which phase."""
        return self.patient + (f", phase {self.phase}" if self.phase >= 0 else "")


def values(patients: Iterable[Patient], surface: str, key: str) -> list[Value]:
    """A figure of every patient and phase; ``normal`` and ``tangential`` are of the motion."""
    found = []
    for one in patients:
        if one.metrics is None:
            continue
        part = one.metrics["structures"].get(surface, {})
        if key in ("normal", "tangential"):
            if "motion_error_mm" in part:
                found.append(Value(part["motion_error_mm"][f"{key}_mean"], one.name))
            continue
        found += [Value(size, one.name, k) for k, size in enumerate(part.get(key, []))]
    return found


def ejection_errors(patients: Iterable[Patient], side: str) -> list[Value]:
    """Error of the ejection fraction in points, found less true; ``side`` is lv or rv."""
    found = []
    for one in patients:
        fraction = (one.metrics or {}).get(f"{side}_ejection_fraction")
        if fraction:
            found.append(Value(100 * (fraction["found"] - fraction["truth"]), one.name))
    return found


def mean(found: Sequence[Value]) -> float:
    """Mean size; NaN, which passes no bound, where nothing was measured."""
    return float(np.mean([one.size for one in found])) if found else float("nan")


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def patient_row(one: Patient) -> list[str]:
    """One line of the table of patients; where each is worst."""
    if one.metrics is None:
        return [
            one.name,
            f"{one.snr:.0f}",
            f"failed: {one.failure}",
            *[""] * (len(PATIENT_HEAD) - 3),
        ]
    distance = _extreme([one], "mean_surface_distance_mm", max)
    overlap = _extreme([one], "dice", min)
    normal = _extreme([one], "normal", max)
    return [
        one.name,
        f"{one.snr:.0f}",
        *(_pair(one.metrics.get(f"{side}_ejection_fraction"), ".3f") for side in ("lv", "rv")),
        _pair(one.metrics.get("lv_mass_g"), ".0f"),
        overlap,
        distance,
        normal,
    ]


PATIENT_HEAD = (
    *("patient", "SNR", "LV EF found / true", "RV EF found / true", "LV mass, g"),
    "lowest Dice",
    *("largest mean distance, mm", "largest normal motion error, mm"),
)


def _pair(figure: dict[str, float] | None, form: str) -> str:
    """What was found and what is true."""
    return f"{figure['found']:{form}} / {figure['truth']:{form}}" if figure else "-"


def _extreme(patients: Sequence[Patient], key: str, choose: Callable[..., Any]) -> str:
    """The extreme over all surfaces, with its surface and phase."""
    each = [(one, name) for name in SURFACES for one in values(patients, name, key)]
    if not each:
        return "-"
    value, surface = choose(each, key=lambda pair: pair[0].size)
    phase = f", phase {value.phase}" if value.phase >= 0 else ""
    return f"{value.size:.3g} ({SURFACES[surface]}{phase})"


def structures(patients: Sequence[Patient]) -> str:
    """Mean and worst of every surface, over all patients and phases."""
    rows = []
    for surface, name in SURFACES.items():
        dice = values(patients, surface, "dice")
        row = [name, f"{mean(dice):.3f}" if dice else "-", _at(dice, min, "{:.3f}")]
        for key in ("mean_surface_distance_mm", "hausdorff_95_mm", "normal", "tangential"):
            found = values(patients, surface, key)
            row += [f"{mean(found):.2f}" if found else "-", _at(found, max, "{:.2f}")]
        rows.append(row)
    head = ["structure", "Dice, mean", "worst", "mean distance mm", "worst", "95 % Hausdorff mm"]
    head += ["worst", "motion error mm, normal", "worst", "tangential", "worst"]
    return table(head, rows)


def _at(found: Sequence[Value], choose: Callable[..., Any], form: str) -> str:
    if not found:
        return "-"
    value = choose(found, key=lambda one: one.size)
    return f"{form.format(value.size)} ({value.place})"


def requirements(patients: Sequence[Patient]) -> str:
    """What was asked, what was found, and whether it is enough."""
    rows = []
    for surface, least in LEAST_DICE.items():
        dice, name = values(patients, surface, "dice"), SURFACES[surface]
        rows += _row(f"Dice, {name}, mean, >= {least:g}", dice, mean(dice) >= least)
        rows += _bounded(f"Dice, {name}, every phase, >= {least:g}", dice, least, lower=True)
    limits = (
        ("mean_surface_distance_mm", "mean distance", MOST_DISTANCE_MM),
        ("hausdorff_95_mm", "95 % Hausdorff", MOST_HAUSDORFF_MM),
    )
    for key, words, bounds in limits:
        for surface, most in bounds.items():
            found = values(patients, surface, key)
            title = f"{words}, {SURFACES[surface]}, every phase, <= {most:g} mm"
            rows += _bounded(title, found, most, lower=False)
    for surface, name in SURFACES.items():
        found = values(patients, surface, "normal")
        title = f"normal motion error, {name}, mean, <= {MOST_NORMAL_MM:g} mm"
        rows += _row(title, found, mean(found) <= MOST_NORMAL_MM)
    rows += _ejection(patients) + _mass(patients)
    failed = [one.name for one in patients if one.metrics is None]
    done = f"{len(patients) - len(failed)} of {len(patients)}"
    rows.append(["every patient is served", done, ", ".join(failed), _verdict(not failed)])
    return table(["asked", "found", "worst", ""], rows)


def _row(title: str, found: Sequence[Value], passed: bool) -> list[list[str]]:
    said = f"{mean(found):.3f}" if found else "not measured"
    return [[title, said, "", _verdict(passed)]]


def _bounded(title: str, found: Sequence[Value], bound: float, lower: bool) -> list[list[str]]:
    """A bound that holds in every phase: in how many it does, and the worst."""
    if not found:
        return [[title, "not measured", "", _verdict(False)]]
    good = [one.size >= bound if lower else one.size <= bound for one in found]
    share = f"in {100 * np.mean(good):.1f} % of {len(good)}"
    return [[title, share, _at(found, min if lower else max, "{:.3f}"), _verdict(all(good))]]


def _ejection(patients: Sequence[Patient]) -> list[list[str]]:
    rows = []
    for side in ("lv", "rv"):
        found = ejection_errors(patients, side)
        if not found:
            continue
        sizes = np.abs([one.size for one in found])
        share = float(np.mean(sizes <= EJECTION_POINTS))
        worst = max(found, key=lambda one: abs(one.size))
        said = f"in {100 * share:.0f} % of {len(found)}; {sizes.mean():.2f} on average"
        bias = f"{worst.size:+.2f} ({worst.place}); bias {mean(found):+.2f}"
        if side == "lv":
            title = f"LV ejection fraction within {EJECTION_POINTS:g} points in 95 %"
            rows.append([title, said, bias, _verdict(share >= EJECTION_SHARE)])
        else:
            title = f"RV ejection fraction within {EJECTION_POINTS:g} points"
            rows.append([title, said, bias, "reported"])
    return rows


def _mass(patients: Sequence[Patient]) -> list[list[str]]:
    """Mass of the left muscle, for which nothing was asked."""
    masses = [(one.name, one.metrics["lv_mass_g"]) for one in patients if one.metrics]
    off = [Value(mass["found"] - mass["truth"], name) for name, mass in masses]
    if not off:
        return []
    worst = max(off, key=lambda one: abs(one.size))
    said = f"{np.mean([abs(one.size) for one in off]):.1f} g off on average"
    bias = f"{worst.size:+.1f} g ({worst.place}); bias {mean(off):+.1f} g"
    return [["LV mass", said, bias, "reported"]]


def _verdict(passed: bool) -> str:
    return "pass" if passed else "**FAIL**"


def groups(patients: Sequence[Patient], key: Key, name: str) -> str:
    """Means by pathology, or whatever ``key`` says of a patient."""
    rows = []
    for group in sorted({key(one) for one in patients}):
        members = [one for one in patients if key(one) == group and one.metrics]
        row = [group, str(len(members))]
        for surface in LEAST_DICE:
            dice = values(members, surface, "dice")
            far = values(members, surface, "mean_surface_distance_mm")
            row.append(f"{mean(dice):.3f}, {mean(far):.2f} mm" if dice and far else "-")
        errors = [abs(one.size) for one in ejection_errors(members, "lv")]
        row.append(f"{np.mean(errors):.2f}" if errors else "-")
        rows.append(row)
    names = (f"{SURFACES[surface]}: Dice, distance" for surface in LEAST_DICE)
    return table([name, "done", *names, "LV EF off, points"], rows)


def snr_band(one: Patient) -> str:
    """Tens of the signal-to-noise ratio."""
    low = 10 * int(one.snr // 10)
    return f"{low} to {low + 10}"


class Slice(NamedTuple):
    """One slice of one phase."""

    patient: str
    phase: int
    number: int
    confidence: float
    dice: float


def slices(patients: Iterable[Patient]) -> list[Slice]:
    """Every slice and phase that has both a confidence and a Dice."""
    return [
        Slice(one.name, phase, number, sure, good)
        for one in patients
        if one.metrics is not None
        for phase, (row, truth) in enumerate(
            zip(one.confidence, one.metrics["slice_dice"], strict=True)
        )
        for number, (sure, good) in enumerate(zip(row, truth, strict=True))
        if sure is not None and good is not None and np.isfinite([sure, good]).all()
    ]


def calibration(patients: Iterable[Patient]) -> str:
    """How wrong the slices are whose confidence is below a bound; Dice over all structures."""
    found = slices(patients)
    sure, good = (np.array([one[k] for one in found], dtype=float) for k in (3, 4))
    rows = []
    for bound in CONFIDENCES:
        # Nothing is surer than 1, and what is just so sure belongs to the last row.
        below = sure < bound if bound < 1 else np.ones(len(sure), bool)
        rows.append([f"below {bound:g}" if bound < 1 else "all", *_judged(good, below)])
    text = table(["confidence", "slices", "mean Dice", f"Dice < {WRONG_DICE:g}"], rows)
    wrong = good < WRONG_DICE
    if wrong.any():
        caught = "; ".join(
            f"below {bound:g}: {100 * np.mean(sure[wrong] < bound):.0f} %"
            for bound in CONFIDENCES[:-1]
        )
        text += (
            f"\n\nOf the {wrong.sum()} slices with Dice < {WRONG_DICE:g}, confidence is {caught}"
        )
    if len(found) > 2 and np.ptp(sure) > 0 and np.ptp(good) > 0:
        text += f"\nRank correlation of confidence and Dice: {spearmanr(sure, good).statistic:.2f}"
    return text


def _judged(
    good: np.ndarray[Any, np.dtype[np.float64]], chosen: np.ndarray[Any, np.dtype[np.bool_]]
) -> list[str]:
    if not chosen.any():
        return ["0", "-", "-"]
    share = 100 * np.mean(good[chosen] < WRONG_DICE)
    return [str(chosen.sum()), f"{good[chosen].mean():.3f}", f"{share:.0f} %"]


def worst_slices(patients: Iterable[Patient]) -> str:
    """Where the labels are most wrong, and how sure they were."""
    chosen = sorted(slices(patients), key=lambda one: one.dice)[:WORST_SLICES]
    rows = [
        [one.patient, str(one.phase), str(one.number), f"{one.dice:.3f}", f"{one.confidence:.3f}"]
        for one in chosen
    ]
    return table(["patient", "phase", "slice", "Dice", "confidence"], rows)
