"""Small ONNX graphs with the contract of SuperPoint and LightGlue, and random weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

DIM = 32
FLOAT, INT = TensorProto.FLOAT, TensorProto.INT64


class Builder:
    """Adds nodes one by one; every call gives the name of its output."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def __call__(self, op: str, *inputs: str, name: str | None = None, outputs: int = 1, **attributes):
        names = [name or f"v{len(self.nodes)}_{k}" for k in range(outputs)]
        self.nodes.append(helper.make_node(op, list(inputs), names, **attributes))
        return names[0] if outputs == 1 else names

    def constant(self, value: np.ndarray) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def ints(self, *values: int) -> str:
        return self.constant(np.array(values, np.int64))

    def save(self, path: Path, inputs: dict, outputs: dict) -> Path:
        taken, made = (
            [helper.make_tensor_value_info(name, *how) for name, how in side.items()]
            for side in (inputs, outputs)
        )
        graph = helper.make_graph(self.nodes, "small", taken, made, self.constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
        onnx.checker.check_model(model)
        onnx.save(model, path)
        return path


def features(b: Builder, image: str, wanted: str) -> tuple[str, str, str]:
    """Keypoints (1, K, 2), scores (1, K), descriptors (1, K, D): random projections of 15 x 15 patches."""
    rng = np.random.default_rng(20)
    W = rng.normal(size=(DIM, 1, 15, 15)).astype(np.float32)
    blur = np.exp(-((np.arange(15) - 7.0) ** 2) / 18.0)
    W = (W - W.mean(axis=(2, 3), keepdims=True)) * np.outer(blur, blur).astype(np.float32)
    W -= W.mean(axis=(2, 3), keepdims=True)
    maps = b("Conv", image, b.constant(W.astype(np.float32)), pads=[7, 7, 7, 7])
    power = b("ReduceMean", b("Mul", maps, maps), axes=[1], keepdims=1)
    strength = b("Div", power, b("Add", power, b.constant(np.array(1.0, np.float32))))
    peak = b("MaxPool", strength, kernel_shape=[5, 5], pads=[2, 2, 2, 2])
    kept = b("Mul", strength, b("Cast", b("Equal", strength, peak), to=FLOAT))
    flat = b("Reshape", kept, b.ints(1, -1))
    scores, index = b("TopK", flat, wanted, outputs=2, axis=1)
    width = b("Slice", b("Shape", image), b.ints(3), b.ints(4))
    xy = [b("Unsqueeze", b(op, index, width), b.ints(2)) for op in ("Mod", "Div")]
    px = b("Concat", *xy, axis=2)
    columns = b("Reshape", maps, b.ints(DIM, -1))
    chosen = b("Transpose", b("Gather", columns, b("Squeeze", index, b.ints(0)), axis=1), perm=[1, 0])
    descriptors = b("Unsqueeze", b("LpNormalization", chosen, axis=1, p=2), b.ints(0))
    return px, scores, descriptors


def assignment(b: Builder, k0: str, k1: str, d0: str, d1: str) -> tuple[str, str]:
    """Matches (M, 2) and scores (M,): mutual nearest under a double softmax, places stirred in a little."""
    rng = np.random.default_rng(21)
    W = b.constant((rng.normal(size=(2, DIM)) * 0.01).astype(np.float32))
    a, c = (b("Add", d, b("Tanh", b("MatMul", k, W))) for d, k in ((d0, k0), (d1, k1)))
    similar = b("MatMul", a, b("Transpose", c, perm=[0, 2, 1]))
    similar = b("Mul", similar, b.constant(np.array(20.0, np.float32)))
    both = b("Mul", b("Softmax", similar, axis=2), b("Softmax", similar, axis=1))
    both = b("Squeeze", both, b.ints(0))
    forth = b("ArgMax", both, axis=1, keepdims=0)
    back = b("ArgMax", both, axis=0, keepdims=0)
    n = b("Squeeze", b("Slice", b("Shape", both), b.ints(0), b.ints(1)), b.ints(0))
    own = b("Range", b.constant(np.array(0, np.int64)), n, b.constant(np.array(1, np.int64)))
    mutual = b("Equal", b("Gather", back, forth, axis=0), own)
    chosen = b("Squeeze", b("NonZero", mutual), b.ints(0))
    pairs = [b("Unsqueeze", b("Gather", one, chosen, axis=0), b.ints(1)) for one in (own, forth)]
    best = b("ReduceMax", both, axes=[1], keepdims=0)
    return b("Concat", *pairs, axis=1), b("Gather", best, chosen, axis=0)


def superpoint(path: Path, **names: str) -> Path:
    """An extractor; names replace the contract's."""
    called = {n: names.get(n, n) for n in ("image", "max_keypoints", "keypoints", "scores", "descriptors")}
    b = Builder()
    px, scores, descriptors = features(b, called["image"], called["max_keypoints"])
    b("Cast", px, name=called["keypoints"], to=FLOAT)
    b("Identity", scores, name=called["scores"])
    b("Identity", descriptors, name=called["descriptors"])
    return b.save(
        path,
        {called["image"]: (FLOAT, [1, 1, "h", "w"]), called["max_keypoints"]: (INT, [1])},
        {
            called["keypoints"]: (FLOAT, [1, "k", 2]),
            called["scores"]: (FLOAT, [1, "k"]),
            called["descriptors"]: (FLOAT, [1, "k", DIM]),
        },
    )


def lightglue(path: Path) -> Path:
    """A matcher."""
    b = Builder()
    matches, scores = assignment(b, "kpts0", "kpts1", "desc0", "desc1")
    b("Identity", matches, name="matches")
    b("Identity", scores, name="scores")
    inputs = {f"kpts{k}": (FLOAT, [1, f"n{k}", 2]) for k in (0, 1)}
    inputs |= {f"desc{k}": (FLOAT, [1, f"n{k}", DIM]) for k in (0, 1)}
    return b.save(path, inputs, {"matches": (INT, ["m", 2]), "scores": (FLOAT, ["m"])})


def fused(path: Path, keypoints: int = 100) -> Path:
    """Both in one graph, as LightGlue-ONNX exports them."""
    b = Builder()
    half = [b("Slice", "images", b.ints(k), b.ints(k + 1), b.ints(0)) for k in (0, 1)]
    found = [features(b, image, b.ints(keypoints)) for image in half]
    scale = b.constant(np.array(0.001, np.float32))
    places = [b("Mul", b("Cast", px, to=FLOAT), scale) for px, _, _ in found]
    matches, scores = assignment(b, places[0], places[1], found[0][2], found[1][2])
    zero = b("Mul", b("Slice", matches, b.ints(0), b.ints(1), b.ints(1)), b.ints(0))
    b("Concat", zero, matches, name="matches", axis=1)
    b("Identity", scores, name="mscores")
    b("Concat", found[0][0], found[1][0], name="keypoints", axis=0)
    return b.save(
        path,
        {"images": (FLOAT, [2, 1, "h", "w"])},
        {
            "keypoints": (INT, [2, keypoints, 2]),
            "matches": (INT, ["m", 3]),
            "mscores": (FLOAT, ["m"]),
        },
    )
