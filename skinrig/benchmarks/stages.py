"""Which stages can be measured, and running them."""

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from skinrig.atomic_file import write_atomically
from skinrig.benchmarks import plan as bench_plan
from skinrig.benchmarks import table as bench_table
from skinrig.benchmarks.document import to_document
from skinrig.benchmarks.results import StageBenchmark
from skinrig.benchmarks.stage import BenchmarkStage, descriptions
from skinrig.console import Console, to_json_value
from skinrig.errors import EXTRA_MISSING, exit_code, one_of, sentence

STAGES: dict[str, str] = {name: entry["run"] for name, entry in descriptions().items()}
"""Module and function of each; a module is imported, and its kernels compiled, when it is run."""


INTERRUPTED_REASON = "the run ended before all of it was measured"
"""Of a stage in a document that a run left which was interrupted."""


class BenchError(ValueError):
    """A stage that cannot be measured."""


def _iterate_results(name: str, *, toy: bool) -> Iterator[StageBenchmark]:
    """Yield what a stage has measured: once, or of a long one ever more until it is whole."""
    module, function = STAGES[name].rsplit(".", 1)
    stage = BenchmarkStage(name, toy=toy)
    run = getattr(import_module(f"skinrig.benchmarks.{module}"), function)
    for _ in run(stage) or ():
        yield stage.to_benchmark()
    yield stage.to_benchmark()


def run_stages(
    names: Sequence[str] | None, *, budget_s: float, toy: bool, out: Path | None, console: Console
) -> dict[str, Any]:
    """Measure stages and return the document of the run.

    Parameters
    ----------
    names
        Out of :data:`STAGES`, each at full size. None: all of them at their small size, and then
        at full size those that fit into the budget, the quickest first.
    budget_s
        Seconds to spend. A stage that would begin after them is left out, and named.
    toy
        Small sizes only: for checking that the benchmark runs.
    out
        Folder for ``bench.json``; None writes nothing.
    console
        Where results and progress go.

    Returns
    -------
    dict
        ``skinrig.bench/2``. Each stage says its ``size``; limits are judged at full size alone, and
        ``not_judged`` names the stages whose limits were not.

    Raises
    ------
    BenchError
        For an unknown stage.
    """
    chosen = list(dict.fromkeys(names)) if names else bench_plan.order_small_stages(STAGES)
    for name in chosen:
        one_of("stage", name, STAGES, BenchError)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)  # a folder that cannot be is told before the work
    run = _Run(console, time.perf_counter() + budget_s, asked=bool(names), toy=toy, out=out)
    run.to_do = list(chosen)
    small = toy or not names
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
    """What was measured so far."""

    console: Console
    deadline_s: float
    """When the budget ends, by `time.perf_counter`."""
    asked: bool
    """Whether stages were asked for by name: then what they need must be there."""
    toy: bool = False
    out: Path | None = None
    """Where the document is kept, stage by stage; None: nowhere."""
    to_do: list[str] = field(default_factory=list)
    """What is still to be measured for the first time."""
    done: dict[str, StageBenchmark] = field(default_factory=dict)
    size: dict[str, Size] = field(default_factory=dict)
    compile_s: dict[str, float] = field(default_factory=dict)
    left_out: list[tuple[str, str]] = field(default_factory=list)

    def measure(self, name: str, size: Size) -> float:
        """Measure a stage, if there is time, and return the seconds that it took."""
        began = time.perf_counter()
        self._measure(name, size, began)
        if name in self.to_do:
            self.to_do.remove(name)
        self.save()
        return time.perf_counter() - began

    def save(self) -> None:
        """Write what there is: a run that is interrupted leaves what it measured."""
        if self.out is not None:
            text = json.dumps(to_json_value(self.document()), indent=1, sort_keys=True)
            write_atomically(self.out / "bench.json", text + "\n")

    def _measure(self, name: str, size: Size, began: float) -> None:
        if began > self.deadline_s:
            self.left_out.append((name, "the budget was used up"))
            return
        self.console.progress(f"bench {name}, {size} size")
        try:
            for made in _iterate_results(name, toy=size == "small"):
                if name in self.to_do:
                    self._take(name, made, size)
                    self.save()
        except ImportError as error:
            if self.asked or exit_code(error) != EXTRA_MISSING:
                raise
            self.left_out.append((name, sentence(error)))
            return
        self._take(name, made, size)

    def _take(self, name: str, made: StageBenchmark, size: Size) -> None:
        self.done[name], self.size[name] = made, size
        if name in self.to_do:
            # the first time that its kernels are called; later ones find them compiled
            self.compile_s[name] = sum(
                max(p.timing.cold_s - p.timing.seconds, 0.0) for p in made.points
            )

    def measure_full_sizes(self) -> None:
        """Measure again at full size what fits into the rest of the budget."""
        pace = bench_plan.MachinePace()
        for name, told_s in bench_plan.order_full_stages(self.done, bench_plan.FULL_S):
            left_s = self.deadline_s - bench_plan.REPORT_RESERVE_S - time.perf_counter()
            if not pace.fits(told_s, left_s):
                break
            pace.add(told_s, self.measure(name, "full"))

    def document(self) -> dict[str, Any]:
        """Return the document of the run."""
        document = to_document(list(self.done.values()))
        document["toy"] = self.toy
        document["left_out"] = [list(item) for item in self.left_out]
        document["left_out"] += [[name, INTERRUPTED_REASON] for name in self.to_do]
        document["not_judged"] = [name for name, size in self.size.items() if size == "small"]
        for name, made in self.done.items():
            stage = document["stages"][made.name]
            stage["size"] = self.size[name]
            stage["compile_seconds"] = self.compile_s[name]
            if self.size[name] == "small":
                stage["limits"] = []
        document["passed"] = all(
            limit["passed"] for stage in document["stages"].values() for limit in stage["limits"]
        )
        return document
