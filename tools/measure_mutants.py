"""Mutate functions of a group of modules, run the tests that reach them, and print the score.

One operator, number or statement is changed at a time, in a child of a process that has loaded the
tests; those on real lines are left out. The mutants are drawn by a seed, without those that other
seeds have drawn. Outcomes go to tools/mutants.csv as they are found, and another run continues
there; a mutant of a changed line runs again. Survivors keep the reason in the column `why` that a
person has written.

python tools/measure_mutants.py --groups session,lines,rules --count 60 --seed 4 [--budget 600]
"""

import argparse
import ast
import csv
import hashlib
import math
import os
import resource
import signal
import sys
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from fixtures.planted import planted  # noqa: E402
from real_time import is_on_a_real_line  # noqa: E402

TABLE = ROOT / "tools/mutants.csv"
COLUMNS = ("group", "file", "line", "column", "change", "hash", "seed", "outcome", "why")
GROUPS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "session": (
        tuple(
            f"capture/session/{name}.py"
            for name in (
                "consent_seal",
                "disk",
                "folder",
                "journal",
                "reopening",
                "store",
                "verification",
            )
        ),
        ("tests/unit/capture/session", "tests/faults/test_damage.py"),
    ),
    "lines": (
        tuple(f"capture/devices/{name}.py" for name in ("wire", "port", "box", "led_box")),
        (
            "tests/protocol/test_wire.py",
            "tests/protocol/test_port.py",
            "tests/protocol/test_port_bounds.py",
            "tests/protocol/test_shared_commands.py",
            "tests/protocol/test_flash_driver.py",
            "tests/protocol/test_dome_driver.py",
            "tests/protocol/test_caliper_driver.py",
        ),
    ),
    "rules": (
        tuple(f"capture/plan/{name}.py" for name in ("dose", "eye_light", "flicker")),
        ("tests/unit/capture/plan",),
    ),
}
"""Mutated files, and the tests that judge them."""
OTHER_OPERATOR = {
    **{ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt},
    **{ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is},
    **{ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And},
    **{ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult},
}
TIME_FACTOR = 10.0
MIN_LIMIT_S = 20.0
PROCESSOR_FACTOR = 3.0
MIN_PROCESSOR_S = 10.0
"""A loop without an end ends by processor time, which a busy machine does not lengthen."""
NORMAL_QUANTILE = 1.96
UNCHANGED = 71
"""Exit code of a child whose mutant changes no function of its module."""


@dataclass(frozen=True)
class Mutant:
    """One change of one file."""

    group: str
    file: str
    line: int
    column: int
    change: str
    hash: str
    functions: frozenset[int]
    """First lines of the functions around it."""
    place: int
    """Number of the node among `list_places`."""

    @property
    def key(self) -> tuple[str, ...]:
        """Return what recognizes it after lines were added above."""
        return self.file, self.hash


def mutate_node(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """Yield the changes of one node, each with its description."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in OTHER_OPERATOR:
        other = OTHER_OPERATOR[type(node.ops[0])]
        yield (
            f"{type(node.ops[0]).__name__} to {other.__name__}",
            with_field(node, "ops", [other(), *node.ops[1:]]),
        )
    elif isinstance(node, (ast.BoolOp, ast.BinOp)) and type(node.op) in OTHER_OPERATOR:
        other = OTHER_OPERATOR[type(node.op)]
        yield f"{type(node.op).__name__} to {other.__name__}", with_field(node, "op", other())
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield "without not", node.operand
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield f"{node.value} to {not node.value}", with_field(node, "value", not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        yield f"{node.value} plus 1", with_field(node, "value", node.value + 1)
    elif isinstance(node, ast.Return) and node.value is not None:
        yield "returns None", with_field(node, "value", ast.Constant(None))
    elif isinstance(node, (ast.Raise, ast.AugAssign)) or (
        isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
    ):
        yield f"without {type(node).__name__}", ast.Pass()
    elif isinstance(node, (ast.If, ast.While, ast.IfExp)) and not isinstance(
        node.test, (ast.Compare, ast.BoolOp, ast.UnaryOp)
    ):
        yield "not", with_field(node, "test", ast.UnaryOp(ast.Not(), node.test))


def with_field(node: ast.AST, name: str, value: object) -> ast.AST:
    """Return a copy of a node with another field."""
    fields = {one: getattr(node, one, None) for one in node._fields} | {name: value}
    return type(node)(**fields)


def list_places(tree: ast.Module) -> Iterator[tuple[ast.AST, str, int | None, frozenset[int]]]:
    """Yield each node in a function as parent, field, index and the lines of its functions."""

    def visit(node: ast.AST, functions: frozenset[int]) -> Iterator[tuple]:
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            first = min([node.lineno, *(one.lineno for one in node.decorator_list)])
            for number in range(len(node.body)):
                yield from place(node, "body", number, frozenset({first}))
            return
        for name, value in ast.iter_fields(node):
            if name == "annotation":
                continue
            for number, one in enumerate(value) if isinstance(value, list) else [(None, value)]:
                if isinstance(one, ast.AST):
                    yield from place(node, name, number, functions)

    def place(parent, name, number, functions):
        held = getattr(parent, name)
        node = held if number is None else held[number]
        if functions and isinstance(node, (ast.expr, ast.stmt)):
            yield parent, name, number, functions
        if not isinstance(node, (ast.Raise, ast.JoinedStr)):  # texts of messages are not mutated
            yield from visit(node, functions)

    return visit(tree, frozenset())


def list_mutants(group: str, file: str) -> list[Mutant]:
    """Return all mutants of a file, in the order of its text."""
    text = (ROOT / file).read_text("utf-8")
    lines, found, count = text.splitlines(), [], Counter()
    for place, (parent, name, index, functions) in enumerate(list_places(ast.parse(text))):
        node = take(parent, name, index)
        for change, _ in mutate_node(node):
            content = f"{lines[node.lineno - 1].strip()} {node.col_offset} {change}"
            count[content] += 1
            content = f"{content} {count[content]}"
            digest = hashlib.sha256(content.encode()).hexdigest()[:10]
            where = (group, file, node.lineno, node.col_offset)
            found.append(Mutant(*where, change, digest, functions, place))
    return found


def take(parent: ast.AST, name: str, index: int | None) -> ast.AST:
    """Return a node from its place."""
    held = getattr(parent, name)
    return held if index is None else held[index]


def mutate_tree(mutant: Mutant) -> ast.Module:
    """Return the tree of the mutant's file with its change."""
    tree = ast.parse((ROOT / mutant.file).read_text("utf-8"))
    parent, name, index, _ = list(list_places(tree))[mutant.place]
    old = take(parent, name, index)
    new = ast.copy_location(dict(mutate_node(old))[mutant.change], old)
    if index is None:
        setattr(parent, name, new)
    else:
        getattr(parent, name)[index] = new
    return ast.fix_missing_locations(tree)


class Reach:
    """Plugin that notes which functions each test calls, and how long it takes."""

    def __init__(self, files: tuple[str, ...]) -> None:
        self.paths = {str(ROOT / file): file for file in files}
        self.tests: dict[tuple[str, int], set[str]] = defaultdict(set)
        self.seconds: dict[str, float] = {}
        self.processor_s: dict[str, float] = {}
        self.test = ""
        self.failed = ""

    def _note(self, frame, event, _) -> None:
        if event == "call" and frame.f_code.co_filename in self.paths:
            file = self.paths[frame.f_code.co_filename]
            self.tests[file, frame.f_code.co_firstlineno].add(self.test)

    def pytest_runtest_logreport(self, report) -> None:
        if report.failed:
            self.failed = report.nodeid

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item, nextitem):
        self.test, begun_s, used_s = item.nodeid, time.perf_counter(), time.process_time()
        sys.setprofile(self._note)
        threading.setprofile(self._note)
        try:
            return (yield)
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
            self.seconds[item.nodeid] = time.perf_counter() - begun_s
            self.processor_s[item.nodeid] = time.process_time() - used_s


class SimulatedLines:
    """Plugin that keeps the given order of tests, and leaves out those in real time.

    On a busy machine, tests in real time would kill any mutant. `tests/conftest.py` sorts files by
    their length, longest first; here the shortest test kills a mutant soonest.
    """

    def __init__(self, tests) -> None:
        self.places = {test: place for place, test in enumerate(tests)}

    def pytest_collection_finish(self, session) -> None:
        session.items[:] = [item for item in session.items if not is_on_a_real_line(item)]
        session.items.sort(key=lambda item: self.places.get(item.nodeid, 0))


def run_tests(tests, plugins=()) -> int:
    """Run tests in this process, without output."""
    quiet = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(quiet, stream)
    arguments = ["-x", "-q", "-p", "no:cacheprovider", "-m", "not long", "--tb=no"]
    arguments += ["--doctest-modules", "--timeout=0"]  # a busy machine kills no mutant
    return int(pytest.main([*arguments, *tests], plugins=[SimulatedLines(tests), *plugins]))


def judge(mutant: Mutant, reach: Reach) -> str:
    """Return "killed", "survived", "not reached", "late" or "no function" of a mutant.

    A late one has used several times the processor time of its tests, or has waited too long.
    """
    tests = set().union(*(reach.tests[mutant.file, line] for line in mutant.functions))
    if not tests:
        return "not reached"
    ordered = sorted(tests, key=lambda test: reach.seconds[test])
    code = run_child(mutant, ordered, reach)
    outcomes = {0: "survived", UNCHANGED: "no function"}
    return outcomes.get(code, "late" if code in (-signal.SIGXCPU, -signal.SIGKILL) else "killed")


def run_child(mutant: Mutant, ordered: list[str], reach: Reach) -> int:
    """Return the exit code of the tests of a mutant, in a process of their own."""
    child = os.fork()
    if child == 0:
        os.setsid()
        allowed_s = MIN_PROCESSOR_S + PROCESSOR_FACTOR * sum(map(reach.processor_s.get, ordered))
        spent_s = math.ceil(time.process_time() + allowed_s)
        resource.setrlimit(resource.RLIMIT_CPU, (spent_s, spent_s + 1))
        code = 70
        try:
            with planted(mutant.file, mutate_tree(mutant)) as changed:
                code = run_tests(ordered) if changed else UNCHANGED
        finally:
            os._exit(code)
    last_s = time.monotonic() + MIN_LIMIT_S + TIME_FACTOR * sum(map(reach.seconds.get, ordered))
    while os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
        if time.monotonic() > last_s:
            os.killpg(child, signal.SIGKILL)
        time.sleep(0.02)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def read_table() -> list[dict[str, str]]:
    """Return the rows of the table; none without a file."""
    if not TABLE.is_file():
        return []
    with TABLE.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def write_table(rows: list[dict[str, str]]) -> None:
    """Replace the table."""
    part = TABLE.with_suffix(".part")
    with part.open("w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
    part.replace(TABLE)


def find_interval(part: int, whole: int) -> tuple[float, float]:
    """Return Wilson's interval of a fraction, 95 %.

    Examples
    --------
    >>> [round(limit, 2) for limit in find_interval(9, 10)]
    [0.6, 0.98]
    """
    square, share = NORMAL_QUANTILE**2 / whole, part / whole
    middle = share + square / 2
    width = NORMAL_QUANTILE * math.sqrt((share * (1 - share) + square / 4) / whole)
    return (middle - width) / (1 + square), (middle + width) / (1 + square)


def main() -> None:
    """Judge the drawn mutants of each group, and print the scores."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--groups", default=",".join(GROUPS))
    parser.add_argument("--count", type=int, default=60, help="mutants of each group")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--budget", type=float, default=math.inf, help="seconds of each group")
    order = parser.parse_args()
    os.chdir(ROOT)
    for group in order.groups.split(","):
        judge_group(group, order.count, order.seed, order.budget)
    for group in GROUPS:
        rows = [row for row in read_table() if row["group"] == group]
        for seed in sorted({row["seed"] for row in rows}):
            print_score(f"{group}, seed {seed}", [row for row in rows if row["seed"] == seed])


def print_score(title: str, rows: list[dict[str, str]]) -> None:
    """Print how many mutants of some rows are killed."""
    judged = [row for row in rows if row["outcome"] != "no function"]
    if judged:
        found = sum(row["outcome"] in ("killed", "late") for row in judged)
        low, high = find_interval(found, len(judged))
        why = sum(bool(row["why"]) for row in judged)
        text = f"{title}: {found} of {len(judged)} killed, {100 * found / len(judged):.0f} %"
        print(f"{text} ({100 * low:.0f} to {100 * high:.0f}), {why} survivors explained")


def judge_group(group: str, count: int, seed: int, budget_s: float) -> None:
    """Judge the drawn mutants of a group that the table lacks, and those marked "again"."""
    files, tests = GROUPS[group]
    mutants = [mutant for file in files for mutant in list_mutants(group, file)]
    rows = read_table()
    current = {mutant.key for mutant in mutants}
    known = {
        (row["file"], row["hash"]): row
        for row in rows
        if row["group"] != group or (row["file"], row["hash"]) in current
    }
    begun_s = time.monotonic()
    order = np.random.default_rng(seed).permutation(len(mutants)).tolist()
    others = {key for key, row in known.items() if row["seed"] != str(seed)}
    chosen = [number for number in order if mutants[number].key not in others][:count]
    again = {key for key, row in known.items() if row["outcome"] == "again"}
    to_do = [mutants[number] for number in sorted(chosen) if mutants[number].key not in known]
    to_do += [mutant for mutant in mutants if mutant.key in again]
    print(
        f"{group}: {len(mutants)} mutants, {len(chosen)} drawn, {len(to_do)} to judge", flush=True
    )
    if not to_do:
        return
    for file in files:  # else pytest makes a second module of the first file, for its doctests
        import_module(file.removesuffix(".py").replace("/", "."))
    reach = Reach(files)
    shown = os.dup(1), os.dup(2)
    code = run_tests((*files, *tests), [reach])
    for number, stream in enumerate(shown, start=1):
        os.dup2(stream, number)
    if code:
        raise SystemExit(f"{group}: {reach.failed or 'pytest'} fails without a mutant, code {code}")
    print(f"  {len(reach.seconds)} tests, {time.monotonic() - begun_s:.0f} s", flush=True)
    for mutant in to_do:
        if time.monotonic() - begun_s > budget_s:
            break
        outcome = judge(mutant, reach)
        row = {name: str(getattr(mutant, name)) for name in COLUMNS[:6]}
        before = known.get(mutant.key, {"seed": str(seed), "why": ""})
        row |= {"seed": before["seed"], "outcome": outcome, "why": before["why"]}
        known[mutant.key] = row
        # others may have written since: rows of this group replace those of the table
        own = [one for one in known.values() if one["group"] == group]
        foreign = [one for one in read_table() if one["group"] != group]
        write_table(sorted(own + foreign, key=lambda one: (one["file"], int(one["line"]))))
        print(f"  {outcome:11} {mutant.file}:{mutant.line} {mutant.change}", flush=True)


if __name__ == "__main__":
    main()
