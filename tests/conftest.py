"""Settings that all tests share."""

import gc

import pytest
from hypothesis import settings

# A first call compiles kernels or loads libraries, so time says nothing; the same examples every
# time, so that a failure is there again on the next run.
settings.register_profile("beatfield", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("beatfield")

LONGEST_FIRST = (
    "test_pipeline",
    "test_field_accuracy",
    "test_dissection",
    "test_registration_space",
    "test_clock_offset",
    "test_registration_calibration",
    "test_segmentation_robustness",
    "test_segmentation",
    "test_phantom_study",
    "test_phantom_anatomy",
    "test_phantom_preview",
    "test_phantom_population",
    "test_field_header",
    "test_phantom_mr",
    "test_segmentation_orientation",
    "test_surface_correspondence",
    "test_report",
)
"""Files that take 15 s and more. Those side by side at the beginning compile different kernels, so
that each finds on disk what the other has compiled."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files first: workers take whole files in turn, and short ones even out the end."""
    rank = {name: place for place, name in enumerate(LONGEST_FIRST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


def pytest_collection_finish() -> None:
    """What is imported by now stays, and need not be looked through for garbage time and again."""
    gc.freeze()
