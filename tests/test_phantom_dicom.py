"""The phantom's DICOM files, judged by the standard's tables and by other people's readers."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
from dicom_standard import CLASSIC_MODULES, ENHANCED_MODULES, FUNCTIONAL_GROUPS
from scipy.spatial.transform import Rotation

from data_synth.dicom import write_dicom
from data_synth.dicom_header import unique_identifier
from data_synth.errors import SynthError
from data_synth.mr import SyntheticCine
from data_synth.protocol import MrSettings
from data_synth.sampling import LONGEST_WINDOW
from pipeline.geometry import transform_points
from pipeline.imaging.dicom import read_dicom_study

PHASES, ROWS, COLUMNS = 4, 20, 24
RR_MS = (803.0, 817.0, 790.0, 811.0, 799.0)
PIXEL_MM, THICKNESS_MM, STEP_MM = 1.4, 8.0, 10.0
CLASSIC, ENHANCED = "1.2.840.10008.5.1.4.1.1.4", "1.2.840.10008.5.1.4.1.1.4.1"
VIEWS = ("two_chamber", "three_chamber", "four_chamber")
KINDS = ("classic", "enhanced", "classic volume", "enhanced volume")


def oblique(angles: tuple[float, float, float], step_mm: float) -> Any:
    mr_from_index = np.eye(4)
    axes = Rotation.from_euler("xyz", angles).as_matrix()
    mr_from_index[:3, :3] = axes * (PIXEL_MM, PIXEL_MM, step_mm)
    mr_from_index[:3, 3] = (-50.3, 20.7, 113.123456)
    return mr_from_index


def cine(seed: int, rr_ms: tuple[float, ...], mr_from_index: Any) -> SyntheticCine:
    """Images of which no two are alike."""
    shape = (PHASES, len(rr_ms), ROWS, COLUMNS)
    rng = np.random.default_rng(seed)
    return SyntheticCine(
        intensity=rng.integers(0, 900, shape).astype(np.int16),
        labels=np.zeros(shape, np.uint8),
        mr_from_index=mr_from_index,
        rr_ms=np.array(rr_ms),
        shifts_mm=np.zeros((len(rr_ms), 3)),
        slice_thickness_mm=THICKNESS_MM,
        field_strength_t=3.0,
    )


@dataclass(frozen=True)
class Written:
    """One examination on disk, with what went into it."""

    folder: Path
    stack: SyntheticCine
    views: dict[str, SyntheticCine]

    def paths(self) -> list[Path]:
        return sorted(self.folder.rglob("*.dcm"))

    def objects(self) -> list[Any]:
        return [pydicom.dcmread(path) for path in self.paths()]


def write(folder: Path, kind: str) -> Written:
    volume = kind.endswith("volume")
    settings = MrSettings(phases=PHASES, matrix=32, acquisition="volume" if volume else "stack")
    angles = (0.3, 0.5, 0.7)
    stack = cine(1, RR_MS, oblique(angles, STEP_MM))
    if volume:
        stack = cine(1, RR_MS[:1] * 5, oblique(angles, PIXEL_MM))
    views = {
        name: cine(2 + k, (808.0 + k,), oblique((0.3 + 1.5, 0.5 + k, 0.7), THICKNESS_MM))
        for k, name in enumerate(VIEWS)
    }
    write_dicom(folder, "p-1", "key", stack, settings, views, kind.startswith("enhanced"))
    return Written(folder, stack, views)


@pytest.fixture(scope="module", params=KINDS)
def written(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Written:
    return write(tmp_path_factory.mktemp("cine"), request.param)


@pytest.fixture(scope="module")
def enhanced(tmp_path_factory: pytest.TempPathFactory) -> Written:
    return write(tmp_path_factory.mktemp("enhanced"), "enhanced")


@pytest.fixture(scope="module")
def classic(tmp_path_factory: pytest.TempPathFactory) -> Written:
    return write(tmp_path_factory.mktemp("classic"), "classic")


needs_validator = pytest.mark.skipif(
    shutil.which("dciodvfy") is None,
    reason="dciodvfy is not on the PATH; the package dicom3tools, Python's or Debian's, has it",
)


@needs_validator
def test_an_independent_validator_finds_neither_error_nor_warning(written: Written) -> None:
    for path in written.paths():
        said = validator_says(path)
        assert "MRImage" in said, "the validator did not recognise the object"
        assert "Error" not in said, said
        assert "Warning" not in said, said


@needs_validator
@pytest.mark.parametrize("spoilt", ["PatientID", "PixelSpacing", "EchoTime", "TriggerTime"])
def test_the_validator_does_find_an_attribute_that_is_taken_away(
    classic: Written, tmp_path: Path, spoilt: str
) -> None:
    data = pydicom.dcmread(classic.paths()[0])
    del data[spoilt]
    data.save_as(tmp_path / "spoilt.dcm")
    assert f"Error - </{spoilt}(" in validator_says(tmp_path / "spoilt.dcm")


def validator_says(path: Path) -> str:
    command = ["dciodvfy", "-new", str(path)]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    return found.stdout + found.stderr


@pytest.mark.skipif(
    shutil.which("dcentvfy") is None,
    reason="dcentvfy is not on the PATH; the package dicom3tools, Python's or Debian's, has it",
)
def test_the_objects_of_a_study_agree_about_what_they_share(written: Written) -> None:
    command = ["dcentvfy", *map(str, written.paths())]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.stdout + found.stderr == ""


def test_every_attribute_that_the_standard_requires_is_there(written: Written) -> None:
    for data in written.objects():
        modules = CLASSIC_MODULES if data.SOPClassUID == CLASSIC else ENHANCED_MODULES
        for module, (filled, present) in modules.items():
            for keyword in filled.split():
                assert data.get(keyword) not in (None, ""), (module, keyword)
            for keyword in present.split():
                assert keyword in data, (module, keyword)


def test_every_frame_has_every_functional_group_once(enhanced: Written) -> None:
    for data in enhanced.objects():
        shared = data.SharedFunctionalGroupsSequence[0]
        for own in data.PerFrameFunctionalGroupsSequence:
            for name, keywords in FUNCTIONAL_GROUPS.items():
                homes = [item for item in (shared, own) if name in item]
                assert len(homes) == 1, (name, "must be shared or per frame, not both")
                group = homes[0][name].value
                assert len(group) == 1
                for keyword in keywords.split():
                    assert group[0].get(keyword) not in (None, ""), (name, keyword)
        # C.7.6.16.2.2: frame content tells frames apart and may not be shared.
        assert "FrameContentSequence" not in shared


def test_dimension_indices_point_at_what_they_name(enhanced: Written) -> None:
    for data in enhanced.objects():
        organization = data.DimensionOrganizationSequence[0].DimensionOrganizationUID
        values = []
        for own in data.PerFrameFunctionalGroupsSequence:
            found = []
            for dimension in data.DimensionIndexSequence:
                assert dimension.DimensionOrganizationUID == organization
                group = own[dimension.FunctionalGroupPointer].value[0]
                found.append(int(group[dimension.DimensionIndexPointer].value))
            content = own.FrameContentSequence[0]
            assert list(content.DimensionIndexValues) == found
            values.append(tuple(found))
        assert len(set(values)) == int(data.NumberOfFrames), "each frame has a place of its own"
        assert min(min(value) for value in values) == 1


def test_identifiers_are_valid_unique_and_shared_where_they_must_be(written: Written) -> None:
    objects = written.objects()
    for data in objects:
        for name in ("SOPInstanceUID", "SeriesInstanceUID", "StudyInstanceUID"):
            assert data[name].value.is_valid
        assert data.file_meta.MediaStorageSOPInstanceUID == data.SOPInstanceUID
    assert len({data.SOPInstanceUID for data in objects}) == len(objects)
    assert len({data.StudyInstanceUID for data in objects}) == 1
    assert len({data.FrameOfReferenceUID for data in objects}) == 1
    by_series = {(data.SeriesInstanceUID, int(data.SeriesNumber)) for data in objects}
    numbers = sorted(number for _, number in by_series)
    assert numbers == list(range(1, len(numbers) + 1)), "one UID a series number"


def test_series_are_those_of_an_examination(classic: Written, enhanced: Written) -> None:
    titles = {int(data.SeriesNumber): data.SeriesDescription for data in classic.objects()}
    assert titles[1] == "cine short axis, slice 1"
    assert [titles[6 + k] for k in range(3)] == [
        "cine long axis, two chamber",
        "cine long axis, three chamber",
        "cine long axis, four chamber",
    ]
    assert len(classic.objects()) == (5 + 3) * PHASES
    assert [int(data.NumberOfFrames) for data in enhanced.objects()] == [5 * PHASES, *[PHASES] * 3]


def frames(written: Written) -> Iterator[tuple[SyntheticCine, int, int, Any, Any, Any]]:
    """Every classic or Enhanced frame: its cine, slice, phase, pixels, place, timing."""
    for data in written.objects():
        name = data.SeriesDescription.removeprefix("cine long axis, ").replace(" ", "_")
        source = written.views.get(name, written.stack)
        if data.SOPClassUID == CLASSIC:
            own_z = int(data.SeriesNumber) - 1 if "slice" in data.SeriesDescription else 0
            z, k = divmod(int(data.InstanceNumber) - 1, PHASES)
            yield source, own_z + z, k, data.pixel_array, data, data
            continue
        for number, own in enumerate(data.PerFrameFunctionalGroupsSequence):
            content = own.FrameContentSequence[0]
            z, k = content.InStackPositionNumber - 1, content.TemporalPositionIndex - 1
            timing = own.CardiacSynchronizationSequence[0]
            place = own.PlanePositionSequence[0]
            yield source, z, k, data.pixel_array[number], place, timing


def test_pixels_place_and_time_of_every_frame_are_the_phantoms(written: Written) -> None:
    seen = 0
    for source, z, k, pixels, place, timing in frames(written):
        np.testing.assert_array_equal(pixels, source.intensity[k, z])
        corner_mm = transform_points(source.mr_from_index, np.array([0.0, 0.0, z]))
        # Decimal strings hold 12 digits of at most 1000 mm.
        np.testing.assert_allclose(
            np.array(place.ImagePositionPatient, float), corner_mm, atol=1e-8
        )
        trigger_ms = timing.get("TriggerTime", timing.get("NominalCardiacTriggerDelayTime"))
        rr_ms = timing.get("NominalInterval", timing.get("RRIntervalTimeNominal"))
        assert float(trigger_ms) == pytest.approx(source.rr_ms[z] * k / PHASES, abs=1e-8)
        assert float(rr_ms) == source.rr_ms[z]
        seen += 1
    assert seen == (5 + 3) * PHASES


def test_a_frame_lasts_as_long_as_it_was_acquired(enhanced: Written) -> None:
    """One of few phases is kept of many: it is none of a third of a heartbeat."""
    assert PHASES < 1 / LONGEST_WINDOW
    for data in enhanced.objects():
        for frame in data.PerFrameFunctionalGroupsSequence:
            content, gating = frame.FrameContentSequence[0], frame.CardiacSynchronizationSequence[0]
            lasted_ms = LONGEST_WINDOW * gating.RRIntervalTimeNominal
            assert content.FrameAcquisitionDuration == pytest.approx(lasted_ms)


def test_an_itk_reader_sees_a_classic_slice_where_it_is(classic: Written) -> None:
    import SimpleITK

    reader = SimpleITK.ImageSeriesReader()
    for z in range(5):
        (series,) = reader.GetGDCMSeriesIDs(str(classic.folder / f"{z + 1:03d}"))
        names = reader.GetGDCMSeriesFileNames(str(classic.folder / f"{z + 1:03d}"), series)
        assert len(names) == PHASES
        for k, name in enumerate(sorted(names)):
            assert_same_place(SimpleITK.ReadImage(name), classic.stack, z)
            found = SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(name))[0]
            np.testing.assert_array_equal(found, classic.stack.intensity[k, z])


def test_an_itk_reader_sees_an_enhanced_object_where_it_is(enhanced: Written) -> None:
    import SimpleITK

    image = SimpleITK.ReadImage(str(enhanced.paths()[0]))
    found = SimpleITK.GetArrayFromImage(image)
    expected = enhanced.stack.intensity.swapaxes(0, 1).reshape(-1, ROWS, COLUMNS)
    np.testing.assert_array_equal(found, expected)
    assert_same_place(image, enhanced.stack, 0)


def assert_same_place(image: Any, source: SyntheticCine, z: int) -> None:
    """The centre of pixel (column 3, row 2) of the image's first slice lies where it should."""
    expected_mm = transform_points(source.mr_from_index, np.array([3.0, 2.0, z]))
    found_mm = image.TransformIndexToPhysicalPoint((3, 2, 0))
    # Directions are written with 12 digits, and GDCM keeps them in double precision.
    np.testing.assert_allclose(found_mm, expected_mm, atol=1e-6)


def test_the_pipeline_reads_the_stack_and_names_each_view_on_a_line(written: Written) -> None:
    stack, _ = read_dicom_study(written.folder)
    np.testing.assert_array_equal(stack.cine.intensity, written.stack.intensity)
    # Slices are told apart along the images' normal, written with 12 digits.
    np.testing.assert_allclose(stack.cine.mr_from_index, written.stack.mr_from_index, atol=1e-8)
    np.testing.assert_allclose(stack.cine.phases, np.arange(PHASES) / PHASES, atol=1e-9)
    np.testing.assert_allclose(stack.rr_ms, written.stack.rr_ms)
    assert len(stack.left_out) == len(VIEWS)
    for view, line in zip(VIEWS, stack.left_out, strict=True):
        assert f'"cine long axis, {view.replace("_", " ")}": {PHASES} images' in line
        assert "not parallel to the stack" in line


def test_the_same_study_is_the_same_bytes(tmp_path: Path) -> None:
    for kind in ("classic", "enhanced"):
        first, second = (write(tmp_path / f"{kind}{n}", kind) for n in range(2))
        for one, other in zip(first.paths(), second.paths(), strict=True):
            assert one.read_bytes() == other.read_bytes()


def test_a_cine_without_views_has_only_its_stack(tmp_path: Path) -> None:
    settings = MrSettings(phases=PHASES, matrix=32)
    stack = cine(1, RR_MS, oblique((0.1, 0.2, 0.3), STEP_MM))
    write_dicom(tmp_path, "p-1", "key", stack, settings)
    assert len(list(tmp_path.rglob("*.dcm"))) == len(RR_MS) * PHASES


def test_a_name_that_does_not_fit_in_a_header_is_refused(tmp_path: Path) -> None:
    stack = cine(1, RR_MS, oblique((0.1, 0.2, 0.3), STEP_MM))
    with pytest.raises(SynthError, match="patient_id"):
        write_dicom(tmp_path, "p" * 57, "key", stack, MrSettings())


def test_identifiers_depend_on_every_part() -> None:
    uids = {unique_identifier(*parts) for parts in ((), ("a",), ("a", 1), ("a", 2), ("b", 1))}
    assert len(uids) == 5
    assert all(pydicom.uid.UID(uid).is_valid and len(uid) <= 64 for uid in uids)
