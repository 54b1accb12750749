"""The tool that compares kernels with limits of the machine: counts, rates and table are right."""

import sys
from pathlib import Path

import numpy as np
import pytest

from rigsim.light.lateral import _flow
from rigsim.render.lens_kernels import gather

TOOLS = Path(__file__).parents[2] / "tools"


@pytest.fixture(scope="module")
def costs():
    sys.path.insert(0, str(TOOLS))
    import kernel_costs

    yield kernel_costs
    sys.path.remove(str(TOOLS))


@pytest.fixture(scope="module")
def tool(costs):
    import measure_limits

    return measure_limits


class Counted(float):
    """A number that counts its operations, whoever does them."""

    operations = 0

    def __mul__(self, other):
        Counted.operations += 1
        return Counted(float(self) * float(other))

    def __add__(self, other):
        Counted.operations += 1
        return Counted(float(self) + float(other))

    def __lt__(self, other):
        Counted.operations += 1
        return float(self) < float(other)


def counted(array):
    return np.vectorize(Counted, otypes=[object])(array)


def count_operations(function, *args):
    Counted.operations = 0
    function(*args)
    return Counted.operations


def test_flow_cost_is_what_its_loops_do(costs, rng):
    field, factors = rng.random((3, 7, 5), np.float32), rng.random((3, 7, 5), np.float32)
    found = count_operations(_flow.py_func, counted(field), *map(counted, factors))
    cost = costs.flow(field, *factors)
    # the first row has no row before it, the last none after it
    assert found == cost.float32 - 4 * 3 * 5
    assert cost.bytes == 4 * (4 * field.size + factors.size)


def test_gather_cost_is_what_its_loops_do(costs, rng):
    """Every other pixel has two samples; windows end at the image's border."""
    height, width, radius, channels = 6, 5, 2, 4
    lookup = np.full((height, width), -1, np.int32)
    lookup.reshape(-1)[::2] = np.arange(15)
    first = np.arange(0, 31, 2, dtype=np.int32)
    slot, slices = np.zeros(30, np.uint8), np.zeros(30, np.uint8)
    numbers = [rng.random(n, np.float32) for n in (30, 25, 30, 30, 120, 120)]
    toward, table, cut, far = numbers[0], numbers[1].reshape(1, 25, 1), *numbers[2:4]
    cut, far = (one.reshape(height, width) for one in (cut, far))
    rows, out = numbers[4].reshape(30, channels), numbers[5].reshape(height, width, channels)
    plain = [lookup, first, slot, slices, toward, table, radius, cut, far, rows, out]
    changed = [counted(one) if k in (4, 5, 7, 8, 9, 10) else one for k, one in enumerate(plain)]
    found = count_operations(gather.py_func, *changed)
    assert found == costs.gather(*plain).float32 > 0


def test_shortest_time_is_that_of_the_bound(costs, tool):
    rates = {"copy": 10.0, "float32": 100.0, "float64": 50.0, "division": 5.0, "exp": 2.0}
    rates |= {"normal": 1.0, "poisson": 0.5, "gather": 4.0}
    seconds = tool.shortest_seconds
    assert seconds(costs.Cost(bytes=30.0, float32=100.0), rates) == ("memory", 3.0)
    work = costs.Cost(bytes=30.0, float32=100.0, float64=50.0, division=10.0)
    assert seconds(work, rates) == ("arithmetic", 4.0)
    assert seconds(costs.Cost(normal=1.0, poisson=1.0), rates) == ("random numbers", 3.0)
    assert seconds(costs.Cost(gather=8.0, float32=100.0), rates) == ("gathers", 2.0)


def test_step_runs_and_puts_its_kernels_back(costs, tool, monkeypatch):
    from rigsim import sensor
    from rigsim.scenes import exposing

    words = "simulate flash --seed 0 --target flat --width 64 --out {out}/session"
    monkeypatch.setattr(tool, "STEPS", {("flash", "capture"): tuple(words.split())})
    monkeypatch.setattr(tool, "STREAM_BYTES", 1 << 16)
    monkeypatch.setattr(tool, "TABLE_BYTES", 1 << 16)
    monkeypatch.setattr(tool, "MIN_CALL_S", 1e-3)
    before = sensor.expose_sensor, exposing.expose_sensor
    record = tool.measure("flash", "capture", None)
    assert (sensor.expose_sensor, exposing.expose_sensor) == before
    row = next(one for one in record["rows"] if one["kernel"] == "rigsim.sensor.expose_sensor")
    assert row["bound"] == "random numbers"
    assert 0.0 < row["share"] < 1.0
    assert 0.05 < row["fraction"] < 1.5
    lines = tool.tabulate([record])
    assert any(
        line.startswith("| flash, capture: rigsim.sensor.expose_sensor | ") for line in lines
    )
    assert all(line.count("|") == 6 for line in lines if "expose_sensor" in line)


def test_every_kernel_exists_and_takes_its_step(costs, tool):
    for kernel in costs.KERNELS:
        owner = tool.importlib.import_module(kernel.module)
        for name in kernel.name.split("."):
            owner = getattr(owner, name)
        assert callable(owner), kernel.name
        assert set(kernel.steps) <= set(costs.STEPS), kernel.name
    with pytest.raises(SystemExit, match="reads a run's sessions"):
        tool.measure("dome", "reconstruct", None)
