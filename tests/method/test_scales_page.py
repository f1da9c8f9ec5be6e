"""The page on lengths says what the code does: rules, limits, examples and every constant in metres."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np
import pytest

import mtpcr_geo
from mtpcr_geo.method import bev, scales
from mtpcr_geo.pipeline.stages.matching import FocusOptions
from mtpcr_geo.pipeline.stages.solving import RefineOptions
from mtpcr_geo.verdict.evidence import FAR_TOLERANCES, FAR_TURN_DEG

PACKAGE = Path(mtpcr_geo.__file__).parent
PAGE = PACKAGE.parent / "docs" / "scales.md"
ROOMS = ("method", "match", "verdict", "survey")

pytestmark = pytest.mark.skipif(not PAGE.is_file(), reason="needs docs/ of the checkout beside the package")


def tables() -> list[list[list[str]]]:
    """Return the tables of the page as rows of cells, without their heads."""
    found: list[list[list[str]]] = []
    rows: list[list[str]] = []
    for line in [*PAGE.read_text(encoding="utf-8").splitlines(), ""]:
        if line.startswith("|"):
            rows.append([cell.strip() for cell in line.strip("|").split("|")])
        elif rows:
            found.append(rows[2:])
            rows = []
    return found


def constants() -> dict[str, tuple[float, ...]]:
    """Return the module-level constants of the method's rooms whose names end in _M."""
    values: dict[str, tuple[float, ...]] = {}
    for file in sorted(path for room in ROOMS for path in (PACKAGE / room).rglob("*.py")):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if not isinstance(node, ast.Assign):
                continue
            for target in node.targets:
                several = isinstance(target, ast.Tuple)
                names = [
                    ast.unparse(one) for one in (target.elts if isinstance(target, ast.Tuple) else [target])
                ]
                value = ast.literal_eval(node.value) if any(name.endswith("_M") for name in names) else ()
                for name, one in zip(names, value if several else (value,), strict=False):
                    if name.endswith("_M") and not name.startswith("_"):
                        values[name] = tuple(one) if isinstance(one, tuple) else (float(one),)
    return values


def test_rules_and_limits_are_those_of_the_code() -> None:
    s = scales
    limits = {row[0]: (row[1], row[2]) for row in tables()[0]}
    assert {name: limit for name, (_, limit) in limits.items()} == {
        "cell": f"{bev.FINEST_AUTO_CELL_M:g} to {bev.COARSEST_AUTO_CELL_M:g} m",
        "patch": f"at most {s.MAX_PATCH_M:g} m; where sparse, 1/2 the extent",
        "search radius": f"at most {s.MAX_SEARCH_RADIUS_M:g} m",
        "block": f"at most {s.MAX_BLOCK_M:g} m",
        "least overlap": f"at most {s.MAX_LEAST_OVERLAP_M2:g} m2",
        "terrain cell": f"{s.MIN_TERRAIN_CELL_M:g} to {s.MAX_TERRAIN_CELL_M:g} m, or 4 cells, or "
        f"1/{s.TERRAIN_CELLS_ACROSS:g} of the extent up to {s.MAX_WIDE_TERRAIN_CELL_M:g} m",
        "same pose": f"{s.MIN_SAME_POSE_M:g} to {s.MAX_SAME_POSE_M:g} m",
        "ground cell": f"{s.MIN_GROUND_CELL_M:g} to {s.MAX_GROUND_CELL_M:g} m",
        "tolerance": f"at least {s.MIN_TOLERANCE_M:g} m",
    }
    rules = {name: rule for name, (rule, _) in limits.items()}
    assert f"{bev.POINTS_PER_CELL:g} points" in rules["cell"]
    assert f"1/{bev.CELLS_PER_EXTENT:g} of the extent, or {bev.FINEST_BY_EXTENT_M:g} m" in rules["cell"]
    filled = f"{s.FEWEST_FILLED_IN_PATCH} that are filled in both"
    assert f"at least {s.MIN_PATCH_CELLS} cells and {filled}" in rules["patch"]
    assert f"at least {s.MIN_SEARCH_RADIUS_CELLS} cells" in rules["search radius"]
    assert f"1/{s.BLOCKS_PER_EXTENT:g} of" in rules["block"]
    assert f"1/{1 / s.LEAST_OVERLAP_SHARE:g} of" in rules["least overlap"]


def test_fractions_in_the_rules_hold_between_the_limits() -> None:
    found = scales.scales_for(0.25, 60.0**2)
    assert (found.patch_m, found.search_radius_m) == (60.0 / 4, 60.0 / 16)
    assert found.terrain_cell_m == 60.0 / 8
    assert found.same_pose_m == found.patch_m / 2
    assert scales.ground_cell_for(0.4) == 0.8
    assert scales.tolerance_for(0.75) == 0.75
    xy = np.random.default_rng(0).uniform(0, 100, (4000, 2))
    assert scales.block_for(xy, 0.5) == pytest.approx(90 / 5, rel=0.03)


def test_the_module_lists_the_same_quantities() -> None:
    listed = re.findall(r"^([a-z]+(?: [a-z]+)?)  +\S", scales.__doc__ or "", flags=re.M)
    assert [name for name in listed if name != "length"] == [row[0] for row in tables()[0]]


def test_the_examples_are_what_comes_out() -> None:
    sites = [(500.0, 20.0**2), (69.4, 932.0), (8.0, 5000.0**2)]
    rows = {row[0]: row[1:] for row in tables()[1]}
    for column, (density, area) in enumerate(sites):
        cell = bev.choose_cell([density], float(np.sqrt(area)))
        found = scales.scales_for(cell, area)
        assert {name: row[column] for name, row in rows.items()} == {
            "cell, m": f"{cell:g}",
            "patch, m": f"{found.patch_m:.3g}",
            "search radius, m": f"{found.search_radius_m:.3g}",
            "least overlap, m2": f"{found.least_overlap_m2:.3g}",
            "terrain cell, m": f"{found.terrain_cell_m:.3g}",
            "same pose, m": f"{found.same_pose_m:.3g}",
            "ground cell, m": f"{scales.ground_cell_for(cell):g}",
            "tolerance, m": f"{found.tolerance_m:g}",
        }


def test_every_constant_in_metres_is_on_the_page_with_its_value() -> None:
    ruled = {name for name in vars(scales) if name.endswith("_M")} - {"OCCUPANCY_CELL_M"}
    ruled |= {"FINEST_AUTO_CELL_M", "FINEST_BY_EXTENT_M", "COARSEST_AUTO_CELL_M"}
    known = {name: values for name, values in constants().items() if name not in ruled}
    stated: dict[str, str] = {}
    for row in tables()[2]:
        names = re.findall(r"`(\w+)`", row[0])
        stated |= dict.fromkeys(names, row[1])
        # one number for all of them, or one each
        values = [value for name in names for value in known.get(name, ())]
        numbers = [float(text) for text in row[1].split(", ")]
        assert numbers in (values, values[:1] if len(set(values)) == 1 else values), row[0]
    assert sorted(stated) == sorted(known), "docs/scales.md must name every constant in metres, and no other"


def test_defaults_in_metres_are_on_the_page() -> None:
    text = " ".join(PAGE.read_text(encoding="utf-8").split())
    focus, refine = FocusOptions(), RefineOptions()
    assert f"`voxel` {refine.voxel:g} of `mtpcr.refine`" in text
    assert f"`radius` {focus.radius:g} (" in text
    assert f"`finest` {focus.finest:g} of `mtpcr.focus`" in text
    assert f"farther than {FAR_TOLERANCES:g} tolerances away" in text
    assert f"turned by more than {FAR_TURN_DEG:g} degrees" in text
