"""What `run.json` holds is what its module lists, key by key."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from helpers_plots import plot

from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.export import run_json
from mtpcr_geo.io.write import write_cloud
from mtpcr_geo.registration import register

KEYS = re.findall(r"^- ``(.+?)``: ", run_json.__doc__ or "", flags=re.M)
RARE = {
    "mtpcr.level <role>.header_remarks",
    "frames",  # null where no pair was made
    "metrics",  # empty where there is no verdict
    "checks",  # likewise
    "uncertainty",  # null where too little agrees
    "metrics.vertical_offset_m",
    *(f"rivals[].{key}" for key in ("east_m", "north_m", "turn_deg", "margin", "far")),  # on doubtful sites
    "mtpcr.focus why",
    "mtpcr.level <role>.plane_to_verticals_deg",
    "mtpcr.level <role>.verticals_spread_deg",
    # where the scene repeats itself
    "mtpcr.refine slid_m",
    # where a vertical that levelling found was corrected
    "mtpcr.refine levelled_again",
    "mtpcr.refine tilt_deg",
    # where the network was asked to match by itself
    "mtpcr.match second_opinion.margin",
    "mtpcr.match second_opinion.taken",
    # where tie points led elsewhere than the search
    "mtpcr.refine from_search",
    # where surfaces and tie points contradicted each other
    "mtpcr.refine matched_again_cell_m",
    # where the lowest points lead to another height than all others; tests/method/test_common_heights.py
    "mtpcr.refine raised",
    # of matchers that describe all places
    "mtpcr.match agreeing_by_chance",
    # of a registration in a survey; tests/survey holds them to a run
    *(key for key in KEYS if key.startswith("mtpcr.match survey.") or key.endswith("_at_the_place")),
    # where several verticals were tried
    *(
        f"mtpcr.match verticals[].{key}"
        for key in ("source", "target", "source_tilt_deg", "target_tilt_deg", "strength", "margin", "taken")
    ),
}
WHOLE = {"T_target_source", "pipeline", "stages[].options"}  # described elsewhere, whatever they hold


def paths(value: Any, path: str = "") -> Iterator[str]:
    """All keys of a JSON value with a value that is no object, joined by dots; [] for a list of objects."""
    if path in WHOLE or re.fullmatch(r"options\.[^.]+", path):
        yield path
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from paths(inner, f"{path}.{key}" if path else key)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for inner in value:
            yield from paths(inner, path + "[]")
    else:
        yield path


def keys_of(run: dict[str, Any]) -> set[str]:
    found = set()
    for stage in run["stages"]:
        metadata = stage.pop("metadata")
        found |= {f"{stage['type']} {path}" for path in paths(metadata)} | {"stages[].metadata"}
    return found | set(paths(run))


def matches(pattern: str, key: str) -> bool:
    return bool(
        re.fullmatch(re.sub(r"<\w+>", r"[^. ]+", pattern.replace("[]", r"\[\]").replace(".", r"\.")), key)
    )


@pytest.fixture(scope="module")
def found_keys(
    town_files: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, set[str]]:
    found = {}
    runs: dict[str, dict[str, Any]] = {
        "correlation": {"source_crs": "local"},
        "prior": {"prior": "georef"},
        "keypoints": {"profile": "paper", "matcher": "orb"},
        "failed": {"matcher": "orb", "cell": 30.0},
    }
    for name, options in runs.items():
        out = tmp_path_factory.mktemp(name) / "out"
        # one of them with a cloud in memory
        source = laspy.read(town_files[0]) if name == "prior" else town_files[0]
        register(source, town_files[1], out, recording=name == "correlation", **options)
        found[name] = keys_of(json.loads((out / "run.json").read_text()))
    # dense enough for a last, finer round of the refinement
    rng = np.random.default_rng(6)
    out = tmp_path_factory.mktemp("plot") / "out"
    cloud = ArrayCloud(plot(rng, density=200.0), None, "plot")
    write_cloud(out.parent / "plot.laz", cloud, None, None)
    register(
        out.parent / "plot.laz",
        plot(rng, density=200.0) + [3.0, -2.0, 1.0],
        out,
        recording=False,
        source_crs="local",
        target_crs="local",
    )
    found["plot"] = keys_of(json.loads((out / "run.json").read_text()))
    return found


@pytest.mark.parametrize("name", ["correlation", "prior", "keypoints", "failed", "plot"])
def test_every_key_of_a_run_is_listed(found_keys: dict[str, set[str]], name: str) -> None:
    assert [key for key in found_keys[name] if not any(matches(one, key) for one in KEYS)] == []


def test_every_key_listed_is_in_some_run_but_for_rare_ones(found_keys: dict[str, set[str]]) -> None:
    seen = set().union(*found_keys.values())
    missing = {one for one in KEYS if not any(matches(one, key) for key in seen)}
    assert missing <= RARE
