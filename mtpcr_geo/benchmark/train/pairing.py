"""Train the matcher on the keypoints and descriptors of a trained network, which stays as it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch.nn import functional as F

from mtpcr_geo.benchmark.train.curve import Curve, learning_rate
from mtpcr_geo.benchmark.train.features import Sites
from mtpcr_geo.benchmark.train.networks import SCALE_PX, BevGlue, BevPoint, Extractor
from mtpcr_geo.benchmark.train.samples import Sample, draw_sample
from mtpcr_geo.core.arrays import Floats

SAME_PX, OTHER_PX = 3.0, 6.0
"""Keypoints nearer than the first are partners, those farther than the second from all others have none."""


@dataclass(frozen=True)
class Keypoints:
    """The keypoints of both patches of a sample, and which belong together.

    Attributes:
        px: two (k, 2) pixels over `SCALE_PX`.
        descriptors: two (k, d).
        partner: two (k,) index into the other's, -1 where there is none, -2 where it is open.

    """

    px: tuple[Any, Any]
    descriptors: tuple[Any, Any]
    partner: tuple[Any, Any]


def partners(first: Floats, second: Floats, M: Floats) -> tuple[Any, Any]:
    """Find which keypoints belong together by the known pose.

    Args:
        first, second: (k, 2) and (m, 2) pixels.
        M: (2, 3) affine map from the first's pixels to the second's.

    Returns:
        (k,) and (m,) int64, see `Keypoints.partner`.

    """
    far = np.linalg.norm((first @ M[:, :2].T + M[:, 2])[:, None] - second[None], axis=2)
    forth, back = far.argmin(1), far.argmin(0)
    own = np.arange(len(first))
    same = (back[forth] == own) & (far[own, forth] < SAME_PX)
    found = [np.where(far.min(axis) > OTHER_PX, -1, -2) for axis in (1, 0)]
    found[0][same] = forth[same]
    found[1][forth[same]] = own[same]
    return torch.from_numpy(found[0]), torch.from_numpy(found[1])


def keypoints_of(extractor: Extractor, sample: Sample, count: int) -> Keypoints:
    """Extract the best keypoints of both patches, and find which belong together."""
    most = torch.tensor([count])
    px, descriptors = [], []
    with torch.no_grad():
        for image in sample.images:
            grey = torch.from_numpy(image).float()[None, None] / 255
            found, _, described, _ = extractor(grey, most)
            px.append(found[0])
            descriptors.append(described[0])
    known = partners(px[0].numpy().astype(np.float64), px[1].numpy().astype(np.float64), sample.M)
    return Keypoints((px[0] / SCALE_PX, px[1] / SCALE_PX), (descriptors[0], descriptors[1]), known)


def train_matcher(
    network: BevPoint,
    sites: Sites,
    *,
    pairs: int,
    epochs: int,
    seed: int,
    batch: int = 4,
    size: int = 256,
    count: int = 256,
    rate: float = 5e-4,
    curve: Curve,
    device: str = "cpu",
) -> BevGlue:
    """Train a `BevGlue` from scratch on the keypoints of a trained `BevPoint`.

    Args:
        network: finds and describes the keypoints.
        sites: views of each.
        pairs: pairs of patches drawn, once for all epochs.
        epochs: times that each is seen.
        seed: of the weights and of every sample.
        batch: pairs in a step.
        size: edge of a patch, pixels, a multiple of 8.
        count: keypoints of a patch.
        rate: learning rate at its highest.
        curve: takes the losses.
        device: where torch works.

    """
    torch.manual_seed(seed)
    rng = np.random.default_rng([seed, 2])
    extractor = Extractor(network.cpu()).eval()
    drawn = [
        keypoints_of(
            extractor, draw_sample(sites[int(rng.integers(len(sites)))], rng, size, shift=0.45), count
        )
        for _ in range(pairs)
    ]
    matcher = BevGlue()
    matcher.to(device)
    optimiser = torch.optim.AdamW(matcher.parameters(), lr=rate, weight_decay=1e-3)
    steps, step = epochs * (pairs // batch), 0
    for _ in range(epochs):
        order = rng.permutation(pairs)
        for start in range(0, pairs - batch + 1, batch):
            for group in optimiser.param_groups:
                group["lr"] = learning_rate(rate, step, steps)
            losses = matcher_losses(matcher, [drawn[k] for k in order[start : start + batch]], device)
            optimiser.zero_grad(set_to_none=True)
            losses["matcher"].backward()
            torch.nn.utils.clip_grad_norm_(matcher.parameters(), 1.0)
            optimiser.step()
            curve.add("matcher", step, {name: float(value.detach()) for name, value in losses.items()})
            step += 1
    matcher.eval()
    return matcher


def matcher_losses(matcher: BevGlue, pairs: Sequence[Keypoints], device: str) -> dict[str, Any]:
    """Return the loss of a batch, and the share of keypoints with a partner whose best is the right one."""

    def stacked(what: str, k: int) -> Any:
        return torch.stack([getattr(one, what)[k] for one in pairs]).to(device)

    px, descriptors, partner = (
        [stacked(what, k) for k in (0, 1)] for what in ("px", "descriptors", "partner")
    )
    both, *sure = matcher(*px, *descriptors)
    with_partner = partner[0] >= 0
    chosen = both.gather(2, partner[0].clamp(min=0)[..., None])[..., 0]
    loss = -chosen[with_partner].mean() / 2 if bool(with_partner.any()) else both.sum() * 0.0
    for k in (0, 1):
        decided = partner[k] > -2
        if bool(decided.any()):
            wanted = (partner[k] >= 0).float()[decided]
            loss = loss + 0.5 * F.binary_cross_entropy_with_logits(sure[k][decided], wanted)
    right = (both.argmax(2) == partner[0])[with_partner]
    return {"matcher": loss, "right": right.float().mean() if right.numel() else torch.tensor(0.0)}
