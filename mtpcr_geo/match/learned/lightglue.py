"""LightGlue and its kin through onnxruntime: matching graphs, and graphs fused with their extractor."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats, Grey
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.match.base import Features, PixelMatches
from mtpcr_geo.match.learned.model_cards import FusedFile, MatcherFile
from mtpcr_geo.match.learned.onnx import Graph, Running, as_input

LEAST_EDGE = 128
"""Edge to which tiny images are padded: fused graphs want room for a fixed number of keypoints."""


class LightGlue:
    """A pairing by a graph of the contract: kpts0, kpts1, desc0, desc1 in; matches and scores out.

    Args:
        model: its description.
        path: its file.
        running: device and threads.

    """

    def __init__(self, model: MatcherFile, path: Path, running: Running) -> None:
        self.model = model
        self.graph = Graph(
            path, ("kpts0", "kpts1", "desc0", "desc1"), ("matches", "scores"), model.names, running
        )

    def pair(
        self, source: Features, target: Features, shapes: tuple[tuple[int, int], tuple[int, int]]
    ) -> tuple[NDArray[np.int64], Floats]:
        """Return (m, 2) indices into both, and (m,) scores; shapes are (h, w) of the images.

        Raises:
            InputError: if the graph gives something else than the contract says.

        """
        none = np.empty((0, 2), np.int64), np.empty(0)
        # the graphs divide by the number of keypoints
        if not len(source) or not len(target):
            return none
        matches, scores = self.graph.run(
            kpts0=self._places(source.px, shapes[0])[None],
            kpts1=self._places(target.px, shapes[1])[None],
            desc0=source.descriptors[None],
            desc1=target.descriptors[None],
        )
        if matches.ndim != 2 or matches.shape[1] != 2 or scores.shape != (len(matches),):
            raise InputError(
                f"{self.graph.path} gives matches {matches.shape} and scores {scores.shape}; "
                "wanted are (M, 2) and (M,)"
            )
        if not len(matches):
            return none
        if matches.min() < 0 or (matches.max(axis=0) >= [len(source), len(target)]).any():
            raise InputError(f"{self.graph.path} matches keypoints that it was not given")
        keep = scores > self.model.score_threshold
        return matches[keep].astype(np.int64), scores[keep].astype(np.float64)

    def _places(self, px: Floats, shape: tuple[int, int]) -> NDArray[np.float32]:
        scale = self.model.scale_px
        return normalised(px, shape) if scale is None else np.asarray(px / scale, np.float32)


def normalised(px: Floats, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Scale pixels as LightGlue wants them: ``(xy - [W, H] / 2) / (max(W, H) / 2)``, (n, 2) float32."""
    size = np.array([shape[1], shape[0]], np.float64)
    return np.asarray((px - size / 2) / (size.max() / 2), np.float32)


class FusedLightGlue:
    """An `ImageMatcher` by a fused graph: images [2, C, H, W] in; keypoints, matches, mscores out.

    Both images are padded to one size; those larger than a tile are shrunk to it, since a fused graph cannot
    match a tile of one image with all of the other.

    Args:
        model: its description.
        path: its file.
        running: device and threads.
        any_yaw: whether it finds its way at any angle.

    """

    def __init__(self, model: FusedFile, path: Path, running: Running, *, any_yaw: bool = False) -> None:
        self.model = model
        self.any_yaw = any_yaw
        self.graph = Graph(path, ("images",), ("keypoints", "matches", "mscores"), model.names, running)

    def prepare(self, image: Grey, empty: int) -> tuple[Grey, int]:
        """Nothing can be done for one image alone."""
        return image, empty

    def match(
        self, first: tuple[Grey, int], second: tuple[Grey, int], most: int | None = None
    ) -> PixelMatches:
        """Match two prepared images; how many keypoints is in the graph.

        Raises:
            InputError: if the graph gives something else than the contract says.

        """
        (source, empty), (target, _) = first, second
        none = PixelMatches(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))
        if np.ptp(source) == 0 or np.ptp(target) == 0:
            return none
        longest = max(*source.shape, *target.shape)
        scale = min(1.0, self.model.tile / longest)
        shrunk = [_shrunk(image, scale) for image in (source, target)]
        shape = [
            -(-max(LEAST_EDGE, *(image.shape[axis] for image in shrunk)) // self.model.size_multiple)
            * self.model.size_multiple
            for axis in (0, 1)
        ]
        images = []
        for image in shrunk:
            padded = np.full(shape, empty, np.uint8)
            padded[: image.shape[0], : image.shape[1]] = image
            images.append(as_input(padded, self.model.channels, self.model.mean, self.model.std))
        keypoints, matches, scores = self.graph.run(images=np.concatenate(images))
        if keypoints.ndim != 3 or keypoints.shape[::2] != (2, 2):
            raise InputError(f"{self.graph.path} gives keypoints {keypoints.shape}; wanted are (2, K, 2)")
        if matches.ndim != 2 or matches.shape[1] != 3 or scores.shape != (len(matches),):
            raise InputError(
                f"{self.graph.path} gives matches {matches.shape} and mscores {scores.shape}; "
                "wanted are (M, 3) and (M,)"
            )
        if len(matches) and (matches[:, 1:].min() < 0 or matches[:, 1:].max() >= keypoints.shape[1]):
            raise InputError(f"{self.graph.path} matches keypoints that it did not give")
        # pixel centres: shrinking maps (x + 0.5) to (x + 0.5) * scale
        s, t = ((keypoints[k].astype(np.float64) + 0.5) / scale - 0.5 for k in (0, 1))
        _, i, j = matches.T
        inside = (scores > self.model.score_threshold) & _within(s[i], source) & _within(t[j], target)
        return PixelMatches(
            s[i[inside]],
            t[j[inside]],
            scores[inside].astype(np.float64),
            s[_within(s, source)],
            t[_within(t, target)],
        )


def _shrunk(image: Grey, scale: float) -> Grey:
    if scale == 1.0:
        return image
    size = tuple(max(round(length * scale), 1) for length in image.shape[::-1])
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _within(px: Floats, image: Grey) -> NDArray[np.bool_]:
    height, width = image.shape
    return np.asarray((px[:, 0] <= width - 0.5) & (px[:, 1] <= height - 0.5))
