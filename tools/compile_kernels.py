"""Compile the kernels that the demo calls into numba's per-module cache, in parallel.

``tools/compiled_kernels.csv`` lists them with their argument types and the first rig of the demo
that calls them; a kernel that was not compiled
here is compiled on its first call. Kernels with an explicit signature are compiled when their
module is imported. Kernels that a cached function builds for an element type are listed under that
function's name. Lines that no longer match the code are skipped.

Usage: python tools/compile_kernels.py [--processes N] [--rig RIG]
       python tools/compile_kernels.py --record   (runs the demo, 3 minutes, and lists its kernels)
"""

from __future__ import annotations

import argparse
import csv
import importlib
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, cast

import numpy as np
from numba import config, types
from numba.core.dispatcher import Dispatcher
from numba.core.errors import NumbaError

LIST = Path(__file__).with_name("compiled_kernels.csv")
ORDER = ("flash", "dome", "gradient", "probe")
"""Rigs in the order in which the demo starts them."""
PACKAGES = ("capture", "model", "reconstruction", "rigsim", "skinrig")
_NAMES = {name: getattr(types, name) for name in dir(types)} | {"bool": types.boolean}


def compile_module(rows: list[tuple[str, str, str]]) -> int:
    """Compile the kernels of one module or load them from the cache; return how many failed.

    One process handles a whole module: two processes that write one function's cache lose entries.
    """
    return sum(not _compile(*row) for row in rows)


def _compile(module: str, name: str, signature: str) -> bool:
    try:
        kernel = getattr(importlib.import_module(module), name)
        given = eval(signature, {"__builtins__": {}}, _NAMES)
    except (ImportError, AttributeError, NameError, SyntaxError, TypeError):
        return False
    try:
        if _is_maker(kernel):
            kernel(np.dtype(str(given)).type)
        elif not isinstance(kernel, Dispatcher):
            return False
        elif given not in kernel.signatures:  # else compiled on import
            kernel.compile(given)
    except (NumbaError, TypeError, RuntimeError):  # kernels with own signatures
        return False
    return True


def _is_maker(found: Any) -> bool:
    """Return whether a module attribute is a cached function that builds kernels."""
    return hasattr(found, "cache_info")


def _named(function: Any, given: Any) -> tuple[str, str]:
    """Return name and types under which `_compile` finds the kernel of a function."""
    name, scope = function.__name__, vars(importlib.import_module(function.__module__))
    kernels = [n for n, v in scope.items() if getattr(v, "py_func", None) is function]
    maker = name.lstrip("_")
    if not kernels and _is_maker(scope.get(maker)):
        real = re.search(r"float\d+", str(given))
        return maker, real.group() if real else str(given)
    return (name if name in kernels or not kernels else kernels[0]), str(given)


def listed(rig: str | None = None) -> list[list[tuple[str, str, str]]]:
    """Return module, function and types by module, the slowest to compile first.

    With the name of a rig, return the kernels that the demo's rigs up to this one call.
    """
    seconds: dict[str, float] = {}
    kernels: dict[str, list[tuple[str, str, str]]] = {}
    with LIST.open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream):
            if rig is not None and ORDER.index(row["rig"]) > ORDER.index(rig):
                continue
            module = row["module"]
            seconds[module] = seconds.get(module, 0.0) + float(row["seconds"])
            kernels.setdefault(module, []).append((module, row["function"], row["types"]))
    return [kernels[module] for module in sorted(seconds, key=lambda name: -seconds[name])]


def compile_all(processes: int, rig: str | None = None) -> int:
    """Compile the kernels of `listed` and return how many lines do not match the code."""
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        return sum(pool.map(compile_module, listed(rig)))


def record() -> None:
    """Run the demo in this process and list the module-level kernels that it compiled."""
    config.CACHE_DIR = tempfile.mkdtemp()  # an empty cache: list all
    from numba.core import event

    class Recorder(event.Listener):  # type: ignore[misc]
        def __init__(self) -> None:
            self.began: list[float] = []
            self.found: list[tuple[str, Any, float, Any]] = []
            self.rig = ORDER[0]  # what the demo compiles on import, its first rig waits for

        def on_start(self, _: Any) -> None:
            self.began.append(time.thread_time())

        def on_end(self, event: Any) -> None:
            seconds = time.thread_time() - self.began.pop()
            function = getattr(event.data["dispatcher"], "py_func", None)
            module = getattr(function, "__module__", "") or ""
            if not self.began and module.split(".")[0] in PACKAGES:
                self.found.append((self.rig, function, seconds, event.data["args"]))

    recorder = Recorder()
    with event.install_listener("numba:compile", recorder), tempfile.TemporaryDirectory() as out:
        from skinrig.console import Console  # imported here: some kernels are compiled on import
        from skinrig.demo import run_demo
        from skinrig.demo_rigs import RUN_BY_PART, RigDemo

        def run_recorded(run: RigDemo, rig: str, run_rig: Callable[[RigDemo], None]) -> None:
            recorder.rig = rig
            run_rig(run)

        recorded = {rig: partial(run_recorded, rig=rig, run_rig=RUN_BY_PART[rig]) for rig in ORDER}
        cast(dict[str, Callable[[RigDemo], None]], RUN_BY_PART).update(recorded)
        run_demo(Path(out) / "demo", list(ORDER), console=Console(False), jobs=1)
    rows = []
    for rig, function, seconds, given in recorder.found:  # all modules are fully imported by now
        name, kinds = _named(function, given)
        rows.append(
            {
                "rig": rig,
                "module": function.__module__,
                "function": name,
                "seconds": f"{seconds:.1f}",
                "types": kinds,
            }
        )
    write(rows)


def is_readable(types_text: str) -> bool:
    """Return whether argument types can be read back; those of named tuples cannot."""
    try:
        eval(types_text, {"__builtins__": {}}, _NAMES)
    except (NameError, SyntaxError, TypeError):
        return False
    return True


def write(rows: list[dict[str, Any]]) -> None:
    """Write the readable rows in an order that does not depend on the order of compilation."""
    rows = [row for row in rows if is_readable(row["types"])]
    rows.sort(key=lambda row: (row["module"], row["function"], row["types"]))
    with LIST.open("w", encoding="utf-8", newline="") as stream:
        table = csv.DictWriter(
            stream, ["rig", "module", "function", "seconds", "types"], lineterminator="\n"
        )
        table.writeheader()
        table.writerows(rows)


def main() -> None:
    """Compile the listed kernels, or record the list, as the command line asks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--processes", type=int, default=min(os.cpu_count() or 1, 4))
    parser.add_argument("--rig", choices=ORDER, help="kernels up to this rig of the demo alone")
    parser.add_argument("--record", action="store_true")
    given = parser.parse_args()
    if given.record:
        record()
        return
    missing = compile_all(given.processes, given.rig)
    if missing:
        text = f"compile_kernels: kernels to compile when first called: {missing}"
        print(text, file=sys.stderr)


if __name__ == "__main__":
    main()
