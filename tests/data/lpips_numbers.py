#!/usr/bin/python3
"""Makes tests/data/lpips: trunks of random weights for LPIPS, and distances that NumPy computes with them.

  tests/data/lpips_numbers.py [OUT]

trunk.onnx has AlexNet's strides and channels but small kernels of which each sees few channels, so that it is small.
distances.json has LPIPS of images that a formula gives, from convolutions in double precision that are written out here;
of the program it has the linear weights only. one_output.onnx and channels.onnx are what no trunk is. The same bytes
every time. Needs Debian's python3-numpy and python3-onnx.
"""
import json
import pathlib
import re
import sys

import numpy as np
from onnx import TensorProto, checker, helper, numpy_helper

HERE = pathlib.Path(__file__).resolve().parent
CHANNELS = 64, 192, 384, 256, 256
SHIFT, SCALE = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
# kernel, stride, padding, groups, whether pooled before
SHAPES = (3, 4, 1, 1, False), (3, 1, 1, 64, True), (1, 1, 0, 192, True), (1, 1, 0, 128, False), (1, 1, 0, 256, False)


def random_layers(all_channels, shapes):
    random = np.random.default_rng(27)
    out, before = [], 3
    for channels, (kernel, _, _, groups, _) in zip(all_channels, shapes):
        seen = before // groups
        weights = random.normal(0, (2 / (seen * kernel * kernel)) ** 0.5, (channels, seen, kernel, kernel))
        out.append((weights.astype(np.float32), random.normal(0, 0.1, channels).astype(np.float32)))
        before = channels
    return out


def write_onnx(path, layers, shapes, outputs):
    nodes, numbers, shown, x = [], [], [], "image"
    for i, ((weights, bias), (kernel, stride, padding, groups, pooled)) in enumerate(zip(layers, shapes), 1):
        if pooled:
            nodes.append(helper.make_node("MaxPool", [x], [f"pool{i}"], kernel_shape=[3, 3], strides=[2, 2]))
            x = f"pool{i}"
        numbers += [numpy_helper.from_array(weights, f"weights{i}"), numpy_helper.from_array(bias, f"bias{i}")]
        nodes.append(helper.make_node("Conv", [x, f"weights{i}", f"bias{i}"], [f"conv{i}"], kernel_shape=[kernel] * 2,
                                      strides=[stride] * 2, pads=[padding] * 4, group=groups))
        nodes.append(helper.make_node("Relu", [f"conv{i}"], [f"relu{i}"]))
        x = f"relu{i}"
        shown.append(helper.make_tensor_value_info(x, TensorProto.FLOAT, [1, len(bias), f"height{i}", f"width{i}"]))
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, "height", "width"])
    model = helper.make_model(helper.make_graph(nodes, "trunk", [image], shown[-outputs:], numbers),
                              opset_imports=[helper.make_opsetid("", 11)], ir_version=6)
    checker.check_model(model)
    path.write_bytes(model.SerializeToString())


def windows(x, kernel, stride, padding):  # channels, rows, columns, kernel, kernel
    x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
    return np.lib.stride_tricks.sliding_window_view(x, (kernel, kernel), (1, 2))[:, ::stride, ::stride]


def features(image, layers):
    x, out = ((2 * image - 1 - SHIFT) / SCALE).transpose(2, 0, 1), []
    for (weights, bias), (kernel, stride, padding, groups, pooled) in zip(layers, SHAPES):
        if pooled:
            x = windows(x, 3, 2, 0).max(axis=(3, 4))
        seen = windows(x, kernel, stride, padding)
        split = seen.reshape(groups, -1, *seen.shape[1:])
        parts = weights.astype(float).reshape(groups, -1, *weights.shape[1:])
        x = np.einsum("gcyxkl,gockl->goyx", split, parts).reshape(len(bias), *seen.shape[1:3])
        x = np.maximum(x + bias.astype(float)[:, None, None], 0)
        out.append(x)
    return out


def distances(a, b, layers, linear):  # of each layer
    out, first = [], 0
    for p, q in zip(features(a, layers), features(b, layers)):
        p, q = (x / (np.sqrt((x ** 2).sum(axis=0)) + 1e-10) for x in (p, q))
        weights = linear[first:first + len(p)]
        out.append(float(np.einsum("c,cyx->yx", weights, (p - q) ** 2).mean()))
        first += len(p)
    return out


def image(width, height, factors, object_):
    y, x, c = np.meshgrid(np.arange(height), np.arange(width), np.arange(3), indexing="ij")
    pixels = (factors[0] * x + factors[1] * y + factors[2] * c + factors[3] * x * y) % 256 / 255
    x0, y0, x1, y1 = object_
    return np.where((x >= x0) & (x < x1) & (y >= y0) & (y < y1), pixels, 0)


def main():
    out = pathlib.Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "lpips"
    out.mkdir(parents=True, exist_ok=True)
    layers = random_layers(CHANNELS, SHAPES)
    write_onnx(out / "trunk.onnx", layers, SHAPES, 5)
    plain = [(1, 1, 0, 1, False)] * 5
    write_onnx(out / "one_output.onnx", random_layers([3] * 5, plain), plain, 1)
    write_onnx(out / "channels.onnx", random_layers([3] * 5, plain), plain, 5)

    text = (HERE.parent.parent / "src/eval/lpips_weights.h").read_text()
    numbers = re.sub(r"//.*", "", re.search(r"kLpipsWeights\[\] = \{(.*?)\};", text, re.S)[1])
    linear = np.array([np.float32(word.strip().rstrip("f")) for word in numbers.split(",") if word.strip()], float)
    assert len(linear) == sum(CHANNELS)

    cases = []
    for width, height, a, b, object_ in ((64, 64, (37, 91, 57, 13), (31, 17, 5, 7), None),
                                         (97, 70, (3, 1, 40, 0), (3, 2, 40, 0), None),
                                         (160, 121, (1, 2, 90, 1), (1, 2, 80, 1), None),
                                         (400, 320, (11, 3, 60, 1), (11, 3, 70, 1), (201, 97, 217, 150))):
        object_ = object_ or (0, 0, width, height)
        layered = distances(image(width, height, a, object_), image(width, height, b, object_), layers, linear)
        cases.append({"width": width, "height": height, "a": a, "b": b, "object": object_, "layers": layered,
                      "distance": sum(layered)})
    (out / "distances.json").write_text(json.dumps({"cases": cases}, indent=1) + "\n")


if __name__ == "__main__":
    main()
