"""Simulated captures: a world of boxes and a scene, driven through the real drivers by URL."""

import importlib
from pathlib import Path
from typing import Any

from skinrig.simulating.orders import SimulationOrder, SimulationResult, order_for


def simulate(order: SimulationOrder) -> SimulationResult:
    """Simulate a capture into SESSION/, and write its truth beside it.

    Parameters
    ----------
    order
        Of one of the four rigs.

    Raises
    ------
    SimulationError
        For what the rig cannot simulate.
    """
    # a module a rig, so that a run loads what its own rig needs
    rig = importlib.import_module(f"skinrig.simulating.{order.rig}")
    done: SimulationResult = getattr(rig, f"simulate_{order.rig}")(order)
    return done


def simulate_session(rig: str, out: str | Path, **options: Any) -> SimulationResult:
    """Simulate a capture with a rig by its name; see `simulate`.

    Parameters
    ----------
    rig
        A key of `skinrig.simulating.orders.ORDER_BY_RIG`.
    out
        The session's folder.
    options
        Fields of the rig's order; lists stand for tuples.
    """
    given = {name: tuple(v) if isinstance(v, list) else v for name, v in options.items()}
    return simulate(order_for(rig, out=Path(out), **given))
