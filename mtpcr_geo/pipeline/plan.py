"""Who serves which stage: this package, or PDAL; and what fits behind what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import MissingPartError, OptionError
from mtpcr_geo.pipeline import safety
from mtpcr_geo.pipeline.grammar import ANY_READER, CLOUD_WRITERS, StageSpec, file_of
from mtpcr_geo.pipeline.pdal import bindings
from mtpcr_geo.pipeline.pdal.switches import Access
from mtpcr_geo.pipeline.registry import make_options, stage_types, unknown_type
from mtpcr_geo.pipeline.stage import Node, Stage
from mtpcr_geo.pipeline.stages.memory import MemoryReader

Kind = Literal["cloud", "pair"]
_PDAL_FAMILIES = ("readers.", "filters.", "writers.")


def plan(
    specs: Sequence[StageSpec],
    *,
    allow_code: bool = False,
    allow_network: bool = False,
    given: Mapping[str, Cloud] | None = None,
) -> list[Node]:
    """Make the stages of a pipeline, in its order.

    Args:
        specs: the linked pipeline.
        allow_code, allow_network: let PDAL stages run code, or reach beyond this machine.
        given: clouds in memory, by the tag of the reader that stands for each.

    Raises:
        OptionError: naming the stage and what is wrong with it.
        MissingPartError: if a stage needs PDAL and PDAL is not there.

    """
    given = given or {}
    access = Access(code=allow_code, network=allow_network)
    safety.check([spec for spec in specs if spec.tag not in given], access)
    by_pdal = served_by_pdal([spec for spec in specs if spec.tag not in given])
    stages: dict[str, Stage] = {}
    for spec in specs:
        if spec.tag in given:
            stages[spec.tag] = MemoryReader(given[spec.tag], spec.tag)
        elif spec.tag in by_pdal:
            from mtpcr_geo.pipeline.pdal.stages import make_pdal_stage

            stages[spec.tag] = make_pdal_stage(spec, access)
        else:
            kind = stage_types()[spec.type]
            stages[spec.tag] = kind(make_options(spec.label, kind.Options, spec.options), spec.tag)
    _check_kinds(specs)
    if by_pdal:
        _connect(specs, stages)
    return [Node(stages[spec.tag], spec.inputs, spec.options) for spec in specs]


def served_by_pdal(specs: Sequence[StageSpec]) -> set[str]:
    """Return which stages PDAL serves: those only it has, and readers and writers right beside them.

    Raises:
        OptionError: if neither knows a stage.
        MissingPartError: if PDAL is needed and not there.

    """
    by_pdal = {spec.tag for spec in specs if _needs_pdal(spec)}
    own = stage_types()
    beside = True
    while beside:
        beside = False
        for spec in specs:
            edges = [(spec.tag, tag) for tag in spec.inputs]
            for edge in edges:
                ends = [end for end in specs if end.tag in edge]
                if len(ends) < 2 or sum(end.tag in by_pdal for end in ends) != 1:
                    continue
                other = next(end for end in ends if end.tag not in by_pdal)
                if other.type.startswith(_PDAL_FAMILIES) and other.type in own and _pdal_has(other):
                    by_pdal.add(other.tag)
                    beside = True
    return by_pdal


def _needs_pdal(spec: StageSpec) -> bool:
    own = stage_types()
    if not spec.type.startswith(_PDAL_FAMILIES):
        if spec.type not in own:
            known = [*own, *bindings.drivers()] if bindings.available() else list(own)
            raise unknown_type(spec.label, spec.type, known)
        return False
    if spec.type in own:
        return not _we_can(spec) and _pdal_has(spec)
    if not bindings.available():
        raise MissingPartError(f"{spec.label} needs PDAL, which is not installed; {bindings.INSTALL}")
    if not _pdal_has(spec):
        raise unknown_type(spec.label, spec.type, [*own, *bindings.drivers()])
    return True


def _we_can(spec: StageSpec) -> bool:
    if "://" in (file_of(spec.options) or ""):
        # PDAL fetches what is elsewhere
        return False
    options = {key: value for key, value in spec.options.items() if key != "user_data"}
    try:
        stage_types()[spec.type].Options.model_validate(options)
    except ValidationError:
        return False
    return spec.type.startswith("readers.") or len(spec.inputs) == 1


def _pdal_has(spec: StageSpec) -> bool:
    return bindings.available() and spec.type in bindings.drivers()


def _connect(specs: Sequence[StageSpec], stages: Mapping[str, Stage]) -> None:
    """Give every PDAL stage what stands before it, and whether PDAL must run once it is reached."""
    from mtpcr_geo.pipeline.pdal.stages import PdalStage

    files: dict[str, Path | None] = {}
    for spec in specs:
        stage = stages[spec.tag]
        name = file_of(spec.options) if spec.type in ("readers.las", "readers.copc") else None
        name = None if name and "://" in name else name
        # the source comes last, and is what mtpcr.apply moves
        files[spec.tag] = Path(name) if name else next((files[t] for t in reversed(spec.inputs)), None)
        if not isinstance(stage, PdalStage):
            continue
        takers = [stages[other.tag] for other in specs if spec.tag in other.inputs]
        stage.upstream = [stages[tag] for tag in spec.inputs]
        stage.for_us = any(not isinstance(taker, PdalStage) for taker in takers)
        stage.boundary = stage.for_us or not takers
        stage.stand_in = files[spec.tag]


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
    of_clouds = ("mtpcr.apply", ANY_READER, *CLOUD_WRITERS)
    if spec.type in of_clouds or not spec.type.startswith("mtpcr."):
        return "cloud"
    return "pair"


def _wanted(spec: StageSpec) -> Kind:
    of_clouds = ("mtpcr.level", "mtpcr.register", *CLOUD_WRITERS)
    if spec.type in of_clouds or not spec.type.startswith("mtpcr."):
        return "cloud"
    return "pair"


def _count(given: Sequence[Kind]) -> str:
    return "one cloud" if len(given) == 1 else f"{len(given)} clouds"
