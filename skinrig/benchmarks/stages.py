"""Run the stages of `skinrig bench` within a time budget and collect one document."""

import json
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from reconstruction.pipeline.checkpoints import code_digest
from reconstruction.pipeline.product_file import PRODUCT_PACKAGES
from skinrig.atomic_file import write_atomically
from skinrig.benchmarks import plan as bench_plan
from skinrig.benchmarks import table as bench_table
from skinrig.benchmarks.document import to_document
from skinrig.benchmarks.results import StageBenchmark
from skinrig.benchmarks.stage import BenchmarkStage, read_descriptions
from skinrig.console import Console, to_json_value
from skinrig.errors import EXIT_EXTRA_MISSING, exit_code, format_error, require_choice
from skinrig.workspace import read_document

STAGES: dict[str, str] = {name: entry["run"] for name, entry in read_descriptions().items()}
"""Module and function by stage. A module is imported, and its kernels are compiled, when the stage
runs."""


MEASURED_PACKAGES = (*PRODUCT_PACKAGES, "rigsim", "skinrig")
"""Packages whose code determines the results of a stage."""

INTERRUPTED_REASON = "the run ended before all of it was measured"
"""Reason recorded for each stage that an interrupted run did not measure."""


class BenchError(ValueError):
    """Stage name that the table of stages does not contain."""


def _iterate_results(
    name: str, *, toy: bool, smoke: bool = False, selection: str = ""
) -> Iterator[StageBenchmark]:
    """Yield the stage's results: a long stage after each of its parts, any stage at its end."""
    module, function = STAGES[name].rsplit(".", 1)
    stage = BenchmarkStage(name, toy=toy, smoke=smoke, selection=selection)
    run = getattr(import_module(f"skinrig.benchmarks.{module}"), function)
    for _ in run(stage) or ():
        yield stage.to_benchmark()
    yield stage.to_benchmark()


def run_stages(
    names: Sequence[str] | None,
    *,
    budget_s: float,
    toy: bool,
    out: Path | None,
    console: Console,
    selection: str = "",
) -> dict[str, Any]:
    """Measure stages within a budget, and return the document of the run.

    Parameters
    ----------
    names
        Keys of :data:`STAGES`, each measured at full size. None: all at small size, then those
        that fit into the budget at full size, the quickest first; finished stages of an earlier
        run are not measured again.
    budget_s
        Time budget in seconds; a stage that would begin after its end is omitted, and listed
        unless an earlier run finished it.
    toy
        Whether to measure small sizes only, with a single call of each function, which checks that
        the benchmark runs.
    out
        Folder for ``bench.json``; None writes nothing. Stages that this run does not measure are
        kept from an earlier document of the same code, versions, machine and ``toy``.
    console
        Receives results and progress.
    selection
        Rig that the stage of whole captures measures; empty: all rigs.

    Returns
    -------
    dict
        Schema ``skinrig.bench/2``. Each stage has a ``size``. Limits are evaluated at full size
        only; ``not_judged`` lists the stages measured at small size.

    Raises
    ------
    BenchError
        For an unknown stage.
    """
    chosen = list(dict.fromkeys(names)) if names else bench_plan.order_small_stages(STAGES)
    for name in chosen:
        require_choice("stage", name, STAGES, BenchError)
    small = toy or not names
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)  # folder errors are raised before any stage runs
    run = _Run(console, time.perf_counter() + budget_s, requested=bool(names), toy=toy, out=out)
    run.selection = selection
    if out is not None:
        run.keep_earlier(out / "bench.json")
    if not names:
        chosen = [name for name in chosen if name not in run.list_finished()]
    run.to_do = list(chosen)
    for name in chosen:
        run.measure(name, "small" if small else "full")
    if small and not toy:
        run.measure_full_sizes()
    document = run.document()
    bench_table.print_tables(document, console)
    return document


Size = Literal["small", "full"]


@dataclass(slots=True)
class _Run:
    """State of a run: results so far, stages to do, time left."""

    console: Console
    deadline_s: float
    """End of the budget on the clock of `time.perf_counter`, s."""
    requested: bool
    """Whether stages were requested by name; a missing optional package is then an error."""
    toy: bool = False
    selection: str = ""
    """Rig that the stage of whole captures measures; empty: all rigs."""
    out: Path | None = None
    """Folder of the document, which is written after each stage; None writes nothing."""
    to_do: list[str] = field(default_factory=list)
    """Stages that were not measured yet at any size."""
    done: dict[str, StageBenchmark] = field(default_factory=dict)
    size: dict[str, Size] = field(default_factory=dict)
    compile_s: dict[str, float] = field(default_factory=dict)
    omitted: list[tuple[str, str]] = field(default_factory=list)
    earlier: dict[str, Any] = field(default_factory=lambda: {"stages": {}, "left_out": []})
    """Document of an earlier run, whose stages are kept until they are measured again."""

    def keep_earlier(self, path: Path) -> None:
        """Keep the stages of an earlier document if it is comparable; report what happens to it."""
        if not path.exists():
            return
        earlier = read_document(path) or {}
        own = to_json_value(self.document())
        same = ("schema", "machine", "skin_bands", "code", "toy")
        if any(earlier.get(key) != own[key] for key in same):
            self.console.print_line(
                f"{path}: of other code, versions, machine or sizes; this run replaces it"
            )
            return
        for stage in earlier["stages"].values():
            for row in (*stage["points"], *stage["limits"], *stage["by_band"]):
                row.update({k: math.nan for k in ("error", "got") if row.get(k, 0) is None})
        self.earlier = earlier
        self.console.print_line(f"{path}: continued, has {', '.join(earlier['stages']) or 'none'}")

    def list_finished(self) -> set[str]:
        """Return the stages that an earlier run of the same selection measured to their end."""
        stages = self.earlier["stages"].items()
        same = {name for name, stage in stages if stage["selection"] == self.selection}
        return same - {name for name, _ in self.earlier["left_out"]}

    def measure(self, name: str, size: Size) -> float:
        """Measure a stage if the budget allows, and return the elapsed seconds."""
        began = time.perf_counter()
        self._measure(name, size, began)
        if name in self.to_do:
            self.to_do.remove(name)
        self.save()
        return time.perf_counter() - began

    def save(self) -> None:
        """Write the document so far, so that an interrupted run keeps its results."""
        if self.out is not None:
            text = json.dumps(to_json_value(self.document()), indent=1, sort_keys=True)
            write_atomically(self.out / "bench.json", text + "\n")

    def _measure(self, name: str, size: Size, began: float) -> None:
        if began > self.deadline_s:
            self.omitted.append((name, "the budget was used up"))
            return
        self.console.progress(f"bench {name}, {size} size")
        try:
            made_so_far = _iterate_results(
                name, toy=size == "small", smoke=self.toy, selection=self.selection
            )
            for made in made_so_far:
                if name in self.to_do:
                    self._take(name, made, size)
                    self.save()
        except ImportError as error:
            if self.requested or exit_code(error) != EXIT_EXTRA_MISSING:
                raise
            self.omitted.append((name, format_error(error)))
            return
        self._take(name, made, size)

    def _take(self, name: str, made: StageBenchmark, size: Size) -> None:
        self.done[name], self.size[name] = made, size
        if name in self.to_do or name not in self.compile_s:
            # the first run of a stage compiles its kernels: cold minus warm time is compilation
            self.compile_s[name] = sum(
                max(p.timing.cold_s - p.timing.seconds, 0.0) for p in made.points
            )

    def measure_full_sizes(self) -> None:
        """Repeat stages at full size, the quickest first, while they fit into the budget."""
        pace = bench_plan.MachinePace()
        small = self.document()["not_judged"]
        for name, expected_s in bench_plan.order_full_stages(small, bench_plan.FULL_S):
            left_s = self.deadline_s - bench_plan.REPORT_RESERVE_S - time.perf_counter()
            if not pace.fits(expected_s, left_s):
                break
            pace.add(expected_s, self.measure(name, "full"))

    def document(self) -> dict[str, Any]:
        """Return the document of the run, complete or interrupted."""
        document = to_document(list(self.done.values()))
        document |= {"toy": self.toy, "code": code_digest(MEASURED_PACKAGES)}
        lacking = [*self.omitted, *((name, INTERRUPTED_REASON) for name in self.to_do)]
        kept = self.list_finished() - self.done.keys()
        document["left_out"] = [list(item) for item in lacking if item[0] not in kept]
        of_run = self.done.keys() | {name for name, _ in document["left_out"]}
        document["left_out"] += [i for i in self.earlier["left_out"] if i[0] not in of_run]
        for name, made in self.done.items():
            stage = document["stages"][made.name]
            stage["size"] = self.size[name]
            stage["selection"] = self.selection
            stage["compile_seconds"] = self.compile_s[name]
            if self.size[name] == "small":
                stage["limits"] = []
        document["stages"] = self.earlier["stages"] | document["stages"]
        document["not_judged"] = [n for n, s in document["stages"].items() if s["size"] == "small"]
        document["passed"] = all(
            limit["passed"] for stage in document["stages"].values() for limit in stage["limits"]
        )
        return document
