"""The colour of each part of the heart in all of the report's pictures."""

from __future__ import annotations

from typing import Any

# Okabe and Ito's colours, told apart by colour-blind readers: jfly.uni-koeln.de/color. Line styles
# serve greyscale, and green and pink, which some take for grey.
STYLES: dict[str, tuple[str, Any]] = {
    "lv_cavity": ("#D55E00", "-"),
    "lv_myocardium": ("#56B4E9", "--"),
    "rv_cavity": ("#009E73", "-."),
    "left_atrium": ("#F0E442", ":"),
    "right_atrium": ("#CC79A7", (0, (7, 1.5))),
    "aorta": ("#0072B2", (0, (3, 1, 1, 1, 1, 1))),
}
"""Of labels: colour and line."""
SURFACE_STYLES = {
    "lv_endocardium": STYLES["lv_cavity"],
    "epicardium": STYLES["lv_myocardium"],
    "rv_endocardium": STYLES["rv_cavity"],
    "left_atrium": STYLES["left_atrium"],
    "right_atrium": STYLES["right_atrium"],
    "aorta": STYLES["aorta"],
}
"""Of the same parts' surfaces."""
SOLID_COLOURS = {
    name: STYLES["lv_cavity"][0] if name == "epicardium" else colour
    for name, (colour, _) in SURFACE_STYLES.items()
    if name != "lv_endocardium"
}
"""Of surfaces seen from outside. Shades of the muscle's light blue would be taken for the aorta's
blue, so the left ventricle keeps its cavity's colour."""
