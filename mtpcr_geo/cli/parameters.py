"""The parameters of a verb, made from the pydantic model of its options.

The model is the only declaration: a field's name, type, default, description and group become those of the
parameter, and the model alone judges the values, so that the command, pipelines and Python refuse the same
values with the same words.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import typer
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.pipeline.options import first_problem
from mtpcr_geo.pipeline.shown import GROUPS, Shown, description_of, shown_of

Model = TypeVar("Model", bound=BaseModel)

_METAVARS: dict[type, str] = {Path: "PATH", int: "INTEGER", float: "NUMBER", str: "TEXT"}


def command_of(
    model: type[Model], run: Callable[[Model], None], rest: str | None = None
) -> Callable[..., None]:
    """Return the function that typer makes a command of: parameters from the model, help from `run`.

    Args:
        model: options of the verb; a field with `Shown` becomes a parameter.
        run: the verb, called with the options once they are read; its docstring is the help.
        rest: field that takes the arguments that are no parameters, if the verb has one.

    """
    parameters = [_parameter(name, field) for name, field in shown_fields(model).items()]

    def verb(context: typer.Context, **given: Any) -> None:
        values: dict[str, Any] = {} if rest is None else {rest: tuple(context.args)}
        for name, field in shown_fields(model).items():
            value = given[_keyword(name, field)]
            # what is not given is the model's to say
            if value is not None and value is not False:
                values[name] = False if _off(field) else value
        run(_read(model, values))

    first = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
    # typer takes a function's parameters from its signature
    verb.__signature__ = inspect.Signature([first, *parameters])  # type: ignore[attr-defined]
    verb.__annotations__ = {one.name: one.annotation for one in (first, *parameters)}
    verb.__doc__ = run.__doc__
    return verb


def shown_fields(model: type[BaseModel]) -> dict[str, FieldInfo]:
    """Return the fields that are parameters of the command, by name: in groups, those required first."""
    shown = {name: field for name, field in model.model_fields.items() if _shown(field) is not None}

    def place(name: str) -> tuple[int, bool]:
        return GROUPS.index((_shown(shown[name]) or Shown("")).group), not shown[name].is_required()

    return {name: shown[name] for name in sorted(shown, key=place)}


def spelling(name: str, field: FieldInfo) -> tuple[str, ...]:
    """Return how a field is written on the command line, the long name first; in capitals, by its place."""
    shown = _shown(field) or Shown("")
    if shown.argument:
        return (name.upper(),)
    return shown.names or (f"--{_keyword(name, field).replace('_', '-')}",)


def help_of(field: FieldInfo) -> str:
    """Return a parameter's help: the field's description as a sentence, and its default."""
    description = field.description or ""
    if _off(field):
        return _sentence(f"do not {description}")
    silent = field.is_required() or field.default is None or field.default is False
    return _sentence(description) + ("" if silent else f" [default: {field.default}]")


def switch(kind: Any) -> Any:
    """Return typer's declaration of a switch, off by default, from the `Annotated` type of its option.

    For functions whose parameters are written out instead of made from a model.
    """
    shown = shown_of(kind)
    return typer.Option(*shown.names, help=_sentence(description_of(kind)), rich_help_panel=shown.group)


def _read(model: type[Model], values: dict[str, Any]) -> Model:
    try:
        return model.model_validate(values)
    except ValidationError as error:
        fields = model.model_fields
        raise OptionError(
            first_problem(
                error, model, lambda name: spelling(name, fields[name])[0] if name in fields else name
            )
        ) from None


def _parameter(name: str, field: FieldInfo) -> inspect.Parameter:
    """Return a parameter as typer wants it: text or a switch, whose value the model reads."""
    shown = _shown(field) or Shown("")
    required = field.is_required()
    declaration: dict[str, Any] = {
        "help": help_of(field),
        "show_default": False,
        "rich_help_panel": shown.group,
    }
    kind: Any = bool
    default: Any = ... if required else None
    if field.annotation is bool:
        default = False
    else:
        named = name.upper() if shown.argument else shown.metavar
        declaration["metavar"] = named or _metavar(field.annotation)
        choices = (field.annotation, *get_args(field.annotation))
        several = next((one for one in choices if get_origin(one) is tuple), None)
        kind = Path if Path in choices else str
        if several is not None and str not in choices:
            kind = tuple[(str,) * len(get_args(several))]  # type: ignore[misc]
    info: Any
    if shown.argument:
        info = typer.Argument(default, **declaration)
    else:
        info = typer.Option(default, *spelling(name, field), **declaration)
    return inspect.Parameter(
        _keyword(name, field), inspect.Parameter.KEYWORD_ONLY, default=info, annotation=kind
    )


def _shown(field: FieldInfo) -> Shown | None:
    return next((part for part in field.metadata if isinstance(part, Shown)), None)


def _off(field: FieldInfo) -> bool:
    """Return whether the parameter turns off what is on by default."""
    return field.annotation is bool and field.default is True


def _keyword(name: str, field: FieldInfo) -> str:
    return f"no_{name}" if _off(field) else name


def _sentence(description: str) -> str:
    return description[:1].upper() + description[1:] + "."


def _metavar(annotation: Any) -> str:
    """Return what stands for a value: the choices, or its kind."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return f"[{'|'.join(map(str, parts))}]"
    if origin in (Union, UnionType):
        return _metavar(next(part for part in parts if part is not type(None)))
    if origin is Annotated:
        return _metavar(parts[0])
    return _METAVARS[annotation]
