"""Who serves which stage: this package, or PDAL; and what fits behind what."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from mtpcr_geo.errors import OptionError
from mtpcr_geo.pipeline.grammar import StageSpec
from mtpcr_geo.pipeline.registry import make_options, stage_types, unknown_type
from mtpcr_geo.pipeline.stage import Stage

if TYPE_CHECKING:
    from mtpcr_geo.pipeline.runner import Settings

Kind = Literal["cloud", "pair"]


def plan(specs: Sequence[StageSpec], settings: Settings) -> dict[str, Stage]:
    """Make the stages of a pipeline, by tag, in its order.

    Raises:
        OptionError: naming the stage and what is wrong with it.
        MissingPartError: if a stage needs PDAL and PDAL is not there.

    """
    own = stage_types()
    stages: dict[str, Stage] = {}
    for spec in specs:
        if spec.type not in own:
            raise unknown_type(spec.label, spec.type, list(own))
        kind = own[spec.type]
        stages[spec.tag] = kind(make_options(spec.label, kind.Options, spec.options), spec.tag)
    _check_kinds(specs)
    return stages


def _check_kinds(specs: Sequence[StageSpec]) -> None:
    """Find stages that are given a cloud where they need a pair, or the other way round."""
    made: dict[str, Kind] = {}
    for spec in specs:
        given = [made[tag] for tag in spec.inputs]
        made[spec.tag] = _kind_made(spec)
        if not spec.inputs:
            continue
        wanted = _wanted(spec)
        if wanted == "cloud" and "pair" in given:
            raise OptionError(
                f"{spec.label} needs a cloud and gets a pair of clouds; put mtpcr.apply before it, "
                "which moves the source"
            )
        if wanted == "pair" and "cloud" in given:
            raise OptionError(
                f"{spec.label} needs a pair of clouds and gets {_count(given)}; put mtpcr.level, or a later "
                "mtpcr stage, before it"
            )
        if wanted == "pair" and len(given) > 1:
            raise OptionError(f"{spec.label} takes one pair and gets {len(given)}; name one in its inputs")
        if spec.type == "mtpcr.register" and len(given) != 2:
            raise OptionError(
                f"{spec.label} takes two clouds, the fixed one (target) first, and gets {_count(given)}; "
                "name them in its inputs"
            )
        if spec.type == "mtpcr.level" and len(given) > 2:
            raise OptionError(
                f"{spec.label} takes two clouds, the fixed one (target) first, or one, and gets "
                f"{len(given)}; join others before by PDAL's filters.merge"
            )


def _kind_made(spec: StageSpec) -> Kind:
    if spec.type == "mtpcr.apply" or not spec.type.startswith("mtpcr."):
        return "cloud"
    return "pair"


def _wanted(spec: StageSpec) -> Kind:
    if spec.type in ("mtpcr.level", "mtpcr.register") or not spec.type.startswith("mtpcr."):
        return "cloud"
    return "pair"


def _count(given: Sequence[Kind]) -> str:
    return "one cloud" if len(given) == 1 else f"{len(given)} clouds"
