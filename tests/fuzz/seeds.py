"""Write the corpus that fuzz_field.c starts from, and the store that it damages.

``python tests/fuzz/seeds.py CORPUS`` bakes a small field, cuts it to what ``bf_open`` reads, and
prints the folder to give as ``BF_FUZZ_FOLDER``.
"""

from __future__ import annotations

import json
import shutil
import struct
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from field_baked import bake_small  # beside this folder, as for the tests

QUESTIONS = [
    (1, -2, 3, 0.1, 0.9, 12, -7, 5, -0.3, -4, -3, -2, 2, 2, 2),
    (0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1),
    (1e300, -1e300, 3, 1e18, 0.9, 12, -7, 5, -0.3, -1e8, 0, 0, 1e-5, 1e5, 1),
]


def write_seeds(corpus: Path, store: Path) -> None:
    """One input of each kind and variation; the store keeps its coefficients only."""
    bake_small(store)
    for part in ("distance", "potential"):
        shutil.rmtree(store / part)
    text = (store / "zarr.json").read_bytes()
    (store / "good.json").write_bytes(text)
    (store / "manifest.json").rename(store / "seed.json")
    field = json.loads(text)["attributes"]["beatfield"]
    short = json.dumps({"attributes": {"beatfield": field}}).encode()
    tiny = {**field, "grid": {**field["grid"], "shape_zyx": [3, 4, 5]}, "accuracy": {}}
    ordered = dict(sorted({**tiny, "mr_from_tracker": None, "rr_s": None}.items()))
    seeds = [b"\0" + short, b"\1" + (store / "seed.json").read_bytes(), b"\2" + short]
    seeds += [
        b"\0" + json.dumps({"attributes": {"beatfield": one}}).encode() for one in (tiny, ordered)
    ]
    seeds += [b"\3" + struct.pack("<15d", *numbers) for numbers in QUESTIONS]
    for number, seed in enumerate(seeds):
        (corpus / f"seed-{number}").write_bytes(seed)


if __name__ == "__main__":
    place = Path(tempfile.mkdtemp(prefix="beatfield-fuzz-")) / "field.zarr"
    write_seeds(Path(sys.argv[1]), place)
    sys.stdout.write(f"{place}\n")
