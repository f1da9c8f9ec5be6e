"""Registration of ground and aerial lidar clouds through bird's-eye-view height images."""

from typing import TYPE_CHECKING, Any

from mtpcr_geo.core.version import __version__

if TYPE_CHECKING:
    from mtpcr_geo.pipeline.api import Pipeline

__all__ = ["Pipeline", "__version__"]


def __getattr__(name: str) -> Any:
    # imported when asked for, so that importing the package costs nothing
    if name == "Pipeline":
        from mtpcr_geo.pipeline.api import Pipeline

        return Pipeline
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
