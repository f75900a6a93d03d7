"""Open3D on a machine without libusb, which it links to but has no use for here."""

from __future__ import annotations

import ctypes
from types import ModuleType


def import_open3d() -> ModuleType:
    """The module ``open3d``, imported when first asked for (it takes most of a second).

    The wheel of libusb-package brings the library that a bare machine lacks; loaded with global
    symbols before, it is what the dynamic linker finds. Where the wheel has none for the machine,
    the system's is left to be found.
    """
    import libusb_package  # noqa: PLC0415

    library = libusb_package.get_library_path()
    if library is not None:
        ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
    import open3d  # noqa: PLC0415

    return open3d
