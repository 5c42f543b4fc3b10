"""The store on disk: the format's promises, and that no damage goes unseen."""

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from field_baked import FIXTURES, PHASES, RADII_MM, RR_S, bake_small, edit, seal
from field_random import EVEN, ORIGIN_MM, SPACING_MM, write_random
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import InputError
from pipeline.field import ForceField
from pipeline.field.files import read_metadata
from pipeline.field.manifest import canonical_manifest
from pipeline.field.potential import offence, potential
from pipeline.field.query import query_point
from pipeline.field.verify import verify_field


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("store") / "field.zarr"
    bake_small(folder)
    return folder


@pytest.fixture
def copy(path, tmp_path):
    return Path(shutil.copytree(path, tmp_path / "field.zarr"))


def files_of(path: Path) -> list[Path]:
    return sorted(one for one in path.rglob("*") if one.is_file())


def test_zarr_python_reads_it(path):
    import zarr

    group = zarr.open_group(path, mode="r", zarr_format=3)
    ball = group["distance/ball"]

    assert ball.shape == (len(PHASES), *ForceField.open(path).grid.shape)
    assert ball.dtype == np.float32
    assert ball.chunks == (1, *ball.shape[1:])
    assert ball.compressors == ()
    centre = tuple(count // 2 for count in ball.shape[1:])
    # Deepest in the middle, as deep as the radius, but for the way to the nearest node and the
    # facets.
    for k, radius in enumerate(RADII_MM):
        assert float(ball[(k, *centre)]) == pytest.approx(-radius, abs=3 * 3**0.5 / 2 + 0.2)
    assert set(group["potential"].array_keys()) == set(FIXTURES)


def test_description_follows_ome_ngff(path):
    attributes = json.loads((path / "zarr.json").read_text())["attributes"]
    grid = attributes["beatfield"]["grid"]

    assert attributes["ome"]["version"] == "0.5"
    for scale in attributes["ome"]["multiscales"]:
        array = json.loads((path / scale["datasets"][0]["path"] / "zarr.json").read_text())
        assert array["dimension_names"] == [axis["name"] for axis in scale["axes"]]
        steps, start = scale["datasets"][0]["coordinateTransformations"]
        assert steps["scale"] == [RR_S / len(PHASES), *grid["spacing_mm"][::-1]]
        assert start["translation"] == [RR_S * PHASES[0], *grid["origin_mm"][::-1]]
        assert [axis["type"] for axis in scale["axes"]] == ["time", "space", "space", "space"]


def test_description_is_that_of_the_format(path):
    described = json.loads((path / "zarr.json").read_text())["attributes"]["beatfield"]

    assert described["format_version"] == 1
    assert (described["frame"], described["unit"], described["periodic"]) == ("LPS", "mm", True)
    assert described["fixtures"]["stay_in"]["side"] == "outside"
    keys = {"structure", "kind", "side", "gamma_mm", "delta_mm", "m", "f_max_n", "device"}
    assert all(keys <= set(fixture) for fixture in described["fixtures"].values())
    volumes = described["structures"]["ball"]["volume_ml"]
    # Inscribed, so smaller; 642 corners leave out under two percent.
    assert np.allclose(volumes, 4 / 3 * np.pi * RADII_MM**3 / 1000, rtol=0.02)


def test_manifest_lists_every_file(path):
    listed = json.loads((path / "manifest.json").read_text())["files"]

    found = {one.relative_to(path).as_posix() for one in files_of(path)}
    assert set(listed) == found - {"manifest.json"}
    assert all(one["size"] == (path / name).stat().st_size for name, one in listed.items())


def test_same_input_same_bytes(path, tmp_path):
    again = tmp_path / "again.zarr"

    bake_small(again)

    names = [one.relative_to(path) for one in files_of(path)]
    assert names == [one.relative_to(again) for one in files_of(again)]
    assert all((path / name).read_bytes() == (again / name).read_bytes() for name in names)


def test_a_whole_field_is_verified(path):
    report = verify_field(path)

    assert report.files == len(files_of(path)) - 1
    assert report.phases == len(PHASES)
    assert "whole" in str(report)


def require_found(path, file, content):
    """A file with other content is found, and is as it was afterwards."""
    whole = file.read_bytes()
    try:
        file.write_bytes(content)
        with pytest.raises(InputError, match="damaged"):
            verify_field(path)
    finally:
        file.write_bytes(whole)


def test_one_changed_bit_anywhere_is_found(path):
    """Any bit of any byte of any file, the manifest's own included."""

    @settings(max_examples=120)
    @given(st.data())
    def changed(data):
        file = data.draw(st.sampled_from(files_of(path)))
        content = bytearray(file.read_bytes())
        place = data.draw(st.integers(0, len(content) - 1))
        content[place] ^= 1 << data.draw(st.integers(0, 7))
        require_found(path, file, content)

    verify_field(path)
    changed()
    # Every file is as it was, so each change was what was found.
    verify_field(path)


@settings(max_examples=100)
@given(st.integers(0, 10**6), st.integers(0, 255))
def test_one_changed_byte_of_the_manifest_is_found(path, place, value):
    file = path / "manifest.json"
    content = bytearray(file.read_bytes())
    if content[place % len(content)] == value:
        return
    content[place % len(content)] = value
    require_found(path, file, content)


@pytest.mark.parametrize("name", ["zarr.json", "distance/ball/c/1/0/0/0", "potential/zarr.json"])
def test_missing_and_cut_files_are_found(copy, name):
    (copy / name).write_bytes((copy / name).read_bytes()[:-1])
    with pytest.raises(InputError, match=rf"{name}: \d+ bytes, the manifest says"):
        verify_field(copy)
    (copy / name).unlink()
    with pytest.raises(InputError, match=f"{name}: is missing"):
        verify_field(copy)


def test_added_files_are_found(copy):
    (copy / "distance" / "more").write_text("x")
    (copy / "link").symlink_to("/nowhere")
    (copy / "way").symlink_to(copy.parent)

    with pytest.raises(InputError, match="distance/more: is not in the manifest") as refusal:
        verify_field(copy)
    assert "link: is not in the manifest" in str(refusal.value)
    assert "way: is not in the manifest" in str(refusal.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda b: b.update(frame="RAS"), r"beatfield\.frame"),
        (lambda b: b.update(phases=[0.5, 0.1]), "phases must rise"),
        (lambda b: b.update(phases=[0.1, 0.2, 0.45, 0.5, 1.0]), "phases must rise"),
        (lambda b: b.update(phases=[0.0, 0.0004]), "shares of a cycle, not seconds"),
        (lambda b: b.update(surprise=1), r"beatfield\.surprise: Extra inputs.* another version"),
        (lambda b: b.pop("source"), r"beatfield\.source: Field required.* another version"),
        (lambda b: b.update(format_version=2), r"format_version: .* another version of beatfield"),
        (lambda b: b["grid"].update(shape_zyx=[3, 3, 3]), r"shape is .* needed \[5, 3, 3, 3\]"),
        (
            lambda b: b["fixtures"]["guide"].update(delta_mm=9.0),
            "guide: phase 0 is not the formula",
        ),
        (lambda b: b["fixtures"]["guide"].update(structure="x"), "no structure 'x'"),
        (
            lambda b: b["structures"]["ball"].update(volume_ml=[math.nan] * 5),
            r"structures\.ball\.volume_ml\.0",
        ),
        (lambda b: b["structures"]["ball"]["volume_ml"].pop(), "one a phase, not 5 and 4"),
        (
            lambda b: b["structures"]["core"].update(spline="spline/ball"),
            "core: spline 'spline/ball' is not its own",
        ),
        (lambda b: b["grid"].update(origin_mm=[9.0, 0.0, 0.0]), "ome and beatfield disagree"),
        (lambda b: b["grid"].update(spacing_mm=[2.7] * 3), "ome and beatfield disagree"),
        (lambda b: b.update(rr_s=800.0), "ome and beatfield disagree"),
    ],
)
def test_sealed_but_wrong_descriptions_are_found(copy, change, words):
    edit(copy, change)
    with pytest.raises(InputError, match=words):
        verify_field(copy)


def test_a_device_of_ones_own_is_kept_with_its_limits(copy):
    law = ForceField.open(copy).fixtures["guide"]
    most = {"force_n": law.f_max_n, "stiffness_n_per_m": law.stiffness_n_per_m}
    edit(copy, lambda b: b["fixtures"]["guide"].update(device="virtuose", device_limits=most))
    assert verify_field(copy)
    found = ForceField.open(copy).fixtures["guide"].device
    assert (found.name, found.force_n) == ("virtuose", law.f_max_n)

    less = most | {"stiffness_n_per_m": 0.9 * law.stiffness_n_per_m}
    edit(copy, lambda b: b["fixtures"]["guide"].update(device_limits=less))
    with pytest.raises(InputError, match=r"guide: .*stiffer than the virtuose can render"):
        ForceField.open(copy)


def test_a_store_may_name_a_known_device_alone(copy):
    """As stores did before limits stood in them; of others they must."""
    known = ForceField.open(copy).fixtures
    edit(copy, lambda b: [one.pop("device_limits") for one in b["fixtures"].values()])
    assert ForceField.open(copy).fixtures == known

    edit(copy, lambda b: b["fixtures"]["guide"].update(device="virtuose"))
    with pytest.raises(InputError, match=r"guide\.device_limits: Field required"):
        ForceField.open(copy)


@pytest.mark.parametrize("array", ["distance/ball", "potential/stay_out", "spline/core"])
def test_sealed_values_that_are_no_numbers_are_found(copy, array):
    chunk = copy / array / "c" / "3" / "0" / "0" / "0"
    values = np.fromfile(chunk, dtype="<f4")
    values[100] = np.nan
    values.tofile(chunk)
    seal(copy)

    with pytest.raises(InputError, match=f"{array}: phase 3"):
        verify_field(copy)


def rewrite(path: Path, change, arrays=("distance/ball", "spline/ball")) -> None:
    """Change the values of all phases, potentials by the formula, and seal the store again."""
    laws = [f"potential/{name}" for name in ("guide", "stay_in")]
    for array in (*arrays, *laws):
        chunks = [path / array / "c" / str(k) / "0" / "0" / "0" for k in range(len(PHASES))]
        before = np.stack([np.fromfile(chunk, dtype="<f4") for chunk in chunks])
        if array in laws:
            law = ForceField.open(path).fixtures[array.removeprefix("potential/")]
            ball = path / "distance" / "ball"
            sources = [ball / chunk.relative_to(path / array) for chunk in chunks]
            distance_mm = np.stack([np.fromfile(source, dtype="<f4") for source in sources])
            offence_mm = offence(distance_mm.astype(float), law.side_code)
            after = potential(offence_mm, law.resolved_delta_mm, law.m)
        else:
            after = change(before)
        for chunk, values in zip(chunks, after, strict=True):
            values.astype("<f4").tofile(chunk)
    seal(path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda mm: -mm, r"distance/ball: phase 0 is negative over .* its surface encloses"),
        (lambda mm: mm - 3, r"distance/ball: phase 2 is negative over .* its surface encloses"),
        (lambda mm: 1.1 * mm, r"phase 0 changes by 3\.\d+ mm between nodes that lie 3 mm apart"),
    ],
)
def test_sealed_values_that_are_no_distances_to_the_surface_are_found(copy, change, words):
    rewrite(copy, change)
    with pytest.raises(InputError, match=words):
        verify_field(copy)


def test_sealed_arrays_of_another_kind_are_found(copy):
    file = copy / "distance" / "ball" / "zarr.json"
    file.write_text(file.read_text().replace("little", "big"))
    seal(copy)

    with pytest.raises(InputError, match=r"distance/ball/zarr\.json: codecs"):
        verify_field(copy)


def test_a_store_without_manifest_is_none(copy, tmp_path):
    (copy / "manifest.json").unlink()
    for read in (verify_field, ForceField.open):
        with pytest.raises(InputError, match=r"has no manifest\.json, so it is no complete field"):
            read(copy)
        with pytest.raises(InputError, match="no such folder"):
            read(tmp_path / "elsewhere")


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("mr_from_tracker", np.diag([2.0, 1, 1, 1]).tolist(), "mr_from_tracker: is not a rotation"),
        ("phases", [0.0, 0.5, 0.99995], "lie 5e-05 of a cycle apart"),
        ("rr_s", 0.0, r"\.rr_s: .* greater than 0"),
        (
            "phases",
            [0.0, 0.1, 0.2, 0.5],
            "triangles and volume_ml need 4 numbers, one a phase",
        ),
    ],
)
def test_a_description_that_is_none_is_told_with_its_file(copy, key, value, words):
    description = json.loads((copy / "zarr.json").read_text())
    description["attributes"]["beatfield"][key] = value
    (copy / "zarr.json").write_text(json.dumps(description))
    with pytest.raises(InputError, match=rf"zarr\.json: beatfield.*{words}"):
        read_metadata(copy)


@pytest.mark.parametrize("text", ["[]", "5", '{"shape": []}', "[" * 100_000])
def test_an_array_sealed_with_no_description_of_its_own_is_told(copy, text):
    (copy / "distance" / "ball" / "zarr.json").write_text(text)
    seal(copy)
    with pytest.raises(InputError, match=r"distance/ball/zarr\.json: (is no|shape is|cannot be)"):
        verify_field(copy)


def test_a_certificate_of_odd_content_keeps_no_question_from_its_answer(copy):
    edit(copy, lambda told: told.update(accuracy={"fixtures": [1]}))
    answers = query_point(copy, (14.0, 2.0, 1.0), 0.3)
    assert [one["stiffness_measured_n_per_m"] for one in answers.values()] == [None] * len(FIXTURES)


def test_opening_refuses_what_it_can_see_at_no_cost(copy):
    whole = (copy / "zarr.json").read_bytes()
    (copy / "zarr.json").write_bytes(whole + b" ")
    with pytest.raises(InputError, match="is not what the manifest says"):
        ForceField.open(copy)

    (copy / "zarr.json").write_bytes(whole)
    chunk = copy / "distance" / "ball" / "c" / "1" / "0" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:-4])
    with pytest.raises(InputError, match=r"bytes, \d+ were needed"):
        ForceField.open(copy)
    chunk.unlink()
    with pytest.raises(InputError, match="cannot be read"):
        ForceField.open(copy)

    (copy / "manifest.json").write_text("[]")
    with pytest.raises(InputError, match=r"manifest\.json: cannot be read"):
        ForceField.open(copy)


def test_a_manifest_has_one_spelling():
    files = {"b": {"size": 1, "sha256": "x"}, "a": {"size": 2, "sha256": "y"}}

    assert canonical_manifest(files) == canonical_manifest(dict(reversed(files.items())))


def test_the_description_of_an_oblong_grid_keeps_its_axes(tmp_path):
    write_random(tmp_path / "f.zarr", 7, PHASES)
    ome = json.loads((tmp_path / "f.zarr" / "zarr.json").read_text())["attributes"]["ome"]
    for scale in ome["multiscales"]:
        step, start = scale["datasets"][0]["coordinateTransformations"]
        assert step["scale"][1:] == list(SPACING_MM[::-1])
        assert start["translation"][1:] == list(ORIGIN_MM[::-1])


def test_a_sealed_potential_that_is_nearly_the_formula_is_found(copy):
    chunk = copy / "potential" / "guide" / "c" / "2" / "0" / "0" / "0"
    values = np.fromfile(chunk, dtype="<f4")
    values[np.argmin(np.abs(values - 0.5))] += 1e-6
    values.tofile(chunk)
    seal(copy)
    with pytest.raises(InputError, match="guide: phase 2 is not the formula"):
        verify_field(copy)


def test_a_sealed_spline_that_is_a_micrometre_off_is_found(copy):
    rewrite(copy, lambda mm: mm + 1e-3, arrays=("spline/ball",))
    with pytest.raises(InputError, match=r"spline/ball: phase 0 misses distance/ball by 0\.001 mm"):
        verify_field(copy)


def test_in_oblong_voxels_a_distance_changes_by_the_way_along_its_own_axis(tmp_path):
    """A flat wall across x, whose nodes lie twice as far apart as those along z."""
    path = tmp_path / "f.zarr"
    write_random(path, 7, EVEN[:1])
    law = ForceField.open(path).fixtures["f"]
    x_mm = ORIGIN_MM[0] + SPACING_MM[0] * np.arange(7)

    def write_wall(slope):
        wall_mm = np.broadcast_to(slope * x_mm, (3, 5, 7)).astype(np.float32)
        offence_mm = offence(wall_mm.astype(float), law.side_code)
        stored = potential(offence_mm, law.resolved_delta_mm, law.m)
        for array, values in (
            ("distance/s", wall_mm),
            ("spline/s", wall_mm),
            ("potential/f", stored),
        ):
            values.astype("<f4").tofile(path / array / "c" / "0" / "0" / "0" / "0")
        edit(path, lambda b: b["structures"]["s"].update(volume_ml=[0.1]))

    write_wall(1.0)
    assert verify_field(path)
    write_wall(1.02)
    with pytest.raises(InputError, match=r"changes by 1\.53 mm between nodes that lie 1\.5 mm"):
        verify_field(path)
