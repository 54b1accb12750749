"""A ledger of pops: what the host believes against what the flash box did."""

import itertools
from collections import Counter

import pytest

from capture.devices.flash import FlashBox
from capture.devices.port import (
    BoxRebooted,
    CommandRefused,
    DeviceError,
    LinkLost,
    Port,
    PortTimeout,
)
from capture.devices.wire import Code

# pops of a low power: the tube recovers in 12 ms, so that a second pop would not be refused
POWER = 0.008


class Ledger:
    """A host that pops, notes what it was told, and recovers from what goes wrong."""

    def __init__(self, world, url):
        self.world = world
        self.url = url
        self.acknowledged, self.refused, self.unknown = {}, set(), set()
        self.errors = Counter()
        self.tokens = (f"t{number}" for number in itertools.count())
        self.box = None

    def open(self, **settings):
        settings.setdefault("clock", self.world.clock if self.world.virtual else None)
        self.port_settings = settings
        self.box = FlashBox(Port(self.url, **settings))
        return self.box

    def recover(self, error):
        """Make the box usable again after `error`, or raise."""
        self.errors[type(error).__name__] += 1
        if isinstance(error, LinkLost):
            self.world.clock.sleep(1.0)
            self.box.port.reopen()
        elif isinstance(error, (BoxRebooted, PortTimeout)):
            self.box.hello()
        else:
            raise error

    def pop(self):
        """Set up and pop once; whatever happens is noted."""
        token = next(self.tokens)
        sent = False
        try:
            self.box.set_power(POWER)
            self.box.wait_charged(120.0)
            self.box.arm()
            sent = True
            self.acknowledged[token] = self.box.fire(token)
            self.box.dark()
        except CommandRefused as error:
            self.errors[Code(error.code).name] += 1
            self.refused.add(token)
        except DeviceError as error:
            if sent and token not in self.acknowledged:
                self.unknown.add(token)
            for _ in range(20):
                try:
                    self.recover(error)
                    break
                except (LinkLost, BoxRebooted, PortTimeout) as again:
                    error = again
            else:
                raise

    def check(self):
        """Fail where a pop was made twice, made though refused, or acknowledged but not made."""
        made = Counter(pop.token for pop in self.world.pops)
        assert all(count == 1 for count in made.values()), made
        assert set(self.acknowledged) <= set(made)
        assert not self.refused & set(made)
        assert set(made) <= set(self.acknowledged) | self.unknown
        powers = {pop.token: pop.power for pop in self.world.pops}
        for token, report in self.acknowledged.items():
            assert report.token == token
            assert report.power == pytest.approx(powers[token], abs=1e-6)
            assert powers[token] == POWER


@pytest.fixture
def ledger():
    made = []

    def ledger(world, url):
        made.append(Ledger(world, url))
        return made[-1]

    yield ledger
    for one in made:
        if one.box is not None:
            one.box.port.close()
