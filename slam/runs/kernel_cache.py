"""Whether the kernels still have to be compiled: what a first run spends its time on."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

OF_A_RUN = ("frontend.", "backend.", "slam.mapping.occupancy_kernels")
ON_DEMAND = (
    "frontend.place_search_kernels",
    "frontend.view_kernels",
    "backend.free_space_kernels",
)
"""Compiled only where a drive comes to a place again or scans are sparse; a second or two."""
OF_VIEWS = ("fusion.depth_kernels", "fusion.compensation_kernels", "fusion.sweep_kernels")


def kernels_are_compiled(*, views: bool = False) -> bool:
    """Whether Numba's cache holds code of the kernel modules that a run uses, as they are now.

    views : those that fuse depth images, too.

    Numba compiles again what is older than its source file. Another processor or version of Numba
    on the same cache shows only when it happens.
    """
    modules = [
        module
        for name, module in sorted(sys.modules.items())
        if name.startswith(OF_A_RUN) and name.endswith("_kernels") and name not in ON_DEMAND
    ]
    if views:
        modules += [import_module(name) for name in OF_VIEWS]
    return all(_is_cached(module) for module in modules)


def _is_cached(module: ModuleType) -> bool:
    source = Path(module.__file__ or "")
    folders = {kernel.stats.cache_path for kernel in vars(module).values() if _is_kernel(kernel)}
    changed = source.stat().st_mtime
    return any(
        index.stat().st_mtime >= changed
        for folder in sorted(filter(None, folders))
        for index in Path(folder).glob(f"{source.stem}.*.nbi")
    )


def _is_kernel(value: object) -> bool:
    return hasattr(value, "py_func") and hasattr(value, "stats")
