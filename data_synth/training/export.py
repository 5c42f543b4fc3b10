"""Write a network as ONNX, node by node: the same weights always give the same bytes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from data_synth.training.network import UNet

Float32 = npt.NDArray[np.float32]
Floats = npt.NDArray[np.floating]

OPSET = 13


def write_onnx(path: Path, network: UNet) -> None:
    """Write ``network`` as it works after training: batch normalisation folded into weights.

    Input ``images`` is ``(n, channels, row, column)`` float32 with sides that divide by 16; output
    ``scores`` is ``(n, scores, row, column)``, before softmax. The graph is named like the file.
    Convolutions' weights are kept in half precision, which changes scores by some 2e-3 of the
    largest and halves the file.
    """
    graph = _Graph()
    name, skips = "images", []
    for number, block in enumerate(network.down):
        if number:
            name = graph.add("MaxPool", [name], kernel_shape=[2, 2], strides=[2, 2])
        name = graph.blocks(name, block)
        skips.append(name)
    skips.pop()
    for narrow, block in zip(network.narrow, network.up, strict=True):
        name = graph.convolution(name, *_arrays(narrow))
        name = graph.add("Resize", [name, "", graph.constant(_TWICE)], **_NEAREST)
        name = graph.blocks(graph.add("Add", [name, skips.pop()]), block)
    graph.convolution(name, *_arrays(network.head), output="scores")
    path.parent.mkdir(parents=True, exist_ok=True)
    channels, scores = network.down[0][0][0].in_channels, network.head.out_channels
    model = graph.model(path.stem, channels, scores)
    path.write_bytes(model.SerializeToString(deterministic=True))


_TWICE = np.array([1, 1, 2, 2], np.float32)
_NEAREST = {
    "mode": "nearest",
    "coordinate_transformation_mode": "asymmetric",
    "nearest_mode": "floor",
}


def _arrays(convolution: nn.Conv2d) -> tuple[Float32, Float32]:
    weight = convolution.weight.detach().float().numpy()
    if convolution.bias is None:
        return weight, np.zeros(len(weight), np.float32)
    return weight, convolution.bias.detach().float().numpy()


def _folded(block: nn.Sequential) -> tuple[Float32, Float32]:
    """Weight and bias of convolution and batch normalisation (running statistics) in one."""
    convolution, norm = block[0], block[1]
    weight, bias = _arrays(convolution)
    scale = (norm.weight / (norm.running_var + norm.eps) ** 0.5).detach().numpy()
    shift = norm.bias - norm.running_mean * (norm.weight / (norm.running_var + norm.eps) ** 0.5)
    return weight * scale[:, None, None, None], bias * scale + shift.detach().numpy()


class _Graph:
    """Nodes and weights in the order in which they were added."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.weights: list[onnx.TensorProto] = []

    def constant(self, values: Floats) -> str:
        name = f"weight{len(self.weights)}"
        self.weights.append(numpy_helper.from_array(np.ascontiguousarray(values), name))
        return name

    def add(self, kind: str, inputs: list[str], output: str = "", **attributes: object) -> str:
        output = output or f"{kind.lower()}{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [output], output, **attributes))
        return output

    def convolution(self, name: str, weight: Float32, bias: Float32, output: str = "") -> str:
        half = self.constant(weight.astype(np.float16))
        full = self.add("Cast", [half], to=TensorProto.FLOAT)
        inputs = [name, full, self.constant(bias)]
        side = weight.shape[-1]
        pads = [side // 2] * 4
        return self.add("Conv", inputs, output, kernel_shape=[side, side], pads=pads)

    def blocks(self, name: str, sequence: nn.Sequential) -> str:
        for block in sequence:
            name = self.add("Relu", [self.convolution(name, *_folded(block))])
        return name

    def model(self, name: str, channels: int, scores: int) -> onnx.ModelProto:
        shape = ["n", channels, "rows", "columns"]
        images = helper.make_tensor_value_info("images", TensorProto.FLOAT, shape)
        shape = ["n", scores, "rows", "columns"]
        said = helper.make_tensor_value_info("scores", TensorProto.FLOAT, shape)
        graph = helper.make_graph(self.nodes, name, [images], [said], self.weights)
        imports = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, opset_imports=imports, ir_version=8)
        onnx.checker.check_model(model)
        return model
