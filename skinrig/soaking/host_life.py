"""End the simulated process of a host: after that it sends nothing and writes nothing."""

from typing import NoReturn


class HostKilled(BaseException):
    """The host's process ends: no code of it runs afterwards."""


class HostLife:
    """Life of one process of a host.

    Attributes
    ----------
    ended : bool
        Whether it was killed.
    """

    def __init__(self) -> None:
        self.ended = False

    def require(self) -> None:
        """Raise `HostKilled` once the process has ended."""
        if self.ended:
            raise HostKilled

    def end(self) -> NoReturn:
        """End the process."""
        self.ended = True
        raise HostKilled
