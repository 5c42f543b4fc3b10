"""What the report says of ultrasound before anything else, and of how the images lie."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from pipeline.imaging.labels import LABELS
from pipeline.job import Job
from pipeline.report import slices
from pipeline.report.moments import Moments
from pipeline.stages.report import _registration_notes


def notes(us: object, figures: dict[str, Any] | None) -> list[str]:
    """Of a study with this ultrasound, whose registration found this, or did not end well."""
    job = SimpleNamespace(
        study=SimpleNamespace(us=us),
        product=lambda stage: None if figures is None else Path("register"),
        figures=lambda stage: figures,
    )
    return _registration_notes(cast(Job, job))


def test_ultrasound_that_was_not_registered_is_not_called_missing() -> None:
    """`on_failure: mr_frame` goes on without it."""
    assert notes(None, None) == ["No tracked ultrasound: the field is in the frame of the MR."]
    (told,) = notes(object(), None)
    assert "could not be registered" in told
    assert "frame of the MR" in told


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
    text = slices.how_it_lies(shown)
    assert text.startswith(f"Slice {4 if turned else 0} is the one nearest the apex. ")
    assert "Right in the pictures is LS, below IL, higher slice numbers P " in text
    labels[labels == LABELS["left_atrium"]] = 0
    assert slices.how_it_lies(replace(shown, labels=labels)).startswith("Right in the pictures")
