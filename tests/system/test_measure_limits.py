"""The tool that compares kernels with limits of the machine: counts, rates and table are right."""

import inspect
import math
import operator
import sys
from pathlib import Path
from types import FunctionType, SimpleNamespace

import numpy as np
import pytest

from reconstruction.brdf_basis import mixture_kernels, row_kernels
from reconstruction.diffuse_albedo import kernels as albedo_kernels
from reconstruction.gradient_normals import moment_kernels, occlusion
from rigsim.light import hidden_sky_kernels, relief_shadow
from rigsim.light.lateral import _flow
from rigsim.render.lens_kernels import gather
from rigsim.scenes.flash import surfaces

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
    """A number that counts its operations and divisions, whoever does them."""

    operations = 0
    divisions = 0

    def __truediv__(self, other):
        if isinstance(other, Counted):
            Counted.divisions += 1
        else:  # by a constant, whose reciprocal is one too
            Counted.operations += 1
        return Counted(float(self) / float(other))

    def __rtruediv__(self, other):
        Counted.divisions += 1
        return Counted(float(other) / float(self))

    def __neg__(self):  # a sign takes no time of its own
        return Counted(-float(self))


def count_operator(name):
    operate = getattr(operator, name)

    def forward(self, other):
        Counted.operations += 1
        found = operate(float(self), float(other))
        return found if isinstance(found, bool) else Counted(found)

    def backward(self, other):
        Counted.operations += 1
        return Counted(operate(float(other), float(self)))

    setattr(Counted, f"__{name}__", forward)
    if name in ("add", "sub", "mul"):
        setattr(Counted, f"__r{name}__", backward)


for _name in ("add", "sub", "mul", "lt", "gt", "le", "ge"):
    count_operator(_name)


def take_root(x):
    Counted.divisions += isinstance(x, Counted)
    return Counted(math.sqrt(x))


def counted(array):
    return np.vectorize(Counted, otypes=[object])(array)


class CountedArrays:
    """NumPy, whose new arrays of float64 hold numbers that count."""

    float64 = float32 = staticmethod(lambda x: x)

    def __getattr__(self, name):
        return getattr(np, name)

    def empty(self, shape, kind=None):
        counts = kind is None or kind is self.float32
        return counted(np.zeros(shape)) if counts else np.empty(shape, kind)


def interpreted(*modules):
    """Return functions of modules of kernels, uncompiled, so that numbers count operations."""
    names = {}
    for module in modules:
        names |= vars(module)
    names |= {"math": SimpleNamespace(**(vars(math) | {"sqrt": take_root})), "np": CountedArrays()}
    names |= {"prange": range, "int64": int, "uint64": int, "float64": lambda x: x}
    for name, value in list(names.items()):
        if hasattr(value, "py_func"):
            names[name] = FunctionType(
                value.py_func.__code__, names, name, None, value.py_func.__closure__
            )
    return SimpleNamespace(**names)


def count_operations(function, *args):
    Counted.operations = Counted.divisions = 0
    function(*args)
    return Counted.operations


def count_both(function, *args):
    return count_operations(function, *args), Counted.divisions


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


def directions(rng, *shape):
    """Return unit vectors about +z."""
    way = rng.standard_normal((*shape, 3))
    way[..., 2] = np.abs(way[..., 2]) + 1.0
    return way / np.linalg.norm(way, axis=-1, keepdims=True)


def test_hidden_sky_cost_is_what_loops_do(costs, rng):
    plain, shape = interpreted(hidden_sky_kernels), (2, 5)
    out, tangent = np.zeros(shape), rng.random(shape)
    planes = np.moveaxis(directions(rng, *shape), -1, 0)
    args = [counted(one) for one in (out, planes, tangent)]
    found = count_both(plain.add_sector_through, *args, 0.3, 0.1)
    cost = costs.add_sector_through(out, planes, tangent, 0.3, 0.1)
    assert found == (cost.float64, cost.division)


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("noise_source", [0, 1, 2])
def test_moment_cost_is_what_lanes_do(costs, rng, noise_source, dark):
    plain, lanes = interpreted(moment_kernels), moment_kernels.PIXEL_LANES
    numbers = rng.uniform(1.4, 1.6, (moment_kernels._LANE_NUMBERS // lanes, lanes))
    numbers[moment_kernels.FULL], numbers[moment_kernels.DARK] = 3.0, 0.1
    numbers, gain, read = counted(numbers.reshape(-1)), Counted(0.1), Counted(1.0)
    operations = divisions = 0
    for turn in range(2 if noise_source == 2 else 1):
        more = count_both(plain._fit_lanes, numbers, noise_source, gain, read, dark, bool(turn))
        operations, divisions = operations + more[0], divisions + more[1]
        divisions -= lanes  # that of a variance with, or without a dark level is not read
    y, out = np.zeros((8, lanes)), np.zeros((moment_kernels.MOMENT_ROWS, lanes))
    cost = costs.fit_moments(y, y, 0.1, 1.0, noise_source, dark, out)
    assert (operations, divisions) == (cost.float64, cost.division)


@pytest.mark.parametrize("channels", [1, 3])
def test_albedo_cost_is_what_loops_do(costs, rng, channels):
    plain, samples = interpreted(albedo_kernels), 7

    def numbers(*shape):
        return counted(rng.uniform(0.2, 0.5, (*shape, samples)))

    ways = [counted(directions(rng, samples)) for _ in range(2)]
    valid = np.ones((samples, channels), bool)
    colors = [counted(np.ones((samples, channels))) for _ in range(2)]
    rows = [numbers(rank) for rank in (3, channels, channels, channels)]
    up = counted([0.0, 0.0, 1.0])
    once = [count_both(plain._pick_samples, *colors, *ways, up, valid, *rows)]
    once += [count_both(plain._fill_factors, *(numbers() for _ in range(3)), 1.4, *numbers(4))]
    for k in range(albedo_kernels._N_LOBES):
        lobe = [numbers() for _ in range(4)]
        has_tail = k >= albedo_kernels._N_BECKMANN
        once.append(count_both(plain._fill_lobe, *lobe, 0.5, has_tail, numbers()))
    step = []
    for _ in range(channels):
        one, factors, sums = numbers(3), tuple(numbers(3)), numbers(3)
        settings = (Counted(0.3), 1.0, 0.01, 4.0)
        step.append(count_both(plain._weigh, *one, factors, *settings, *sums))
    solution = np.zeros((channels + 6, channels + 6)), np.zeros(channels + 6)
    arrays = numbers(6), numbers(), numbers(), numbers(channels), numbers()
    step.append(count_both(plain._fill_lobe_equations, *arrays, *solution))
    found = np.sum(once, axis=0) + albedo_kernels.N_FIT_STEPS * np.sum(step, axis=0)
    # threes of products: 27 instead of the 21 that are needed
    found[0] -= albedo_kernels.N_FIT_STEPS * 2 * 6 * samples
    f, light = np.zeros((1, samples, channels)), np.zeros((1, samples, 3))
    cost = costs.fit_envelope(f, f, light, light, light[:, 0], valid[None], *[None] * 9)
    assert tuple(found) == (cost.float64, cost.division)


@pytest.mark.parametrize("count", [4, 16])
def test_mixture_cost_is_what_loops_do(costs, rng, count):
    plain = interpreted(row_kernels, mixture_kernels)
    table = np.full((32, 12, 90, 16), Counted(0.5), object)
    light, view = directions(rng, 2, 3), directions(rng, 2, 3)
    normals, out = np.repeat([[0.0, 0.0, 1.0]], 2, axis=0), np.zeros((2, 3))
    weights = rng.random((2, count))
    given = [counted(one) for one in (weights, light, view, normals)]
    found = count_both(plain._mixtures, table, *given, out)
    cost = costs.mix_basis(table, weights, light, view, normals, out)
    assert found == (cost.float64, cost.division)
    assert out.all()


def test_occlusion_cost_is_what_loops_do(costs, rng):
    plain, width, lights, steps = interpreted(occlusion), 5, 6, 4

    def numbers(*shape):
        return counted(rng.uniform(0.1, 0.5, shape))

    def lit(count):
        table = numbers(12, count)
        table[10] = Counted(0.3)  # the elevation of the horizon, so that half of the light is left
        return table

    line = [numbers(width + 1), numbers(width + 1), numbers(width)]
    sample = count_both(plain._raise_tangents, *line, 0.2, 0.3, 0.1, numbers(width))
    elevation = count_both(plain._convert_to_elevations, numbers(width))
    light = []
    for hidden in (False, True):
        few, many = (
            count_both(
                plain._observed,
                *numbers(2),
                (lit(n), np.zeros((2, n), int)),
                counted(np.full(24, 0.3)),
                0.25,
                hidden,
            )
            for n in (lights, 2 * lights)
        )
        light.append(np.subtract(many, few) / lights)
    directions = occlusion.HORIZON_DIRECTIONS
    pixel = directions * (steps * np.array(sample) + elevation) / width
    pixel = pixel + lights * np.sum(light, axis=0)
    shift, places = np.zeros((2, directions, steps), int), np.zeros((3, 5, 2))
    relief, table = np.zeros((3, 5)), np.zeros((12, lights))
    cost = costs.solve_occlusion(relief, places, (shift, None, 1), (table, None), 0.25)
    assert tuple(pixel * 15) == pytest.approx((cost.float64, cost.division))


def test_horizon_cost_is_fewest_that_loops_do(costs, rng):
    """Each test of the hull's points, of which the count has none, takes more."""
    plain, field = interpreted(relief_shadow), -rng.random((4, 6)).cumsum(axis=1)
    out = np.zeros((4, 6))
    found = count_both(plain._sweep, counted(field), Counted(1.0), Counted(0.0), out)
    cost = costs.sweep(field, 1.0, 0.0, out)
    assert found[0] >= cost.float32 > 0
    assert found[1] >= 2 * cost.division == np.count_nonzero(out) > 0


def test_average_cost_is_what_loops_do(costs, rng):
    """Columns of maps, and numbers without an axis of their own."""
    plain = interpreted(surfaces)
    pixel, first = np.array([1, 4, 5]), np.array([0, 2, 3, 7])
    for inner in ((), (3,), (2, 3)):
        rows = rng.random((7, *inner))
        out = counted(np.zeros((6, math.prod(inner))))
        found = count_operations(
            plain._average_hits, counted(rows.reshape(7, -1)), pixel, first, out
        )
        hits = SimpleNamespace(shape=(2, 3), first=first)
        cost = costs.average_hits(hits, rows)
        assert found == cost.float32 + 3 * math.prod(inner)  # and a mean per pixel
        assert cost.bytes == rows.nbytes + first.nbytes + 4 * out.size


def test_shortest_time_is_that_of_the_bound(costs, tool):
    rates = {"copy": 10.0, "float32": 100.0, "float64": 50.0, "division": 5.0, "exp": 2.0}
    rates |= {"normal": 1.0, "poisson": 0.5, "gather": 4.0}
    seconds = tool.shortest_seconds
    assert seconds(costs.Cost(bytes=30.0, float32=100.0), rates) == ("memory", 3.0)
    work = costs.Cost(bytes=30.0, float32=100.0, float64=50.0, division=10.0)
    assert seconds(work, rates) == ("memory", 3.0)  # classes overlap
    assert seconds(costs.Cost(float32=100.0, float64=75.0), rates) == ("arithmetic", 1.5)
    assert seconds(costs.Cost(division=10.0, exp=5.0), rates) == ("functions", 2.5)
    assert seconds(costs.Cost(division=10.0, float64=50.0), rates) == ("divisions", 2.0)
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


def test_every_kernel_exists_and_takes_its_step(tool):
    for kernel in tool.KERNELS:
        owner = tool.importlib.import_module(kernel.module)
        for name in kernel.name.split("."):
            owner = getattr(owner, name)
        assert callable(owner), kernel.name
        if kernel.makes:  # the function is given to the compiler by its maker
            owner = vars(sys.modules[kernel.module])[f"_{kernel.name}"]
        named = inspect.signature(getattr(owner, "py_func", owner)).parameters.values()
        given = [one for one in named if one.kind is not inspect.Parameter.KEYWORD_ONLY]
        options = {one.name: None for one in named if one not in given}
        inspect.signature(kernel.prepare).bind(*given)
        for function in (kernel.count, kernel.cost or kernel.count):
            inspect.signature(function).bind(*given, **options)
        assert set(kernel.steps) <= set(tool.STEPS), kernel.name
    with pytest.raises(SystemExit, match="reads a run's sessions"):
        tool.measure("dome", "reconstruct", None)
