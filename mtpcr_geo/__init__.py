"""Registration of ground and aerial lidar clouds through bird's-eye-view height images.

>>> import mtpcr_geo as mg
>>> registration = mg.register("ground.laz", "aerial.laz")  # doctest: +SKIP
>>> registration.verdict.name  # doctest: +SKIP
'accepted'

Clouds are files, (n, 3) arrays, `laspy.LasData` or `Cloud`. The steps of the method stand alone too, as
functions on arrays: `level`, `make_bev`, `mtpcr_geo.match.correlation.match`, `tie_points_of`,
`solve_tie_points`, `refine`. What is offered here is imported when it is asked for, so that importing the
package costs next to nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from mtpcr_geo.core.version import __version__

if TYPE_CHECKING:
    from mtpcr_geo.check import check_clouds as check
    from mtpcr_geo.core.cloud import Cloud
    from mtpcr_geo.core.errors import MtpcrError
    from mtpcr_geo.core.types import Verdict
    from mtpcr_geo.io.memory import read
    from mtpcr_geo.method.bev import make_bev
    from mtpcr_geo.method.inverse_mapping import tie_points_of
    from mtpcr_geo.method.levelling import level
    from mtpcr_geo.method.refine import refine
    from mtpcr_geo.method.solve import solve_tie_points
    from mtpcr_geo.pipeline.api import Pipeline
    from mtpcr_geo.registration import Registration, apply, register

__all__ = [
    "Cloud",
    "MtpcrError",
    "Pipeline",
    "Registration",
    "Verdict",
    "__version__",
    "apply",
    "check",
    "level",
    "make_bev",
    "read",
    "refine",
    "register",
    "solve_tie_points",
    "tie_points_of",
]

_MODULE_OF = {
    "Cloud": "mtpcr_geo.core.cloud",
    "MtpcrError": "mtpcr_geo.core.errors",
    "Pipeline": "mtpcr_geo.pipeline.api",
    "Registration": "mtpcr_geo.registration",
    "Verdict": "mtpcr_geo.core.types",
    "apply": "mtpcr_geo.registration",
    "level": "mtpcr_geo.method.levelling",
    "make_bev": "mtpcr_geo.method.bev",
    "read": "mtpcr_geo.io.memory",
    "refine": "mtpcr_geo.method.refine",
    "register": "mtpcr_geo.registration",
    "solve_tie_points": "mtpcr_geo.method.solve",
    "tie_points_of": "mtpcr_geo.method.inverse_mapping",
}


def __getattr__(name: str) -> Any:
    if name == "check":
        # the room of that name can be called
        return import_module("mtpcr_geo.check")
    if name in _MODULE_OF:
        value = getattr(import_module(_MODULE_OF[name]), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
