"""Write a field as a Zarr v3 group, one phase at a time, and seal it with a manifest.

Every chunk is one phase as raw little-endian float32, so that any program can map it. The
manifest is written last: a store without it is not a store.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.field.files import chunk_path
from pipeline.field.manifest import write_manifest
from pipeline.field.metadata import FieldMetadata, attributes
from pipeline.field.spline import time_solver
from pipeline.geometry import Float32

SLAB = 65_536
"""Nodes whose whole cycle is in memory at once."""


class FieldWriter:
    """A store in the making; hold one phase, write it, forget it."""

    def __init__(self, path: Path, metadata: FieldMetadata) -> None:
        """Create the empty group and arrays at ``path``, which must not hold any."""
        import zarr

        self._path = path
        self._metadata = metadata
        self._group = zarr.create_group(path, zarr_format=3, attributes=attributes(metadata))
        self._arrays = {name: self._create(name) for name in metadata.arrays}

    def _create(self, name: str) -> Any:
        from zarr.codecs import BytesCodec

        shape = self._metadata.grid.shape_zyx
        return self._group.create_array(
            name,
            shape=(len(self._metadata.phases), *shape),
            chunks=(1, *shape),
            dtype="float32",
            serializer=BytesCodec(endian="little"),
            compressors=None,
            filters=None,
            fill_value=np.nan,
            dimension_names=("t", "z", "y", "x"),
            config={"write_empty_chunks": True},
        )

    def write(self, name: str, index: int, values: Float32) -> None:
        """Write phase ``index`` of the array ``name``, ``(z, y, x)``."""
        self._arrays[name][index] = values

    def solve_splines_in_time(self) -> None:
        """Turn the spline arrays, so far solved in space phase by phase, into the final ones.

        A slab of nodes is in memory at a time, all its phases together.
        """
        solver = time_solver(np.array(self._metadata.phases))
        for structure in self._metadata.structures:
            mapped = [phase.reshape(-1) for phase in self.splines(structure)]
            for start in range(0, len(mapped[0]), SLAB):
                slab = np.stack([phase[start : start + SLAB] for phase in mapped])
                solved = solver @ slab.astype(np.float64)
                for phase, values in zip(mapped, solved, strict=True):
                    phase[start : start + SLAB] = values

    def splines(self, structure: str) -> list[Float32]:
        """The spline arrays of a structure, mapped for changes: ``(z, y, x)``, one a phase."""
        folder = self._path / self._metadata.structures[structure].spline
        shape = self._metadata.grid.shape_zyx
        return [
            np.memmap(chunk_path(folder, index), dtype="<f4", mode="r+", shape=shape)
            for index in range(len(self._metadata.phases))
        ]

    def finish(self, metadata: FieldMetadata) -> None:
        """Write the final attributes, then the manifest."""
        self._group.update_attributes(attributes(metadata))
        write_manifest(self._path)
