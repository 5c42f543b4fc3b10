"""Files of which a value or two is none: in words, and no library ends the process."""

from __future__ import annotations

import gzip
import os
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import nibabel
import numpy as np
import pydicom
import pytest
from batch_program import make_study
from cine_files import ALL_FRAMES, dicom_frame, read_dicom_cine, write_dicom
from sweep_files import good_fields, write

from pipeline.batch_plan import plan_batch
from pipeline.ending import guarded
from pipeline.errors import InputError
from pipeline.imaging.ecg import read_ecg
from pipeline.imaging.nifti import read_nifti_cine
from pipeline.imaging.ultrasound import read_sweep
from pipeline.meshes import read_mesh, write_vtp
from pipeline.publish import write_whole
from pipeline.study import open_study
from pipeline.surface_folders import _timing
from pipeline.yaml_files import read_yaml

TETRAHEDRON = np.array([[0.0, 0, 0], [30, 0, 0], [0, 30, 0], [0, 0, 30]])
FACES = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)]
HEAD = """ply
format {} 1.0
element vertex 4
property float x
property float y
property float z
element face 4
property list uchar int vertex_indices
end_header
"""


def ply(form: str, faces: list[tuple[int, ...]], promised: int = 3) -> bytes:
    """A tetrahedron; ``promised`` is how many corners the first face says that it has."""
    counts = [promised, 3, 3, 3]
    rows = list(zip(counts, faces, strict=True))
    head = HEAD.format(form).encode()
    if form == "ascii":
        lines = [" ".join(map(str, one)) for one in TETRAHEDRON]
        lines += [" ".join(map(str, (count, *face))) for count, face in rows]
        return head + "\n".join(lines).encode() + b"\n"
    order = "<" if "little" in form else ">"
    body = TETRAHEDRON.astype(f"{order}f4").tobytes()
    for count, face in rows:
        body += struct.pack(f"{order}B3i", count % 256, *face)
    return head + body


FORMS = ["ascii", "binary_little_endian", "binary_big_endian"]


@pytest.mark.parametrize("form", FORMS)
def test_a_ply_file_of_any_kind_is_read(tmp_path: Path, form: str) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(ply(form, FACES))
    surface = read_mesh(path)
    np.testing.assert_allclose(surface.vertices_mm, TETRAHEDRON)
    np.testing.assert_array_equal(surface.triangles, FACES)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("faces", "promised", "words"),
    [
        ([(0, 99_999_999, 1), *FACES[1:]], 3, "face 0 has the corners .0, 99999999, 1., of 4"),
        ([(0, -3, 1), *FACES[1:]], 3, "face 0 has the corners"),
        (FACES, 2, "face 0 has the corners"),
        (FACES, 200, "cut off|face 0 has the corners"),
    ],
)
def test_a_ply_file_whose_faces_have_no_such_vertices_is_refused(
    tmp_path: Path, form: str, faces: list[tuple[int, ...]], promised: int, words: str
) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(ply(form, faces, promised))
    with pytest.raises(InputError, match=rf"a\.ply: .*({words})"):
        read_mesh(path)


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("NumberOfPoints", "99999999999"),
        ("NumberOfPolys", "99999999999"),
        ("NumberOfPolys", "-4"),
        ("NumberOfComponents", "999999999"),
    ],
)
def test_a_vtp_file_that_promises_more_than_it_can_hold_is_refused(
    tmp_path: Path, name: str, number: str
) -> None:
    path = tmp_path / "a.vtp"
    write_vtp(path, read_mesh(_written(tmp_path / "a.ply", ply("ascii", FACES))))
    read_mesh(path)
    path.write_text(re.sub(rf'{name}="\d+"', f'{name}="{number}"', path.read_text(), count=1))
    with pytest.raises(InputError, match=f"{name} is {number}, more than such a file can hold"):
        read_mesh(path)


def _written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("line", "changed", "words"),
    [
        (rb"NDims = 3", b"NDims = -1", "NDims is -1 and DimSize has 3 numbers"),
        (rb"NDims = 3", b"NDims = 99999999999", "NDims is 99999999999"),
        (rb"NDims = 3\n", b"", "NDims is missing"),
        (rb"ElementDataFile = LOCAL", b"ElementDataFile = a%s%n%n.raw 1 9 1", "names no files"),
        (rb"ElementDataFile = LOCAL", b"ElementDataFile = a%d%s.raw 1 9 1", "names no files"),
        (rb"ElementType = MET_UCHAR", b"ElementType = MET_STRING", "ElementType is MET_STRING"),
        (rb"DimSize = .*", b"DimSize = " + b"9" * 5000, "tells no DimSize in whole numbers"),
        (rb"Seq_Frame0001_ImageStatus", b"Seq_Frame0001_ImageStatus\xfe", "is no text"),
    ],
)
def test_a_sweeps_header_that_the_library_would_crash_on_is_refused(
    tmp_path: Path, line: bytes, changed: bytes, words: str
) -> None:
    path = write(tmp_path / "s.mha", good_fields())
    content, count = re.subn(line, changed.replace(b"\\", b"\\\\"), path.read_bytes(), count=1)
    assert count == 1
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"s\.mha: .*({words})"):
        read_sweep(path)


def one_image(folder: Path, change: Callable[[bytes], bytes]) -> Path:
    """A cine of which one file's bytes are changed."""
    write_dicom(folder)
    path = sorted(folder.iterdir())[0]
    path.write_bytes(change(path.read_bytes()))
    return path


@pytest.mark.parametrize(
    ("found", "changed"),
    [
        (b"\x28\x00\x10\x00US", b"\x28\x00\x10\x00QS"),
        (b"\x20\x00\x32\x00DS", b"\x20\x00\x32\x00QQ"),
        (b"\x18\x00\x60\x10DS", b"\x18\x00\x60\x10SQ"),
        (b"\x28\x00\x10\x00US\x02\x00", b"\x28\x00\x10\x00US\x00\x00"),
    ],
)
def test_a_byte_of_a_dicom_header_that_is_none_is_told_with_the_file(
    tmp_path: Path, found: bytes, changed: bytes
) -> None:
    def swapped(content: bytes) -> bytes:
        assert content.count(found) == 1
        return content.replace(found, changed)

    path = one_image(tmp_path, swapped)
    with pytest.raises(InputError, match=re.escape(str(path))):
        read_dicom_cine(tmp_path)


@pytest.mark.parametrize("seed", range(3))
def test_damaged_dicom_is_told_or_read_and_ends_in_nothing_else(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    write_dicom(tmp_path)
    path = sorted(tmp_path.iterdir())[seed]
    whole = path.read_bytes()
    said = []
    for _ in range(60):
        damaged = bytearray(whole)
        for place in rng.integers(132, len(whole), 2):
            damaged[place] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            read_dicom_cine(tmp_path)
        except InputError as error:
            said.append(str(error))
    assert len(said) > 10
    assert all(str(tmp_path) in one for one in said)


def test_dicom_that_is_deflated_as_a_whole_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    write_dicom(tmp_path)
    path = sorted(tmp_path.iterdir())[0]
    data = pydicom.dcmread(path)
    data.file_meta.TransferSyntaxUID = pydicom.uid.DeflatedExplicitVRLittleEndian
    data.save_as(path)
    with pytest.raises(InputError, match="is deflated as a whole"):
        read_dicom_cine(tmp_path)


def test_a_damaged_run_length_image_is_not_taken_for_a_black_one(tmp_path: Path) -> None:
    """Of sixteen bits there must be two segments; another library made zeros of one."""
    write_dicom(tmp_path)
    path = sorted(tmp_path.iterdir())[0]
    data = pydicom.dcmread(path)
    data.compress(pydicom.uid.RLELossless)
    data.save_as(path)
    assert read_dicom_cine(tmp_path).cine.intensity.max() > 0
    frame = next(pydicom.encaps.generate_frames(data.PixelData, number_of_frames=1))
    data.PixelData = pydicom.encaps.encapsulate([b"\x01\0\0\0" + frame[4:]])
    data.save_as(path)
    with pytest.raises(InputError, match="its pixels cannot be read"):
        read_dicom_cine(tmp_path)


def test_an_image_that_lies_beyond_every_bore_is_refused(tmp_path: Path) -> None:
    write_dicom(tmp_path)
    path = sorted(tmp_path.iterdir())[0]
    data = dicom_frame(*ALL_FRAMES[0])
    data.ImagePositionPatient = ["1e300", "0", "0"]
    data.save_as(path, enforce_file_format=True)
    with pytest.raises(InputError, match=r"position \[1e\+300"):
        read_dicom_cine(tmp_path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda header: header.__setitem__("vox_offset", np.inf), "cannot be read as NIfTI"),
        (lambda header: header.__setitem__("xyzt_units", 7), "has no trigger times"),
        (lambda header: header.__setitem__("srow_x", [1, 0, 0, 1e30]), "no number of millimetres"),
    ],
)
def test_a_nifti_header_of_nonsense_is_told(
    tmp_path: Path, change: Callable[[nibabel.Nifti1Header], None], words: str
) -> None:
    path = tmp_path / "cine.nii"
    image = nibabel.Nifti1Image(np.ones((8, 8, 4, 5), np.float32), np.eye(4))
    image.header["pixdim"][4] = 40.0
    image.header.set_xyzt_units("mm", "msec")
    nibabel.save(image, path)
    header = nibabel.load(path).header
    change(header)
    content = path.read_bytes()
    path.write_bytes(header.binaryblock + content[len(header.binaryblock) :])
    with pytest.raises(InputError, match=words):
        read_nifti_cine(path, None, None)


@pytest.mark.parametrize("damage", ["a voxel", "the checksum", "the end"])
def test_a_packed_cine_that_is_not_what_its_checksum_says_is_refused(
    tmp_path: Path, damage: str
) -> None:
    """Not packed at all inside, so that a bit is a voxel's, and nothing else tells of it."""
    path = tmp_path / "cine.nii.gz"
    voxels = np.random.default_rng(5).integers(0, 999, (64, 64, 4, 3)).astype(np.int16)
    image = nibabel.Nifti1Image(voxels, np.diag([1.5, 1.5, 8, 1]))
    whole = gzip.compress(image.to_bytes(), compresslevel=0)
    path.write_bytes(whole)
    assert read_nifti_cine(path, None, 800).cine.intensity.shape == (3, 4, 64, 64)
    flipped = bytearray(whole)
    flipped[{"a voxel": len(whole) // 2, "the checksum": -6, "the end": -1}[damage]] ^= 4
    path.write_bytes(flipped if damage != "the end" else whole[:-8])
    with pytest.raises(InputError, match="truncated or damaged"):
        read_nifti_cine(path, None, 800)


@pytest.mark.parametrize(
    "behind", [bytes(512), b"\n", gzip.compress(b"", mtime=0)], ids=["zeros", "a line", "a part"]
)
def test_what_comes_behind_a_packed_cine_is_nobodys(tmp_path: Path, behind: bytes) -> None:
    path = tmp_path / "cine.nii.gz"
    voxels = np.random.default_rng(5).integers(0, 999, (64, 64, 4, 3)).astype(np.int16)
    content = nibabel.Nifti1Image(voxels, np.diag([1.5, 1.5, 8, 1])).to_bytes()
    whole = gzip.compress(content[:5000]) + gzip.compress(content[5000:])
    path.write_bytes(whole + behind)
    assert read_nifti_cine(path, None, 800).cine.intensity.shape == (3, 4, 64, 64)
    flipped = bytearray(whole)
    flipped[-6] ^= 4
    path.write_bytes(bytes(flipped) + behind)
    with pytest.raises(InputError, match="truncated or damaged"):
        read_nifti_cine(path, None, 800)


def test_an_ecg_that_promises_more_than_it_describes_is_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "us.hea").write_text("us 99999999 500 3400\nus.dat 16 200 16 0 0 0 0 II\n")
    (tmp_path / "us.dat").write_bytes(bytes(6800))
    with pytest.raises(InputError, match="promises 99999999 signals, and has 1 lines"):
        read_ecg(tmp_path / "us")
    names = ",".join(f"lead{k}" for k in range(10_000))
    (tmp_path / "a.csv").write_text(f"time_s,{names}\n")
    with pytest.raises(InputError, match="has 10001 columns, at most 256"):
        read_ecg(tmp_path / "a.csv")


def test_a_timing_that_gives_a_key_twice_is_told(tmp_path: Path) -> None:
    path = tmp_path / "cine.nii"
    nibabel.save(nibabel.Nifti1Image(np.ones((8, 8, 4, 5), np.float32), np.eye(4)), path)
    times = '"trigger_times_ms": [0, 160, 320, 480, 640]'
    (tmp_path / "timing.json").write_text(f'{{{times}, "rr_ms": 800, "rr_ms": 900}}')
    with pytest.raises(InputError, match="rr_ms is given a second time; keep one of them"):
        read_nifti_cine(path, tmp_path / "timing.json", None)


@pytest.mark.parametrize("text", ["!!bool maybe", "!!int ''", "!!float ''", "!!timestamp foo"])
def test_a_tag_that_does_not_fit_is_told(tmp_path: Path, text: str) -> None:
    path = tmp_path / "study.yaml"
    path.write_text(f"patient_id: {text}\n")
    with pytest.raises(InputError, match=r"study\.yaml: cannot be read as YAML"):
        read_yaml(path)


def test_a_description_that_is_a_dead_link_is_not_passed_over(tmp_path: Path) -> None:
    make_study(tmp_path / "p")
    (tmp_path / "p" / "study.yaml").unlink(missing_ok=True)
    (tmp_path / "p" / "study.yaml").symlink_to("nowhere")
    with pytest.raises(InputError, match=r"study\.yaml: is a link to nowhere, where nothing is"):
        open_study(tmp_path / "p")


def test_a_folder_that_is_none_costs_itself_alone(tmp_path: Path) -> None:
    studies = tmp_path / "studies"
    make_study(studies / "good")
    make_study(studies / "odd")
    (studies / "odd" / "study.yaml").write_text("patient_id: !!bool maybe\n")
    (studies / "circle").symlink_to("about")
    (studies / "about").symlink_to("circle")
    plans = {one.name: one for one in plan_batch(studies, tmp_path / "out")}
    assert plans["good"].patient_id == "good"
    assert not plans["good"].refused
    assert "is a link to" in str(plans["circle"].refused)


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (PermissionError(13, "Permission denied", "a/b"), "a/b: cannot be reached (Permission"),
        (OSError(36, "File name too long", b"n" * 9), "nnnnnnnnn: cannot be reached (File name"),
        (RuntimeError("Symlink loop from 'a'"), "links lead in a circle (Symlink loop from 'a')"),
    ],
)
def test_a_place_that_cannot_be_reached_is_told(
    capsys: pytest.CaptureFixture[str], error: Exception, words: str
) -> None:
    def fail() -> None:
        raise error

    assert guarded(fail) == 2
    assert f"error: {words}" in capsys.readouterr().err


def test_what_is_no_file_is_written_to_and_a_link_stays_one(tmp_path: Path) -> None:
    """As `--out /dev/stdout`: as root the device itself was replaced by a file."""
    (tmp_path / "link").symlink_to(tmp_path / "table")
    write_whole(tmp_path / "link", "one\n")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "table").read_text() == "one\n"
    os.mkfifo(tmp_path / "pipe")
    reading = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    write_whole(tmp_path / "pipe", "two\n")
    assert os.read(reading, 100) == b"two\n"
    os.close(reading)
    assert (tmp_path / "pipe").is_fifo()


def test_a_pipe_beside_own_surfaces_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "phases.json")
    with pytest.raises(InputError, match=r"phases\.json: is a pipe"):
        _timing(tmp_path / "phases.json", 1)


def test_packed_pixels_beyond_what_the_header_says_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "s.mha", good_fields(), compress=True)
    head, pixels = path.read_bytes().split(b"ElementDataFile = LOCAL\n")
    longer = zlib.compress(zlib.decompress(pixels) + b"0")
    head = re.sub(rb"(CompressedDataSize = )\d+", rb"\g<1>%d" % len(longer), head)
    path.write_bytes(head + b"ElementDataFile = LOCAL\n" + longer)
    with pytest.raises(InputError, match=r"are more than the .* bytes that its header says"):
        read_sweep(path)
