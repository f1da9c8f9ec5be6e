"""Lets ``python -m mtpcr_geo`` do what ``mtpcr-geo`` does."""

from mtpcr_geo.cli import main

main()
