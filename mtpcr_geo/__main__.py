"""Run the command: ``python -m mtpcr_geo`` does what ``mtpcr-geo`` does."""

from mtpcr_geo.cli.app import command

command()
