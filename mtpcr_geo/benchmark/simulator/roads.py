"""Road networks: warped grids with some streets left out, and the walks a robot takes along them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

from mtpcr_geo.core.arrays import Floats, Indices, Mask

STEP_M = 1.0


@dataclass(frozen=True)
class RoadStyle:
    """What kind of network.

    Attributes:
        spacing: (2,) metres between parallel roads, in the two directions.
        jitter: standard deviation of the nodes' places, metres.
        warp: amplitude of the bends, metres.
        dropped: share of streets left out.
        width: carriageway, metres.

    """

    spacing: tuple[float, float]
    jitter: float
    warp: float
    dropped: float
    width: float


@dataclass(frozen=True)
class Network:
    """Roads as a graph.

    Attributes:
        nodes: (n, 2) metres.
        edges: (e, 2) node numbers.
        lines: one (k, 2) centre line per edge, metres, points about a metre apart.
        widths: (e,) carriageway widths, metres.

    """

    nodes: Floats
    edges: Indices
    lines: tuple[Floats, ...]
    widths: Floats

    def points(self) -> tuple[Floats, Floats]:
        """Return all centre-line points (n, 2) and the road's width at each (n,)."""
        counts = [len(line) for line in self.lines]
        return np.concatenate(self.lines), np.repeat(self.widths, counts)

    def lengths(self) -> Floats:
        """Return the length of each edge in metres: (e,)."""
        return np.array([np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in self.lines])

    def _leg(self, a: int, b: int) -> Floats:
        for (i, j), line in zip(self.edges, self.lines, strict=True):
            if (i, j) == (a, b):
                return line
            if (j, i) == (a, b):
                return line[::-1]
        raise ValueError(f"no road joins nodes {a} and {b}")

    def walk(self, allowed: Mask, start: int, end: int, length: float) -> Floats:
        """Walk along roads as one who maps a quarter: the nearest street not yet seen comes next.

        Args:
            allowed: (n,) bool, nodes that may be visited before the last leg.
            start, end: nodes where the walk begins and ends.
            length: metres after which the walk turns to its end.

        Returns:
            (k, 2) centre-line points in metres, about a metre apart.

        """
        cost = self.lengths()
        n = len(self.nodes)
        i, j = self.edges.T
        graph = csr_matrix((np.r_[cost, cost], (np.r_[i, j], np.r_[j, i])), shape=(n, n))
        distance, before = dijkstra(graph, return_predecessors=True)
        todo = {tuple(e) for e in self.edges.tolist() if allowed[e[0]] and allowed[e[1]]}
        path, here, walked = [start], start, 0.0

        def go(to: int) -> None:
            nonlocal here, walked
            legs = [to]
            while legs[-1] != here:
                legs.append(int(before[here, legs[-1]]))
            for a, b in zip(legs[::-1], legs[-2::-1], strict=False):
                todo.discard((min(a, b), max(a, b)))
            path.extend(legs[-2::-1])
            walked += float(distance[here, to])
            here = to

        while todo and walked < length:
            near = min(
                ((distance[here, a], a, b) for e in todo for a, b in (e, e[::-1])),
                key=lambda c: (c[0], c[1], c[2]),
            )
            go(near[1])
            street = (min(near[1:]), max(near[1:]))
            if street in todo:  # the street itself, even where another way is shorter
                todo.discard(street)
                path.append(near[2])
                walked += float(np.linalg.norm(self.nodes[near[2]] - self.nodes[near[1]]))
                here = near[2]
        go(end)
        if len(path) < 2:
            return self.nodes[[start]]
        return np.concatenate([self._leg(a, b) for a, b in pairwise(path)])


def make_network(half: float, style: RoadStyle, rng: np.random.Generator) -> Network:
    """Lay a road network over a square of edge ``2 * half`` metres about the origin."""
    yaw = rng.uniform(-0.5, 0.5)
    reach = 1.5 * half
    spacing = [min(s, 0.7 * half) for s in style.spacing]  # a small site has roads too
    counts = [int(np.ceil(2 * reach / s)) + 1 for s in spacing]
    u, v = np.meshgrid(*(np.arange(k) - (k - 1) / 2 for k in counts))
    u, v = u + rng.uniform(-0.4, 0.4), v + rng.uniform(-0.4, 0.4)
    grid = np.stack([u * spacing[0], v * spacing[1]], -1).reshape(-1, 2)
    grid += rng.normal(0, style.jitter, grid.shape)
    number = np.arange(len(grid)).reshape(u.shape)
    along = np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], 1)
    across = np.stack([number[:-1].ravel(), number[1:].ravel()], 1)
    edges = np.concatenate([along, across])
    main = np.r_[
        np.repeat(rng.random(number.shape[0]) < 0.3, number.shape[1] - 1),
        np.tile(rng.random(number.shape[1]) < 0.2, number.shape[0] - 1),
    ]
    kept = main | (rng.random(len(edges)) >= style.dropped)

    phase = rng.uniform(0, 2 * np.pi, (2, 3))
    wave = rng.uniform(90.0, 260.0, (2, 3))
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])

    def bend(p: Floats) -> Floats:
        shift = np.zeros_like(p)
        for k in range(3):
            shift[:, 0] += np.sin(2 * np.pi * p[:, 1] / wave[0, k] + phase[0, k])
            shift[:, 1] += np.sin(2 * np.pi * p[:, 0] / wave[1, k] + phase[1, k])
        return np.asarray((p + 0.5 * style.warp * shift) @ turn)

    lines = []
    for a, b in edges:
        steps = max(2, int(np.linalg.norm(grid[b] - grid[a]) / STEP_M) + 1)
        t = np.linspace(0, 1, steps)[:, None]
        lines.append(bend(grid[a] + t * (grid[b] - grid[a])))
    nodes = bend(grid)
    inside = np.abs(nodes).max(axis=1) < half + 5.0
    within = inside[edges].all(axis=1)
    kept = kept & within if (kept & within).any() else within
    n = len(nodes)
    i, j = edges[kept].T
    _, label = connected_components(csr_matrix((np.ones(len(i)), (i, j)), shape=(n, n)), directed=False)
    biggest = np.bincount(label[i]).argmax() if len(i) else 0
    kept &= label[edges[:, 0]] == biggest
    used = np.unique(edges[kept])
    renumber = np.full(n, -1)
    renumber[used] = np.arange(len(used))
    widths = np.where(main, 1.35, 1.0) * style.width * rng.uniform(0.9, 1.1, len(edges))
    index = np.flatnonzero(kept)
    return Network(
        nodes[used],
        renumber[edges[index]],
        tuple(lines[k] for k in index),
        widths[index],
    )
