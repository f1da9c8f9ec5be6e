"""The figures that the paper prints, to stand beside those measured here.

MT-PCR: Leveraging Modality Transformation for Large-Scale Point Cloud Registration with Limited Overlap:
its Tables I to IV. They were measured by its authors on the GrAco dataset; none was measured here.
Rows that its source holds but does not print are in `UNPRINTED`.
"""

from __future__ import annotations

from typing import NamedTuple


class Combination(NamedTuple):
    """Two sequences of GrAco: the source's and the target's, A for aerial and G for ground."""

    source: str
    target: str

    @property
    def name(self) -> str:
        """Such as "A03-G05"."""
        return f"{self.source}-{self.target}"

    @property
    def group(self) -> str:
        """Such as "A-G"."""
        return f"{self.source[0]}-{self.target[0]}"


class Extent(NamedTuple):
    """A row of Table I: extent in metres, overlap in percent."""

    dx_m: float
    dy_m: float
    dz_m: float
    overlap_source_pct: float
    overlap_target_pct: float


GROUPS = ("A-G", "G-G", "A-A")

COMBINATIONS = (
    Combination("A02", "G05"),
    Combination("A03", "G03"),
    Combination("A03", "G05"),
    Combination("A04", "G01"),
    Combination("A04", "G06"),
    Combination("A06", "G01"),
    Combination("A07", "G05"),
    Combination("A07", "G06"),
    Combination("G01", "G02"),
    Combination("G03", "G06"),
    Combination("G04", "G05"),
    Combination("A01", "A02"),
    Combination("A05", "A07"),
    Combination("A06", "A08"),
)
"""The fourteen of Table II, in its order."""

TABLE_I = {
    "A03-G03": Extent(440.21, 454.04, 58.58, 14.82, 22.28),
    "A04-G01": Extent(457.13, 387.83, 32.91, 19.97, 22.9),
    "A07-G06": Extent(432.11, 492.93, 33.35, 16.09, 18.1),
    "G04-G05": Extent(558.95, 466.31, 26.72, 66.49, 42.11),
    "A01-A02": Extent(390.39, 452.18, 57.55, 32.42, 75.19),
}
"""Scale and overlap of the five combinations for which the paper gives them."""

METRICS = ("e_r_deg", "e_t_m", "rmsd_m")

# fmt: off
TABLE_II: dict[str, dict[str, tuple[float, ...]]] = {
    "FPFH+TEASER": {
        "e_r_deg": (
            1.927, 2.262, 13.494, 116.87, 135.276, 2.258, 19.538, 18.782,
            0.961, 1.935, 0.33, 1.946, 0.354, 0.536,
        ),
        "e_t_m": (
            7.43, 2.351, 20.053, 122.073, 133.817, 4.141, 37.906, 20.387,
            1.444, 2.163, 1.062, 8.619, 0.746, 0.646,
        ),
        "rmsd_m": (
            1.472, 1.797, 13.718, 156.847, 171.099, 2.368, 34.72, 16.062,
            1.128, 3.743, 0.498, 2.314, 0.912, 0.735,
        ),
    },
    "FPFH+SVD": {
        "e_r_deg": (
            5.12, 13.064, 13.59, 148.059, 83.7, 14.278, 6.152, 7.096,
            12.422, 17.946, 2.828, 8.294, 5.077, 12.483,
        ),
        "e_t_m": (
            55.235, 6.711, 21.2, 80.52, 74.29, 62.914, 126.617, 19.251,
            72.176, 105.874, 11.906, 40.512, 21.774, 28.006,
        ),
        "rmsd_m": (
            59.234, 10.355, 32.425, 89.095, 93.452, 70.004, 132.943, 19.876,
            77.03, 102.462, 9.782, 38.344, 18.455, 29.984,
        ),
    },
    "PLADE": {
        "e_r_deg": (
            39.621, 28.063, 6.376, 48.336, 15.019, 3.954, 8.215, 44.288,
            9.579, 1.058, 5.489, 16.87, 29.966, 6.832,
        ),
        "e_t_m": (
            105.302, 36.386, 60.531, 46.213, 7.067, 22.976, 10.891, 47.04,
            8.642, 5.582, 8.801, 130.142, 125.632, 106.821,
        ),
        "rmsd_m": (
            112.395, 33.748, 52.759, 37.947, 7.274, 24.189, 13.608, 48.299,
            9.993, 5.914, 7.668, 123.813, 133.473, 109.133,
        ),
    },
    "SpinImage+SVD": {
        "e_r_deg": (
            85.024, 149.601, 32.379, 127.438, 24.666, 32.634, 99.331, 52.581,
            179.142, 1.335, 6.251, 16.01, 24.732, 14.331,
        ),
        "e_t_m": (
            211.419, 129.44, 83.437, 83.829, 138.882, 62.072, 246.243, 70.229,
            51.67, 84.605, 54.349, 28.902, 85.737, 70.343,
        ),
        "rmsd_m": (
            200.246, 136.747, 90.904, 87.622, 144.623, 65.976, 263.335, 77.647,
            57.186, 89.912, 55.489, 32.341, 88.333, 76.037,
        ),
    },
    "Predator": {
        "e_r_deg": (
            6.377, 7.193, 23.59, 20.208, 14.112, 10.242, 3.292, 7.888,
            1.115, 1.133, 1.015, 4.125, 1.389, 2.242,
        ),
        "e_t_m": (
            4.782, 10.465, 21.2, 68.037, 31.71, 5.588, 18.964, 6.415,
            1.143, 1.69, 1.82, 6.186, 1.83, 1.97,
        ),
        "rmsd_m": (
            2.805, 11.403, 32.425, 60.327, 38.99, 3.151, 20.726, 6.921,
            1.327, 1.84, 1.749, 5.379, 1.466, 1.379,
        ),
    },
    "GeoTransformer": {
        "e_r_deg": (
            1.901, 5.756, 12.026, 14.928, 45.002, 3.385, 10.246, 9.189,
            1.31, 0.708, 0.297, 8.167, 0.384, 1.558,
        ),
        "e_t_m": (
            8.455, 4.537, 5.12, 10.211, 25.512, 3.944, 6.598, 5.479,
            0.715, 1.346, 1.144, 4.889, 0.918, 1.124,
        ),
        "rmsd_m": (
            6.49, 4.626, 4.381, 12.196, 20.839, 1.674, 10.723, 6.305,
            0.767, 1.708, 1.531, 3.036, 1.002, 1.383,
        ),
    },
    "MT-PCR": {
        "e_r_deg": (
            0.32, 0.504, 0.414, 2.825, 0.892, 0.776, 0.862, 0.511,
            0.4, 0.731, 0.133, 0.586, 0.24, 0.575,
        ),
        "e_t_m": (
            1.156, 1.278, 0.794, 3.021, 1.212, 1.567, 0.827, 1.01,
            0.82, 0.825, 0.395, 1.75, 0.914, 1.007,
        ),
        "rmsd_m": (
            0.372, 1.75, 0.644, 4.128, 1.616, 0.882, 0.981, 1.222,
            0.49, 1.671, 0.271, 0.914, 0.979, 0.713,
        ),
    },
}
# fmt: on
"""Average errors of each method over the combinations, in the order of `COMBINATIONS`."""

TABLE_III: dict[str, tuple[float, float, float]] = {
    "FPFH+TEASER": (36.88, 86.25, 65.0),
    "FPFH+SVD": (2.19, 6.25, 1.5),
    "PLADE": (7.48, 44.75, 5.25),
    "SpinImage+SVD": (0.0, 2.08, 0.0),
    "Predator": (40.44, 81.5, 77.32),
    "GeoTransformer": (63.72, 92.48, 87.64),
    "MT-PCR": (97.25, 96.67, 96.5),
}
"""Success rates in percent by group (5 degrees, 2 m), in the order of `GROUPS`."""

UNPRINTED = ("FPFH+SVD", "SpinImage+SVD")
"""Methods whose rows are commented out in the paper's source."""


class Ablation(NamedTuple):
    """A row of Table IV: which parts are on, and the errors of A03-G05 and of A06-G01."""

    res: bool
    focus: bool
    ie: bool
    a03_g05: tuple[float, float, float]
    a06_g01: tuple[float, float, float]


TABLE_IV = (
    Ablation(False, False, False, (8.033, 10.237, 9.604), (8.408, 20.537, 20.326)),
    Ablation(True, True, True, (0.414, 0.794, 0.644), (0.776, 0.567, 0.882)),
    Ablation(False, True, True, (1.865, 1.738, 0.989), (3.869, 18.502, 16.792)),
    Ablation(True, False, True, (3.083, 3.541, 2.083), (1.941, 9.217, 8.712)),
    Ablation(True, True, False, (9.009, 7.94, 6.932), (4.35, 18.606, 16.339)),
)
"""Errors (degrees, m, RMSD m) with parts switched off. The full method's e_t on A06-G01 differs from
Table II (1.567 m), which is the one to cite."""
