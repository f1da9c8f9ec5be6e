"""The verb ``qgis-plugin``."""

from __future__ import annotations

import inspect
import sys
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from mtpcr_geo.cli.options import ApplyVerb, CheckVerb, QgisPluginVerb, RegisterVerb
from mtpcr_geo.cli.parameters import command_of, help_of, shown_fields, spelling
from mtpcr_geo.cli.shared import say
from mtpcr_geo.core.wording import in_a_line
from mtpcr_geo.pipeline.shown import INPUTS, OUTPUT, Shown

# what a dialog has no use for: it prints nothing, and empty fields say nothing
_LEFT_OUT = ("as_json", "verbose", "quiet", "dump_pipeline", "no_prior")


def run(options: QgisPluginVerb) -> None:
    """Write a plugin for QGIS that offers register, apply and check in its Processing toolbox.

    Install the zip in QGIS: Plugins, Manage and Install Plugins, Install from ZIP. It calls this command.

    Examples:
        mtpcr-geo qgis-plugin
        mtpcr-geo qgis-plugin -o plugin.zip --overwrite

    """
    from mtpcr_geo.export.qgis.plugin_zip import write_plugin
    from mtpcr_geo.io.outputs import OutputSet

    with OutputSet(options.overwrite) as outputs:
        write_plugin(outputs.path(options.out), verbs(), _own_command())
        outputs.commit()
    if not options.quiet:
        say(f"wrote {in_a_line(options.out)}")


def verbs() -> dict[str, Any]:
    """Return help and parameters of register, apply and check as JSON, from the models of their options."""
    from mtpcr_geo.cli import apply, check, register

    models: dict[str, tuple[type[BaseModel], Any]] = {
        "register": (RegisterVerb, register.run),
        "apply": (ApplyVerb, apply.run),
        "check": (CheckVerb, check.run),
    }
    return {
        name: {
            "help": (inspect.getdoc(function) or "").partition("\nExamples:\n")[0].strip(),
            "parameters": [
                _parameter(field_name, field, name)
                for field_name, field in shown_fields(model).items()
                if field_name not in _LEFT_OUT
            ],
        }
        for name, (model, function) in models.items()
    }


def _parameter(name: str, field: FieldInfo, verb: str) -> dict[str, Any]:
    """Return a parameter as the plugin reads it."""
    shown = next(part for part in field.metadata if isinstance(part, Shown))
    kind, choices = _kind(field.annotation)
    if name == "out":
        kind = "out_folder" if verb == "register" else "out_file"
    elif name == "models":
        kind = "folder"
    description = field.description or name
    return {
        "name": name,
        "flag": None if shown.argument else spelling(name, field)[0],
        "kind": kind,
        "choices": choices,
        "default": None if field.is_required() else field.default,
        "required": field.is_required(),
        "label": description[:1].upper() + description[1:].partition(";")[0].partition(": ")[0],
        "help": help_of(field),
        "advanced": not field.is_required() and shown.group not in (INPUTS, OUTPUT),
    }


def _kind(annotation: Any) -> tuple[str, list[str]]:
    """Return what kind of value an option takes, and its choices."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return "choice", [str(part) for part in parts]
    if origin is Annotated:
        return _kind(parts[0])
    if origin in (Union, UnionType):
        kinds = [_kind(part) for part in parts if part is not type(None)]
        return next((kind for kind in kinds if kind[0] == "text"), kinds[0])
    if origin is tuple and len(parts) == 2:
        return "point", []
    plain = {bool: "switch", float: "number", int: "integer", Path: "file"}
    return plain.get(annotation, "text"), []


def _own_command() -> str | None:
    """Return the file of the command that runs, where it is one."""
    path = Path(sys.argv[0]).resolve()
    return str(path) if path.is_file() and path.stem == "mtpcr-geo" else None


command = command_of(QgisPluginVerb, run)
