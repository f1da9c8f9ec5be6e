"""Checks of one or two clouds before they are registered: what they are, and what is wrong with them.

The module itself can be called: ``mtpcr_geo.check(source, target)`` is `check_clouds`.
"""

import sys
from types import ModuleType
from typing import Any

from mtpcr_geo.check.describe import CloudFacts
from mtpcr_geo.check.findings import Finding
from mtpcr_geo.check.preflight import CheckReport, check_clouds

__all__ = ["CheckReport", "CloudFacts", "Finding", "check_clouds"]


class _CallableModule(ModuleType):
    """A module that is the function of its name too: a package has one attribute for both."""

    def __call__(self, *args: Any, **options: Any) -> CheckReport:
        """Check one or two clouds, see `check_clouds`."""
        return check_clouds(*args, **options)


sys.modules[__name__].__class__ = _CallableModule
