"""Write the trained networks as ONNX files of the package's contract."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import torch

from mtpcr_geo.benchmark.train.networks import DESCRIPTOR_DIM, BevGlue, BevPoint, Extractor, Matcher

OPSET = 17
FILES = "bev_point.onnx", "bev_glue.onnx"


def export(features: BevPoint, matcher: BevGlue, folder: Path) -> list[Path]:
    """Write both graphs into a folder, and return their paths.

    Args:
        features: finds keypoints and describes them.
        matcher: pairs them.
        folder: made if missing.

    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in FILES]
    _export(
        Extractor(features.cpu()).eval(),
        (torch.rand(1, 1, 64, 96), torch.tensor([32])),
        paths[0],
        ["image", "max_keypoints"],
        ["keypoints", "scores", "descriptors", "map"],
        {
            "image": {2: "h", 3: "w"},
            "keypoints": {1: "k"},
            "scores": {1: "k"},
            "descriptors": {1: "k"},
            "map": {2: "rows", 3: "columns"},
        },
    )
    places, described = (torch.rand(1, 24, 2), torch.rand(1, 20, 2)), (24, 20)
    vectors = [torch.nn.functional.normalize(torch.randn(1, n, DESCRIPTOR_DIM), dim=2) for n in described]
    _export(
        Matcher(matcher.cpu()).eval(),
        (*places, *vectors),
        paths[1],
        ["kpts0", "kpts1", "desc0", "desc1"],
        ["matches", "scores"],
        {
            "kpts0": {1: "n"}, "kpts1": {1: "m"}, "desc0": {1: "n"}, "desc1": {1: "m"},
            "matches": {0: "pairs"}, "scores": {0: "pairs"},
        },
    )  # fmt: skip
    return paths


def _export(
    graph: Any, inputs: tuple[Any, ...], path: Path, taken: list[str], given: list[str], free: dict[str, Any]
) -> None:
    with warnings.catch_warnings():
        # the exporter by tracing is called old, and warns of the sizes that it follows by name
        warnings.simplefilter("ignore")
        torch.onnx.export(
            graph, inputs, str(path), input_names=taken, output_names=given, dynamic_axes=free,
            opset_version=OPSET, dynamo=False,
        )  # fmt: skip
