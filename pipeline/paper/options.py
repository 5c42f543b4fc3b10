"""What a user may choose of the paper's experiments; importing it loads nothing heavy."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from pipeline.console import Whole

DEMO_PRODUCTS = Path("demo/products-1/patient-0001")
DEMO_STUDY = Path("demo/studies-1/patient-0001")


@dataclass(frozen=True)
class PaperOptions:
    """Subject, seed and parts."""

    products: Path = DEMO_PRODUCTS
    """A patient's products, or a field.zarr alone."""

    study: Path | None = None
    """The study whose ultrasound Figure 6 shows; the demo's for the demo's products."""

    seed: Whole = 1
    """Of pellets and simulated operators."""

    operators: Whole = 100
    """How many simulated operators do the task."""

    only: tuple[str, ...] = ()
    """Parts to make, such as figure-5; all without it."""

    def resolved_study(self) -> Path | None:
        """The study given, or the demo's where its products are asked for."""
        if self.study is None and self.products == DEMO_PRODUCTS and DEMO_STUDY.is_dir():
            return DEMO_STUDY
        return self.study

    def command(self) -> str:
        """What to type to make a part again, but for its name."""
        chosen = ""
        # The line is there to be pasted, and names may hold spaces.
        if self.products != DEMO_PRODUCTS:
            chosen += f" --products {shlex.quote(str(self.products))}"
        if self.study:
            chosen += f" --study {shlex.quote(str(self.study))}"
        return f"beatfield paper OUT{chosen} --seed {self.seed} --operators {self.operators}"


PAPER = PaperOptions()
