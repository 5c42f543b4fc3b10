"""Values of the structures in label images: the one table that every stage and product uses."""

from __future__ import annotations

LABELS: dict[str, int] = {
    "lv_cavity": 1,
    "lv_myocardium": 2,
    "rv_cavity": 3,
    "left_atrium": 4,
    "right_atrium": 5,
    "aorta": 6,
}
"""Structure name to label value; 0 is everything else."""
