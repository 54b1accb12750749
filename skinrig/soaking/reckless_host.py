"""Request as much light as a controller gives: its own limits alone protect the subject."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from capture.devices.port import CommandRefused, Port
from rigsim.world import World

LONG_SHARE, FLICKER_SHARE = 0.25, 0.4
"""Shares of the runs that reach the dose limit of an LED, and that flicker."""
FEW_REQUESTS, MANY_REQUESTS, FLASH_REQUESTS = 25, 450, 120
MEAN_PAUSE_S = 0.4
FLASH_PAUSE_S = 0.6
"""Mean pause, s: all requests take longer than the minute of the flash's limit."""
FLICKER_PAUSE_S = 0.12
DARK_PAUSE_S = 3.0
LIGHT_COMMANDS: Final = {
    "dome": "LED:ON {led},{ms},1000",
    "gradient_sphere": "PATT full,{ms},1000",
    "flash": "FLAS:FIRE r{number}",
}
"""Command of light by kind of controller."""


def request_too_much_light(
    world: World, world_name: str, kind: str, *, rng: np.random.Generator, first_seq: int
) -> bool:
    """Request light again and again as the host of a new subject with open eyes.

    Parameters
    ----------
    world, world_name
        World of the controller, and its name.
    kind
        Kind of the controller: one of `LIGHT_COMMANDS`.
    rng
        Draws commands and pauses.
    first_seq
        First number of the host.

    Returns
    -------
    bool
        Whether light that was on went out when the host made all dark.
    """
    with Port(f"sim://{kind}?world={world_name}", clock=world.clock, first_seq=first_seq) as port:
        port.hello()
        setup = ["FLAS:POW 0.05"] if kind == "flash" else ["DOSE:NEW reckless", "SAFE:EYES OPEN"]
        for text in (*setup, "SYST:WDOG 5000"):
            port.ask(text)
        for command, pause_s in _draw_requests(kind, len(world.rig.lights), rng):
            port.ask("SYST:ARM")
            try:
                port.ask(command)
            except CommandRefused:
                pass  # the limit that is under test
            world.clock.sleep(pause_s)
        world.clock.sleep(DARK_PAUSE_S)
        port.ask("SYST:ARM")
        try:
            port.ask("FLAS:LAMP ON,500" if kind == "flash" else _command(kind, 0, 200, 0))
        except CommandRefused:
            pass
        port.ask("SAFE")
        return not world.box(kind).device.lit  # type: ignore[attr-defined]


def _command(kind: str, led: int, ms: int, number: int) -> str:
    return LIGHT_COMMANDS[kind].format(led=led, ms=ms, number=number)


def _draw_requests(kind: str, lights: int, rng: np.random.Generator) -> Iterator[tuple[str, float]]:
    """Yield commands of light, each with the pause after it, s."""
    led, style = int(rng.integers(lights)), rng.random()
    if kind == "flash":
        for number in range(FLASH_REQUESTS):
            yield _command(kind, led, 0, number), float(rng.exponential(FLASH_PAUSE_S))
    elif style < LONG_SHARE:
        for _ in range(MANY_REQUESTS):
            yield _command(kind, led, 250, 0), 1.0
    elif style < LONG_SHARE + FLICKER_SHARE:
        for _ in range(FEW_REQUESTS):
            yield _command(kind, led, int(rng.integers(5, 40)), 0), FLICKER_PAUSE_S
    else:
        for _ in range(FEW_REQUESTS):
            led = int(rng.integers(lights)) if rng.random() < 0.3 else led
            pause_s = float(rng.exponential(MEAN_PAUSE_S))
            yield _command(kind, led, int(rng.integers(20, 500)), 0), pause_s
