"""JSON Schema of pipelines, from the option models, so that editors complete and check."""

from __future__ import annotations

from typing import Any

from mtpcr_geo.pipeline.pdal import bindings
from mtpcr_geo.pipeline.registry import stage_types

_TAG = {"type": "string", "pattern": "^[A-Za-z][A-Za-z0-9_]*$", "description": "name of this stage"}
_INPUTS = {
    "anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}}],
    "description": "tags of the stages this one takes from; all current ones if not given",
}
_REPEATABLE = {"type": ["string", "number", "boolean", "object", "array", "null"]}


def pipeline_schema() -> dict[str, Any]:
    """Return the JSON Schema of a pipeline: our stages in full, and PDAL's as far as PDAL is here to ask."""
    definitions: dict[str, Any] = {}
    stages = [_own(kind, definitions) for kind in stage_types()]
    if bindings.available():
        known = stage_types()
        stages += [_pdal(driver) for driver in bindings.drivers().values() if driver.name not in known]
    else:
        pattern = {"type": "string", "pattern": "^(readers|filters|writers)\\."}
        stages.append({"type": "object", "required": ["type"], "properties": {"type": pattern}})
    elements = {
        "type": "array",
        "minItems": 1,
        "items": {
            "anyOf": [
                {"type": "string", "description": "file to read, or to write if it comes last"},
                {"type": "object", "required": ["filename"], "not": {"required": ["type"]}},
                *stages,
            ]
        },
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "mtpcr-geo pipeline",
        "anyOf": [
            elements,
            {"type": "object", "required": ["pipeline"], "properties": {"pipeline": elements}},
        ],
        "$defs": definitions,
    }


def _own(kind: str, definitions: dict[str, Any]) -> dict[str, Any]:
    stage = stage_types()[kind]
    schema = stage.Options.model_json_schema(ref_template="#/$defs/{model}")
    definitions |= schema.pop("$defs", {})
    # PDAL knows more options of the stages that both serve
    closed = kind.startswith("mtpcr.")
    return {
        "type": "object",
        "description": (stage.__doc__ or "").strip().splitlines()[0],
        "required": ["type", *schema.get("required", [])],
        "properties": {
            "type": {"const": kind},
            "tag": _TAG,
            "inputs": _INPUTS,
            "user_data": {},
            **schema.get("properties", {}),
        },
        "additionalProperties": not closed,
    }


def _pdal(driver: bindings.Driver) -> dict[str, Any]:
    options = {
        name: {**_REPEATABLE, "description": description} for name, description in driver.options.items()
    }
    return {
        "type": "object",
        "description": driver.description,
        "required": ["type"],
        "properties": {"type": {"const": driver.name}, "tag": _TAG, "inputs": _INPUTS, **options},
        "additionalProperties": not driver.options,
    }
