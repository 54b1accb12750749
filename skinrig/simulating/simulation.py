"""Simulated captures: a world of boxes and a scene, driven through the real drivers by URL."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from skinrig.simulating.orders import (
    DomeOrder,
    FlashOrder,
    GradientOrder,
    Order,
    ProbeOrder,
    Simulated,
    order_for,
)


def simulate(order: Order) -> Simulated:
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
    match order:
        case FlashOrder():
            from skinrig.simulating.flash import simulate_flash

            return simulate_flash(order)
        case DomeOrder():
            from skinrig.simulating.dome import simulate_dome

            return simulate_dome(order)
        case GradientOrder():
            from skinrig.simulating.gradient import simulate_gradient

            return simulate_gradient(order)
        case ProbeOrder():
            from skinrig.simulating.probe import simulate_probe

            return simulate_probe(order)
    raise TypeError(f"order: got {type(order).__name__}, expected one of a rig's")


def simulate_session(rig: str, out: str | Path, **options: Any) -> Simulated:
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
