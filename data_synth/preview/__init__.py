"""One self-contained page that shows a synthetic study."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from data_synth.simulate import SyntheticStudy


def write_preview(path: Path, study: SyntheticStudy) -> None:
    """Write the page; its folder is made if missing."""
    from data_synth.preview.page import render_page
    from data_synth.preview.style import own_style

    path.parent.mkdir(parents=True, exist_ok=True)
    with own_style():
        path.write_text(render_page(study), encoding="utf-8")
