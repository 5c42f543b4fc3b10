"""Settings of the imaging stages; light to import, so that the command line starts at once."""

from __future__ import annotations

from pydantic import Field

from pipeline.validation import Section

THIN_MM = 4.0
"""Slices no farther apart are those of a volume, through which others can be drawn as good."""

LOW_CONFIDENCE = 0.8
"""Labels of an image that are trusted less are shown as doubtful."""


class SegmentSettings(Section):
    """How the heart is labelled in the images and carried to an isotropic grid."""

    most_views: int = Field(5, ge=1, le=5)
    """In how many ways, each turned a little otherwise, the network is shown each image; the more
    images a study has, the fewer, so that the time stays about the same."""

    phase_blend: float = Field(0.25, ge=0, le=0.25)
    """How much phases are mixed with their neighbours at 25 phases a beat, as the share that either
    would have in a plain mean; with fewer, it falls as the square of their distance grows."""

    min_confidence: float = Field(0.4, ge=0, le=1)
    """An image whose labels are trusted less counts as not understood and fails the stage; a few
    beyond the left ventricle do not."""

    min_ventricle_ml: float = Field(30.0, gt=0, le=1000)
    """A left ventricle (cavity and muscle) smaller than this counts as not found."""

    grid_mm: float = Field(1.5, ge=0.5, le=4)
    """Spacing of the isotropic grid."""

    margin_mm: float = Field(12.0, ge=0, le=100)
    """Empty space kept around the heart on the isotropic grid."""

    correct_shifts: bool = True
    """Move slices against breath-hold shifts before they become a volume: in their plane, and along
    its normal where long-axis views tell how far."""
