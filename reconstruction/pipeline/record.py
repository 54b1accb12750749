"""What became of each stage of a reconstruction: run, reused or skipped, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from reconstruction.pipeline.graph import Outcome, Stage


def record(
    graph: Sequence[Stage], outcome: Outcome, before: Mapping[str, str]
) -> tuple[dict[str, str], ...]:
    """Return what a run did, stage by stage in the order of the graph.

    Parameters
    ----------
    graph
        All stages.
    outcome
        What a run of it did.
    before
        Input hash of each stage of the run before, by name; empty: there was none.

    Returns
    -------
    tuple of dict
        ``stage``; ``done``: "run", "reused" or "skipped"; ``why``; ``inputs``: the hash of all that
        the stage's products depend on, empty where nothing needed it.

    Examples
    --------
    >>> a = Stage("a", (), ("x",), dict)
    >>> outcome = Outcome({}, ("a",), (), (), {"a": "12"})
    >>> record([a], outcome, {"a": "34"})[0]["why"]
    'its inputs have changed'
    """
    skipped = dict(outcome.left_out)
    return tuple(_entry(stage.name, outcome, before, skipped) for stage in graph)


def _entry(
    name: str, outcome: Outcome, before: Mapping[str, str], skipped: Mapping[str, str]
) -> dict[str, str]:
    key = outcome.keys.get(name, "")
    if name in outcome.reused:
        done, why = "reused", "its inputs are the same"
    elif name in outcome.ran:
        done = "run"
        if name not in before:
            why = "it was not made before"
        elif before[name] != key:
            why = "its inputs have changed"
        else:
            why = "what it made is not kept, or not all of it"
    else:
        done, why = "skipped", skipped.get(name, "nothing wanted depends on it")
    return {"stage": name, "done": done, "why": why, "inputs": key}
