"""Judge the soak: plant each bug of tests/data/soak_bugs.toml, and print when it is found.

Run: python tools/judge_soak.py [--days 10] [--seed 0] [--only TEXT] [--write]
"""

import argparse
import re
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from fixtures.planted import BUGS, mutate, planted  # noqa: E402

from skinrig.soaking.soak import run_soak  # noqa: E402

TABLE = ROOT / "tests/data/soak_bugs.toml"


def judge(bug, *, seed, days, first_day=0):
    """Return (day or -1, processor time in s, what was found) of one planted bug."""
    begun_s = time.process_time()
    with planted(bug["file"], mutate(bug)) as changed:
        if not changed:
            raise SystemExit(f"{bug['name']}: no function changed")
        result = run_soak(seed, hours=24.0 * days, first_day=first_day)
    day = first_day + result.days - 1 if result.failure else -1
    return day, time.process_time() - begun_s, result.failure


def note_finding(name, seed, day):
    """Write seed and day of a bug into the table."""
    text = TABLE.read_text("utf-8")
    entry = re.compile(rf'(name = "{re.escape(name)}"\n(?:.*\n){{3}})seed = .*\nday = .*\n')
    TABLE.write_text(entry.sub(lambda m: f"{m[1]}seed = {seed}\nday = {day}\n", text), "utf-8")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--days", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="")
    parser.add_argument("--missing", action="store_true", help="bugs without a finding only")
    parser.add_argument("--write", action="store_true", help="write seeds and days to the table")
    order = parser.parse_args()
    found = []
    for bug in BUGS:
        if order.only not in bug["name"] or (order.missing and bug["day"] >= 0):
            continue
        day, seconds, failure = judge(bug, seed=order.seed, days=order.days)
        found.append(day >= 0)
        print(f"{bug['name']:45} day {day:3}  {seconds:6.1f} s  {failure[:110]}", flush=True)
        if order.write and day >= 0:
            note_finding(bug["name"], order.seed, day)
    print(f"{sum(found)} of {len(found)} found")


if __name__ == "__main__":
    main()
