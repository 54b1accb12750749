"""Print a Markdown table of the firmware's tests by box, target and suite from pytest's report.

Usage: pytest -m long tests/hardware tests/firmware --junitxml report.xml
       python tools/tabulate_firmware_tests.py report.xml
"""

import re
import sys
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

BOXES = ("flash", "dome", "gradient_sphere", "caliper", "probe", "scanner")
TARGETS = ("posix-tcp", "posix", "mega2560", "mps2-an385", "mps2-an500", "compiled")
OTHER_TARGET = "other"
"""Of tests whose names do not have one: the core as a library, or one image."""
Outcomes = dict[tuple[str, str, str], Counter[str]]


def find_word(words: tuple[str, ...], text: str, default: str) -> str:
    """Return the first of the words in a text, or the default."""
    return next((word for word in words if re.search(rf"(?<![a-z]){word}(?![a-z])", text)), default)


def outcome_of(case: ElementTree.Element) -> str:
    """Return passed, failed, or the reason for which a test skipped."""
    if case.find("failure") is not None or case.find("error") is not None:
        return "failed"
    skipped = case.find("skipped")
    return "passed" if skipped is None else skipped.get("message", "skipped")


def count_outcomes(report: ElementTree.Element) -> Outcomes:
    """Return how often each outcome occurs, by box, target and suite (a test file)."""
    found: Outcomes = {}
    for case in report.iter("testcase"):
        suite = case.get("classname", "").rpartition("test_")[2]
        name = case.get("name", "")
        target = find_word(TARGETS, name, OTHER_TARGET)
        rest = name.replace(target, "").replace("_", " ").replace("gradient sphere", BOXES[2])
        box = find_word(BOXES, f"{rest} {suite.replace('_', ' ')}", "any")
        found.setdefault((box, target, suite), Counter())[outcome_of(case)] += 1
    return found


def main() -> None:
    print("| box, target | suite | passed | failed | skipped by name |")
    print("| --- | --- | --- | --- | --- |")
    total: Counter[str] = Counter()
    outcomes = count_outcomes(ElementTree.fromstring(Path(sys.argv[1]).read_text("utf-8")))
    for (box, target, suite), counts in sorted(outcomes.items()):
        skips = [f"{n}: {why}" for why, n in counts.items() if why not in ("passed", "failed")]
        shown = "; ".join(skips) or "0"
        print(f"| {box}, {target} | {suite} | {counts['passed']} | {counts['failed']} | {shown} |")
        total += counts
    skipped = sum(n for why, n in total.items() if why not in ("passed", "failed"))
    print(f"| all | | {total['passed']} | {total['failed']} | {skipped} |")


if __name__ == "__main__":
    main()
