"""The person and the flash rig that most tests of scenes and subjects look at."""

import pytest

from capture.rig import Rig, load_rig
from rigsim.subject import SimulatedSubject, make_subject


@pytest.fixture(scope="session")
def face() -> SimulatedSubject:
    return make_subject("II", seed=4, size=256)


@pytest.fixture(scope="session")
def rig() -> Rig:
    return load_rig("flash").resized(252)
