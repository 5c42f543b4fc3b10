"""Training of the segmentation network: what it learns from, and that it can be repeated."""

from dataclasses import fields, replace

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs the extra 'train'")
pytest.importorskip("onnx", reason="training needs the extra 'train'")

from data_synth.errors import SynthError  # noqa: E402
from data_synth.population import draw_heart  # noqa: E402
from data_synth.tissue import COUNTED_AS, TRUTH_LABELS, Tissue  # noqa: E402
from data_synth.training.__main__ import main  # noqa: E402
from data_synth.training.batches import Batches, Echo, varied  # noqa: E402
from data_synth.training.contrast import CLASSES, LABEL_OF, draw_contrast  # noqa: E402
from data_synth.training.export import write_onnx  # noqa: E402
from data_synth.training.faults import normalise, spoil  # noqa: E402
from data_synth.training.loop import draw_from, mean_of, train  # noqa: E402
from data_synth.training.network import PLANES, HeartNet, loss, take_over  # noqa: E402
from data_synth.training.pool import (  # noqa: E402
    PIXEL_MM,
    PLANE_STEP_MM,
    PlaneFrame,
    PoolSettings,
    canonical_axes,
    cut_block,
    draw_frame,
    fill_pool,
    heart_blocks,
)
from data_synth.training.render import (  # noqa: E402
    CROP,
    Parts,
    _draw_positions,
    draw_sample,
)
from data_synth.training.runs import TrainSettings, has_ended  # noqa: E402
from data_synth.training.walls import laid_bare, thin_walled  # noqa: E402


@pytest.fixture(scope="module")
def blocks():
    return heart_blocks(0, PoolSettings())


@pytest.fixture(scope="module")
def heart():
    return draw_heart(np.random.default_rng(0))


def test_blocks_of_a_heart_depend_on_seed_and_number_alone(blocks):
    np.testing.assert_array_equal(heart_blocks(0, PoolSettings(hearts=7)), blocks)
    assert (heart_blocks(1, PoolSettings(blocks_per_heart=1))[0] != blocks[0]).any()


def test_block_shows_the_tissue_that_the_heart_has_there(heart):
    frame = PlaneFrame(heart.centre_mm - 40.0, canonical_axes(heart.long_axis), 3.0)
    block = cut_block(heart, 0.2, frame)
    index = np.random.default_rng(1).integers(0, block.shape, (200, 3))
    steps_mm = index[:, ::-1] * (PIXEL_MM, PIXEL_MM, frame.plane_step_mm)
    points_mm = frame.origin_mm + steps_mm @ frame.axes
    np.testing.assert_array_equal(block[tuple(index.T)], heart.tissue(points_mm, 0.2))


@pytest.mark.parametrize("seed", range(8))
def test_drawn_planes_are_canonical_and_of_clinical_spacing(heart, seed):
    frame = draw_frame(np.random.default_rng(seed), heart)
    np.testing.assert_allclose(frame.axes @ frame.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame.axes) == pytest.approx(1)
    assert PLANE_STEP_MM[0] <= frame.plane_step_mm <= PLANE_STEP_MM[1]


def test_sample_is_a_normal_image_with_labels_on_three_planes(blocks):
    rng = np.random.default_rng(2)
    for _ in range(12):
        sample = draw_sample(rng, blocks[0])
        assert sample.image.shape == sample.labels.shape == (PLANES, CROP, CROP)
        assert sample.image.dtype == np.float32
        assert np.isfinite(sample.image).all()
        assert sample.labels.max() < CLASSES


def test_bent_and_swollen_images_never_fold():
    rows, columns = np.mgrid[:176, :176]
    away = np.hypot(rows - 88, columns - 90)
    for seed in range(60):
        rng = np.random.default_rng(seed)
        radius = rng.uniform(4, 28)
        plane = np.where(away < radius + 6, Tissue.LV_MYOCARDIUM, Tissue.AIR)
        plane = np.where(away < radius, Tissue.LV_CAVITY, plane).astype(np.uint8)
        down, across = _draw_positions(rng, plane, shape=True)
        area = np.diff(down, axis=0)[:, :-1] * np.diff(across, axis=1)[:-1]
        area -= np.diff(down, axis=1)[:-1] * np.diff(across, axis=0)[:, :-1]
        # One sense of rotation everywhere: the map from image to plane has no fold.
        assert area.min() > 0


@pytest.mark.parametrize("layers", [1, 2, 3])
def test_thin_wall_loses_its_outer_layers_to_what_lies_there(layers):
    rows, columns = np.mgrid[:64, :64]
    away = np.hypot(rows - 32, columns - 32)
    plane = np.where(columns < 32, Tissue.FAT, Tissue.LUNG)
    plane = np.where(away < 20, Tissue.LV_MYOCARDIUM, plane)
    plane = np.where(away < 14, Tissue.LV_CAVITY, plane).astype(np.uint8)
    found = thin_walled(plane[None], layers)[0]
    assert ((found == Tissue.LV_CAVITY) == (plane == Tissue.LV_CAVITY)).all()
    muscle = found == Tissue.LV_MYOCARDIUM
    # Layers are taken along rows and columns: there the wall is thinner by just that many pixels.
    assert muscle[32, 32:].sum() == (plane[32, 32:] == Tissue.LV_MYOCARDIUM).sum() - layers
    assert set(np.unique(found[(plane == Tissue.LV_MYOCARDIUM) & ~muscle])) == {
        Tissue.FAT,
        Tissue.LUNG,
    }
    # However many layers go, the cavity never meets the outside.
    bare = thin_walled(plane[None], 9)[0]
    ring = cv2.dilate((plane == Tissue.LV_CAVITY).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert np.isin(bare[ring], (Tissue.LV_CAVITY, Tissue.LV_MYOCARDIUM)).all()


def test_what_lies_around_comes_up_to_the_heart_in_place_of_its_covers():
    rows, columns = np.mgrid[:64, :64]
    away = np.hypot(rows - 32, columns - 32)
    plane = np.where(columns < 32, Tissue.LIVER, Tissue.LUNG)
    plane = np.where(away < 22, Tissue.FAT, plane)
    plane = np.where(away < 18, Tissue.LV_MYOCARDIUM, plane)
    plane = np.where(away < 12, Tissue.LV_CAVITY, plane).astype(np.uint8)
    rng = np.random.default_rng(4)
    found = np.stack([laid_bare(rng, plane[None])[0] for _ in range(60)])
    changed = found != plane
    assert (plane[changed.any(axis=0)] == Tissue.FAT).all()
    assert set(np.unique(found[changed])) == {Tissue.LIVER, Tissue.LUNG, Tissue.PERICARDIUM}
    # On either side it is what lies there that comes near, at times with nothing between.
    beside = (away >= 18) & (away < 19.5)
    for side, tissue in ((columns < 26, Tissue.LIVER), (columns > 38, Tissue.LUNG)):
        assert (found[:, beside & side] == tissue).any()
        assert (found[:, beside & side] == Tissue.FAT).any()
    assert (found[:, (away < 22) & (columns < 26)] != Tissue.LUNG).all()


def test_without_random_parts_an_image_is_its_plane_in_one_scanners_grey_values(blocks):
    plain = Parts(**{part.name: False for part in fields(Parts)})
    rng = np.random.default_rng(5)
    inside, muscle = [], []
    for k in range(12):
        sample = draw_sample(rng, blocks[k % 2], plain)
        inside.append(sample.image[1][sample.labels[1] == 1])
        muscle.append(sample.image[1][sample.labels[1] == 2])
    blood, dark = np.concatenate(inside), np.concatenate(muscle)
    # Blood is drawn at 1 and muscle at 0.35 of it; noise, partial volume and scaling come after.
    assert np.median(dark) < 0.6 * np.median(blood)
    assert np.std(blood) < 0.25 * np.median(blood)


def test_samples_show_all_structures_and_no_two_are_alike(blocks):
    rng = np.random.default_rng(3)
    samples = [draw_sample(rng, blocks[k % 2]) for k in range(40)]
    assert set(np.unique([s.labels for s in samples])) == set(range(CLASSES))
    images = np.stack([s.image for s in samples]).reshape(40, -1)
    assert len(np.unique(images, axis=0)) == 40


def test_a_batch_depends_on_seed_and_number_alone(blocks):
    draw = draw_from(list(blocks))
    one, other = (Batches(draw, 5, 2, seed=4, stream=1) for _ in range(2))
    other[0]
    for first, second in zip(one[3], other[3], strict=True):
        assert torch.equal(first, second)
    assert not torch.equal(one[3][0], one[2][0])
    assert not torch.equal(one[3][0], Batches(draw, 5, 2, seed=5, stream=1)[3][0])
    assert len(list(one)) == len(one) == 5


def test_images_are_seen_again_until_others_take_their_place():
    """Twelve drawn, two at a time; the last eight are kept, and four of them join every batch."""
    echo, seen = Echo(8, seed=0), []
    for number in range(6):
        images = torch.full((2, 1, 1, 1), float(number))
        batch, labels = echo.joined(images, images[:, 0].byte(), 6)
        assert torch.equal(batch[:2], images)
        assert torch.equal(batch[:, 0].byte(), labels)
        seen.append(batch[2:].flatten().tolist())
    # Until there are four to see again, none is.
    assert [len(one) for one in seen] == [0, 0, 4, 4, 4, 4]
    for number, again in enumerate(seen):
        assert set(again) <= set(range(max(0, number - 4), number))
    many = [echo.joined(images, images[:, 0].byte(), 6)[0][2:] for _ in range(3)]
    assert set(torch.cat(many).flatten().tolist()) <= {2.0, 3.0, 4.0, 5.0}


def test_what_is_seen_again_is_changed_with_its_labels():
    """A bright disc's labels stay on it; within its rim, as wide as interpolation blurs."""
    rows, columns = torch.meshgrid(torch.arange(128.0), torch.arange(128.0), indexing="ij")
    away = torch.hypot(rows - 70, columns - 50)
    images = (away < 20).float().expand(40, 3, 128, 128)
    torch.manual_seed(3)
    changed, labels = varied(images, images.byte() * 4)
    assert labels.dtype == torch.uint8
    assert set(labels.unique().tolist()) == {0, 4}
    middle = [(one == 4).nonzero().double().mean(0)[1:] for one in labels]
    shift = torch.stack(middle) - torch.tensor([70.0, 50.0])
    # One in two keeps its place.
    assert 10 <= int((shift.norm(dim=1) < 0.01).sum()) <= 30
    assert float(shift.norm(dim=1).max()) > 4
    inside = torch.nn.functional.max_pool2d(-(labels == 4).float(), 5, 1, 2) == -1
    outside = torch.nn.functional.max_pool2d((labels == 4).float(), 5, 1, 2) == 0
    for grey, disc, around in zip(changed, inside, outside, strict=True):
        assert float(grey[disc].mean()) > 0.9
        assert abs(float(grey[around].mean())) < 0.05
    # What an image is drawn with again is its own: no two have the same noise.
    assert not torch.equal(*varied(images[:2], images[:2].byte())[0])


def test_the_mean_of_two_runs_lies_between_them(blocks, tmp_path, monkeypatch):
    monkeypatch.setattr("data_synth.training.loop.MEAN_BATCHES", 2)
    monkeypatch.setattr("data_synth.training.loop.MEAN_IMAGES", 4)
    settings, paths = (
        TrainSettings(widths=(8, 12, 12, 12, 12)),
        [tmp_path / "a.pt", tmp_path / "b.pt"],
    )
    networks = [HeartNet(settings.widths) for _ in paths]
    for network, path in zip(networks, paths, strict=True):
        torch.save(network.state_dict(), path)
    mean = mean_of(paths, draw_from(blocks), settings, tmp_path).state_dict()
    first, second = (network.state_dict() for network in networks)
    torch.testing.assert_close(
        mean["head.weight"], (first["head.weight"] + second["head.weight"]) / 2
    )
    # Features are normalised by images, not by what either run had: neither has seen any.
    assert float(mean["down.0.0.1.running_mean"].abs().max()) > 0.01
    assert (tmp_path / "heart.onnx").is_file()
    torch.save(HeartNet((4, 12, 12, 12, 12)).state_dict(), paths[1])
    with pytest.raises(ValueError, match=r"b\.pt is not of a network of widths"):
        mean_of(paths, draw_from(blocks), settings, tmp_path)


def test_every_tissue_but_those_named_is_background():
    named = {tissue for _, tissue in TRUTH_LABELS.values()} | set(COUNTED_AS)
    assert set(np.flatnonzero(LABEL_OF)) == named


def test_contrast_is_never_negative_and_varies():
    rng = np.random.default_rng(0)
    drawn = [draw_contrast(rng) for _ in range(200)]
    assert min(one.mean.min() for one in drawn) >= 0
    assert np.std([one.muscle for one in drawn]) > 0.1


def test_normalised_images_ignore_the_scanner_units():
    image = np.random.default_rng(0).gamma(2.0, 1.0, (64, 64)).astype(np.float32)
    # float32 keeps 7 digits; the percentiles' difference is of the order of the values.
    np.testing.assert_allclose(normalise(image * 700 + 50), normalise(image), atol=1e-4)


def test_faults_leave_the_image_recognisable():
    """Bright stays brighter than dark on the whole, whatever the scanner does."""
    disc = np.hypot(*np.mgrid[-64:64, -64:64]) < 40
    for seed in range(20):
        image = np.broadcast_to(np.where(disc, 1.0, 0.2), (3, 128, 128)).astype(np.float32)
        spoiled = spoil(np.random.default_rng(seed), image)[1]
        assert spoiled[disc].mean() > spoiled[~disc].mean()


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_loss_is_cross_entropy_plus_weighted_one_minus_dice(weight):
    rng = np.random.default_rng(0)
    scores = rng.normal(size=(2, PLANES * CLASSES, 4, 5))
    labels = rng.integers(0, CLASSES, (2, PLANES, 4, 5))
    # The definitions, in plain numpy and double precision.
    exponent = np.exp(scores.reshape(2, PLANES, CLASSES, 4, 5))
    chance = np.moveaxis(exponent / exponent.sum(axis=2, keepdims=True), 2, -1)
    truth = np.eye(CLASSES)[labels]
    cross_entropy = -np.log((chance * truth).sum(axis=-1)).mean()
    axes = (0, 1, 2, 3)
    dice = (2 * (chance * truth).sum(axes) + 1) / (chance.sum(axes) + truth.sum(axes) + 1)
    expected = cross_entropy + weight * (1 - dice[1:].mean())

    found = float(loss(torch.from_numpy(scores), torch.from_numpy(labels), weight))

    # Sums of under 1000 terms in single precision.
    assert found == pytest.approx(expected, abs=1e-5)


def test_exported_network_computes_what_the_trained_one_does(tmp_path):
    """Run by an independent engine; batch normalisation folded with statistics far from 0 and 1."""
    torch.manual_seed(0)
    network = HeartNet()
    images = torch.rand(4, 3, 64, 96)
    network(images)
    network.eval()
    write_onnx(tmp_path / "net.onnx", network)
    engine = cv2.dnn.readNetFromONNX(str(tmp_path / "net.onnx"))
    engine.setInput(images.numpy(), "images")
    found = engine.forward("scores")

    with torch.no_grad():
        expected = network(images).numpy()
    # Weights in half precision are off by 2^-12 of themselves on average, one independent of
    # another: a layer's sums by no more, and some 20 layers by sqrt(20) times that, 1.1e-3.
    assert np.sqrt(np.mean((found - expected) ** 2)) < 2e-3 * np.sqrt(np.mean(expected**2))


def test_training_repeats_to_the_byte_whoever_draws(blocks, tmp_path):
    values = {0: [], 2: []}
    for workers, into in values.items():
        settings = TrainSettings(steps=6, batch=3, fresh=2, kept=4, seed=1, workers=workers)

        def note(step, value, minutes, into=into):
            into.append(value)

        train(list(blocks), settings, tmp_path / str(workers), note)
    assert values[0] == values[2]
    written = [(tmp_path / str(workers) / "heart.onnx").read_bytes() for workers in values]
    assert written[0] == written[1]
    assert len(written[0]) < 10_000_000


@pytest.mark.parametrize("kept", [4, 1000])
def test_training_that_was_cut_short_goes_on_to_the_same_bytes(blocks, tmp_path, kept):
    settings = TrainSettings(steps=7, batch=5, fresh=2, kept=kept, seed=1, export_minutes=0.0)
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    train(list(blocks), settings, whole)

    def stop(step, value, minutes):
        # Told a step late: four steps are kept.
        if step == 4:
            raise KeyboardInterrupt

    steps = []
    with pytest.raises(KeyboardInterrupt):
        train(list(blocks), settings, cut, stop)
    assert not has_ended(cut / "heart", settings)
    train(list(blocks), settings, cut, lambda step, *_: steps.append(step))
    assert steps == [5, 6, 7]
    assert (cut / "heart.onnx").read_bytes() == (whole / "heart.onnx").read_bytes()
    # What has ended is not begun again, and is no run of other settings.
    again = train([], settings, cut, lambda step, *_: steps.append(step))
    assert steps == [5, 6, 7]
    assert again.state_dict()["head.weight"].shape[0] == PLANES * CLASSES
    with pytest.raises(SynthError, match=r"steps 7, now 9.*give another folder"):
        train(list(blocks), replace(settings, steps=9), cut)


@pytest.mark.parametrize(
    ("option", "value"),
    [("--steps", "0"), ("--minutes", "0"), ("--fresh", "0"), ("--batch", "-1"), ("--seed", "-1")],
)
def test_numbers_of_which_there_must_be_more_are_refused(tmp_path, capsys, option, value):
    with pytest.raises(SystemExit, match="2"):
        main(["--out", str(tmp_path / "new"), option, value])
    assert f"{option}: {value}: give" in capsys.readouterr().err


def test_training_beats_every_constant_answer(blocks):
    """A network that sees nothing can at best answer the frequencies of the classes."""
    torch.manual_seed(0)
    batches = Batches(draw_from(list(blocks)), 100, 2, seed=0, stream=1)
    # With next to no heart in view there is nothing to learn from two images.
    images, labels = next(b for b in batches if len(np.unique(b[1][..., 32:96, 32:96])) > 5)
    images, truth = images[..., 32:96, 32:96], labels[..., 32:96, 32:96].long()
    share = np.bincount(truth.flatten(), minlength=CLASSES) / truth.numel()
    constant = np.tile(np.log(np.maximum(share, 1e-9)), PLANES)[None, :, None, None]
    scores = torch.from_numpy(np.broadcast_to(constant, (2, PLANES * CLASSES, 64, 64)).copy())
    blind = loss(scores, truth, 0.0).item()
    network = HeartNet()
    optimiser = torch.optim.AdamW(network.parameters(), lr=2e-3)
    for _ in range(60):
        value = loss(network(images), truth, 0.0)
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
    assert value.item() < blind


def test_training_goes_on_from_a_checkpoint(blocks, tmp_path):
    once = TrainSettings(steps=1, batch=2)
    train(list(blocks), once, tmp_path)
    still = TrainSettings(steps=1, batch=2, learning_rate=0.0, start=tmp_path / "heart.pt")
    before = torch.load(tmp_path / "heart.pt", weights_only=True)
    after = train(list(blocks), still, tmp_path / "on").state_dict()
    assert torch.equal(before["head.weight"], after["head.weight"])


def test_wider_network_goes_on_from_what_a_narrower_one_says():
    torch.manual_seed(0)
    narrow, wide = HeartNet((8, 12, 16, 24, 32)), HeartNet((8, 14, 16, 30, 40))
    images = torch.rand(2, 3, 64, 64)
    narrow(images)
    take_over(wide, narrow.state_dict())
    narrow.eval(), wide.eval()
    with torch.no_grad():
        # Zeros are added to sums, whose order may change.
        torch.testing.assert_close(wide(images), narrow(images), rtol=1e-4, atol=1e-5)
    # What was added learns: gradients reach its outputs at once.
    wide.train()
    wide(images).square().mean().backward()
    assert wide.down[2][0][0].weight.grad[:, 12:].abs().max() > 0


def test_a_start_wider_than_the_network_is_told_before_hearts_are_made(tmp_path, capsys):
    torch.save(HeartNet().state_dict(), tmp_path / "heart.pt")
    arguments = ["--out", str(tmp_path / "new"), "--start", str(tmp_path / "heart.pt")]
    with pytest.raises(SystemExit, match="2"):
        main([*arguments, "--widths", "8", "12", "16", "24", "32"])
    assert "give --widths as wide or wider" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_start_that_is_not_there_is_told_before_hearts_are_made(tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["--out", str(tmp_path / "new"), "--start", str(tmp_path / "no.pt")])
    assert "no.pt is no file; give the heart.pt of an earlier run" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_fewer_images_kept_than_a_batch_has_are_refused(tmp_path, capsys):
    with pytest.raises(SystemExit) as refused:
        main(["--out", str(tmp_path / "new"), "--batch", "16", "--kept", "15"])
    assert refused.value.code == 2
    assert "--kept: 15 images cannot fill batches of 16" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_pool_is_filled_once_and_kept(tmp_path, monkeypatch):
    import data_synth.training.pool as pool

    made = []

    def quick(number, settings):
        made.append(number)
        return np.full((1, 2, 2, 2), number, np.uint8)

    monkeypatch.setattr(pool, "heart_blocks", quick)
    told = []
    first = fill_pool(tmp_path, PoolSettings(hearts=2))
    paths = fill_pool(tmp_path, PoolSettings(hearts=3), lambda *done: told.append(done))
    assert made == [0, 1, 2]
    assert paths[:2] == first
    assert told == [(3, 3)]
    assert np.load(paths[2]).max() == 2
    with pytest.raises(SynthError, match="spread"):
        fill_pool(tmp_path, PoolSettings(hearts=3, spread=2.0))


def test_command_line_leaves_a_network(tmp_path, capsys):
    short = ["--steps", "1", "--batch", "2"]
    arguments = ["--out", str(tmp_path), "--hearts", "1", *short]
    assert main([*arguments, "--pool-only"]) == 0
    assert not (tmp_path / "heart.onnx").exists()
    assert main(arguments) == 0
    assert (tmp_path / "heart.onnx").stat().st_size > 1e6
    assert "pool: 1 of 1 hearts" in capsys.readouterr().out
    # Without hearts of its own seed, those of another are learned from.
    others = ["--hearts", "0", "--seed", "5", "--more", "0", "1", *short]
    assert main(["--out", str(tmp_path / "on"), "--pool", str(tmp_path / "pool"), *others]) == 0
    assert (tmp_path / "on" / "heart.onnx").exists()
