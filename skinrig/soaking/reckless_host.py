"""Request as much light as a controller gives: its own limits alone protect the subject."""

from typing import Final

import numpy as np

from capture.devices.port import CommandRefused, Port
from rigsim.world import World

LONG_SHARE: Final = 0.15
"""Share of the runs that are long enough to reach the dose limit of an LED."""
FEW_REQUESTS, MANY_REQUESTS, FLASH_REQUESTS = 25, 700, 120
MEAN_PAUSE_S = 0.4
FLASH_PAUSE_S = 0.6
"""Mean pause, s: all requests take longer than the minute of the flash's limit."""
LIGHT_COMMANDS: Final = {
    "dome": "LED:ON {led},{ms},1000",
    "gradient_sphere": "PATT full,{ms},1000",
    "flash": "FLAS:FIRE r{number}",
}
"""Command of light by kind of controller."""


def request_too_much_light(
    world: World, world_name: str, kind: str, *, rng: np.random.Generator, first_seq: int
) -> None:
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
    """
    many = kind != "flash" and rng.random() < LONG_SHARE
    lights = len(world.rig.lights)
    led = int(rng.integers(lights))
    with Port(f"sim://{kind}?world={world_name}", clock=world.clock, first_seq=first_seq) as port:
        port.hello()
        setup = ["FLAS:POW 0.05"] if kind == "flash" else ["DOSE:NEW reckless", "SAFE:EYES OPEN"]
        for text in (*setup, "SYST:WDOG 5000"):
            port.ask(text)
        few, pause_s = FEW_REQUESTS, MEAN_PAUSE_S
        if kind == "flash":
            few, pause_s = FLASH_REQUESTS, FLASH_PAUSE_S
        for number in range(MANY_REQUESTS if many else few):
            if not many and rng.random() < 0.3:
                led = int(rng.integers(lights))
            ms = 500 if many else int(rng.integers(20, 900))
            port.ask("SYST:ARM")
            try:
                port.ask(LIGHT_COMMANDS[kind].format(led=led, ms=ms, number=number))
            except CommandRefused:
                pass  # the limit that is under test
            world.clock.sleep(1.0 if many else float(rng.exponential(pause_s)))
        world.clock.sleep(1.0)
        port.ask("SAFE")
