"""Report section on benchmarks: error against seconds, by setting and by skin."""

from collections.abc import Iterator, Mapping
from typing import Any

from skinrig.benchmarks import figures as bench_figures
from skinrig.benchmarks import table as bench_table
from skinrig.benchmarks.document import SCHEMA
from skinrig.reporting import page

SCHEMA_FAMILY = SCHEMA.split("/")[0]


def is_bench(document: Mapping[str, Any]) -> bool:
    """Return whether a document is a benchmark of any version."""
    return str(document.get("schema", "")).startswith(f"{SCHEMA_FAMILY}/")


def section(document: Mapping[str, Any], checks: list[page.Check]) -> Iterator[page.Block]:
    """Yield plots and tables of a benchmark, and add its limits to the checks.

    Parameters
    ----------
    document
        ``skinrig.bench/2``; of another version, only a note is yielded.
    checks
        Checks of the report.
    """
    yield page.Heading("Error against run time", level=2)
    if document["schema"] != SCHEMA:
        yield page.build_note(
            f"The file has schema {document['schema']}, expected {SCHEMA}; "
            "run `skinrig bench` again."
        )
        return
    for name, stage in document["stages"].items():
        for limit in stage["limits"]:
            got = float("nan") if limit["got"] is None else limit["got"]
            judged = got, limit["bound"], limit["sense"], limit["unit"]
            again = f"skinrig bench --stage {name}"
            checks.append(
                page.Check(f"{name}: {limit['name']}", *judged, worst=_worst(stage), command=again)
            )
    plots = [
        bench_figures.plot_error_against_time(name, stage)
        for name, stage in document["stages"].items()
        if stage["points"]
    ]
    yield page.Collapsible(f"Plots of {len(plots)} stages", [page.Plots(plots)])
    yield page.build_view("benchmark", stages=document["stages"])
    if knees := bench_table.list_knee_rows(document):
        yield page.build_table(
            bench_table.KNEE_COLUMNS, knees, caption="Knees of the curves of error against seconds"
        )
    bands = bench_table.list_band_rows(document)
    if bands:
        yield page.build_table(
            bench_table.BAND_COLUMNS, bands, caption="Error at the default setting by melanin band"
        )
    yield from _left_out(document)


def _worst(stage: Mapping[str, Any]) -> str:
    known = [one for one in stage["by_band"] if one["error"] is not None]
    if len(known) < 2:
        return ""
    worst = max(known, key=lambda one: float(one["error"]))
    return f"{worst['band']}: {float(worst['error']):.3g}"


def _left_out(document: Mapping[str, Any]) -> Iterator[page.Block]:
    rows = [(f"{what}, whole stage", why) for what, why in document.get("left_out", ())]
    rows += [
        (f"{name}: {what}", why)
        for name, stage in document["stages"].items()
        for what, why in stage.get("left_out", ())
    ]
    if rows:
        yield page.build_table(
            ("setting", "reason"), rows, caption="Settings that were not measured"
        )
    if document.get("not_judged"):
        yield page.build_note(
            "Measured at small size; their limits are not checked: "
            f"{', '.join(document['not_judged'])}."
        )
