"""Which stages there are, and how one is made from its options in the JSON."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping
from functools import cache
from typing import Any

from pydantic import ValidationError

from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.suggestions import meant
from mtpcr_geo.pipeline.options import first_problem as first_problem
from mtpcr_geo.pipeline.stage import Stage, StageOptions

_MODULES = ("io", "rasters", "matching", "solving", "export", "project", "register")


@cache
def stage_types() -> dict[str, type[Stage]]:
    """Return every stage the package serves itself, by type, in the order of a run."""
    found: dict[str, type[Stage]] = {}
    for name in _MODULES:
        module = importlib.import_module(f"mtpcr_geo.pipeline.stages.{name}")
        for value in vars(module).values():
            if inspect.isclass(value) and issubclass(value, Stage) and not inspect.isabstract(value):
                kind = getattr(value, "type", None)
                if isinstance(kind, str):
                    found.setdefault(kind, value)
    return found


def unknown_type(label: str, kind: str, valid: list[str]) -> OptionError:
    """Say that there is no such stage, and which one may be meant."""
    own = [known for known in valid if known.startswith("mtpcr.")]
    hint = meant(kind, own if kind.startswith("mtpcr.") else valid)
    return OptionError(f"{label}: there is no stage type {kind!r}{hint}")


def make_options(label: str, model: type[StageOptions], written: Mapping[str, Any]) -> StageOptions:
    """Read a stage's options.

    Raises:
        OptionError: naming the stage and the option; a misspelt one names the nearest valid one.

    """
    # PDAL lets every stage carry user_data, for the user's own use
    options = {key: value for key, value in written.items() if key != "user_data"}
    try:
        return model.model_validate(options)
    except ValidationError as error:
        raise OptionError(f"{label}: {first_problem(error, model)}") from None
