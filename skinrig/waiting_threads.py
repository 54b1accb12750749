"""How threads of a numerical library wait for the next loop that is theirs."""

from collections.abc import MutableMapping

WAITING_ASLEEP = {"OMP_WAIT_POLICY": "PASSIVE"}
"""Threads that spin as they wait hold a core that other work of the machine could have. OpenMP
reads it when it is loaded, which is before the first parallel loop."""


def wait_asleep(environment: MutableMapping[str, str]) -> None:
    """Let threads sleep as they wait, unless the user has said how they shall.

    Parameters
    ----------
    environment
        Variables of this process, before a numerical library is loaded; what is set stays.

    Examples
    --------
    >>> environment = {"HOME": "/home/me"}
    >>> wait_asleep(environment)
    >>> environment["OMP_WAIT_POLICY"]
    'PASSIVE'
    >>> wait_asleep(asked := {"OMP_WAIT_POLICY": "ACTIVE"})
    >>> asked
    {'OMP_WAIT_POLICY': 'ACTIVE'}
    """
    for name, value in WAITING_ASLEEP.items():
        environment.setdefault(name, value)
