"""The two networks: keypoints and descriptors in SuperPoint's form, and a matcher in LightGlue's form.

DeTone, Malisiewicz and Rabinovich, SuperPoint: Self-Supervised Interest Point Detection and Description,
2018; Lindenberger, Sarlin and Pollefeys, LightGlue: Local Feature Matching at Light Speed, 2023. Smaller than
either, written and trained from scratch.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torch.nn import functional as F

CELL_PX = 8
DESCRIPTOR_DIM = 64
NMS_RADIUS = 4
LAYERS, HEADS = 3, 4
SCALE_PX = 256.0
"""Pixels that the matcher takes for one unit of length."""


def _block(inside: int, outside: int, stride: int = 1, dilation: int = 1) -> Any:
    return nn.Sequential(
        nn.Conv2d(inside, outside, 3, stride, dilation, dilation, bias=False),
        nn.BatchNorm2d(outside),
        nn.ReLU(inplace=True),
    )


class BevPoint(nn.Module):
    """Keypoints and descriptors of an image: a shared trunk to an eighth of the resolution, and two heads.

    The last convolutions are dilated, so that a descriptor sees 109 pixels about its place: one corner of a
    roof is like another, and what stands round it is not.

    Args:
        width: channels of the trunk at its end.

    """

    def __init__(self, width: int = 96) -> None:
        super().__init__()
        self.trunk = nn.Sequential(
            _block(1, 16),
            _block(16, 32, 2),
            _block(32, 32),
            _block(32, 64, 2),
            _block(64, 64),
            _block(64, width, 2),
            _block(width, width),
            _block(width, width, dilation=2),
        )
        self.detector = nn.Sequential(_block(width, width), nn.Conv2d(width, CELL_PX**2 + 1, 1))
        self.descriptor = nn.Sequential(_block(width, width, dilation=2), nn.Conv2d(width, DESCRIPTOR_DIM, 1))

    def forward(self, image: Any) -> tuple[Any, Any]:
        """Return (b, 65, h/8, w/8) logits of the cells and (b, d, h/8, w/8) descriptors, not normalised.

        Args:
            image: (b, 1, h, w) grey / 255; h and w multiples of 8.

        """
        seen = self.trunk((image - 0.5) * 4.0)
        return self.detector(seen), self.descriptor(seen)


def heatmap(logits: Any) -> Any:
    """Return the (b, h, w) probability of keypoints from the (b, 65, h/8, w/8) logits of the cells."""
    return F.pixel_shuffle(torch.softmax(logits, 1)[:, :-1], CELL_PX)[:, 0]


def sample_descriptors(maps: Any, px: Any) -> Any:
    """Return the (b, n, d) descriptors, of unit length, at (b, n, 2) pixels (column, row) of the image."""
    height, width = maps.shape[-2] * CELL_PX, maps.shape[-1] * CELL_PX
    size = torch.stack([torch.as_tensor(width), torch.as_tensor(height)]).to(px)
    grid = (px + 0.5) / size * 2 - 1
    found = F.grid_sample(maps, grid[:, None], mode="bilinear", padding_mode="border", align_corners=False)
    return F.normalize(found[:, :, 0].transpose(1, 2), dim=2)


class Extractor(nn.Module):
    """The extractor's graph of the package's contract, which gives the map of descriptors too."""

    def __init__(self, network: BevPoint) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Any, max_keypoints: Any) -> tuple[Any, Any, Any, Any]:
        """Return (1, k, 2) pixels, (1, k) scores and (1, k, d) descriptors, best first, and the map.

        The map is (1, d, h/8, w/8), of unit length.
        """
        logits, maps = self.network(image)
        found = heatmap(logits)
        peaks = found == F.max_pool2d(found[:, None], 2 * NMS_RADIUS + 1, 1, NMS_RADIUS)[:, 0]
        flat = (found * peaks.to(found.dtype)).flatten(1)
        scores, index = torch.topk(flat, max_keypoints[0], dim=1)
        width = image.shape[-1]
        px = torch.stack([index % width, torch.div(index, width, rounding_mode="floor")], 2).to(image.dtype)
        return px, scores, sample_descriptors(maps, px), F.normalize(maps, dim=1)


def _rotated(x: Any, cosine: Any, sine: Any) -> Any:
    """Turn pairs of the (b, heads, n, dim) channels by angles that places give (rotary encoding)."""
    a, b = x[..., 0::2], x[..., 1::2]
    return torch.stack([a * cosine - b * sine, a * sine + b * cosine], -1).flatten(-2)


class _Update(nn.Module):
    """Adds a message to descriptors, as LightGlue does; the last layer starts at zero and adds nothing."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.out = nn.Linear(dim, dim)
        self.mix = nn.Sequential(nn.Linear(2 * dim, 2 * dim), nn.LayerNorm(2 * dim), nn.GELU())
        self.last = nn.Linear(2 * dim, dim)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, x: Any, message: Any) -> Any:
        return x + self.last(self.mix(torch.cat([x, self.out(message)], -1)))


def _attend(q: Any, k: Any, v: Any) -> Any:
    weight = torch.softmax(q @ k.transpose(-1, -2) / q.shape[-1] ** 0.5, -1)
    return (weight @ v).transpose(1, 2).flatten(2)


def _heads(x: Any) -> Any:
    """Split (b, n, dim) channels into (b, heads, n, dim / heads)."""
    return x.unflatten(-1, (HEADS, -1)).transpose(1, 2)


class _Layer(nn.Module):
    def __init__(self, dim: int) -> None:
        super().__init__()
        self.own = nn.Linear(dim, 3 * dim)
        self.own_update = _Update(dim)
        self.across = nn.Linear(dim, 2 * dim)
        self.across_update = _Update(dim)

    def _self(self, x: Any, turns: tuple[Any, Any]) -> Any:
        q, k, v = (_heads(part) for part in self.own(x).chunk(3, -1))
        return self.own_update(x, _attend(_rotated(q, *turns), _rotated(k, *turns), v))

    def forward(self, a: Any, b: Any, turns_a: Any, turns_b: Any) -> tuple[Any, Any]:
        a, b = self._self(a, turns_a), self._self(b, turns_b)
        (ka, va), (kb, vb) = ([_heads(part) for part in self.across(x).chunk(2, -1)] for x in (a, b))
        return self.across_update(a, _attend(ka, kb, vb)), self.across_update(b, _attend(kb, ka, va))


class BevGlue(nn.Module):
    """Pairs keypoints by attention: scores for every pair, and how sure each keypoint is to have a partner.

    Untrained it is a double softmax over descriptors, since its layers add nothing at first.
    """

    def __init__(self, dim: int = DESCRIPTOR_DIM, layers: int = LAYERS) -> None:
        super().__init__()
        self.places = nn.Linear(2, dim // HEADS // 2, bias=False)
        nn.init.normal_(self.places.weight, std=4.0)
        self.layers = nn.ModuleList([_Layer(dim) for _ in range(layers)])
        self.project = nn.Linear(dim, dim)
        with torch.no_grad():
            self.project.weight.copy_(torch.eye(dim))
            self.project.bias.zero_()
        self.log_scale = nn.Parameter(torch.tensor(3.0))
        self.partner = nn.Linear(dim, 1)
        nn.init.zeros_(self.partner.weight)
        nn.init.constant_(self.partner.bias, 1.0)

    def _turns(self, places: Any) -> tuple[Any, Any]:
        angle = self.places(places)[:, None]
        return torch.cos(angle), torch.sin(angle)

    def forward(self, kpts0: Any, kpts1: Any, desc0: Any, desc1: Any) -> tuple[Any, Any, Any]:
        """Return the (b, n, m) log of the double softmax and the (b, n) and (b, m) logits of a partner.

        Args:
            kpts0, kpts1: (b, n, 2) and (b, m, 2) places, pixels over `SCALE_PX`.
            desc0, desc1: (b, n, d) and (b, m, d) descriptors.

        """
        a, b = desc0 * 4.0, desc1 * 4.0
        turns = self._turns(kpts0), self._turns(kpts1)
        for layer in self.layers:
            a, b = layer(a, b, *turns)
        pa, pb = F.normalize(self.project(a), dim=-1), F.normalize(self.project(b), dim=-1)
        similar = pa @ pb.transpose(1, 2) * torch.exp(self.log_scale)
        both = torch.log_softmax(similar, 2) + torch.log_softmax(similar, 1)
        return both, self.partner(a)[..., 0], self.partner(b)[..., 0]


class Matcher(nn.Module):
    """The matcher's graph of the package's contract: places and descriptors in, mutual matches out."""

    def __init__(self, network: BevGlue) -> None:
        super().__init__()
        self.network = network

    def forward(self, kpts0: Any, kpts1: Any, desc0: Any, desc1: Any) -> tuple[Any, Any]:
        """Return (m, 2) indices and (m,) scores in 0..1."""
        both, sure0, sure1 = self.network(kpts0, kpts1, desc0, desc1)
        total = both + F.logsigmoid(sure0)[:, :, None] + F.logsigmoid(sure1)[:, None, :]
        forth, back = total[0].argmax(1), total[0].argmax(0)
        own = torch.arange(kpts0.shape[1], device=forth.device)
        mutual = (back[forth] == own).nonzero()[:, 0]
        partner = forth[mutual]
        # square root: the product of two probabilities each way
        return torch.stack([mutual, partner], 1), torch.exp(total[0][mutual, partner] / 2)
