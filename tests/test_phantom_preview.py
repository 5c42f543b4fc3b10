"""The page that shows a synthetic study: whole, self-contained, and true to the study."""

from __future__ import annotations

import base64
import re
from io import BytesIO
from pathlib import Path
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from PIL import Image

from data_synth import PhantomSettings, SyntheticStudy, simulate_study, write_preview
from data_synth.ecg import simulate_ecg
from data_synth.ecg_settings import EcgSettings
from data_synth.norms import NORMS
from data_synth.preview import curves, images, page, scene
from data_synth.preview.style import STYLES
from data_synth.tissue import TRUTH_LABELS
from data_synth.truth import mr_from_image
from pipeline.study import open_study

SMALL = {
    "seed": 4,
    "pathology": "infarct",
    "mr": {
        "phases": 3,
        "slices": 5,
        "slice_gap_mm": 12.0,
        "pixel_mm": 3.0,
        "matrix": 64,
        "through_plane_samples": 1,
    },
    "ultrasound": {"sweeps": 1, "frames": 3, "pixel_mm": 1.0, "probe": "epicardial"},
}


@pytest.fixture(scope="module")
def study() -> SyntheticStudy:
    return simulate_study(PhantomSettings.model_validate(SMALL))


@pytest.fixture(scope="module")
def html(study: SyntheticStudy, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("page") / "deep" / "preview.html"
    write_preview(path, study)
    return path.read_text(encoding="utf-8")


def pictures(text: str) -> list[tuple[str, bytes]]:
    """Kind and content of every picture in a page."""
    found = re.findall(r'src="data:image/([a-z+]+);base64,([^"]+)"', text)
    return [(kind, base64.b64decode(content)) for kind, content in found]


def test_the_page_stands_alone_and_is_small(html: str) -> None:
    """Nothing is fetched: every source is inside, and there is neither script nor link."""
    sources = re.findall(r'(?:src|href)="([^"]{0,20})', html)
    assert sources
    assert all(source.startswith("data:image/") for source in sources)
    assert "<script" not in html
    assert "<link" not in html
    assert "url(" not in re.sub(r"base64,[^\"]+", "", html)
    assert len(html.encode()) < 5e6


def test_every_picture_can_be_opened_and_curves_are_vectors(html: str) -> None:
    found = pictures(html)
    kinds = [kind for kind, _ in found]
    # Volumes and two records of the ECG.
    assert kinds.count("svg+xml") == 3
    for kind, content in found:
        if kind == "svg+xml":
            root = ElementTree.fromstring(content)
            assert root.findall(".//{http://www.w3.org/2000/svg}path")
        else:
            assert np.ptp(np.asarray(Image.open(BytesIO(content)).convert("L"))) > 50


def test_the_page_tells_illness_seed_settings_and_function(html: str) -> None:
    words = re.sub(r"<[^>]+>", " ", re.sub(r'src="[^"]+"', "", html))
    assert "infarct" in words
    for key, value, changed in page.flat_settings(PhantomSettings.model_validate(SMALL)):
        assert key in words
        assert changed == (key.split(".")[0] in SMALL and _given(key) is not None), (key, value)
    for title in ("The heart", "short axis", "long axis", "Tracked ultrasound", "ECG", "Settings"):
        assert title in words
    for norm in NORMS.values():
        assert norm.source in words


def _given(key: str) -> object:
    tree: object = SMALL
    for part in key.split("."):
        tree = tree.get(part) if isinstance(tree, dict) else None
    return tree


def test_the_movie_has_every_phase_and_moves(html: str, study: SyntheticStudy) -> None:
    movies = [Image.open(BytesIO(content)) for kind, content in pictures(html) if kind == "webp"]
    moving = [movie for movie in movies if getattr(movie, "n_frames", 1) > 1]
    assert [movie.n_frames for movie in moving] == [len(study.cine.phases)]
    frames = []
    for k in range(moving[0].n_frames):
        moving[0].seek(k)
        frames.append(np.asarray(moving[0].convert("L"), float))
    # The bar alone would change 8 of some 350 rows.
    changed = np.abs(frames[1] - frames[0])[:-10] > 40
    assert changed.mean() > 0.01


@pytest.mark.slow
def test_the_same_study_gives_the_same_page(
    study: SyntheticStudy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever a user's own figures look like; also where no surfaces can be drawn: the page says
    so then, and shows the rest."""
    monkeypatch.setattr(scene, "draw_scenes", lambda *_: {})
    write_preview(tmp_path / "first.html", study)
    with matplotlib.rc_context({"image.origin": "lower", "text.usetex": True}):
        write_preview(tmp_path / "again.html", study)
    first, again = (path.read_text() for path in (tmp_path / "first.html", tmp_path / "again.html"))
    assert first == again
    assert "could be drawn in three dimensions" in first
    assert len(pictures(first)) > 5


def test_surfaces_are_drawn_from_three_sides_at_both_moments(html: str) -> None:
    """Skipped where VTK cannot draw; the page is tested without it above."""
    if "could be drawn in three dimensions" in html:
        pytest.skip("no off-screen drawing here")
    rows = [
        np.asarray(Image.open(BytesIO(content)).convert("RGB"), float)
        for kind, content in pictures(html)
        if kind == "webp"
    ][:3]
    width, height = scene.SIZE_PIXELS
    assert [row.shape[:2] for row in rows] == [(height, 3 * width)] * 2 + [(height, 2 * width)]
    drawn = [
        (np.abs(row[:, k * width : (k + 1) * width] - 255) > 20).any(axis=-1).mean()
        for row in rows[:2]
        for k in range(3)
    ]
    # A heart fills a good part of each picture and leaves a margin.
    assert all(0.1 < share < 0.8 for share in drawn)
    for row in rows[:2]:
        border = np.concatenate([row[0], row[-1]])
        assert (border > 235).all(), "cut off at the edge"


@pytest.mark.slow
def test_a_sweep_of_one_frame_does_not_keep_the_heart_from_being_drawn(
    study: SyntheticStudy, html: str
) -> None:
    if "could be drawn in three dimensions" in html:
        pytest.skip("no off-screen drawing here")
    (fan,) = (page.fans_of(sweep) for sweep in study.sweeps)
    one = scene.Fans(fan.outlines_mm[:1], fan.corners_mm, fan.image)
    moments = {"end-diastole": study.heart.surfaces(0.0)}
    drawn = scene.draw_scenes(moments, study.heart.rotation, {"sweep_000": one})
    assert {"end-diastole/front", "sweep/front"} <= set(drawn)


@pytest.mark.slow
def test_a_study_without_ecg_ultrasound_and_views_has_a_page(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(scene, "draw_scenes", lambda *_: {})
    bare = {**SMALL, "cine_only": True, "long_axis": False}
    text = page.render_page(simulate_study(PhantomSettings.model_validate(bare)))
    assert "None was asked for" in text
    assert "Tracked ultrasound" not in text
    assert ">ECG<" not in text


def test_text_from_settings_is_escaped(html: str) -> None:
    """Lists among the settings hold quotes, which would end an attribute."""
    assert "[&#39;I&#39;, &#39;II&#39;, &#39;V1&#39;]" in html


def test_truth_outlines_on_ultrasound_lie_on_what_is_seen(study: SyntheticStudy) -> None:
    """Blood scatters some 30 dB less than muscle: outlines out of place would not part the two."""
    sweep = study.sweeps[0]
    step = images.OUTLINE_STEP
    for k in range(len(sweep.images)):
        labels = images.frame_labels(sweep, study.heart, k)
        grey = sweep.images[k, ::step, ::step][: labels.shape[0], : labels.shape[1]]
        blood = grey[labels == TRUTH_LABELS["lv_cavity"][0]].astype(float)
        muscle = grey[labels == TRUTH_LABELS["lv_myocardium"][0]].astype(float)
        assert min(blood.size, muscle.size) > 30
        assert np.median(muscle) > np.median(blood) + 20


def test_the_cavitys_line_is_over_the_muscles_where_they_meet() -> None:
    labels = np.zeros((20, 20), np.uint8)
    labels[4:16, 4:16] = TRUTH_LABELS["lv_myocardium"][0]
    labels[8:12, 8:12] = TRUTH_LABELS["lv_cavity"][0]
    axis = Figure().subplots()
    images._contours(axis, labels, np.arange(20), np.arange(20))
    drawn = [to_hex(one.get_edgecolor()[0]).upper() for one in axis.collections]
    assert drawn == [STYLES[name][0] for name in ("lv_myocardium", "lv_cavity")]


def test_fans_lie_where_the_pictures_are(study: SyntheticStudy) -> None:
    """The hung picture's edges have its own size in mm, and right angles."""
    sweep = study.sweeps[0]
    fan = page.fans_of(sweep)
    corner, right, down = fan.corners_mm
    rows, columns = sweep.images.shape[1:]
    pixel_mm = np.linalg.norm(mr_from_image(sweep)[0][:3, 0])
    assert np.linalg.norm(right - corner) == pytest.approx((columns - 1) * pixel_mm)
    assert np.linalg.norm(down - corner) == pytest.approx((rows - 1) * pixel_mm)
    assert (right - corner) @ (down - corner) == pytest.approx(0, abs=1e-6)
    assert fan.outlines_mm.shape[0] == len(sweep.images)
    assert fan.image.shape == (rows, columns, 4)


def test_the_window_holds_the_whole_heart_and_is_square(study: SyntheticStudy) -> None:
    for cine in (study.cine, *study.views.values()):
        rows, columns = images.heart_window(cine)
        inside = np.zeros(cine.labels.shape[2:], bool)
        inside[rows, columns] = True
        assert not (cine.labels.max(axis=(0, 1)) > 0)[~inside].any()
        assert rows.stop - rows.start == columns.stop - columns.start


def test_an_ecg_strip_names_every_beat_in_it() -> None:
    settings = EcgSettings(ectopic_probability=0.3)
    ecg = simulate_ecg(np.random.default_rng(3), 30.0, 0.8, settings=settings)
    start_s = 5.0
    figure = curves.ecg_strip(ecg, start_s, np.array([6.0, 7.0]))
    named = [text.get_text() for text in figure.axes[0].texts]
    inside = (ecg.r_times_s >= start_s) & (ecg.r_times_s < start_s + curves.STRIP_S)
    expected = [
        {"normal": "N", "premature_ventricular": "V"}[kind]
        for kind, shown in zip(ecg.kinds, inside, strict=True)
        if shown
    ]
    assert named == expected
    assert "V" in named
    assert len(figure.axes) == len(ecg.leads)


def test_a_page_beside_the_study_does_not_disturb_the_pipeline(tmp_path: Path) -> None:
    (tmp_path / "p" / "cine").mkdir(parents=True)
    (tmp_path / "p" / "cine" / "a.dcm").write_bytes(b"x")
    before = open_study(tmp_path / "p")
    (tmp_path / "p" / "preview.html").write_text("<p>")
    assert open_study(tmp_path / "p") == before


def test_norms_hold_healthy_means_and_span_both_sexes() -> None:
    for norm in NORMS.values():
        for mean, deviation in (norm.men, norm.women):
            assert norm.low <= mean - 2 * deviation + 1e-9
            assert norm.high >= mean + 2 * deviation - 1e-9
