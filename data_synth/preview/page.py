"""The page itself: pictures, tables and words put together."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping
from importlib.resources import files
from typing import Any

import jinja2
import numpy as np

from data_synth.heart import BeatingHeart
from data_synth.kernels import Float
from data_synth.measures import MUSCLE_G_ML, wall_thickness_mm
from data_synth.norms import NORMS
from data_synth.preview import curves, images, scene
from data_synth.preview.style import as_svg, as_webp, encode, words
from data_synth.settings import PhantomSettings
from data_synth.simulate import SyntheticStudy
from data_synth.truth import chamber_function, mr_from_image
from data_synth.ultrasound import Sweep

Picture = dict[str, str]

CURVE_POINTS = 25
"""Of the volume curves, however few phases the cine has."""


def render_page(study: SyntheticStudy) -> str:
    """The whole page as HTML; pictures are inside it."""
    away = np.abs(study.cine.phases - study.heart.pulse.end_systole)
    systole = int(away.argmin())
    sections = [
        _heart(study),
        _short_axis(study, systole),
        _long_axis(study, systole),
        *_ultrasound(study),
        *_ecg(study),
    ]
    template = jinja2.Template(
        files("data_synth.preview").joinpath("page.html.j2").read_text(encoding="utf-8"),
        autoescape=True,
        trim_blocks=True,
    )
    page: str = template.render(
        patient_id=study.settings.patient_id,
        summary=_summary(study),
        sections=sections,
        function=_function_rows(study.heart),
        settings=flat_settings(study.settings),
    )
    return page


def volume_curves_ml(heart: BeatingHeart, phases: Float) -> dict[str, list[float]]:
    """Volume of every truth body at each of the phases."""
    curves_ml: dict[str, list[float]] = {}
    for phase in phases:
        for name, volume in heart.volumes_ml(float(phase)).items():
            curves_ml.setdefault(name, []).append(volume)
    return curves_ml


def flat_settings(settings: PhantomSettings) -> list[tuple[str, str, bool]]:
    """Every setting as (key, value, whether it is not the default)."""

    def walk(tree: Mapping[str, Any], head: str) -> list[tuple[str, Any]]:
        rows: list[tuple[str, Any]] = []
        for key, value in tree.items():
            name = f"{head}{key}"
            rows += walk(value, f"{name}.") if isinstance(value, Mapping) else [(name, value)]
        return rows

    usual = dict(walk(PhantomSettings().model_dump(mode="json"), ""))
    given = walk(settings.model_dump(mode="json"), "")
    return [(key, str(value), usual.get(key) != value) for key, value in given]


def _summary(study: SyntheticStudy) -> list[tuple[str, str]]:
    settings, cine = study.settings, study.cine
    phases, slices, rows, columns = cine.intensity.shape
    pixel, _, step = np.linalg.norm(cine.mr_from_index[:3, :3], axis=0)
    return [
        ("heart", words(settings.pathology)),
        ("seed", str(settings.seed)),
        ("heart rate", f"{settings.heart_rate_bpm:g} beats a minute"),
        ("cine MR", f"{slices} slices of {rows} x {columns} pixels, {phases} phases"),
        ("pixel, slice step", f"{pixel:.2f} mm, {step:.1f} mm"),
        ("long-axis views", ", ".join(words(name) for name in study.views) or "none"),
        ("ultrasound", _counted(study.sweeps)),
    ]


def _counted(sweeps: tuple[Sweep, ...]) -> str:
    if not sweeps:
        return "none"
    frames = sum(len(sweep.images) for sweep in sweeps)
    return ", ".join(
        f"{count} {what}{'s' * (count != 1)}"
        for count, what in ((len(sweeps), "sweep"), (frames, "frame"))
    )


def _heart(study: SyntheticStudy) -> dict[str, Any]:
    moments = {
        "end-diastole": study.heart.surfaces(0.0),
        "end-systole": study.heart.surfaces(study.heart.pulse.end_systole),
    }
    fans = {sweep.name: fans_of(sweep) for sweep in study.sweeps}
    drawn = scene.draw_scenes(moments, study.heart.rotation, fans)
    pictures = []
    for moment in moments if drawn else ():
        row = [drawn[f"{moment}/{side}"] for side in ("front", "back", "cut")]
        caption = f"{moment}: from the front, from behind, and laid open along the long axis"
        pictures.append(_picture(encode([np.concatenate(row, axis=1)]), caption))
    if "sweep/front" in drawn:
        row = [drawn[f"sweep/{side}"] for side in ("front", "left")]
        caption = (
            "the sweeps from the front and from the patient's left: the transducer's path "
            "(thick), outlines of four pictures of each; right, its middle picture in its place; "
            f"{_coloured(fans)}"
        )
        pictures.append(_picture(encode([np.concatenate(row, axis=1)]), caption))
    phases = np.arange(CURVE_POINTS) / CURVE_POINTS
    graph = as_svg(curves.volume_curves(phases, volume_curves_ml(study.heart, phases)))
    pictures.append(_picture(graph, "volumes enclosed by the truth meshes", "svg+xml"))
    missing = "Nothing could be drawn in three dimensions here, or not in two minutes."
    note = "" if drawn else f"{missing} Surfaces are left out."
    return {"title": "The heart", "note": note, "pictures": pictures, "is_heart": True}


def _coloured(names: Iterable[str]) -> str:
    """Which sweep is drawn in which colour, in words."""
    colours = zip(names, scene.PROBES.values(), strict=False)
    return ", ".join(f"{name} {colour}" for name, colour in colours)


def fans_of(sweep: Sweep) -> scene.Fans:
    """Where a sweep's pictures lie in LPS; the tip is the middle of a picture's upper edge."""
    count, rows, columns = sweep.images.shape
    mask = images.sector_mask(sweep)
    left, right = [], []
    for j in np.linspace(0, rows - 1, 12).astype(int):
        across = np.flatnonzero(mask[j])
        if len(across):
            left.append((float(across[0]), float(j)))
            right.append((float(across[-1]), float(j)))
    outline = [(columns / 2, 0.0), *right, *left[::-1]]
    corners = [(0.0, 0.0), (columns - 1.0, 0.0), (0.0, rows - 1.0)]
    index = np.array([(x, y, 0.0, 1.0) for x, y in outline + corners])
    places = np.einsum("fij,pj->fpi", mr_from_image(sweep), index)[..., :3]
    middle = count // 2
    opaque = np.where(mask, 215, 0).astype(np.uint8)
    image = np.dstack([sweep.images[middle]] * 3 + [opaque])
    return scene.Fans(places[:, :-3], places[middle, -3:], image)


def _short_axis(study: SyntheticStudy, systole: int) -> dict[str, Any]:
    cine = study.cine
    pictures = [
        _picture(as_webp(images.stack_grid(cine, number), 90), f"{moment}, apex to base, from 0")
        for moment, number in (("end-diastole", 0), ("end-systole", systole))
    ]
    seconds = float(cine.rr_ms.mean()) / 1000
    reel = [(cine, images.middle_slice(cine))]
    reel += [(view, 0) for name, view in study.views.items() if name == "four_chamber"]
    # Twice as slow as life, so that the eye can follow.
    moving = images.movie(reel, 2 * seconds)
    pictures.insert(0, _picture(moving, "one beat, twice as slow as life; the bar is the phase"))
    kind = "volume" if study.settings.mr.acquisition == "volume" else "short axis"
    return {"title": f"Cine MR: {kind}", "note": "", "pictures": pictures}


def _long_axis(study: SyntheticStudy, systole: int) -> dict[str, Any]:
    if not study.views:
        return {"title": "Cine MR: long axis", "note": "None was asked for.", "pictures": []}
    moments = {"end-diastole": 0, "end-systole": systole}
    row = as_webp(images.long_axis_row(study.views, moments), 90)
    caption = "long-axis views with the contours of the truth"
    return {"title": "Cine MR: long axis", "note": "", "pictures": [_picture(row, caption)]}


def _ultrasound(study: SyntheticStudy) -> list[dict[str, Any]]:
    pictures = [
        _picture(
            as_webp(images.ultrasound_row(sweep, study.heart), 90),
            f"{sweep.name}: frames as recorded; below, with the contours of the truth",
        )
        for sweep in study.sweeps
    ]
    return [{"title": "Tracked ultrasound", "note": "", "pictures": pictures}] if pictures else []


def _ecg(study: SyntheticStudy) -> list[dict[str, Any]]:
    if study.us_ecg is None:
        return []
    times_s = np.concatenate([sweep.true_times_s for sweep in study.sweeps])
    first = max(0.0, float(times_s.min()) - 1)
    strips = {
        "during MR": curves.ecg_strip(study.mr_ecg, 0.0),
        "during ultrasound; ticks: frames": curves.ecg_strip(study.us_ecg, first, times_s),
    }
    pictures = [_picture(as_svg(strip), name, "svg+xml") for name, strip in strips.items()]
    note = (
        "Dotted lines: true R peaks; N normal, A premature atrial, V premature ventricular, "
        "f in fibrillation."
    )
    return [{"title": "ECG", "note": note, "pictures": pictures}]


def _function_rows(heart: BeatingHeart) -> list[dict[str, str]]:
    """Table of function: figure, value, published normal range, whether within."""
    values: dict[str, float] = {}
    for chamber, function in chamber_function(heart).items():
        values |= {f"{chamber}.{figure}": value for figure, value in function.items()}
    values["lv_mass_g"] = MUSCLE_G_ML * heart.volumes_ml(0.0)["lv_myocardium"]
    walls_mm = wall_thickness_mm(heart)
    values["left_ventricle.thinnest_wall_mm"] = float(walls_mm.min())
    values["left_ventricle.thickest_wall_mm"] = float(walls_mm.max())
    rows = []
    for name, value in values.items():
        digits = 3 if name.endswith("fraction") else int(name.endswith("_mm"))
        norm = NORMS.get(name)
        rows.append(
            {
                "name": words(
                    name.replace(".", ", ")
                    .replace("_mm", " (mm)")
                    .replace("_ml", " (ml)")
                    .replace("_g", " (g)")
                ),
                "value": f"{value:.{digits}f}",
                "range": f"{norm.low:.{digits}f} to {norm.high:.{digits}f}" if norm else "",
                "within": ("yes" if norm.low <= value <= norm.high else "no") if norm else "",
                "source": norm.source if norm else "",
            }
        )
    return rows


def _picture(content: bytes, caption: str, kind: str = "webp") -> Picture:
    encoded = base64.b64encode(content).decode("ascii")
    return {"source": f"data:image/{kind};base64,{encoded}", "caption": caption}
