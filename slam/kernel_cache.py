"""Whether the kernels still have to be compiled: what a first run spends its time on."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType


def kernels_are_compiled() -> bool:
    """Whether Numba's cache holds code of every kernel module that is loaded, as it is now.

    Numba compiles again what is older than its source file. Another processor or version of Numba
    on the same cache shows only when it happens.
    """
    packages = ("frontend", "backend", "slam")
    modules = [
        module
        for name, module in sorted(sys.modules.items())
        if name.startswith(packages) and name.endswith("_kernels")
    ]
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
