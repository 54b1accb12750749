"""Register the plugins when Mitsuba is imported, without importing it now.

Mitsuba loads LLVM at its import, so that `rigsim.mitsuba.startup` first chooses the library. The
choice alone needs this package without Mitsuba.
"""

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import ModuleType
from typing import Final

from rigsim.mitsuba.plugins import register

MITSUBA_MODULE: Final = "mitsuba"


def register_on_import() -> None:
    """Register the plugins now where Mitsuba is imported already, otherwise at its import."""
    if MITSUBA_MODULE in sys.modules:
        register(sys.modules[MITSUBA_MODULE])
    else:
        sys.meta_path.insert(0, _RegisteringFinder())


class _RegisteringLoader(SourceFileLoader):
    """Loader of Mitsuba that registers the plugins at its end."""

    def exec_module(self, module: ModuleType) -> None:
        super().exec_module(module)
        # Mitsuba replaces its module during the import
        register(sys.modules[MITSUBA_MODULE])


class _RegisteringFinder(MetaPathFinder):
    """Finder of Mitsuba alone; Python's own finder locates it."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != MITSUBA_MODULE:
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _RegisteringLoader(spec.loader.name, spec.loader.path)
        return spec
