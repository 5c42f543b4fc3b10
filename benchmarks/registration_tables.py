"""Results of registration_figures.py as Markdown: error, capture, seconds, worth of verdicts."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import chi2

from pipeline.registration.settings import RegisterSettings
from pipeline.registration.size import Size
from pipeline.registration.verdict import APART, Evidence, judge

CAPTURED_MM = 2.0


def line(name: str, some: list[dict[str, Any]]) -> str:
    """One row of a table."""
    whole = [one for one in some if "mean_mm" in one]
    if not whole:
        return f"| {name} | {len(some)} | | | | | |"
    points = np.concatenate([one["quantiles_mm"] for one in whole])
    means = np.array([one["mean_mm"] for one in whole])
    seconds = [one.get("cpu_s", one["wall_s"]) for one in whole]
    # What is refused at the door ends nowhere: it counts as not captured.
    captured = (means < CAPTURED_MM).sum() / len(some)
    return (
        f"| {name} | {len(some)} | {np.median(points):.2f} | {np.quantile(points, 0.95):.2f} | "
        f"{np.median(means):.2f} | {captured:.1%} | {np.median(seconds):.1f} |"
    )


HEAD = (
    "| | runs | median TRE (mm) | 95th percentile | median of means | under 2 mm | CPU s |\n"
    "|---|---|---|---|---|---|---|"
)


def tables(results: list[dict[str, Any]]) -> str:
    """All results as Markdown."""
    ours = [one for one in results if one["method"] == "beatfield"]
    text = [HEAD]
    names = {
        "beatfield": "beatfield",
        "per_sweep": "calibration: per_sweep",
        "global": "without a start",
        "peer": "SimpleITK MI",
    }
    for method, name in names.items():
        some = [one for one in results if one["method"] == method]
        text += [line(name, some)] if some else []
    trusted = [one for one in ours if graded(one) in ("good", "doubtful")]
    text.append(line("beatfield, verdict not failed", trusted))
    both = {(one["study"], one["start"]) for one in results if one["method"] == "peer"}
    if both:
        same = [one for one in ours if (one["study"], one["start"]) in both]
        text.append(line("beatfield, the same as SimpleITK MI", same))
    for key in ("share", "probe", "frames", "dropout", "snr_db", "pathology"):
        text += ["", f"By {key}:", "", HEAD]
        for value in sorted({one[key] for one in ours}, key=_rank):
            text.append(line(str(value), [one for one in ours if one[key] == value]))
    text += ["", *walls(ours), *calibration(ours)]
    corrected = [one for one in results if one["method"] == "per_sweep"]
    if corrected:
        text += ["", "With calibration: per_sweep:", "", HEAD]
        for probe in sorted({one["probe"] for one in corrected}):
            text.append(line(probe, [one for one in corrected if one["probe"] == probe]))
        text += ["", *calibration(corrected)]
    return "\n".join(text)


def _rank(value: float | str | None) -> tuple[float, str]:
    """Sorts numbers by size, after none, and names by letter."""
    return (value, "") if isinstance(value, (int, float)) else (-np.inf, str(value or ""))


def calibration(results: list[dict[str, Any]]) -> list[str]:
    """What the verdicts and the expected errors are worth."""
    text = ["| verdict | runs | under 2 mm | median expected (mm) | root mean square error (mm) |"]
    text.append("|---|---|---|---|---|")
    for verdict in ("good", "doubtful", "failed", "refused"):
        some = [one for one in results if graded(one) == verdict]
        whole = [one for one in some if "mean_mm" in one]
        if not whole:
            text.append(f"| {verdict} | {len(some)} | | | |")
            continue
        means = np.array([one["mean_mm"] for one in whole])
        expected = np.median([one["expected_mm"] for one in whole])
        rms = np.sqrt((means**2).mean())
        under = f"{(means < CAPTURED_MM).mean():.1%}"
        text.append(f"| {verdict} | {len(some)} | {under} | {expected:.2f} | {rms:.2f} |")
    parts = (
        chances(results),
        thresholds(results),
        coverage(results),
        sizes(results),
        aparts(results),
    )
    for part in parts:
        text += ["", *part]
    return text


def walls(results: list[dict[str, Any]]) -> list[str]:
    """How far chambers' walls are from where they are said to be, as a tool feels it."""
    some = [one for one in results if "walls_mm" in one]
    if not some:
        return []
    placed, best = (
        np.array([one[key] for one in some]) for key in ("walls_mm", "walls_if_true_mm")
    )
    return [
        f"Walls of the chambers from where surfaces and pose put them, mean of a study: median "
        f"{np.median(placed):.2f} mm, 95th percentile {np.quantile(placed, 0.95):.2f}, worst "
        f"{placed.max():.2f}; with the true pose {np.median(best):.2f}, "
        f"{np.quantile(best, 0.95):.2f}, {best.max():.2f}.",
        "",
    ]


def sizes(results: list[dict[str, Any]]) -> list[str]:
    """How many results fit another size of the heart clearly better."""
    gains = np.array([one["better_by_size"] for one in results if "better_by_size" in one])
    if not len(gains):
        return []
    told = sum(Size(0.0, gain).in_doubt for gain in gains)
    best = ", ".join(f"{gain:.1%}" for gain in np.sort(gains)[::-1][:3])
    return [f"Size in doubt: {told} of {len(gains)}; the largest gains are {best}."]


def aparts(results: list[dict[str, Any]]) -> list[str]:
    """How many results have parts that agree clearly better with poses of their own."""
    gains = np.sort([one["apart"] for one in results if "apart" in one])
    if not len(gains):
        return []
    told = int((gains > APART).sum())
    ends = f"{gains[0]:.1%} to {gains[-1]:.1%}, median {np.median(gains):.1%}"
    return [f"Parts apart: {told} of {len(gains)}; gains are {ends}."]


def chances(results: list[dict[str, Any]]) -> list[str]:
    """The chance that results give themselves to be under 2 mm, and how many are."""
    trusted = [one for one in results if graded(one) in ("good", "doubtful")]
    text = ["| chance of under 2 mm | runs | mean chance | under 2 mm |", "|---|---|---|---|"]
    for low, high in ((0.0, 0.7), (0.7, 0.8), (0.8, 0.9), (0.9, 0.95), (0.95, 1.01), (0.0, 1.01)):
        some = [one for one in trusted if low <= one["chance_under_2_mm"] < high]
        if some:
            mean = np.mean([one["chance_under_2_mm"] for one in some])
            under = np.mean([one["mean_mm"] < CAPTURED_MM for one in some])
            text.append(
                f"| {low:.2f} to {min(high, 1):.2f} | {len(some)} | {mean:.2f} | {under:.2f} |"
            )
    return text


def graded(one: dict[str, Any], good_tre_mm: float | None = None) -> str:
    """The verdict on a kept result as today's settings give it; failures stay failures."""
    if one["verdict"] not in ("good", "doubtful"):
        return str(one["verdict"])
    settings = RegisterSettings()
    limit_mm = {"good_tre_mm": good_tre_mm or settings.good_tre_mm}
    sure = one["confidence"], one["rival"], one["expected_mm"]
    valid = round(one["valid"] * one["frames"])
    size = Size(one.get("larger", 0.0), one.get("better_by_size", 0.0))
    told = {"size": size, "apart": one.get("apart", 0.0)}
    return judge(
        Evidence(*sure, valid, one["frames"], shift_mm=0.0, turn_deg=0.0, **told),
        settings.model_copy(update=limit_mm),
    ).grade


def thresholds(results: list[dict[str, Any]]) -> list[str]:
    """Results that are good under each threshold, and how many of them are under 2 mm, on seeds
    that are even, to choose by, and odd, to see whether the choice holds."""
    text = ["| good_tre_mm | even seeds: good | under 2 mm | odd seeds: good | under 2 mm |"]
    text.append("|---|---|---|---|---|")
    for limit_mm in np.arange(1.5, 2.01, 0.05):
        cells = [f"{limit_mm:.2f}"]
        for odd in (0, 1):
            means = [
                one["mean_mm"]
                for one in results
                if int(one["study"].split("-")[0]) % 2 == odd
                and graded(one, float(limit_mm)) == "good"
            ]
            cells += [str(len(means)), str(sum(mean < CAPTURED_MM for mean in means))]
        text.append("| " + " | ".join(cells) + " |")
    return text


def coverage(results: list[dict[str, Any]]) -> list[str]:
    """Errors of what did not fail, in units of what was expected."""
    some = [one for one in results if one["verdict"] in ("good", "doubtful")]
    ratios = np.array([one["mean_mm"] / one["expected_mm"] for one in some])
    squares = np.array(
        [
            np.array(one["error"]) @ np.linalg.solve(np.array(one["covariance"]), one["error"])
            for one in some
        ]
    )
    within = [(squares < chi2.ppf(share, 6)).mean() for share in (0.5, 0.8, 0.95, 0.99)]
    return [
        f"Of the {len(some)} that did not fail: mean error over expected, median "
        f"{np.median(ratios):.2f}, 95th percentile {np.quantile(ratios, 0.95):.2f}; six-parameter "
        "errors within the ellipsoids of 50, 80, 95 and 99 %: "
        + ", ".join(f"{share:.0%}" for share in within)
        + f"; squared error in units of the covariance {squares.mean():.1f} (6 if it is right)."
    ]
