"""The report: what its pictures show, whatever the number of slices and phases."""

from __future__ import annotations

import os
import re
import subprocess
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver
from PIL import Image

from pipeline.config import Settings
from pipeline.doubts import ranges
from pipeline.errors import StageError
from pipeline.geometry import Float, MovingSurface
from pipeline.imaging.labels import LABELS
from pipeline.report import animation, certificate, curves, heart, pictures, slices
from pipeline.report.animation import HEAD, ROOM, TOWARDS_VIEWER, _webp, even_in_time, framing
from pipeline.report.colours import STYLES
from pipeline.report.moments import MARGIN_PIXELS, Moments
from pipeline.report.page import Opening, figure_row, render
from pipeline.report.provenance import provenance
from pipeline.report.style import as_png, as_svg, as_webp
from pipeline.sealing import digest_of_files
from pipeline.stages import report as report_stage

PAGE_LIMIT_BYTES = 6_000_000


def moments(slice_count: int, size: int = 96, with_heart: slice = slice(None)) -> Moments:
    """Noise, which no file format makes small, and every structure as a square of its own."""
    rng = np.random.default_rng(5)
    shape = (2, slice_count, size, size)
    labels = np.zeros(shape, np.uint8)
    for number, value in enumerate(LABELS.values()):
        row, column = 30 + 12 * (number // 3), 30 + 12 * (number % 3)
        labels[:, with_heart, row : row + 8, column : column + 8] = value
    mr_from_index = np.diag([1.4, 1.4, 8.0, 1.0])
    return Moments(
        ("End-diastole", "End-systole"),
        (0, 1),
        np.array([0.0, 0.4]),
        rng.uniform(0, 1000, shape).astype(np.float32),
        labels,
        mr_from_index,
    )


def drawn(figure: Figure) -> Float:
    """A figure's pixels, red, green and blue in [0, 1]."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3] / 255


def pixels_of(figure: Figure, name: str) -> int:
    """How many pixels bear a structure's colour."""
    away = np.abs(drawn(figure) - np.array(to_rgb(STYLES[name][0]))).max(axis=-1)
    return int((away < 0.03).sum())


def titled(figure: Figure) -> list[str]:
    return [axis.get_title() for axis in figure.axes if axis.get_title()]


@pytest.mark.parametrize("count", [3, 5, 16, pytest.param(24, marks=pytest.mark.slow)])
def test_every_slice_of_a_usual_stack_is_shown_in_its_order(count: int) -> None:
    figure = slices.contours(moments(count), 0)
    assert titled(figure) == [f"slice {number}" for number in range(count)]


def test_of_two_hundred_slices_a_choice_from_end_to_end_of_the_heart_is_shown() -> None:
    shown = moments(200, size=64, with_heart=slice(31, 170))
    found = [int(title.split()[1]) for title in titled(slices.contours(shown, 1))]
    assert (found[0], found[-1], len(found)) == (31, 169, slices.MOST_SLICES)
    # Even: 138 steps in 23, which is 6.
    assert set(np.diff(found)) == {6}


@pytest.mark.slow
def test_the_least_certain_of_many_slices_are_among_those_shown() -> None:
    confidence = np.full((2, 200), 0.97)
    confidence[0, [1, 41, 43]], confidence[1, [52, 198]] = (0.7, 0.6, 0.75), (0.5, 0.7)
    shown = moments(200, size=64)
    for moment in (0, 1):
        titles = titled(slices.contours(shown, moment, confidence, 0.8))
        found = [int(title.split()[1].rstrip(":")) for title in titles]
        assert {52, 41, 1, 198} <= set(found)
        assert 43 not in found
        assert found == sorted(found)
        # A doubtful slice may be one of the even choice too.
        assert slices.MOST_SLICES - 4 <= len(found) <= slices.MOST_SLICES


def test_a_stack_without_any_label_is_still_shown() -> None:
    empty = moments(200, with_heart=slice(0, 0))
    assert len(titled(slices.contours(empty, 0))) == slices.MOST_SLICES


@pytest.mark.parametrize("name", list(LABELS))
def test_each_structure_is_outlined_in_its_colour(name: str) -> None:
    """Its line beside the legend's: without the label the legend's alone remains."""
    shown = moments(3)
    without = np.where(shown.labels == LABELS[name], 0, shown.labels)
    with_it = pixels_of(slices.contours(shown, 0), name)
    legend = pixels_of(slices.contours(replace(shown, labels=without), 0), name)
    # Three squares of 8 pixels a side; a pixel is drawn larger than one dot of the figure. Of a
    # dotted line, the thinnest of them, 1 in 2.65 is drawn.
    assert with_it - legend > 3 * 4 * 8 / 2.65


def test_a_slice_of_low_confidence_is_marked_where_it_is() -> None:
    confidence = np.array([[0.95, 0.61, np.nan], [0.5, 0.95, 0.5]])
    figure = slices.contours(moments(3), 0, confidence, low=0.8)
    assert titled(figure) == ["slice 0: 0.95", "slice 1: 0.61 (low)", "slice 2"]
    colours = [axis.title.get_color() for axis in figure.axes[:3]]
    assert colours == ["black", slices.ALARM, "black"]


def test_a_slice_that_was_not_recorded_says_so() -> None:
    shown = replace(moments(3), interpolated=(1,))
    figure = slices.contours(shown, 0, np.array([[0.9, 0.7, 0.9]]), 0.8)
    assert titled(figure)[:2] == ["slice 0: 0.90", "slice 1 (interpolated): 0.70 (low)"]


def test_the_window_holds_the_heart_of_both_moments_and_stays_inside_the_image() -> None:
    shown = moments(3)
    shown.labels[1, 2, 5, 90] = 1
    rows, columns = shown.window()
    assert (rows.start, rows.stop) == (0, 30 + 12 + 8 + MARGIN_PIXELS)
    assert (columns.start, columns.stop) == (30 - MARGIN_PIXELS, 96)
    place = shown.pixels_mm(2)[10, 4]
    np.testing.assert_allclose(place, [1.4 * (columns.start + 4), 1.4 * 10, 16.0])


def test_pixels_that_are_not_square_are_shown_in_proportion() -> None:
    shown = replace(moments(3), mr_from_index=np.diag([1.0, 2.5, 8.0, 1.0]))
    assert shown.pixel_aspect == 2.5
    assert slices.contours(shown, 0).axes[0].get_aspect() == 2.5


@pytest.mark.parametrize(("phases", "count"), [(2, 3), (25, 16), (60, 200)])
def test_the_confidence_map_marks_exactly_the_low_cells(phases: int, count: int) -> None:
    rng = np.random.default_rng(0)
    confidence = rng.uniform(0.85, 1, (phases, count))
    confidence[1, 2] = confidence[0, 0] = 0.5
    axis = slices.confidence_map(confidence, 0.8).axes[0]
    values = np.asarray(axis.images[0].get_array())
    np.testing.assert_array_equal(values, confidence.T)
    if confidence.size <= slices.MOST_NUMBERS:
        texts = [text.get_text() for text in axis.texts]
        assert len(texts) == confidence.size
        assert [text for text in texts if "(low)" in text] == ["0.50 (low)"] * 2
    else:
        marks = np.asarray(axis.collections[0].get_offsets())
        assert sorted(map(tuple, marks)) == [(0, 0), (1, 2)]


def test_numbers_of_the_confidence_map_read_on_their_colours() -> None:
    """By the contrast of the Web Content Accessibility Guidelines (2.2, 1.4.3): 4.5 at least."""

    def luminance(colour: Any) -> float:
        share = np.array(to_rgb(colour))
        linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    axis = slices.confidence_map(np.linspace(0.5, 1, 60).reshape(6, 10), 0.8).axes[0]
    image = axis.images[0]
    for text in axis.texts:
        phase, number = map(int, text.get_position())
        behind = image.to_rgba(np.asarray(image.get_array())[number, phase])[:3]
        dark, light = sorted([luminance(behind), luminance(text.get_color())])
        assert (light + 0.05) / (dark + 0.05) >= 4.5, text.get_text()


def test_a_slice_that_was_not_judged_is_no_doubt() -> None:
    confidence = np.array([[0.9, np.nan], [0.7, np.nan]])
    assert [one.slice for one in slices.doubts(confidence, 0.8)] == [0]
    assert slices.lowest_place(confidence) == "0.70 (slice 0, phase 1)"
    assert slices.lowest_place(np.full((2, 2), np.nan)) == "not measured"
    assert drawn(slices.confidence_map(confidence, 0.8)).size


def test_doubts_name_slice_and_phases_worst_first() -> None:
    confidence = np.full((8, 4), 0.95)
    confidence[[1, 2, 3, 6], 1] = 0.75
    confidence[4, 3] = 0.4
    first, second = slices.doubts(confidence, 0.8)
    assert first == (3, (4,), 0.4)
    assert (second.slice, ranges(second.phases)) == (1, "1 to 3, 6")


def axis_of(figure: Figure) -> Axes:
    return figure.axes[0]


@pytest.mark.parametrize("count", [2, 25, 60])
def test_curves_close_over_the_beat(count: int) -> None:
    """What leaves at phase 1 is what enters at phase 0, also where no phase lies at 0."""
    phases = (np.arange(count) + 0.5) / count
    volumes = 100 + 40 * np.cos(2 * np.pi * phases)
    figure = curves.volume_curves(phases, {"lv_endocardium": volumes.tolist(), "heart": [0.0]})
    (line,) = axis_of(figure).lines
    x, y = np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)
    assert np.interp(0.0, x, y) == pytest.approx(np.interp(1.0, x, y))
    np.testing.assert_allclose(np.interp(phases, x, y), volumes)
    assert axis_of(figure).get_xlim() == (0, 1)


def test_a_segment_that_was_not_measured_is_a_gap() -> None:
    figure = curves.thickness_map(np.array([0.0, 0.5]), {"a": [8.0, None], "b": [9.0, 12.0]})
    image = axis_of(figure).images[0].get_array()
    assert np.ma.getmaskarray(image).tolist() == [[False, True], [False, False]]
    assert image.max() == 12


def test_few_phases_beat_evenly_in_the_animation() -> None:
    """Vertices that run round a square at uneven phases are at even steps of it; truth by hand."""
    phases = np.array([0.1, 0.35, 0.85])
    height = np.array([0.0, 10.0, 20.0])
    vertices = np.zeros((3, 4, 3))
    vertices[..., 2] = height[:, None]
    moving = MovingSurface(vertices, np.array([[0, 1, 2], [0, 2, 3]]), phases)
    found = even_in_time(moving, 4)[:, 0, 2]
    # At .1, .35, .6 and .85 of the beat: on the first, the second, halfway to the third, on it.
    np.testing.assert_allclose(found, [0, 10, 15, 20], atol=1e-5)
    eight = even_in_time(moving, 8)[:, 0, 2]
    # At .975: halfway from the third back to the first.
    assert eight[7] == pytest.approx(10, abs=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_the_camera_sees_all_that_moves_and_little_more(seed: int) -> None:
    """VTK's own projection puts every point inside the picture, and some near its border."""
    import pyvista

    rng = np.random.default_rng(seed)
    points = rng.normal(0, (60, 30, 80), (500, 3)) + rng.uniform(-200, 200, 3)
    centre_mm, half_mm = framing(points)
    camera = pyvista.Camera()
    camera.enable_parallel_projection()
    camera.focal_point = tuple(centre_mm)
    camera.position = tuple(centre_mm + 500 * TOWARDS_VIEWER)
    camera.up = tuple(HEAD)
    camera.parallel_scale = half_mm
    camera.clipping_range = (1, 2000)
    matrix = camera.GetCompositeProjectionTransformMatrix(1.0, -1, 1)
    seen = np.array([matrix.MultiplyPoint((*point, 1.0)) for point in points])[:, :3]
    assert np.abs(seen).max() < 1
    assert np.abs(seen[:, :2]).max() == pytest.approx(1 / ROOM, rel=1e-6)


def measures(phases: int) -> dict[str, Any]:
    """As the surface stage writes them."""
    wave = np.cos(2 * np.pi * np.arange(phases) / phases)
    names = ("lv_endocardium", "rv_endocardium", "left_atrium", "right_atrium", "aorta")
    segments = {f"basal {k}": (9 - wave).tolist() for k in range(16)}
    return {
        "volumes_ml": {name: (100 + 40 * wave).round(1).tolist() for name in names},
        "lv_mass_g": [110.0] * phases,
        "lv_wall_thickness_mm": {"mean": (9 - wave).tolist(), "segments": segments},
    }


@pytest.mark.parametrize(
    ("phases", "count"), [(2, 3), pytest.param(60, 200, marks=pytest.mark.slow)]
)
def test_the_page_of_any_stack_is_small_and_whole(
    phases: int, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Images of noise: those of hearts take fewer bytes. A recording as large takes 200 kB."""
    moving = _webp(np.random.default_rng(1).integers(0, 255, (5, 400, 400, 3), np.uint8), 0.8)
    monkeypatch.setattr(heart, "beating_surfaces", lambda surfaces, rr_s: moving)
    shown = moments(count, size=192)
    shown.labels[:, 0, 0, 0] = shown.labels[:, 0, -1, -1] = 1
    confidence = np.random.default_rng(2).uniform(0.4, 1, (phases, count))
    sections = [
        heart.segmentation(shown, confidence, 0.8),
        heart.movement({}, 0.8, np.arange(phases) / phases, measures(phases)),
    ]
    example = {"point_mm": [0, 0, 0], "phase": 0, "fixture": "a"}
    page = render("a", heart.function_rows(measures(phases)), sections, example, Opening("b"))
    assert len(page.encode()) < PAGE_LIMIT_BYTES
    assert len(re.findall(r'<img alt="[^"]+" src="data:image/', page)) == 3 + 4
    assert page.count('media="(prefers-reduced-motion: reduce), print" srcset="data:') == 1
    for words in ("LV mass</th><td>110 g", "RV ejection fraction</th><td>57 %", "doubtful slice"):
        assert words in page
    chosen = "24 of the 200 slices are shown" in page
    assert chosen == (count == 200)
    assert ("and" in sections[0].tables[0].rows[-1][0]) == (count == 200)


def test_a_sure_segmentation_has_no_table_of_doubts() -> None:
    section = heart.segmentation(moments(3), np.full((2, 3), 0.97), 0.8)
    assert section.tables == []
    assert "Lowest confidence: 0.97" in section.text


@pytest.mark.parametrize("where", ["before", "after"])
def test_an_animation_without_room_for_its_files_fails(
    monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """A page without it would stand as finished."""
    ball = MovingSurface(np.zeros((2, 3, 3)), np.array([[0, 1, 2]]), np.array([0, 0.5]))

    def full(path: Path, surfaces: object) -> None:
        if where == "before":
            raise OSError(28, "No space left on device")

    ended = subprocess.CompletedProcess([], animation.NO_ROOM)
    monkeypatch.setattr(animation, "_hand_over", full)
    monkeypatch.setattr(animation.subprocess, "run", lambda *_, **__: ended)
    with pytest.raises(StageError, match=r"temporary files .* TMPDIR"):
        animation.beating_surfaces({"epicardium": ball}, 0.8)


def test_what_cannot_be_shown_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine that cannot draw in 3D, and a wall in which no segment was told."""
    said = SimpleNamespace(returncode=1, stderr=b"Traceback\nNameError: no display\n")
    monkeypatch.setattr(animation.subprocess, "run", lambda *_, **__: said)
    known = measures(4)
    known["lv_wall_thickness_mm"]["segments"] = {}
    section = heart.movement({}, 0.8, np.arange(4) / 4, known)
    assert (
        "not shown beating: this machine cannot draw in 3D (NameError: no display)" in section.text
    )
    assert [one.caption for one in section.pictures] == [
        "Volumes through the cycle",
        "Left muscle: mass and mean wall thickness",
    ]


def test_a_stack_without_a_right_ventricle_has_no_figures_of_one() -> None:
    known = measures(4)
    del known["volumes_ml"]["rv_endocardium"]
    assert [name for name, _ in heart.function_rows(known)] == [
        "LV volume, largest / smallest",
        "LV ejection fraction",
        "LV stroke volume",
        "LV mass",
    ]


@pytest.mark.parametrize("tall", [1.0, 2.5])
def test_arrows_of_force_point_along_it_whatever_the_pixels(tall: float) -> None:
    """A plane's normal leans by 30 degrees down from the columns' direction, and attracts."""
    lean = np.radians(30)
    normal = np.array([np.cos(lean), np.sin(lean), 0.0])
    field: Any = SimpleNamespace(
        fixtures={"a": SimpleNamespace(structure="plane", f_max_n=1.0)},
        potential=lambda points, phase, fixture: np.full(len(points), 0.5),
        distance_mm=lambda points, phase, structure: (points - 40.0) @ normal,
        force_n=lambda points, phase, fixture: np.tile(normal, (len(points), 1)),
    )
    shown = replace(moments(3), mr_from_index=np.diag([1.0, tall, 8.0, 1.0]))
    figure = pictures.potential_on_slice(shown, field, "a")
    drawn(figure)
    (arrows,) = (one for one in figure.axes[0].collections if isinstance(one, Quiver))
    arrow = np.asarray(arrows.get_paths()[0].vertices)
    tip = arrow[np.linalg.norm(arrow, axis=1).argmax()]
    assert np.degrees(np.arctan2(tip[1], tip[0])) == pytest.approx(-30, abs=0.1)


def test_pictures_repeat_to_the_byte() -> None:
    def made() -> list[bytes]:
        figure = slices.contours(moments(3), 0, np.array([[0.9, 0.7, 0.8]]), 0.8)
        curve = curves.volume_curves(np.array([0.0, 0.5]), {"aorta": [1.0, 2.0]})
        return [as_webp(figure), as_png(figure), as_svg(curve)]

    first, second = made(), made()
    assert first == second
    assert Image.open(BytesIO(first[0])).format == "WEBP"
    assert b"Matplotlib" not in first[1]


def test_pieces_of_a_cut_are_joined_so_that_dashes_show() -> None:
    angles = np.linspace(0, 2 * np.pi, 41)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    bow = np.column_stack([np.arange(8.0), np.arange(8.0) ** 2]) + 5
    pieces = np.concatenate([np.stack([one[:-1], one[1:]], axis=1) for one in (ring, bow)])
    pieces = np.random.default_rng(3).permutation(pieces)
    pieces[::2] = pieces[::2, ::-1]
    found = sorted(pictures.joined(pieces), key=len)
    assert [len(one) for one in found] == [8, 41]
    np.testing.assert_allclose(sorted(found[0].tolist()), sorted(bow.tolist()), atol=1e-6)
    np.testing.assert_array_equal(found[1][0], found[1][-1])
    assert np.linalg.norm(np.diff(found[1], axis=0), axis=1).max() < 0.16
    assert pictures.joined(np.zeros((0, 2, 2))) == []


@pytest.mark.parametrize(
    ("name", "value", "row"),
    [
        ("drift_max_mm", 0.092345, ("drift max", "0.0923 mm")),
        (
            "force_step_max_n_per_0_1_mm",
            0.4144,
            ("force step max per 0.1 mm", "0.414 N over 0.1 mm"),
        ),
        ("stiffness_n_per_m", 5385.7, ("stiffness", "5386 N/m")),
        ("node_error_far_mm", 6.37693e-06, ("node error far", "6.38e-06 mm")),
        ("sign_errors", 0, ("sign errors", "0")),
        ("verdict", "good", ("verdict", "good")),
        ("drift_max_mm", None, ("drift max", "unknown")),
        ("force_change_max_n_per_ms", None, ("force change max", "unknown")),
    ],
)
def test_figures_are_shown_with_their_units_and_no_more_digits_than_they_are_worth(
    name: str, value: object, row: tuple[str, str]
) -> None:
    assert figure_row(name, value) == row


def test_each_fixtures_forces_stand_beside_its_own_law_and_device() -> None:
    """The largest over both fixtures are those of different ones, so they are not shown."""
    soft = {
        "stiffness_n_per_m": 321.4,
        "stiffness_measured_n_per_m": 391.2,
        "stiffness_any_direction_p99_n_per_m": 323.0,
        "stiffness_any_direction_max_n_per_m": 1237.0,
        "stiffness_limit_n_per_m": 400.0,
        "beyond_limit_share": 0.0019,
        "force_step_max_n_per_0_1_mm": 0.4284,
        "force_change_max_n_per_ms": 0.153,
    }
    stiff = {
        **soft,
        "stiffness_n_per_m": 384.1,
        "stiffness_measured_n_per_m": 524.6,
        "stiffness_limit_n_per_m": None,
        "beyond_limit_share": None,
        "force_change_max_n_per_ms": None,
    }
    largest = {name: max(soft[name], stiff[name] or 0.0) for name in soft}
    surfaces = {"sign_errors": 0, "node_error_near_mm": 4e-7, "band_mm": 15.0, "structures": {}}
    forces, kept, others = certificate.tables(
        {**surfaces, **largest, "fixtures": {"soft": soft, "stiff": stiff}},
        {"node_error_near_mm": 0.001, "sign_errors": 0},
    )
    assert forces.rows == [
        ("soft", "321", "391", "323", "1237", "400", "0.19%", "0.43", "0.153"),
        ("stiff", "384", "525", "323", "1237", "unknown", "unknown", "0.43", "unknown"),
    ]
    assert len(forces.head) == len(forces.rows[0])
    assert kept.rows == [
        ("node error near", "4e-07 mm", "0.001 mm"),
        ("sign errors", "0", "0"),
    ]
    assert len(kept.head) == len(kept.rows[0])
    assert others.rows == [("band", "15 mm")]


def test_the_page_tells_what_it_was_made_of_as_sha256sum_does(tmp_path: Path) -> None:
    for name, text in {"cine/b.dcm": "one", "cine/A.dcm": "two", "manifest.json": "{}"}.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)

    def printed(command: str) -> str:
        shell = ["bash", "-c", command]
        return subprocess.run(
            shell, cwd=tmp_path, capture_output=True, text=True, check=True
        ).stdout

    digests = dict(line.split("  ")[::-1] for line in printed("sha256sum cine/*").splitlines())
    settings = Settings.model_validate({"bake": {"spacing_mm": 2.5}, "register": {"min_frames": 7}})
    section = provenance({"cine": digests, "us": {}}, settings, tmp_path / "manifest.json")
    files, changed, software = section.tables
    of_cine = printed("sha256sum cine/* | LC_ALL=C sort -k 2 | sha256sum").split()[0]
    *networks, manifest = files.rows[1:]
    assert files.rows[0] == ("cine", "2 files", of_cine)
    for name, _, digest in networks:
        (path,) = Path(render.__code__.co_filename).parents[1].rglob(name.split()[1])
        assert printed(f"sha256sum {path}").split()[0] == digest
    assert [manifest] == [
        ("bake/field.zarr/manifest.json", "1 file", printed("sha256sum manifest.json").split()[0]),
    ]
    assert changed.rows == [("register.min_frames", "7", "10"), ("bake.spacing_mm", "2.5", "1.5")]
    assert ("numpy", np.__version__) in software.rows
    one = {"cine/cine.nii.gz": digests["cine/b.dcm"]}
    assert provenance({"cine": one}, settings, tmp_path / "manifest.json").tables[0].rows[0] == (
        "cine",
        "1 file",
        digests["cine/b.dcm"],
    )
    no_text = os.fsdecode(b"cine/b\xfc.dcm")
    (tmp_path / "cine" / "b.dcm").rename(tmp_path / no_text)
    by_name = {no_text: digests["cine/b.dcm"], "cine/A.dcm": digests["cine/A.dcm"]}
    of_cine = printed("sha256sum cine/* | LC_ALL=C sort -k 2 | sha256sum").split()[0]
    assert digest_of_files(by_name) == of_cine
    (said,) = provenance({}, Settings(), tmp_path / "manifest.json").tables[1].rows
    assert said == ("all", "default", "")


def test_the_page_is_drawn_alike_for_everybody(monkeypatch: pytest.MonkeyPatch) -> None:
    """A user's own `matplotlibrc` may turn pictures over, and ask for LaTeX."""
    seen = []

    def look(_: object) -> None:
        seen.append([matplotlib.rcParams[name] for name in ("image.origin", "text.usetex")])
        raise StageError("enough")

    monkeypatch.setattr(report_stage, "read_cine", look)
    with matplotlib.rc_context({"image.origin": "lower", "text.usetex": True}):
        with pytest.raises(StageError, match="enough"):
            report_stage.run(SimpleNamespace(products=Path("nowhere")))
        assert matplotlib.rcParams["image.origin"] == "lower"
    assert seen == [["upper", False]]
