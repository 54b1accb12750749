"""Checks of two runs beside each other."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from skinrig.reporting import page
from skinrig.reporting.comparison.runs import Run
from skinrig.written_units import written


@dataclass(frozen=True, slots=True)
class CheckRow:
    """A check of one or both runs."""

    name: str
    a: page.Check | None
    b: page.Check | None

    @property
    def changed(self) -> str:
        """Return "better" or "worse" where the verdict changed."""
        if self.a is None or self.b is None or self.a.passed == self.b.passed:
            return ""
        return "better" if self.b.passed else "worse"

    @property
    def outcome(self) -> str:
        """What became of the verdict, in words."""
        return self.changed or ("no" if self.a and self.b else "only in one")

    @property
    def difference(self) -> float:
        """What B measured less what A did; NaN where one did not."""
        return float("nan") if self.a is None or self.b is None else self.b.got - self.a.got


def rows_of(a: Run, b: Run) -> list[CheckRow]:
    """Return the checks of two runs by name, verdicts that changed first."""
    by_a = {_common_name(check, a, b): check for check in a.checks}
    by_b = {_common_name(check, b, a): check for check in b.checks}
    rows = [CheckRow(name, by_a.get(name), by_b.get(name)) for name in {**by_a, **by_b}]
    return sorted(rows, key=lambda row: (row.changed != "worse", row.changed != "better"))


def _common_name(check: page.Check, run: Run, other: Run) -> str:
    """Return a check's name without the folder's where the two folders are named differently."""
    name = check.name
    if len(run.appearances) == len(other.appearances) == 1:
        name = name.removeprefix(f"{next(iter(run.appearances))}: ")
    if len(run.found.pictures) == len(other.found.pictures) == 1:
        name = name.removeprefix(f"{run.found.pictures[0].name}: ")
    return name


def table(a: Run, b: Run, rows: Sequence[CheckRow]) -> Iterator[page.Block]:
    """Yield the section on checks of both; empty without any."""
    if not rows:
        return

    def told(check: page.Check | None) -> str:
        if check is None:
            return "not checked"
        return written(page.number(check.got), check.unit) + (
            ", kept" if check.passed else ", missed"
        )

    def limit(row: CheckRow) -> str:
        bounds = [
            f"{'≤' if c.sense == '<=' else '≥'} {written(page.number(c.bound), c.unit)}"
            for c in (row.a, row.b)
            if c is not None
        ]
        return " and ".join(dict.fromkeys(bounds))

    yield page.Heading("Checks of both", level=2)
    yield page.table(
        ("check", a.label, b.label, "difference", "limit", "changed"),
        [
            (row.name, told(row.a), told(row.b), row.difference, limit(row), row.outcome)
            for row in rows
        ],
        caption="Verdicts that changed stand first; limits that follow a bound may differ",
    )
