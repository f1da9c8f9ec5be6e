"""Why a search came to nothing, in words: what there was, what was wanted, what to do."""

from __future__ import annotations

import numpy as np

from mtpcr_geo.core.types import Bev


def nothing_to_compare(source: Bev, target: Bev, wanted_cells: float, near_prior: bool) -> str:
    """Say why no pose brings two rasters to overlap enough.

    Args:
        source, target: rasters of one cell size.
        wanted_cells: cells that both must fill at a pose for it to be considered.
        near_prior: whether only poses near a prior were considered.

    """
    cell = source.grid.cell
    wanted = int(np.ceil(wanted_cells))
    text = (
        f"no pose brings the rasters to overlap enough to compare: {wanted} cells of {cell:g} m "
        f"({wanted * cell**2:.3g} m2) are wanted in common"
    )
    filled = {"source": int((source.count > 0).sum()), "target": int((target.count > 0).sum())}
    role = "source" if filled["source"] <= filled["target"] else "target"
    if filled[role] < 2 * wanted:
        return (
            f"{text}, and the {role} fills {filled[role]} in all; give a finer cell (option cell) if the "
            "points are dense enough for one, or a larger or denser cloud"
        )
    if near_prior:
        return (
            f"{text}, and none within the range of the prior does; widen it (options within, "
            "yaw_tolerance), or search without the prior"
        )
    return (
        f"{text} (the source fills {filled['source']:,}, the target {filled['target']:,}); they lie in "
        "strips or scattered patches too narrow for that: give a coarser cell (option cell), or clouds "
        "without gaps"
    )
