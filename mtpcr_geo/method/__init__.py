"""The method of MT-PCR, step by step: functions on arrays, which return arrays and small dataclasses.

The table gives the function of each step of the paper. A name is relative to ``mtpcr_geo.method`` unless it
starts with ``mtpcr_geo``. The last column names the parameter of the function that selects the form, with the
paper's first; the docstring of the function describes them all.

=================  ========  =======================================  ======================================
Step               Equation  Function                                 Paper's form, other forms
=================  ========  =======================================  ======================================
1 Levelling                  `levelling.level`                        mode: "ransac", "auto"
2 Resolution       Eq. 1     `bev.resolution_of`                      area_m2: of the bounding box, occupied
                             `bev.choose_cells`                       resolution: "eq1", "eq1_occupied", ...
3 Height raster    Eq. 2     `bev.make_bev`, `bev.rasterise`          convention: "ceil", "centre"
3 Grey values      Eq. 3     `images.grey`                            printed: True, False
4 Enhancement      Eq. 4     `images.enhance`                         gain: "saturated", "normalised"
3 and 4 in one     Eq. 3-4   `images.image_of`                        look: "paper", "band_pass", ...
5 Matching                   `mtpcr_geo.match.registry.make_matcher`  name: "superpoint", "bev", ...
6 FOCUS                      `focus.focus`                            settings: theta, radius_m, finer
7 Inverse mapping  Eq. 5     `inverse_mapping.inverse_mapping`        pixel: "printed", "ceil", "centre"
                             `inverse_mapping.tie_points_of`          surface: "grey", "top", "ground"
8 Iterative SVD              `solve.iterative_svd`                    start: None, a robust start
                             `solve.solve_tie_points`                 robust_start: False, True
8 ICP                        `refine.refine`                          method: "point_to_point", "gicp"
                             `icp.Surfaces.descend`                   method: likewise
=================  ========  =======================================  ======================================

Eq. 3 and Eq. 5 cannot work as printed: ``printed=True`` leaves an image of 0 and 255, and ``pixel="printed"``
puts all points on one line. The profile "paper" of a registration therefore takes ``printed=False`` and
``pixel="ceil"``, and the paper's form of everything else. The one more exception is the image of Eq. 3 and 4:
a learned matcher whose weights were trained on another one ("bev" on "band_pass") is shown that.

Not in the paper: `overlap` (the ground that both clouds see), `downsample` (thinning by voxels),
`neighbourhoods` (the shape of a point's surroundings), the settling of heights on the ground in `refine`, and
in `images` the band-passed height and the step edges, which the default matcher correlates.

Most of the functions can be imported from here (see ``__all__``) and are loaded when asked for. `focus`,
`inverse_mapping` and `refine` are modules here; each holds the function of its name.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mtpcr_geo.method.bev import cell_of, choose_cells, make_bev, rasterise, resolution_of
    from mtpcr_geo.method.icp import Surfaces
    from mtpcr_geo.method.images import enhance, grey, image_of
    from mtpcr_geo.method.inverse_mapping import tie_points_of
    from mtpcr_geo.method.levelling import level
    from mtpcr_geo.method.solve import iterative_svd, solve_tie_points

__all__ = [
    "Surfaces",
    "cell_of",
    "choose_cells",
    "enhance",
    "grey",
    "image_of",
    "iterative_svd",
    "level",
    "make_bev",
    "rasterise",
    "resolution_of",
    "solve_tie_points",
    "tie_points_of",
]

_MODULE_OF = {
    "Surfaces": "icp",
    "cell_of": "bev",
    "choose_cells": "bev",
    "enhance": "images",
    "grey": "images",
    "image_of": "images",
    "iterative_svd": "solve",
    "level": "levelling",
    "make_bev": "bev",
    "rasterise": "bev",
    "resolution_of": "bev",
    "solve_tie_points": "solve",
    "tie_points_of": "inverse_mapping",
}


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
