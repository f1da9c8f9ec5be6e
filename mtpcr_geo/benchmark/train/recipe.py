"""The whole training: sites, views, features, matcher, files."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from mtpcr_geo.benchmark.train.sites import site
from mtpcr_geo.benchmark.train.views import View, views_of
from mtpcr_geo.core.errors import MissingPartError, OptionError
from mtpcr_geo.core.system import sha256


@dataclass(frozen=True)
class Recipe:
    """What a training is made of; the defaults are those of the weights in the package.

    Attributes:
        seed: of weights and samples; sites have seeds of their own.
        sites: places simulated.
        draws: cells at which each cloud is rasterised.
        feature_steps: of the optimiser for keypoints and descriptors.
        batch: pairs of patches in a step.
        size: edge of a patch, pixels.
        width: channels of the extractor.
        matcher_pairs: pairs of patches that the matcher learns from.
        matcher_epochs: times that it sees each.
        matcher_size: edge of its patches, pixels.
        keypoints: of a patch, for the matcher.
        threads: of PyTorch.
        device: "auto", "cpu" or "cuda".
        precision: "float32", or "bfloat16" for the network's arithmetic, which takes half the time where
            processors have it and ten times as long where they do not; "auto" takes it where they do.

    Raises:
        OptionError: if device or precision is none of these.

    """

    seed: int = 0
    sites: int = 63
    draws: int = 6
    feature_steps: int = 20000
    batch: int = 8
    size: int = 128
    width: int = 128
    matcher_pairs: int = 600
    matcher_epochs: int = 6
    matcher_size: int = 256
    keypoints: int = 256
    threads: int = 2
    device: str = "auto"
    precision: str = "auto"

    ABOUT: ClassVar[dict[str, str]] = {
        "seed": "seed of weights and samples",
        "sites": "places simulated",
        "draws": "cells at which each cloud is rasterised",
        "feature_steps": "steps for keypoints and descriptors",
        "batch": "pairs of patches in a step",
        "size": "edge of a patch, pixels",
        "width": "channels of the extractor",
        "matcher_pairs": "pairs of patches that the matcher learns from",
        "matcher_epochs": "times that the matcher sees each",
        "matcher_size": "edge of the matcher's patches, pixels",
        "keypoints": "keypoints of a patch, for the matcher",
        "threads": "threads of PyTorch",
        "device": "auto, cpu or cuda",
        "precision": "auto, float32 or bfloat16",
    }
    CHOICES: ClassVar[dict[str, tuple[str, ...]]] = {
        "device": ("auto", "cpu", "cuda"),
        "precision": ("auto", "float32", "bfloat16"),
    }

    def __post_init__(self) -> None:
        """Check the words."""
        for name, known in self.CHOICES.items():
            if getattr(self, name) not in known:
                raise OptionError(f"{name} is {getattr(self, name)!r}; it is one of {', '.join(known)}")


def train(
    recipe: Recipe,
    out: Path,
    *,
    clouds: Path | None = None,
    sites: list[list[View]] | None = None,
    until: float = math.inf,
    say: Callable[[str], object] = lambda line: None,
) -> dict[str, Any]:
    """Train both networks and write bev_point.onnx, bev_glue.onnx, curve.csv and run.json.

    Args:
        recipe: what the training is made of.
        out: folder of the files; made if missing.
        clouds: folder where simulated clouds are kept.
        sites: views of the places to train on, instead of the recipe's.
        until: time of `time.monotonic` after which it stops; the same call takes it up again.
        say: takes a line now and then.

    Returns:
        The content of run.json: recipe, seconds, sizes and sha256 of the files, last means of the losses.

    Raises:
        MissingPartError: if PyTorch is not installed.
        Interrupted: if the time was over before the features were trained.

    """
    try:
        import torch
    except ImportError:
        raise MissingPartError(
            "training needs PyTorch; install the extra train: pip install 'mtpcr-geo[train]'"
        ) from None
    from mtpcr_geo.benchmark.train.curve import Curve
    from mtpcr_geo.benchmark.train.export import export
    from mtpcr_geo.benchmark.train.features import train_features
    from mtpcr_geo.benchmark.train.pairing import train_matcher

    torch.set_num_threads(recipe.threads)
    torch.use_deterministic_algorithms(True, warn_only=True)
    device = recipe.device
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    precision = recipe.precision
    if precision == "auto":
        precision = "bfloat16" if device == "cuda" or _computes_bfloat16() else "float32"
    out.mkdir(parents=True, exist_ok=True)
    seconds = {}
    began = time.monotonic()
    if sites is None:
        sites = [views_of(site(number, clouds), recipe.seed, recipe.draws) for number in range(recipe.sites)]
    seconds["sites"] = round(time.monotonic() - began, 1)
    say(f"{sum(len(views) for views in sites)} views of {len(sites)} sites")
    curve = Curve(max(1, min(50, recipe.feature_steps // 10)), say)
    began = time.monotonic()
    features = train_features(
        sites,
        steps=recipe.feature_steps,
        seed=recipe.seed,
        batch=recipe.batch,
        size=recipe.size,
        width=recipe.width,
        half=precision == "bfloat16",
        curve=curve,
        device=device,
        checkpoint=out / "features.pt",
        until=until,
    )
    seconds["features"] = round(time.monotonic() - began, 1)
    began = time.monotonic()
    matcher = train_matcher(
        features,
        sites,
        pairs=recipe.matcher_pairs,
        epochs=recipe.matcher_epochs,
        seed=recipe.seed,
        size=recipe.matcher_size,
        count=recipe.keypoints,
        curve=curve,
        device=device,
    )
    torch.save(matcher.cpu().state_dict(), out / "matcher.pt")
    seconds["matcher"] = round(time.monotonic() - began, 1)
    paths = export(features, matcher, out)
    curve.write(out / "curve.csv")
    networks: tuple[Any, Any] = features, matcher
    facts = {
        "recipe": dataclasses.asdict(recipe),
        "precision": precision,
        "torch": str(torch.__version__),
        "seconds": seconds,
        "parameters": {
            path.name: sum(values.numel() for values in network.state_dict().values())
            for path, network in zip(paths, networks, strict=True)
        },
        "files": {path.name: {"bytes": path.stat().st_size, "sha256": sha256(path)} for path in paths},
        "last": {f"{row['part']} {row['name']}": row["mean"] for row in curve.rows},
    }
    (out / "run.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    return facts


def _computes_bfloat16() -> bool:
    """Return whether this processor has instructions for bfloat16; PyTorch imitates them where it has not."""
    import torch

    told: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    return bool(told.get("avx512_bf16") or told.get("amx_bf16"))
