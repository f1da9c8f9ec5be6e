"""Which methods the benchmark has, and how one is made from its name.

A method is named on the command line by its name and, after a colon, its options:
``fpfh-ransac:voxel=1.5,icp=false``. The label in the tables is that text.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mtpcr_geo.benchmark.baselines.open3d import import_open3d
from mtpcr_geo.benchmark.estimate import Method
from mtpcr_geo.core.errors import MissingPartError, OptionError
from mtpcr_geo.core.suggestions import meant


@dataclass(frozen=True)
class _Entry:
    module: str
    factory: str
    needs: tuple[str, ...] = ()
    advice: str = "pip install 'mtpcr-geo[benchmark]'"


_OPEN3D = "mtpcr_geo.benchmark.baselines.fpfh"
_KISS = "mtpcr_geo.benchmark.baselines.kiss"
METHODS: dict[str, _Entry] = {
    "mtpcr-geo": _Entry(
        "mtpcr_geo.benchmark.own_method",
        "RegistrationMethod",
        ("cv2", "scipy.fft", "scipy.ndimage", "scipy.spatial", "small_gicp"),
    ),
    "icp": _Entry("mtpcr_geo.benchmark.baselines.icp", "PointToPointIcp", ("small_gicp",)),
    "fpfh-svd": _Entry(_OPEN3D, "FpfhSvd", ("open3d",)),
    "fpfh-ransac": _Entry(_OPEN3D, "FpfhRansac", ("open3d",)),
    "fpfh-fgr": _Entry(_OPEN3D, "FpfhFgr", ("open3d",)),
    "fpfh-kiss-solver": _Entry(_KISS, "FpfhKissSolver", ("open3d", "kiss_matcher")),
    "kiss-matcher": _Entry(_KISS, "KissMatcher", ("kiss_matcher",)),
    "fpfh-teaser": _Entry(
        "mtpcr_geo.benchmark.baselines.teaser",
        "FpfhTeaser",
        ("open3d", "teaserpp_python"),
        "build TEASER++'s Python binding, which no package index has",
    ),
    "external": _Entry("mtpcr_geo.benchmark.baselines.external", "External"),
}
_RENAMED = {"fpfh-gnc": "fpfh-kiss-solver"}


def make_method(spec: str) -> Method:
    """Make a method from its name and options.

    Raises:
        OptionError: if there is no such method or option.
        MissingPartError: if a library it needs is not installed.

    """
    name = spec.partition(":")[0]
    entry = METHODS.get(name)
    if entry is None:
        hint = meant(_RENAMED.get(name, name), list(METHODS)) or f"; choose from {', '.join(METHODS)}"
        raise OptionError(f"there is no benchmark method {name!r}{hint}")
    for library in entry.needs:
        if importlib.util.find_spec(library) is None:
            raise MissingPartError(
                f"the method {name} needs {library}, which is not installed: {entry.advice}"
            )
    factory: Callable[..., Method] = getattr(importlib.import_module(entry.module), entry.factory)
    options = options_of(spec)
    known = inspect.signature(factory).parameters
    if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in known.values()):
        for key in options:
            if key not in known:
                raise OptionError(f"the method {name} has no option {key!r}{meant(key, list(known))}")
    try:
        return factory(**options)
    except (TypeError, ValueError) as error:
        raise OptionError(f"the method {spec!r} cannot be made: {error}") from error


def load_libraries(spec: str) -> None:
    """Import what a method uses, so that the time of its first run is not that of loading."""
    for library in METHODS[spec.partition(":")[0]].needs:
        if library == "open3d":
            import_open3d()
        else:
            importlib.import_module(library)


def options_of(spec: str) -> dict[str, Any]:
    """Read the options in a method's text: numbers, yes and no, or text.

    Raises:
        OptionError: if one is not of the form ``option=value``.

    """
    options: dict[str, Any] = {}
    for part in filter(None, spec.partition(":")[2].split(",")):
        key, equals, value = part.partition("=")
        if not equals:
            raise OptionError(f"in the method {spec!r}, {part!r} is not of the form option=value")
        options[key.strip()] = _value(value.strip())
    return options


def _value(text: str) -> Any:
    if text.lower() in ("true", "yes", "false", "no"):
        return text.lower() in ("true", "yes")
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
