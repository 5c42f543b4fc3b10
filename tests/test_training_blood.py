"""Training of the network for ultrasound: that it learns from what it is shown, and is kept."""

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs the extra 'train'")
pytest.importorskip("onnx", reason="training needs the extra 'train'")

from data_synth.training.ultrasound.__main__ import main  # noqa: E402
from data_synth.training.ultrasound.learning import (  # noqa: E402
    CROP,
    BloodNet,
    draw_sample,
    loss,
)
from data_synth.training.ultrasound.pictures import (  # noqa: E402
    BLOOD,
    CLASSES,
    OUTSIDE,
    WALL,
    heart_pictures,
)


@pytest.fixture(scope="module")
def drawn():
    return heart_pictures(9100, 4)


def test_loss_is_cross_entropy_and_dice_within_the_sector():
    rng = np.random.default_rng(0)
    scores = rng.normal(size=(2, CLASSES, 8, 8)).astype(np.float32)
    labels = rng.integers(0, CLASSES, (2, 8, 8))
    labels[:, :3] = OUTSIDE
    chance = np.exp(scores) / np.exp(scores).sum(axis=1, keepdims=True)
    inside = labels != OUTSIDE
    truth = np.stack([labels == k for k in range(CLASSES)], axis=1)
    away = -np.log((chance * truth).sum(axis=1)[inside]).mean()
    dice = []
    for k in (BLOOD, WALL):
        both = (chance[:, k] * truth[:, k]).sum()
        dice.append((2 * both + 1) / ((chance[:, k] * inside).sum() + truth[:, k].sum() + 1))
    found = float(loss(torch.from_numpy(scores), torch.from_numpy(labels), 0.3))
    # Sums of under 100 terms in single precision.
    assert found == pytest.approx(away + 0.3 * (1 - np.mean(dice)), abs=1e-5)


def test_samples_are_parts_of_the_pictures_and_repeat(drawn):
    for picture in drawn:
        images, labels = draw_sample(np.random.default_rng(0), picture)
        again, _ = draw_sample(np.random.default_rng(0), picture)
        np.testing.assert_array_equal(images, again)
        assert images.shape == (2, CROP, CROP)
        np.testing.assert_array_equal(images[1] > 0, labels != OUTSIDE)
        assert not images[0][labels == OUTSIDE].any()


def test_command_line_leaves_a_network_that_an_independent_engine_reads(tmp_path, capsys):
    arguments = ["--out", str(tmp_path), "--hearts", "1", "--frames", "4", "--steps", "3"]
    assert main([*arguments, "--batch", "2", "--pool-only"]) == 0
    assert not (tmp_path / "blood.onnx").exists()
    assert main([*arguments, "--batch", "2"]) == 0
    assert "pool: 1 of 1 hearts" in capsys.readouterr().out
    network = BloodNet()
    network.load_state_dict(torch.load(tmp_path / "blood.pt", weights_only=True))
    network.eval()
    images = torch.rand(2, 2, 64, 96)
    engine = cv2.dnn.readNetFromONNX(str(tmp_path / "blood.onnx"))
    engine.setInput(images.numpy(), "images")
    with torch.no_grad():
        expected = network(images).numpy()
    # Single precision, at most some 20 layers deep with sums of up to 1152 terms.
    np.testing.assert_allclose(
        engine.forward("scores"), expected, atol=1e-3 * np.abs(expected).max()
    )
