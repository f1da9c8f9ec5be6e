"""Advice for pipelines: an option of the command is the option of a stage there."""

from __future__ import annotations

from collections.abc import Sequence

from mtpcr_geo.core import advice
from mtpcr_geo.pipeline.grammar import Element
from mtpcr_geo.pipeline.registry import stage_types

# what the verb `pipeline` and the class `Pipeline` take themselves
_OF_THE_RUN = frozenset({"overwrite", "allow_code", "allow_network"})


def for_command(elements: Sequence[Element]) -> advice.Spelling:
    """Return how options are written behind ``mtpcr-geo pipeline``: ``--level.source_crs=local``."""

    def spelling(name: str, value: str) -> str:
        stage = None if name in _OF_THE_RUN else _stage_with(elements, name)
        if stage is None:
            return f"--{name.replace('_', '-')}{' ' + value if value else ''}"
        # a list is one word for a shell
        said = advice.as_value(value).replace(" ", "") if " " in value else value
        said = "true" if name in advice.SWITCHES else said
        return f"--{stage.tag or stage.type}.{name}{'=' + said if said else ''}"

    return spelling


def for_python(elements: Sequence[Element]) -> advice.Spelling:
    """Return how options are written in a stage: ``"source_crs": "local"`` of level."""

    def spelling(name: str, value: str) -> str:
        stage = None if name in _OF_THE_RUN else _stage_with(elements, name)
        if stage is None:
            return advice.as_keyword(name, value)
        said = "true" if name in advice.SWITCHES else advice.as_value(value) if value else ""
        return f'"{name}"{": " + said if said else ""} of {stage.tag or stage.type}'

    return spelling


def _stage_with(elements: Sequence[Element], name: str) -> Element | None:
    """Return the first stage that has an option."""
    types = stage_types()
    return next(
        (one for one in elements if one.type in types and name in types[one.type].Options.model_fields), None
    )
