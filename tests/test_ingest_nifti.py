"""What the ingest stage makes of NIfTI files that other programs cut, turned or stored anew."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pytest

from pipeline.config import Settings
from pipeline.errors import InputError
from pipeline.job import Job
from pipeline.products import read_blank_ends, read_cine, read_long_axis
from pipeline.stages import ingest
from pipeline.study import open_study
from tests.outside_heart import Scan, render


def ingested(folder: Path) -> tuple[Path, list[str]]:
    """Where the stage wrote, and what it told."""
    job = Job(open_study(folder), Settings(), folder, folder.parent / "out", lambda done, of: None)
    job.folder.mkdir()
    figures: dict[str, Any] = ingest.run(job)
    return job.folder, figures["remarks"]


def saved(path: Path, data: Any, step: float, unit: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = nibabel.Nifti1Image(data, np.diag([3, 3, 12, 1.0]))
    image.header.set_xyzt_units("mm", unit)
    image.header["pixdim"][4] = step
    nibabel.save(image, path)


def chest(phases: int = 6) -> Any:
    """``(column, row, slice, phase)`` as another renderer has it."""
    scan = Scan(tuple(np.arange(phases) / phases), slices=6, step_mm=12.0, pixel_mm=3.0, depths=1)
    return render(2, scan).cine.intensity.T


def test_nan_about_cine_and_view_and_a_views_step_without_a_unit_are_told(tmp_path: Path) -> None:
    data = chest()
    x, y = np.indices(data.shape[:2]) - (np.array(data.shape[:2])[:, None, None] - 1) / 2
    outside = np.hypot(x, y) > 50
    darkest = data[~outside].min()
    cut = np.where(outside[:, :, None, None], np.nan, data)
    saved(tmp_path / "p" / "cine" / "cine.nii.gz", cut, 0.15, "sec")
    view = tmp_path / "p" / "long_axis" / "two_chamber.nii.gz"
    saved(view, cut[:, :, 2:3], 150, "unknown")
    folder, remarks = ingested(tmp_path / "p")
    expected = np.where(outside[:, :, None, None], darkest, data)
    np.testing.assert_array_equal(read_cine(folder).intensity.T, expected.astype(np.float32))
    (found,) = read_long_axis(folder)
    assert np.isfinite(found.cine.intensity).all()
    told = f"{outside.mean():.1%} of the pixels, at the edge of"
    assert any(one.startswith(f"the cine: {told} 6 of 6 slices") for one in remarks)
    of_view = [one for one in remarks if one.startswith("long-axis view two_chamber: ")]
    assert ["no unit" in one for one in of_view] == [True, False]
    assert told in of_view[1]


def test_exchanged_axes_are_named_with_their_file(tmp_path: Path) -> None:
    saved(tmp_path / "p" / "cine" / "cine.nii.gz", chest(8).swapaxes(2, 3), 0.15, "sec")
    with pytest.raises(InputError, match=r"cine\.nii\.gz: its axes of slices and phases look exch"):
        ingested(tmp_path / "p")


def test_spoilt_slices_are_counted_as_messages_do_without_blank_ends(tmp_path: Path) -> None:
    data = chest()
    padded = np.concatenate([np.zeros_like(data[:, :, :1]), data], axis=2)
    padded[:, :, 4] = padded[:, :, 2]
    saved(tmp_path / "p" / "cine" / "cine.nii.gz", padded, 0.15, "sec")
    words = r"slices 1 and 3 show the same images.*cine\.spoilt_slices: \[3\]"
    with pytest.raises(InputError, match=words) as refused:
        ingested(tmp_path / "p")
    assert "slice 1 of the files is slice 0 from here on" in refused.value.__notes__[0]
    (tmp_path / "out").rmdir()
    (tmp_path / "p" / "study.yaml").write_text("cine: {spoilt_slices: [3]}\n")
    folder = ingested(tmp_path / "p")[0]
    assert read_blank_ends(folder) == (1, 0)
    cine = read_cine(folder)
    assert cine.interpolated == (3,)
    mean = (data[:, :, 2] + data[:, :, 4]) / 2
    np.testing.assert_allclose(cine.intensity.T[:, :, 3], mean, rtol=1e-6)
