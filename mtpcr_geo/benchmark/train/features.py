"""Train keypoints and descriptors: corners that both views show, and descriptors told apart by contrast."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn import functional as F

from mtpcr_geo.benchmark.train.curve import Curve, learning_rate
from mtpcr_geo.benchmark.train.networks import BevPoint, sample_descriptors
from mtpcr_geo.benchmark.train.samples import Labels, Sample, draw_sample, label
from mtpcr_geo.benchmark.train.views import View
from mtpcr_geo.core.errors import MtpcrError
from mtpcr_geo.match.likelihood import TEMPERATURE

NEAR_PX = 8.0
"""Places of a patch nearer than this are not told apart: they share cells of the descriptor's map."""
DETECTOR_WEIGHT = 0.5
KEEP_EVERY = 50
"""Steps after which a training is kept."""

Sites = Sequence[Sequence[View]]


class Interrupted(MtpcrError):
    """The time given to a training was over; what it came to is kept."""


def train_features(
    sites: Sites,
    *,
    steps: int,
    seed: int,
    batch: int = 8,
    size: int = 96,
    rate: float = 2e-3,
    curve: Curve,
    device: str = "cpu",
    width: int = 96,
    half: bool = False,
    checkpoint: Path | None = None,
    until: float = math.inf,
) -> BevPoint:
    """Train a `BevPoint` from scratch.

    Args:
        sites: views of each.
        steps: of the optimiser.
        seed: of the weights and of every sample.
        batch: pairs of patches in a step.
        size: edge of a patch, pixels, a multiple of 8.
        rate: learning rate at its highest.
        curve: takes the losses.
        device: where torch works.
        width: of the network.
        half: compute the network in bfloat16; weights stay float32.
        checkpoint: file where the training is kept, and from which it goes on.
        until: time of `time.monotonic` after which it stops, to be taken up again.

    Raises:
        Interrupted: if the time was over before.

    """
    torch.manual_seed(seed)
    network = BevPoint(width)
    network.to(device).to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=1e-3)
    first = _resume(checkpoint, network, optimiser, curve)
    network.train()
    for step in range(first, steps):
        # by the step, so that a training that goes on sees what an uninterrupted one does
        rng = np.random.default_rng([seed, 1, step])
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(rate, step, steps)
        drawn = [draw_sample(sites[int(rng.integers(len(sites)))], rng, size) for _ in range(batch)]
        losses = feature_losses(network, drawn, [label(sample, rng) for sample in drawn], device, half)
        optimiser.zero_grad(set_to_none=True)
        (losses["descriptor"] + DETECTOR_WEIGHT * losses["detector"]).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimiser.step()
        curve.add("features", step, {name: float(value.detach()) for name, value in losses.items()})
        if checkpoint is not None and (step + 1 == steps or (step + 1) % KEEP_EVERY == 0):
            kept = {"step": step + 1, "network": network.state_dict(), "optimiser": optimiser.state_dict()}
            torch.save({**kept, "curve": curve.rows}, checkpoint)
            if step + 1 < steps and time.monotonic() > until:
                raise Interrupted(f"stopped after {step + 1} of {steps} steps; go on with the same command")
    network.eval()
    return network


def _resume(checkpoint: Path | None, network: BevPoint, optimiser: Any, curve: Curve) -> int:
    """Take up a training that was interrupted; return the step that comes next."""
    if checkpoint is None or not checkpoint.is_file():
        return 0
    kept = torch.load(checkpoint, weights_only=True)
    network.load_state_dict(kept["network"])
    optimiser.load_state_dict(kept["optimiser"])
    curve.rows[:] = kept["curve"]
    return int(kept["step"])


def feature_losses(
    network: BevPoint, samples: Sequence[Sample], labels: Sequence[Labels], device: str, half: bool = False
) -> dict[str, Any]:
    """Return the losses of a batch, and the share of places whose nearest descriptor is the right one."""
    pairs = len(samples)
    images = np.stack([image for k in (0, 1) for image in (sample.images[k] for sample in samples)])
    grey = torch.from_numpy(images).to(device)[:, None].float() / 255
    with torch.autocast(device, torch.bfloat16, enabled=half):
        logits, maps = network(grey)
    logits, maps = logits.float(), maps.float()
    cells = np.stack([cell for k in (0, 1) for cell in (one.cells[k] for one in labels)])
    detector = F.cross_entropy(logits, torch.from_numpy(cells).to(device), ignore_index=-1)
    px = [torch.from_numpy(np.stack([one.points[k] for one in labels])).to(device) for k in (0, 1)]
    valid = torch.from_numpy(np.stack([one.valid for one in labels])).to(device)
    first, second = sample_descriptors(maps[:pairs], px[0]), sample_descriptors(maps[pairs:], px[1])
    descriptor, right = contrast(first, second, px, valid)
    return {"descriptor": descriptor, "detector": detector, "right": right}


def contrast(first: Any, second: Any, px: Sequence[Any], valid: Any) -> tuple[Any, Any]:
    """Return the double softmax loss of (b, n, d) descriptors, and the share of right nearest ones.

    Every place is to be told from all others of the batch, but for those beside it.
    """
    pairs, n, _ = first.shape
    similar = first.flatten(0, 1) @ second.flatten(0, 1).T / TEMPERATURE
    beside = torch.zeros(pairs, n, pairs, n, dtype=torch.bool, device=first.device)
    own = torch.eye(n, dtype=torch.bool, device=first.device)
    for k in range(pairs):
        near = torch.cdist(px[0][k], px[0][k]) < NEAR_PX
        near |= torch.cdist(px[1][k], px[1][k]) < NEAR_PX
        beside[k, :, k, :] = near & ~own
    usable = valid.flatten()
    hidden = beside.view(pairs * n, pairs * n) | ~usable[None, :] | ~usable[:, None]
    hidden.fill_diagonal_(False)
    similar = similar.masked_fill(hidden, -1e4)
    forth = torch.log_softmax(similar, 1).diagonal()[usable]
    back = torch.log_softmax(similar, 0).diagonal()[usable]
    right = (similar.argmax(1) == torch.arange(pairs * n, device=first.device))[usable]
    return -(forth.mean() + back.mean()) / 2, right.float().mean()
