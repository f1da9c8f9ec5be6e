"""The verb ``models``."""

from __future__ import annotations

import typer

from mtpcr_geo.cli.options import ModelsVerb
from mtpcr_geo.cli.parameters import command_of
from mtpcr_geo.cli.shared import json_text, say


def run(options: ModelsVerb) -> None:
    """List the learned matchers: which files are there, their licences, and who publishes those missing.

    Examples:
        mtpcr-geo models
        mtpcr-geo models --models ~/models --json

    """
    from mtpcr_geo.match.learned.model_cards import VARIABLE, inventory, models_folder

    folder = models_folder(options.models)
    found = list(inventory(folder))
    if options.as_json:
        typer.echo(json_text({"folder": folder, "models": found}))
        return
    say(f"models folder: {folder}" if folder else f"no models folder (give --models, or set {VARIABLE})")
    for model in found:
        say(f"\n{model['name']}: {model['title']}{'' if model['usable'] else ' - not usable yet'}")
        for name, file in model["files"].items():
            say(f"  {name}: " + (f"sha256 {file['sha256']}" if file else "missing"))
        say(f"  licence: {model['licence']}")
        if model["terms"]:
            say(f"  terms: {model['terms']}")
        say(f"  published by: {model['project']}")
    say("\ncorrelation, rootsift and orb need no files and are always there")


command = command_of(ModelsVerb, run)
