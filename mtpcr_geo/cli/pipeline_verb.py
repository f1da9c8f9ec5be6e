"""What the verb `pipeline` does, behind its thin function in the command."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.progress import Progress
from mtpcr_geo.io.outputs import OutputSet
from mtpcr_geo.pipeline import grammar
from mtpcr_geo.pipeline.api import metadata_of, read_text
from mtpcr_geo.pipeline.runner import RunResult, Settings, execute, validate


def run_pipeline(
    file: Path,
    arguments: Sequence[str],
    *,
    check: bool,
    metadata: Path | None,
    overwrite: bool,
    allow_code: bool,
    allow_network: bool,
    progress: Progress,
) -> RunResult | None:
    """Read a pipeline, change it as the arguments say, and run it, or only check it (None then).

    Raises:
        MtpcrError: for whatever a user can cause.

    """
    where = "standard input" if str(file) == "-" else str(file)
    elements = grammar.parse(read_text(file), where)
    grammar.override(elements, overrides_of(arguments))
    specs = grammar.link(elements)
    settings = Settings(overwrite=overwrite, allow_code=allow_code, allow_network=allow_network)
    if check:
        validate(specs, settings)
        return None
    with OutputSet(overwrite) as outputs:
        part = outputs.path(metadata) if metadata else None
        result = execute(specs, settings, progress)
        if part is not None:
            part.write_text(_json(metadata_of(result)), encoding="utf-8")
        outputs.commit()
    return result


def overrides_of(arguments: Sequence[str]) -> list[str]:
    """Read what is left of the command line as overrides, ``--name.option=value`` or with a space.

    Raises:
        OptionError: if something else is among it.

    """
    found: list[str] = []
    left = list(arguments)
    while left:
        word = left.pop(0)
        if not word.startswith("--") or "." not in word.partition("=")[0]:
            raise OptionError(f"unexpected argument {word!r}; overrides are written --stage.option=value")
        if "=" not in word:
            if not left:
                raise OptionError(f"the override {word} has no value; write {word}=value")
            word = f"{word}={left.pop(0)}"
        found.append(word)
    return found


def print_schema() -> None:
    """Print the JSON Schema of pipelines."""
    from mtpcr_geo.pipeline.schema import pipeline_schema

    print(json.dumps(pipeline_schema(), indent=2))


def print_models(folder: Path | None, *, as_json: bool) -> None:
    """Print which learned matchers there are, and which of their files."""
    from mtpcr_geo.match.learned.model_cards import VARIABLE, inventory, models_folder

    where = models_folder(folder)
    found = list(inventory(where))
    if as_json:
        print(_json({"folder": where, "models": found}))
        return
    print(f"models folder: {where}" if where else f"no models folder (give --models, or set {VARIABLE})")
    for model in found:
        print(f"\n{model['name']}: {model['title']}{'' if model['usable'] else ' - not usable yet'}")
        for name, file in model["files"].items():
            print(f"  {name}: " + (f"sha256 {file['sha256']}" if file else "missing"))
        print(f"  licence: {model['licence']}")
        if model["terms"]:
            print(f"  terms: {model['terms']}")
        print(f"  published by: {model['project']}")
    print("\ncorrelation, rootsift and orb need no files and are always there")


def print_outcome(result: RunResult | None, *, as_json: bool, verbose: bool, quiet: bool) -> None:
    """Print what a pipeline came to: its verdict if it has one, and its files."""
    if result is None:
        if as_json:
            print(json.dumps({"valid": True}))
        elif not quiet:
            print("the pipeline is valid")
        return
    if as_json:
        verdict = result.verdict
        print(
            _json(
                {
                    "verdict": verdict.name if verdict else None,
                    "reasons": list(verdict.reasons) if verdict else [],
                    "outputs": [str(path) for path in result.outputs],
                    **metadata_of(result),
                }
            )
        )
    elif not quiet:
        from rich.console import Console

        from mtpcr_geo.cli.summary import print_run

        print_run(Console(highlight=False), result, verbose=verbose)


def _json(value: Any) -> str:
    from mtpcr_geo.export.run_json import plain

    return json.dumps(plain(value), indent=2, allow_nan=False)
