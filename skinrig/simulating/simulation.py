"""Simulate captures: drive a world of simulated devices and a scene through the real drivers."""

import importlib
from pathlib import Path
from typing import Any

from skinrig.resources.forecast import Task, count_megapixels
from skinrig.simulating.orders import SimulationOrder, SimulationResult, order_for
from skinrig.simulating.resumption import SessionComplete


def simulate(order: SimulationOrder) -> SimulationResult:
    """Simulate a capture into SESSION/ and write its ground truth next to it.

    Parameters
    ----------
    order
        Order of one of the four rigs.

    Raises
    ------
    SimulationError
        For an order that the rig cannot simulate.
    """
    # one module per rig, imported on use, so that a run loads only its own rig
    rig = importlib.import_module(f"skinrig.simulating.{order.rig}")
    try:
        done: SimulationResult = getattr(rig, f"simulate_{order.rig}")(order)
    except SessionComplete as complete:
        return complete.result
    return done


def list_tasks(rig: str, out: Path, **options: Any) -> list[Task]:
    """Return a simulation and a reconstruction, to forecast their memory.

    Parameters
    ----------
    rig, out, options
        As in `simulate_session`.
    """
    planner = importlib.import_module(f"skinrig.simulating.{rig}")
    planned = planner.plan_capture(order_for(rig, out=out, **options))
    amounts = count_megapixels(*planned)
    return [Task(f"{command} {rig}", amounts) for command in ("simulate", "reconstruct")]


def simulate_session(rig: str, out: str | Path, **options: Any) -> SimulationResult:
    """Simulate a capture with the rig of a name; see `simulate`.

    Parameters
    ----------
    rig
        A key of `skinrig.simulating.orders.ORDER_BY_RIG`.
    out
        The session's folder.
    options
        Fields of the rig's order; lists are converted to tuples.
    """
    given = {name: tuple(v) if isinstance(v, list) else v for name, v in options.items()}
    return simulate(order_for(rig, out=Path(out), **given))
