"""Files that others made, by mistake or to do harm, end in words: nothing hangs or grows."""

from __future__ import annotations

import gzip
import os
import shutil
import subprocess
import time
from pathlib import Path

import nibabel
import numpy as np
import pytest
from cine_files import dicom_frame, read_dicom_cine
from field_baked import bake_small
from sweep_files import good_fields, write

from pipeline.errors import InputError
from pipeline.field import ForceField, get_include
from pipeline.field.verify import verify_field
from pipeline.imaging.ecg import patient_mark, read_ecg
from pipeline.imaging.limits import require_bounded
from pipeline.imaging.nifti import read_nifti_cine
from pipeline.imaging.ultrasound import read_sweep
from pipeline.study import open_study
from pipeline.study_files import sweep_files
from pipeline.yaml_files import read_yaml


def a_study(root: Path) -> Path:
    folder = root / "patient"
    (folder / "cine").mkdir(parents=True)
    (folder / "cine" / "cine.nii.gz").write_bytes(b"")
    return folder


@pytest.mark.parametrize("name", ["study.yaml", "cine/timing.json", "cine/other.dcm", "us/a.mha"])
def test_a_pipe_in_a_study_is_refused_and_not_waited_for(tmp_path: Path, name: str) -> None:
    folder = a_study(tmp_path)
    (folder / name).parent.mkdir(exist_ok=True)
    os.mkfifo(folder / name)
    with pytest.raises(InputError, match=f"{name}: is a pipe, a socket or a device, a file is"):
        open_study(folder)


def test_a_link_to_a_device_that_study_yaml_names_is_refused(tmp_path: Path) -> None:
    folder = a_study(tmp_path)
    (folder / "endless").symlink_to("/dev/zero")
    (folder / "study.yaml").write_text("cine: {timing: endless}\n")
    with pytest.raises(InputError, match="endless: is a pipe, a socket or a device"):
        open_study(folder)


@pytest.mark.parametrize("name", ["manifest.json", "zarr.json"])
def test_a_pipe_in_a_field_is_refused(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match=f"{name}: is a pipe"):
        ForceField.open(tmp_path)
    with pytest.raises(InputError):
        verify_field(tmp_path)


def test_c_does_not_wait_for_a_pipe_either(tmp_path: Path) -> None:
    example = Path(__file__).parents[1] / "docs" / "examples" / "query.c"
    program, field = tmp_path / "query", tmp_path / "field.zarr"
    field.mkdir()
    os.mkfifo(field / "manifest.json")
    os.mkfifo(field / "zarr.json")
    subprocess.run(
        ["cc", "-I", str(get_include()), str(example), "-o", str(program), "-lm"], check=True
    )
    asked = [str(program), str(field), "1", "2", "3", "0"]
    ended = subprocess.run(asked, capture_output=True, text=True, timeout=20, check=False)
    assert ended.returncode != 0
    assert "cannot be read" in ended.stderr

    shutil.rmtree(field)
    bake_small(field)
    chunk = field / "spline" / "core" / "c" / "2" / "0" / "0" / "0"
    chunk.unlink()
    os.mkfifo(chunk)
    ended = subprocess.run(asked, capture_output=True, text=True, timeout=20, check=False)
    assert ended.returncode != 0
    assert "a size is wrong" in ended.stderr
    with pytest.raises(InputError, match=f"{chunk}: is a pipe"):
        verify_field(field)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("patient_id: 2024-13-01\n", "month must be in 1..12.*needs quotes"),
        (f"patient_id: {'9' * 5000}\n", "cannot be read as YAML.*needs quotes"),
        (f"cine: {'[' * 3000}{']' * 3000}\n", "nested too deeply"),
        ("cine: &a [*a]\n", "nested too deeply, or holds itself"),
    ],
    ids=["date", "number", "deep", "circle"],
)
def test_yaml_that_the_library_stumbles_over_is_refused(
    tmp_path: Path, text: str, said: str
) -> None:
    path = tmp_path / "study.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        read_yaml(path)


def test_aliases_that_grow_beyond_memory_are_refused_and_others_are_not(tmp_path: Path) -> None:
    path = tmp_path / "study.yaml"
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 9)]
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"aliases .* stand for 4.9e.08 keys and values"):
        read_yaml(path)
    path.write_text("a: &a [1, 2]\nb: *a\n")
    assert read_yaml(path) == {"a": [1, 2], "b": [1, 2]}


def test_a_timing_file_that_is_nested_too_deeply_is_refused(tmp_path: Path) -> None:
    path, timing = tmp_path / "cine.nii", tmp_path / "timing.json"
    nibabel.save(nibabel.Nifti1Image(np.ones((8, 8, 4, 5), np.int16), np.eye(4)), path)
    timing.write_text("[" * 100_000)
    with pytest.raises(InputError, match=r"timing\.json: cannot be read as JSON"):
        read_nifti_cine(path, timing)


@pytest.mark.parametrize("ending", ["nii", "nii.gz"])
def test_a_nifti_header_that_claims_more_than_memory_is_refused(
    tmp_path: Path, ending: str
) -> None:
    header = nibabel.Nifti1Header()
    header.set_data_dtype(np.int16)
    header.set_data_shape((32767, 32767, 100, 30))
    header["magic"], header["vox_offset"] = b"n+1", 352
    content = header.binaryblock + bytes(1000)
    path = tmp_path / f"cine.{ending}"
    path.write_bytes(gzip.compress(content) if ending == "nii.gz" else content)
    with pytest.raises(InputError, match=r"tells of 3.22e.12 values, which take 1.29e.04 GB"):
        read_nifti_cine(path, None, 900.0)


def test_a_nifti_image_of_more_pixels_than_any_scanner_makes_is_refused(tmp_path: Path) -> None:
    header = nibabel.Nifti1Header()
    header.set_data_dtype(np.uint8)
    header.set_data_shape((4097, 4096, 3, 2))
    header["magic"], header["vox_offset"] = b"n+1", 352
    path = tmp_path / "cine.nii"
    path.write_bytes(header.binaryblock + bytes(1000))
    with pytest.raises(InputError, match=r"cine\.nii: one image: its header tells of 1\.68e"):
        read_nifti_cine(path, None, 900.0)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [("Columns", 65535, "one image: its header"), ("NumberOfFrames", 2**31 - 1, "1.03e.11 values")],
)
def test_a_dicom_header_that_claims_more_than_memory_is_refused(
    tmp_path: Path, key: str, value: int, said: str
) -> None:
    image = dicom_frame(0, 0)
    image.Rows = 65535 if key == "Columns" else image.Rows
    setattr(image, key, value)
    image.save_as(tmp_path / "a.dcm", enforce_file_format=True)
    with pytest.raises(InputError, match=said):
        read_dicom_cine(tmp_path)


def test_a_sweep_that_claims_more_than_memory_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "sweep.mha", good_fields(), compress=True)
    path.write_bytes(path.read_bytes().replace(b"DimSize = 17 12 5", b"DimSize = 17000 12000 5000"))
    with pytest.raises(InputError, match=r"tells of 1.02e.12 values"):
        read_sweep(path)


@pytest.mark.parametrize("name", ["/etc/hostname", "../elsewhere.dat"])
def test_headers_do_not_have_files_of_other_folders_read(tmp_path: Path, name: str) -> None:
    folder = a_study(tmp_path)
    (tmp_path / "patient" / "elsewhere.dat").write_bytes(bytes(4000))
    (folder / "ecg").mkdir()
    header = folder / "ecg" / "mr.hea"
    header.write_text(f"mr 1 500 2000\n{name} 16 200/mV 16 0 0 0 0 II\n")
    for read in (open_study, lambda _: read_ecg(header)):
        with pytest.raises(InputError, match=f"mr.hea: names {name}, which is not beside it"):
            read(folder)
    header.unlink()
    (folder / "us").mkdir()
    (folder / "us" / "a.mhd").write_text(f"ObjectType = Image\nElementDataFile = {name}\n")
    (folder / "ecg" / "us.csv").write_text("time_s,II\n")
    with pytest.raises(InputError, match=f"a.mhd: names {name}, which is not beside it"):
        open_study(folder).input_digests()


def test_what_memory_holds_is_read() -> None:
    require_bounded(1 << 30, "a.nii")
    with pytest.raises(InputError, match=r"a\.nii: its header tells of 1\.07e\+09 values"):
        require_bounded((1 << 30) + 1, "a.nii")


def test_what_tells_patients_apart_does_not_tell_who_they_are() -> None:
    """Who tries all numbers of a hospital finds as many patients as would fit as not."""
    numbers = [f"{number:07d}" for number in range(40_000)]
    fitting = [one for one in numbers if patient_mark(one) == patient_mark("0012345")]
    assert len(fitting) > 3
    assert len(fitting) < 100


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("DimSize", "1.7e4 12000 5000", "tells no DimSize in whole numbers"),
        ("ElementType", "MET_LONG", r"tells of 1.02e.12 values"),
    ],
)
def test_a_sweep_whose_size_is_written_otherwise_is_measured_all_the_same(
    tmp_path: Path, key: str, value: str, said: str
) -> None:
    """The library reads powers of ten, and kinds of values of which no scanner has any."""
    path = write(tmp_path / "sweep.mha", good_fields())
    header, pixels = path.read_bytes().split(b"ElementDataFile", 1)
    lines = dict(line.split(" = ", 1) for line in header.decode().splitlines())
    lines |= {"DimSize": "17000 12000 5000", key: value}
    header = "".join(f"{name} = {text}\n" for name, text in lines.items()).encode()
    path.write_bytes(header + b"ElementDataFile" + pixels)
    with pytest.raises(InputError, match=said):
        read_sweep(path)


@pytest.mark.parametrize(
    "end",
    [
        "ElementDataFile = LIST 2D\na.raw\n../patient/other.raw\n",
        "\vElementDataFile = ../other.raw\n",
    ],
    ids=["list", "tab"],
)
def test_no_spelling_has_a_sweep_read_files_of_other_folders(tmp_path: Path, end: str) -> None:
    folder = a_study(tmp_path)
    for name in ("ecg", "us"):
        (folder / name).mkdir()
    (folder / "us" / "a.mhd").write_text(f"ObjectType = Image\n{end}")
    (folder / "us" / "a.raw").write_bytes(bytes(9))
    (folder / "ecg" / "us.csv").write_text("time_s,II\n")
    with pytest.raises(
        InputError, match=r"a\.mhd: names \.\./.*other\.raw, which is not beside it"
    ):
        open_study(folder).input_digests()


def test_a_header_of_blanks_takes_no_longer_than_it_is_long(tmp_path: Path) -> None:
    path = tmp_path / "a.mhd"
    path.write_bytes(b"\n" * 200_000 + b"ElementDataFile = a" + b" " * 200_000 + b"b\n")
    begun_s = time.process_time()
    assert sweep_files(path) == [path]
    assert time.process_time() - begun_s < 5
