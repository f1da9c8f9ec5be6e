"""Run GeoTransformer on two point files and write its transform; to be run in GeoTransformer's environment.

    python run_geotransformer.py CHECKOUT WEIGHTS SOURCE TARGET RESULT [--experiment kitti] [--scale 12]

Fits github.com/qinzheng93/GeoTransformer at e7a135a (its last, December 2022), whose extension must be built,
with PyTorch 1.7 or later. WEIGHTS is a file of its releases that belongs to the experiment; the word "random"
takes none, to try the wrapper. The model is made by the experiment's ``create_model``, and not by its
``demo.py``: that one leaves the model in training mode, where the coarse matches are drawn from the truth it
is given (upstream issues 37, 51, 107 and 116).

Coordinates are divided by the scale, and the translation multiplied by it: weights of 3DMatch know rooms,
those of KITTI streets (scale 1). The scale is raised where a cloud would have more superpoints than allowed:
memory grows with their square (12 GiB for 2000, of which each pair has 256 features for each of 3 angles).
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

EXPERIMENTS = {
    "3dmatch": "geotransformer.3dmatch.stage4.gse.k3.max.oacl.stage2.sinkhorn",
    "kitti": "geotransformer.kitti.stage5.gse.k3.max.oacl.stage2.sinkhorn",
}
# of its demonstration; what is not here is counted on the pair
NEIGHBOURS = {"3dmatch": [38, 36, 36, 38]}


def main() -> None:
    """Scale, run the model as in its own tests, and write the transform that takes source to target."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkout", type=Path)
    parser.add_argument("weights")
    for name in ("source", "target", "result"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--experiment", choices=sorted(EXPERIMENTS), default="3dmatch")
    parser.add_argument("--scale", type=float, default=12.0)
    parser.add_argument("--max-superpoints", type=int, default=2000)
    parser.add_argument("--device", choices=("cuda", "cpu"), help="cuda where there is one, if not given")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    source, target = np.load(options.source), np.load(options.target)
    result = options.result.resolve()
    weights = None if options.weights == "random" else Path(options.weights).resolve()
    folder = options.checkout.resolve() / "experiments" / EXPERIMENTS[options.experiment]
    sys.path[:0] = [str(options.checkout.resolve()), str(folder)]
    os.chdir(folder)
    if importlib.util.find_spec("IPython") is None:
        # its models import one function of it, for debugging
        sys.modules["IPython"] = types.ModuleType("IPython")
        sys.modules["IPython"].embed = None  # type: ignore[attr-defined]
    import torch

    torch.manual_seed(options.seed)
    device = options.device or ("cuda" if torch.cuda.is_available() else "cpu")
    if device == "cpu":
        # its layers call this wherever they make a tensor, and count on a copy without strides
        torch.Tensor.cuda = lambda self, *arguments, **more: self.contiguous()
    from config import make_cfg
    from geotransformer.utils.data import (
        calibrate_neighbors_stack_mode,
        registration_collate_fn_stack_mode,
    )
    from geotransformer.utils.torch import release_cuda, to_cuda
    from model import create_model

    cfg = make_cfg()
    sizes = cfg.backbone
    coarsest = sizes.init_voxel_size * 2 ** (sizes.num_stages - 1)
    scale = fitted_scale([source, target], options.scale, coarsest, options.max_superpoints)
    src, ref = (thinned(xyz / scale, sizes.init_voxel_size) for xyz in (source, target))
    print(f"device {device}, scale {scale:.1f}, {len(src)} source and {len(ref)} target points")
    pair = {
        "src_points": src.astype(np.float32),
        "ref_points": ref.astype(np.float32),
        "src_feats": np.ones((len(src), 1), np.float32),
        "ref_feats": np.ones((len(ref), 1), np.float32),
        # asked for, and used for losses alone once the model is in evaluation mode
        "transform": np.eye(4, dtype=np.float32),
    }
    stages = (sizes.num_stages, sizes.init_voxel_size, sizes.init_radius)
    neighbours = NEIGHBOURS.get(options.experiment)
    if neighbours is None:
        neighbours = calibrate_neighbors_stack_mode([pair], registration_collate_fn_stack_mode, *stages)
    batch = registration_collate_fn_stack_mode([pair], *stages, neighbours)
    print("superpoints of target and source:", batch["lengths"][-1].tolist())
    model = to_device(create_model(cfg), device)
    if weights is None:
        print("random weights: the answer means nothing")
    else:
        model.load_state_dict(load(torch, weights, device)["model"])
    model.eval()
    with torch.no_grad():
        found = release_cuda(model(to_cuda(batch)))
    T = np.array(found["estimated_transform"], float)
    T[:3, 3] *= scale
    np.savetxt(result, T, "%.17g")


def to_device(model: Any, device: str) -> Any:
    """Move a model, as its demonstration does."""
    return model.cuda() if device == "cuda" else model


def load(torch: Any, path: Path, device: str) -> Any:
    """Read weights that were saved with more than tensors beside them, by any version of PyTorch."""
    try:
        return torch.load(path, map_location=device, weights_only=False)
    except TypeError:
        # PyTorch before 1.13 knows no such argument
        return torch.load(path, map_location=device)


if __name__ == "__main__":
    main()
