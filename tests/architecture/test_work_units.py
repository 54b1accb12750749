"""Units of files for one process, and the reports that a process sends."""

from pathlib import Path
from types import SimpleNamespace

import pytest

PLUGIN = "work_units"


@pytest.fixture
def work_units(request):
    plugins = request.config.pluginmanager.get_plugins()
    return next(one for one in plugins if getattr(one, "__name__", "") == PLUGIN)


@pytest.mark.parametrize(
    ("file", "unit"),
    [
        ("tests/architecture/test_sizes.py", "tests/architecture"),
        ("tests/system/test_docs.py", "tests/architecture"),
        ("tests/unit/rigsim/scenes/gradient/test_scene.py", "tests/unit/rigsim/scenes"),
        ("tests/unit/rigsim/test_sensor.py", "tests/unit/rigsim/test_sensor.py"),
        ("tests/recovery/test_dome_rig.py", "tests/recovery/test_dome_rig.py"),
        ("model/skin.py", "model/skin.py"),
    ],
)
def test_folders_of_unit_tests_are_units(file, unit, work_units):
    assert work_units.name_unit(file) == unit


def report(**changed):
    facts = {"when": "setup", "passed": True, "sections": [], "user_properties": []}
    return SimpleNamespace(**facts | {"duration": 0.001} | changed)


@pytest.mark.parametrize(
    "changed",
    [
        {"when": "call"},
        {"passed": False},
        {"sections": [("log", "a warning")]},
        {"user_properties": [("attempts", 2)]},
        {"duration": 0.5},
    ],
)
def test_reports_with_news_are_sent(changed, work_units):
    assert work_units.is_worth_sending(report(**changed))


def test_quick_setup_without_news_is_not_sent(work_units):
    assert not work_units.is_worth_sending(report())


def test_workers_run_each_test_once_in_units(tmp_path, work_units):
    """Two processes, files of two folders: the tests of a folder share a process."""
    pytest.importorskip("xdist")
    from xdist.scheduler import LoadFileScheduling

    def config(dist):
        values = {"dist": dist, "tx": ["2*popen"]}
        option = SimpleNamespace(loadscopereorder=False)
        return SimpleNamespace(getvalue=values.get, getoption=lambda *_: [], option=option)

    make = work_units.pytest_xdist_make_scheduler
    assert make(config("load"), None) is None
    tests = [f"tests/unit/model/{folder}/test_{n}.py::test_x" for folder in "ab" for n in range(3)]
    made = make(config("loadfile"), None)
    assert isinstance(made, LoadFileScheduling)
    nodes = [Node(name) for name in ("one", "two")]
    for node in nodes:
        made.add_node(node)
        made.add_node_collection(node, tests)
    made.schedule()
    assert sorted(number for node in nodes for number in node.asked) == list(range(6))
    folders = [{tests[number].split("/")[3] for number in node.asked} for node in nodes]
    assert sorted(map(sorted, folders)) == [["a"], ["b"]]


@pytest.mark.parametrize(
    ("waiting", "elsewhere", "position"),
    [
        ([False, True, True], False, 1),
        ([False, True, True], True, 0),
        ([True, True, False], True, 2),
        ([True, True], True, 0),
        ([False, False], False, 0),
    ],
)
def test_one_process_at_a_time_waits(waiting, elsewhere, position, work_units):
    assert work_units.choose_unit(waiting, elsewhere) == position


def test_units_that_wait_are_known_by_folder(work_units):
    assert work_units.waits("tests/protocol/test_port.py")
    assert work_units.waits("tests/firmware/test_resets.py")
    assert not work_units.waits("tests/unit/capture/devices")
    assert not work_units.waits("model/skin.py")
    folders = (Path(__file__).parents[1] / folder for folder in work_units.REAL_TIME)
    assert all(folder.is_dir() for folder in folders)


class Node:
    """A process of tests, as far as a scheduler asks for it."""

    shutting_down = False

    def __init__(self, name):
        self.gateway = SimpleNamespace(id=name)
        self.asked = []

    def send_runtest_some(self, numbers):
        self.asked += numbers

    def shutdown(self):
        self.shutting_down = True
