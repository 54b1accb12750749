"""Compile the kernels that the demo calls, into numba's cache beside the modules, in processes.

``tools/compiled_kernels.csv`` names them with their types; without this they are compiled when
they are first called. Kernels whose types stand in their source are compiled as their module is
imported; those that a cached function makes for a type of numbers stand under its name. A line that
does not fit the code any more is left out and costs nothing.

Usage: python tools/compile_kernels.py [--processes N]
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
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numba import config, types
from numba.core.dispatcher import Dispatcher
from numba.core.errors import NumbaError

LIST = Path(__file__).with_name("compiled_kernels.csv")
PACKAGES = ("capture", "model", "reconstruction", "rigsim", "skinrig")
_NAMES = {name: getattr(types, name) for name in dir(types)} | {"bool": types.boolean}


def compile_module(rows: list[tuple[str, str, str]]) -> int:
    """Compile kernels of one module, or load them from the cache, and count those that cannot be.

    One process does a whole module: two that write the cache of one function would lose entries.
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
        elif given not in kernel.signatures:  # else the import has compiled it
            kernel.compile(given)
    except (NumbaError, TypeError, RuntimeError):  # the last of kernels with types of their own
        return False
    return True


def _is_maker(found: Any) -> bool:
    """Tell whether a name of a module is a cached function, which makes kernels."""
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


def listed() -> list[list[tuple[str, str, str]]]:
    """Return module, function and types by module, the slowest to compile first."""
    seconds: dict[str, float] = {}
    kernels: dict[str, list[tuple[str, str, str]]] = {}
    with LIST.open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream):
            module = row["module"]
            seconds[module] = seconds.get(module, 0.0) + float(row["seconds"])
            kernels.setdefault(module, []).append((module, row["function"], row["types"]))
    return [kernels[module] for module in sorted(seconds, key=lambda name: -seconds[name])]


def compile_all(processes: int) -> int:
    """Compile what is listed and return how many lines do not fit the code."""
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        return sum(pool.map(compile_module, listed()))


def record() -> None:
    """Run the demo in this process, and list the module-level kernels it compiled anew."""
    config.CACHE_DIR = tempfile.mkdtemp()  # what is compiled already would not be listed
    from numba.core import event

    class Recorder(event.Listener):  # type: ignore[misc]
        def __init__(self) -> None:
            self.began: list[float] = []
            self.found: list[tuple[Any, float, Any]] = []

        def on_start(self, _: Any) -> None:
            self.began.append(time.thread_time())

        def on_end(self, event: Any) -> None:
            seconds = time.thread_time() - self.began.pop()
            function = getattr(event.data["dispatcher"], "py_func", None)
            module = getattr(function, "__module__", "") or ""
            if not self.began and module.split(".")[0] in PACKAGES:
                self.found.append((function, seconds, event.data["args"]))

    recorder = Recorder()
    with event.install_listener("numba:compile", recorder), tempfile.TemporaryDirectory() as out:
        from skinrig.console import Console  # here: some kernels are compiled as they are imported
        from skinrig.demo import run_demo
        from skinrig.demo_rigs import RIGS

        run_demo(Path(out) / "demo", list(RIGS), console=Console(False), jobs=1)
    rows = []
    for function, seconds, given in recorder.found:  # all modules are whole by now
        name, kinds = _named(function, given)
        rows.append(
            {
                "module": function.__module__,
                "function": name,
                "seconds": f"{seconds:.1f}",
                "types": kinds,
            }
        )
    write(rows)


def write(rows: list[dict[str, Any]]) -> None:
    """Write the list, in an order that does not depend on the run's."""
    rows.sort(key=lambda row: (row["module"], row["function"], row["types"]))
    with LIST.open("w", encoding="utf-8", newline="") as stream:
        table = csv.DictWriter(
            stream, ["module", "function", "seconds", "types"], lineterminator="\n"
        )
        table.writeheader()
        table.writerows(rows)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--processes", type=int, default=min(os.cpu_count() or 1, 4))
    parser.add_argument("--record", action="store_true")
    given = parser.parse_args()
    if given.record:
        record()
        return
    missing = compile_all(given.processes)
    if missing:
        print(f"compile_kernels: {missing} kernels are compiled when first called", file=sys.stderr)


if __name__ == "__main__":
    main()
