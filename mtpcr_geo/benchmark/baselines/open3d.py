"""Open3D, imported only here and only when a baseline needs it."""

from __future__ import annotations

import ctypes
from typing import Any

from mtpcr_geo.core.errors import MissingPartError


def import_open3d() -> Any:
    """Import Open3D, with the libusb of the wheel ``libusb-package`` where the system has none.

    Raises:
        MissingPartError: if Open3D or a system library it needs is not installed.

    """
    try:
        import open3d
    except ImportError:
        try:
            import libusb_package

            ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
            import open3d
        except (ImportError, OSError) as error:
            raise MissingPartError(
                f"this baseline needs Open3D, which cannot be loaded ({error}); "
                "run pip install 'mtpcr-geo[benchmark]', or install the named system library"
            ) from error
    return open3d
