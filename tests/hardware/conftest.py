"""Run the tests of hardware on a given port, or on the images that `make firmware` has built."""

import contextlib
from types import SimpleNamespace

import pytest
from fixtures.compiled.targets import TARGETS, start_target
from fixtures.quick_close import quick_close

from capture.devices.port import Port

__all__ = ["quick_close"]


def pytest_generate_tests(metafunc):
    if "target" not in metafunc.fixturenames:
        return
    url = metafunc.config.getoption("--device-port")
    only = getattr(metafunc.module, "BOX", None)
    pairs = [(board, box) for board, (boxes, _) in TARGETS.items() for box in boxes]
    images = [
        pytest.param(pair, id="-".join(pair), marks=pytest.mark.long)
        for pair in pairs
        if only is None or pair[1] in only
    ]
    given = [url] if url else images
    metafunc.parametrize("target", given, indirect=True, scope="module")


@pytest.fixture(scope="module")
def target(request):
    """The box with its URL: given on the command line, or an image that runs meanwhile."""
    if isinstance(request.param, str):
        yield SimpleNamespace(url=request.param, board="")
        return
    with contextlib.closing(start_target(*request.param)) as target:
        yield target


@pytest.fixture(scope="module")
def device_port(target):
    return target.url


@pytest.fixture
def attach(device_port):
    """Return a function that opens a box, reset and dark at the end, or skips for another kind."""
    with contextlib.ExitStack() as parts:

        def attach(driver):
            with Port(device_port) as port:
                if port.hello().kind != driver.kind:
                    pytest.skip(f"another box than the {driver.kind}")
            box = parts.enter_context(driver(Port(device_port)))
            parts.callback(box.dark)
            box.reset()
            return box

        yield attach
