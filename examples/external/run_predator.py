"""Run Predator on two point files and write its transform as text; to be run in Predator's environment.

    python run_predator.py CHECKOUT SOURCE TARGET RESULT [--config configs/test/indoor.yaml] [--scale 12]

Fits github.com/prs-eth/OverlapPredator at 8c78f12 (February 2025), whose C++ wrappers must be built, with
PyTorch 1.7 or later and Open3D 0.10 or later. It does what its ``scripts/demo.py`` does, with its modules,
except that

- the sizes of neighbourhoods are counted on the pair, where the demonstration wants its training data;
- weights are read onto whatever device there is, where the demonstration wants CUDA;
- RANSAC is called as the Open3D installed has it, where the demonstration calls Open3D 0.10;
- clouds are held to the points that its own data sets have (30,000), and to as many of the coarsest stage as
  memory takes, by raising the scale.

Its indoor weights know rooms: coordinates are divided by the scale, and the translation multiplied by it;
with ``configs/test/kitti.yaml`` the scale is 1. ``--weights random`` takes none, to try the wrapper.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
from scaling import fitted_scale, thinned

# of its tests: longest distance of a match, in divided metres, and matches drawn; points drawn by their score
RANSAC = {"indoor": (0.05, 3, 1000), "kitti": (0.3, 4, 5000)}


def main() -> None:
    """Scale, run the model, draw points by their score, and match them by RANSAC."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("checkout", "source", "target", "result"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--config", default="configs/test/indoor.yaml")
    parser.add_argument("--weights", help="file, or random; what the configuration names if not given")
    parser.add_argument("--scale", type=float, default=12.0)
    parser.add_argument("--max-points", type=int, default=30_000)
    parser.add_argument("--max-superpoints", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    source, target = np.load(options.source), np.load(options.target)
    result = options.result.resolve()
    weights = options.weights
    if weights not in (None, "random"):
        weights = str(Path(weights).resolve())
    # its modules, and the files that its configuration names, are found from its checkout
    os.chdir(options.checkout)
    sys.path.insert(0, os.getcwd())
    for name in ("torchvision", "h5py"):
        # imported for the data of ModelNet alone
        if importlib.util.find_spec(name) is None:
            sys.modules[name] = types.ModuleType(name)
    import torch
    from configs.models import architectures
    from datasets.dataloader import calibrate_neighbors, collate_fn_descriptor
    from easydict import EasyDict
    from lib.utils import load_config, setup_seed
    from models.architectures import KPFCNN

    setup_seed(options.seed)
    rng = np.random.default_rng(options.seed)
    config = EasyDict(load_config(options.config))
    config.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    config.architecture = architectures[config.dataset]
    edge = config.first_subsampling_dl
    coarsest = edge * 2 ** (config.num_layers - 1)
    scale = fitted_scale([source, target], options.scale, coarsest, options.max_superpoints)
    src, tgt = (
        drawn(thinned(xyz / scale, edge), options.max_points, rng).astype(np.float32)
        for xyz in (source, target)
    )
    print(f"device {config.device}, scale {scale:.1f}, {len(src)} source and {len(tgt)} target points")
    ones = [np.ones((len(xyz), 1), np.float32) for xyz in (src, tgt)]
    # the truth and the matches that its data sets give stand there for losses alone
    rotation, shift = np.eye(3, dtype=np.float32), np.zeros((3, 1), np.float32)
    pair = (src, tgt, *ones, rotation, shift, torch.ones(1, 2).long(), src, tgt, torch.ones(1))
    neighbours = calibrate_neighbors([pair], config, collate_fn=collate_fn_descriptor)
    inputs = collate_fn_descriptor([pair], config, neighbours)
    model = KPFCNN(config).to(config.device)
    if weights == "random":
        print("random weights: the answer means nothing")
    else:
        model.load_state_dict(load(torch, weights or config.pretrain, config.device)["state_dict"])
    model.eval()
    with torch.no_grad():
        inputs = {key: moved(value, config.device) for key, value in inputs.items()}
        features, overlap, saliency = (one.detach().cpu().numpy() for one in model(inputs))
    points = inputs["points"][0].cpu().numpy()
    score = (overlap * saliency).ravel().astype(float)
    count = int(inputs["stack_lengths"][0][0])
    distance, sample, most = RANSAC[config.dataset]
    sides = [
        chosen(points[part], features[part], score[part], most, rng)
        for part in (slice(0, count), slice(count, None))
    ]
    T = ransac(*sides[0], *sides[1], distance, sample, options.seed)
    T[:3, 3] *= scale
    np.savetxt(result, T, "%.17g")


def drawn(xyz: np.ndarray, most: int, rng: np.random.Generator) -> np.ndarray:
    """Draw at most so many points."""
    return xyz if len(xyz) <= most else xyz[rng.permutation(len(xyz))[:most]]


def chosen(
    xyz: np.ndarray, features: np.ndarray, score: np.ndarray, most: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw points, the likelier the higher their score."""
    if len(xyz) > most and np.count_nonzero(score > 0) >= most:
        score = np.maximum(score, 0.0)
        picked = rng.choice(len(xyz), most, replace=False, p=score / score.sum())
    else:
        picked = np.arange(len(xyz))
    return xyz[picked], features[picked]


def ransac(
    src: np.ndarray,
    src_features: np.ndarray,
    tgt: np.ndarray,
    tgt_features: np.ndarray,
    distance: float,
    sample: int,
    seed: int,
) -> np.ndarray:
    """Match features and find the transform by RANSAC, with its authors' checks and number of samples."""
    import open3d

    kit = open3d.pipelines.registration if hasattr(open3d, "pipelines") else open3d.registration
    if hasattr(open3d.utility, "random"):
        open3d.utility.random.seed(seed)
    sides, described = [], []
    for xyz, features in ((src, src_features), (tgt, tgt_features)):
        cloud = open3d.geometry.PointCloud()
        cloud.points = open3d.utility.Vector3dVector(xyz.astype(np.float64))
        feature = kit.Feature()
        feature.data = features.T.astype(np.float64)
        sides.append(cloud)
        described.append(feature)
    checks = [
        kit.CorrespondenceCheckerBasedOnEdgeLength(0.9),
        kit.CorrespondenceCheckerBasedOnDistance(distance),
    ]
    estimation = kit.TransformationEstimationPointToPoint(False)
    new = hasattr(open3d, "pipelines")
    # 50,000 samples; the second number was the validations, and is the confidence since 0.12
    criteria = kit.RANSACConvergenceCriteria(50_000, 0.999 if new else 1000)
    match = kit.registration_ransac_based_on_feature_matching
    mutual = (False,) if new else ()
    found = match(*sides, *described, *mutual, distance, estimation, sample, checks, criteria)
    return np.array(found.transformation, float)


def moved(value: Any, device: Any) -> Any:
    """Move a tensor, or a list of them, to a device."""
    return [one.to(device) for one in value] if isinstance(value, list) else value.to(device)


def load(torch: Any, path: str, device: Any) -> Any:
    """Read weights that were saved with more than tensors beside them, by any version of PyTorch."""
    try:
        return torch.load(path, map_location=device, weights_only=False)
    except TypeError:
        # PyTorch before 1.13 knows no such argument
        return torch.load(path, map_location=device)


if __name__ == "__main__":
    main()
