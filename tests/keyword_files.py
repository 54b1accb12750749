"""`pytest -k` reads only the files that can hold a test of the expression.

To read all takes 9 s. Pytest's cache keeps the names of each file's tests, by which ``-k`` selects
them. A file that has not changed since its last reading is left unread where the expression matches
none of them. Names that a change of another module alone would add are thus not found; without
``-k``, and by an expression with ``not``, every file is read.
"""

import re
from functools import cache

import pytest
from _pytest.mark import KeywordMatcher
from _pytest.mark.expression import Expression

RECORD = "skinrig/test_names"
"""Key of pytest's cache: by file, the time of its last change, and the names of its tests."""


def stamp(path):
    return path.stat().st_mtime_ns


@cache
def read_record(config):
    """Return the record of earlier runs, by file."""
    kept = getattr(config, "cache", None)
    return {} if kept is None else kept.get(RECORD, {})


def pytest_ignore_collect(collection_path, config):
    """Leave unread what holds no test of the expression, and folders of nothing else."""
    expression = config.getoption("keyword")
    if not expression:
        return None
    record = read_record(config)
    files = [collection_path]
    if collection_path.is_dir():
        files = list(collection_path.rglob("test_*.py"))
    if not files or any(can_match(path, expression, record) for path in files):
        return None
    return True


@pytest.hookimpl(tryfirst=True)  # before anything is left out
def pytest_collection_modifyitems(config, items):
    """Record the files of all items, if each was read whole and no other process records it."""
    in_part = config.getoption("lf", False) or any("::" in one for one in config.args)
    if in_part or not hasattr(config, "cache") or hasattr(config, "workerinput"):
        return
    record = read_record(config) | make_record(items)
    if record != read_record(config):
        config.cache.set(RECORD, record)


def can_match(path, expression, record):
    """Return whether a file can hold a test that the expression selects."""
    if str(path) not in record or re.search(r"\bnot\b", expression):
        return True  # a name that is not in a file may select all its tests
    changed, names = record[str(path)]
    if changed != stamp(path):
        return True
    try:
        found = Expression.compile(expression)
    except SyntaxError:
        return True  # pytest reports it
    return found.evaluate(lambda word, **_: word.lower() in names)


def make_record(items):
    """Return the record of the files of all items."""
    names = {}
    for item in items:
        names.setdefault(item.path, set()).update(KeywordMatcher.from_item(item)._names)
    return {str(path): [stamp(path), "\n".join(sorted(own)).lower()] for path, own in names.items()}
