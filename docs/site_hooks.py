"""Parts of the pages that are made from the code when the site is built.

A page holds ``<!-- generated: NAME -->`` where the part goes. mkdocs calls `on_page_markdown`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import Any

_MARK = re.compile(r"^<!-- generated: (\w+) -->$", re.MULTILINE)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Return a page's text with its generated parts in place."""
    return _MARK.sub(lambda found: PARTS[found[1]](), markdown)


def method_table() -> str:
    """Return the table step, equation, function, parameter of `mtpcr_geo.method`."""
    import mtpcr_geo.method

    lines = (mtpcr_geo.method.__doc__ or "").splitlines()
    first, _, last = (number for number, line in enumerate(lines) if line.startswith("==="))
    columns = [found.span() for found in re.finditer("=+", lines[first])]
    rows = [[line[start:end].strip() for start, end in columns] for line in lines[first + 1 : last]]
    return _table(rows[0], rows[2:])


def register_options() -> str:
    """Return the options of a registration: name, type, default, description."""
    from mtpcr_geo.pipeline.options import RegisterOptions

    return _options(RegisterOptions)


def stages() -> str:
    """Return the stages of pipelines, in the order of a run, with their options."""
    from mtpcr_geo.pipeline.registry import stage_types
    from mtpcr_geo.pipeline.stage import StageOptions

    common = set(StageOptions.model_fields)
    parts = []
    for name, stage in stage_types().items():
        said = (stage.__doc__ or "").split("\n\n")[0].strip()
        parts += [f"### `{name}`", said, _options(stage.Options, common)]
    return "\n\n".join(part for part in parts if part)


def _options(model: Any, left_out: Iterable[str] = ()) -> str:
    schema = model.model_json_schema()
    required = schema.get("required", [])
    rows = []
    for name, field in schema["properties"].items():
        if name not in left_out:
            default = "required" if name in required else f"`{_json(field.get('default'))}`"
            rows.append([f"`{name}`", _kind(field), default, field.get("description", "")])
    return _table(["option", "type", "default", "what it is"], rows) if rows else ""


def _kind(field: dict[str, Any]) -> str:
    if "anyOf" in field:
        return " or ".join(dict.fromkeys(_kind(one) for one in field["anyOf"] if one.get("type") != "null"))
    if "enum" in field:
        return ", ".join(f"`{value}`" for value in field["enum"])
    if "const" in field:
        return f"`{field['const']}`"
    return str(field.get("type", "object" if "$ref" in field else "any"))


def _json(value: Any) -> str:
    import json

    return json.dumps(value)


def _table(head: list[str], rows: Iterable[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    cells = ([cell.replace("|", "\\|").replace("\n", " ") for cell in row] for row in lines)
    return "\n".join("| " + " | ".join(row) + " |" for row in cells)


PARTS: dict[str, Callable[[], str]] = {
    "method_table": method_table,
    "register_options": register_options,
    "stages": stages,
}
