"""What the report says of ultrasound before anything else, and of how the images lie."""

from __future__ import annotations

from dataclasses import replace
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from PIL import Image

from pipeline.config import Settings
from pipeline.doubts import doubts, few_phases
from pipeline.geometry import MovingSurface
from pipeline.imaging.labels import LABELS
from pipeline.imaging.view import AS_THE_FILE_SAYS
from pipeline.job import Job
from pipeline.products import FrameRow
from pipeline.report import pictures, slices
from pipeline.report.animation import _webp, first_frame
from pipeline.report.moments import Moments
from pipeline.report.page import Opening, Section, Table, render
from pipeline.report.registered import frames_shown, registration_notes
from pipeline.stages.report import _of_whole_ventricles, _opening
from pipeline.summary import remarks


def notes(us: object, figures: dict[str, Any] | None) -> list[str]:
    """Of a study with this ultrasound, whose registration found this, or did not end well."""
    job = SimpleNamespace(
        study=SimpleNamespace(us=us),
        product=lambda stage: None if figures is None else Path("register"),
        figures=lambda stage: figures,
        skipped={"register": "frames agree with nothing"},
    )
    return registration_notes(cast(Job, job))


def test_ultrasound_that_was_not_registered_is_not_called_missing() -> None:
    """`on_failure: mr_frame` goes on without it."""
    assert notes(None, None) == []
    (told,) = notes(object(), None)
    assert told == "The tracked ultrasound could not be registered: frames agree with nothing."


@pytest.mark.parametrize(
    ("figures", "told"),
    [
        ({"verdict": "good", "reason": "", "us_clock_applied_s": 0.0}, []),
        ({"verdict": "doubtful", "reason": "few frames"}, ["Registration doubtful: few frames."]),
        (
            {"verdict": "good", "reason": "", "us_clock_applied_s": 0.06},
            [
                "Clocks: ultrasound 0.060 s ahead of its ECG, which was put right "
                "(register.clock_offset)."
            ],
        ),
    ],
)
def test_doubts_and_corrections_stand_at_the_top(figures: dict[str, Any], told: list[str]) -> None:
    assert notes(object(), figures) == told


def opening(
    us: object,
    verdict: str | None,
    doubtful: bool,
    truth: bool,
    cut_off: dict[str, dict[int, int]] | None = None,
) -> Opening:
    """Of a study whose other stages found nothing amiss, or a slice of low confidence."""
    figures: dict[str, Any] = {
        "segment": {
            "orientation": str(AS_THE_FILE_SAYS),
            "cut_off": cut_off or {},
            "cut_sideways": {},
        },
        "ingest": {"remarks": [], "interpolated_slices": [3] if doubtful else [], "phases": 9},
        "surface": {"left_out": {}},
        "bake": {"accuracy": {}, "left_out": {}},
        "register": {"verdict": verdict, "reason": "few frames", "remarks": []},
    }
    made = {"register": verdict is not None, "evaluate": truth}
    job = SimpleNamespace(
        study=SimpleNamespace(us=us),
        product=lambda stage: Path(stage) if made[stage] else None,
        figures=figures.__getitem__,
        skipped={"register": "frames agree with nothing"},
        settings=Settings(),
    )
    return _opening(cast(Job, job))


@pytest.mark.parametrize(
    ("us", "verdict", "doubtful", "headline"),
    [
        (object(), "good", False, "Registration good. No warnings"),
        (object(), "good", True, "Registration good. 1 warning, to be read first."),
        (object(), "doubtful", True, "Registration doubtful. 2 warnings, to be read first."),
        (object(), None, False, "NOT REGISTERED: not for use with a tracker;"),
        (None, None, False, "Not registered: no tracked ultrasound,"),
    ],
)
def test_the_page_begins_with_what_the_field_is_worth(
    us: object, verdict: str | None, doubtful: bool, headline: str
) -> None:
    said = opening(us, verdict, doubtful, truth=True)
    assert said.headline.startswith(headline)
    assert any("not for use on patients" in text for text in said.told)


@pytest.mark.parametrize(
    ("body", "warned"), [("aorta", False), ("left atrium", True), ("right ventricle", True)]
)
def test_what_is_cut_off_and_of_no_fixture_is_no_warning(body: str, warned: bool) -> None:
    """The default fixtures lie at the left ventricle and the left atrium; ejection is told too."""
    said = opening(object(), "good", False, truth=True, cut_off={body: {11: 9}})
    assert any(body in text for text in said.warnings) == warned
    assert any(body in text for text in said.told) != warned


def test_ventricles_that_eject_unequally_are_told_unless_one_is_cut_off() -> None:
    surface = {"volumes_ml": {"lv_endocardium": [150.0, 70.0], "rv_endocardium": [160.0, 95.0]}}
    [said] = doubts({}, surface)
    assert said.startswith("volumes: the left ventricle ejects 80 ml and the right one 65 ml;")
    assert doubts({"cut_off": {"right ventricle": {11: 9}}}, surface) == []
    surface["volumes_ml"]["rv_endocardium"] = [160.0, 91.0]
    assert doubts({}, surface) == []
    surface["volumes_ml"]["rv_endocardium"] = [160.0, 60.0]
    [said] = doubts({}, surface)
    assert said.startswith("volumes: the left ventricle ejects 80 ml and the right one 100 ml;")


def test_a_view_is_told_that_agrees_along_less_than_half_of_its_lines() -> None:
    """Of another patient or another phase; a view of few lines gets no benefit of rounding."""
    [said] = doubts({"views_agree": {"two_chamber": [6, 14], "four_chamber": [7, 14]}}, {})
    assert "two_chamber agrees with the slices along 6 of 14 lines" in said


def test_a_ventricle_is_told_that_ejects_more_than_any_does() -> None:
    """Hyperdynamic and hypertrophic hearts eject up to four fifths."""
    assert doubts({"volumes_ml": {"lv_cavity": [150.0, 30.0]}}, {}) == []
    [said] = doubts({"volumes_ml": {"lv_cavity": [150.0, 18.0]}}, {})
    assert "the left ventricle ejects 88 % of its 150 ml; look at the contours of phase 1" in said


def test_a_slice_that_swings_less_than_a_quarter_hardly_moves() -> None:
    still, slow = ({"swing": swing, "in_step": 0.1} for swing in (0.24, 0.26))
    [first, second] = doubts({"out_of_step": {"3": still, "5": slow}}, {})
    assert first.startswith("slice 3 ")
    assert "hardly moving" in first
    assert "moving otherwise" in second


def test_lines_on_a_frame_are_those_of_its_own_phase() -> None:
    """Between two stored phases, and between the last and the first of the next beat."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    moving = MovingSurface(
        np.stack([corners, corners + 4, corners + 1]),
        np.array([[0, 1, 2]]),
        np.array([0.1, 0.5, 0.7]),
    )
    for phase, off in ((0.1, 0), (0.2, 1), (0.5, 4), (0.6, 2.5), (0.7, 1), (0.9, 0.5), (0.0, 0.25)):
        found = pictures._between(moving, phase).vertices_mm
        np.testing.assert_allclose(found, corners + off, atol=1e-12)


def test_a_frame_that_speaks_against_a_registration_is_shown() -> None:
    rows = [FrameRow("a", k, k / 20, 0.1, 0.4 + 0.6 * (k == 30), k < 25) for k in range(31)]
    assert [row.frame for row in frames_shown(rows)] == [0, 12, 24, 27]
    assert [row.frame for row in frames_shown(rows[:25])] == [0, 8, 16, 24]
    # Of few frames each is shown once.
    assert [row.frame for row in frames_shown(rows[:3])] == [0, 1, 2]
    assert frames_shown([]) == []


def test_what_of_the_folder_is_not_used_is_told_in_one_line() -> None:
    ingest = {
        "left_out": ["series 3: scout", "series 17: across", "series 9: a report"],
        "long_axis": ["series 17"],
        "interpolated_slices": [4],
    }
    assert remarks({"ingest": {"status": "done", "figures": ingest}}) == [
        ("input", "slice 4 is drawn between its neighbours"),
        ("left out", "of the cine's folder series 3: scout, and 1 more that the report names"),
    ]


@pytest.mark.parametrize("truth", [False, True])
def test_a_phantom_is_not_shown_as_a_patient(truth: bool) -> None:
    told = " ".join(opening(None, None, False, truth).told)
    assert ("synthetic" in told) is truth
    assert ("No known truth" in told) is not truth


def test_warnings_are_told_from_the_rest_by_words_and_not_by_colour_alone() -> None:
    example = {"point_mm": [0, 0, 0], "phase": 0, "fixture": "a"}
    page = render("p", [], [], example, Opening("Look.", ["it is <bad>"], ["it is so"]))
    assert '<p class="verdict"><strong>Look.</strong></p>' in page
    assert "<strong>Mind:</strong> it is &lt;bad&gt;</p>" in page
    assert '<p class="told">it is so</p>' in page


def test_tables_have_heads_that_a_screen_reader_can_tell() -> None:
    example = {"point_mm": [0, 0, 0], "phase": 0, "fixture": "a"}
    table = Table(("structure", ""), [("aorta", "3 mm")])
    page = render("p", [("mass", "3 g")], [Section("s", "t", (), [table])], example, Opening("x"))
    assert "<th>" not in page
    for head in ('"col">structure', '"row">aorta', '"row">mass'):
        assert f"<th scope={head}</th>" in page


@pytest.mark.parametrize("turned", [False, True])
def test_the_page_says_how_the_stack_lies(turned: bool) -> None:
    """A radiologist must know which end is the apex, and which side of a picture is left."""
    labels = np.zeros((1, 5, 4, 4), np.uint8)
    labels[:, :4, 1:3, 1:3] = LABELS["lv_myocardium"]
    labels[:, 4, 1:3, 1:3] = LABELS["left_atrium"]
    columns = np.array([[0.8, 0.0, 0.6], [0.6, 0.0, -0.8], [0.0, 1.0, 0.0]]).T
    mr_from_index = np.eye(4)
    mr_from_index[:3, :3] = columns * (1.5, 1.5, 8.0)
    shown = Moments(
        ("End-diastole",),
        (0,),
        np.zeros(1),
        np.zeros(labels.shape, np.float32),
        labels[:, ::-1] if turned else labels,
        mr_from_index,
    )
    axis = slices.contours(shown, 0).axes[0]
    sides = {one.get_position(): one.get_text() for one in axis.texts}
    assert sides == {(0.98, 0.5): "LS", (0.02, 0.5): "RI", (0.5, 0.02): "IL", (0.5, 0.98): "SR"}
    text = slices.how_it_lies(shown)
    assert text.startswith(f"Slice {4 if turned else 0} is the one nearest the apex. ")
    assert "Right in the pictures is LS, below IL, higher slice numbers P " in text
    labels[labels == LABELS["left_atrium"]] = 0
    assert slices.how_it_lies(replace(shown, labels=labels)).startswith("Right in the pictures")


@pytest.mark.parametrize(("pixel_mm", "drawn"), [(1.1, True), (2.5, True), (0.2, False)])
def test_the_scale_of_a_picture_is_so_long_in_the_patient(pixel_mm: float, drawn: bool) -> None:
    """In turned images of oblong pixels too; a picture too small for it goes without."""
    labels = np.zeros((1, 3, 60, 60), np.uint8)
    labels[:, :, 10:50, 10:50] = LABELS["lv_myocardium"]
    turned = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    frame = np.eye(4)
    frame[:3, :3] = turned * (pixel_mm, 3.0, 8.0)
    grey = np.zeros(labels.shape, np.float32)
    shown = Moments(("End-diastole",), (0,), np.zeros(1), grey, labels, frame)
    axis = slices.contours(shown, 0).axes[0]
    lines = [one for one in axis.lines if one.get_color() == "white"]
    assert [np.ptp(one.get_xdata()) * pixel_mm for one in lines] == pytest.approx([20] * drawn)
    assert all(np.ptp(one.get_ydata()) == 0 for one in lines)
    assert ("20 mm" in [text.get_text() for text in axis.texts]) == drawn


def test_the_animation_at_rest_is_one_picture() -> None:
    frames = np.zeros((3, 20, 20, 3), np.uint8)
    frames[0, ..., 0], frames[1, ..., 1], frames[2, ..., 2] = 255, 255, 255
    still = Image.open(BytesIO(first_frame(_webp(frames, 0.8))))
    assert getattr(still, "n_frames", 1) == 1
    red, green, blue = np.asarray(still.convert("RGB")).mean(axis=(0, 1))
    assert red > 200 > 60 > max(green, blue)


def test_ultrasound_of_oblong_pixels_is_shown_in_proportion() -> None:
    images = [np.zeros((8, 8), np.float32)] * 2
    # Pixels of 1 x 1 mm, and of 2 mm across and 3 mm down.
    given = np.stack([np.eye(4), np.diag([1 / 2, 1 / 3, 1, 1])])
    figure = pictures.cuts_on_ultrasound(images, ["a", "b"], given, np.zeros(2), {})
    assert [axis.get_aspect() for axis in figure.axes] == [1.0, 1.5]


def test_a_frame_has_a_scale_in_millimetres_of_the_patient() -> None:
    images, names = [np.zeros((80, 100), np.float32)] * 2, ["a", "b"]
    given = np.stack([np.diag([4.0, 4, 4, 1]), np.diag([1 / 2, 1 / 3, 1, 1])])
    figure = pictures.cuts_on_ultrasound(images, names, given, np.zeros(2), {})
    for axis, pixels in zip(figure.axes, (80.0, 10.0), strict=True):
        lengths = [np.ptp(line.get_xdata()) for line in axis.lines]
        # 20 mm; one that is longer than half of the picture is not drawn.
        assert lengths == pytest.approx([pixels] if pixels < 50 else [])
        assert [text.get_text() for text in axis.texts] == ["20 mm"] * len(lengths)


def test_blood_that_was_found_lies_where_it_was_found_in_the_frame() -> None:
    step = np.array([2.0, 3.0])
    blood = pictures.BloodFound(np.zeros((5, 4), np.float32), step)
    oblong = np.diag([1 / 2, 1 / 3, 1, 1])[None]
    image = [np.zeros((15, 8), np.float32)]
    figure = pictures.cuts_on_ultrasound(image, ["a"], oblong, np.zeros(1), {}, [blood])
    frame, below = figure.axes
    assert (below.get_xlim(), below.get_ylim()) == (frame.get_xlim(), frame.get_ylim())
    assert below.get_aspect() == frame.get_aspect() == 1.5
    shown = below.images[0]
    left, right, bottom, top = shown.get_extent()
    rows, columns = blood.chance.shape
    centres = left + (np.arange(columns) + 0.5) * (right - left) / columns
    np.testing.assert_allclose(centres, step[0] * np.arange(columns))
    centres = top + (np.arange(rows) + 0.5) * (bottom - top) / rows
    np.testing.assert_allclose(centres, step[1] * np.arange(rows))


def test_figures_of_a_ventricle_that_the_stack_cuts_off_say_so() -> None:
    rows = [("LV mass", "45 g"), ("RV ejection fraction", "57 %")]
    assert _of_whole_ventricles(rows, {}) == rows
    left, right = _of_whole_ventricles(rows, {"left ventricle": {0: 2}, "aorta": {7: 2}})
    assert left == ("LV mass", "45 g (of what the stack shows)")
    assert right == rows[1]


def test_phases_too_few_to_tell_where_walls_are_between_them_are_told():
    def accuracy(unsure_mm: float | None, phases: int) -> dict[str, Any]:
        parts = {"epicardium": {"sign_errors_by_phase": phases * [0]}}
        return {"motion_unsure_p99_mm": unsure_mm, "structures": parts}

    # Of ten phases walls are unsure by up to 0.8 mm, which is no surprise.
    assert few_phases(accuracy(0.9, 10)) == []
    # Where no field was baked.
    assert few_phases({}) == []
    [said] = few_phases(accuracy(None, 2))
    assert "nobody knows" in said
    assert few_phases(accuracy(None, 1)) == []
    [said] = few_phases(accuracy(0.9, 6))
    assert "to a millimetre, for there are but 6 phases" in said
    # What rests does so between phases, too.
    assert few_phases(accuracy(0.2, 6)) == []
    [said] = few_phases(accuracy(1.26, 10))
    assert "walls may lie 1.3 mm" in said
    stages = {"bake": {"status": "done", "figures": {"accuracy": accuracy(1.26, 10)}}}
    assert ("doubtful", said) in remarks(stages)
    stages["bake"]["status"] = "stale"
    assert remarks(stages) == []


@pytest.mark.parametrize(
    ("segment", "surface", "words"),
    [
        # Muscle keeps its volume; images with inverted contrast gave 1.89 times.
        ({"volumes_ml": {"lv_myocardium": [100.0, 138.0]}}, {}, None),
        (
            {"volumes_ml": {"lv_myocardium": [145.0, 100.0, 120.0]}}, {},
            "labels: of heart muscle phase 1 has 100 ml and phase 0 145 ml",
        ),
        ({"lowest_confidence": 0.71, "least_certain": {"slice": 4, "phase": 2}}, {}, None),
        (
            {"lowest_confidence": 0.69, "least_certain": {"slice": 4, "phase": 2}}, {},
            "labels of slice 4 in phase 2, whose confidence of 0.69 is the lowest",
        ),
        ({"astray_mm": {"5": 19.4}}, {}, "slice 5 showed the heart 19 mm beside"),
        ({}, {"left_out_ml": {"aorta": {"4": 9.1}}}, "surfaces: aorta leaves out up to 9.1 ml"),
        ({}, {"crossing_triangles": {"heart": 4}}, "surfaces: heart passes through itself (4"),
        (
            {}, {"off_mm": {"epicardium": {"3": 1.6, "7": 2.0}}},
            "surfaces: epicardium lies 2.0 mm or more beside its labels",
        ),
        (
            {}, {"misfit_ml": {"aorta": {"3": [9.0, 10.0], "4": [12.0, 14.0]}}},
            "surfaces: aorta encloses 12.0 ml in phase 4, its labels 14.0 ml; look at the contours",
        ),
        ({"flicker_beats": {"8": 0.07}}, {}, None),
        (
            {"flicker_beats": {"8": 0.1, "10": 0.02, "9": 0.15}}, {},
            "labels of slice 8 to 9 came and went from phase to phase, and are a mean over 15 % of",
        ),
        # Stroke volumes of 80 and 69.5 ml are 0.13 of the larger one apart, of 80 and 67 ml 0.16.
        (
            {}, {"volumes_ml": {"lv_endocardium": [150.0, 70.0], "rv_endocardium": [160.0, 90.5]}},
            None,
        ),
        (
            {}, {"volumes_ml": {"lv_endocardium": [150.0, 70.0], "rv_endocardium": [160.0, 93.0]}},
            "volumes: the left ventricle ejects 80 ml and the right one 67 ml",
        ),
        (
            {"cut_sideways": {"left ventricle": 9}},
            {"volumes_ml": {"lv_endocardium": [150.0, 70.0], "rv_endocardium": [160.0, 99.0]}},
            None,
        ),
        # Smallest at 0.95, where the end of the beat is 0.05: a tenth early, around the R peak.
        (
            {}, {"end_systole": {"phase": 0.95, "usual": 0.05}, "lv_ejection_fraction": 0.6},
            None,
        ),
        (
            {}, {"end_systole": {"phase": 0.97, "usual": 0.37}, "lv_ejection_fraction": 0.6},
            "times: the left ventricle is smallest at phase 0.97, where 0.37 is usual",
        ),
    ],
)  # fmt: skip
def test_what_speaks_against_labels_and_times_is_told(
    segment: dict[str, Any], surface: dict[str, Any], words: str | None
) -> None:
    said = doubts(segment, surface)
    assert [one[: len(words or "")] for one in said] == ([] if words is None else [words])


def test_what_is_cut_at_the_sides_and_what_is_left_out_is_told_of_the_run() -> None:
    stages = {
        "ingest": {"status": "done", "figures": {"phases": 9}},
        "segment": {"status": "done", "figures": {"cut_sideways": {"aorta": 4, "heart": 4}}},
        "register": {"status": "done", "figures": {"remarks": ["sweep 2 stands still"]}},
        "bake": {"status": "done", "figures": {"left_out": {"valve": "unseen", "apex": "unseen"}}},
    }
    assert remarks(stages) == [
        ("input", "sweep 2 stands still"),
        (
            "cut off",
            "aorta, heart at the images' edge in 4 of 9 phases: surfaces and volumes end there",
        ),
        ("left out", "fixture valve, apex: unseen"),
    ]
