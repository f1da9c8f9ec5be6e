"""Lets ``python -m mtpcr_geo`` do what ``mtpcr-geo`` does."""

from mtpcr_geo.cli.app import main

main()
