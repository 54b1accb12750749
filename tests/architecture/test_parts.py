"""Parts of the tests: each file in one, none left out, about as long."""

from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import pytest

CONFTEST = Path(__file__).parents[1] / "conftest.py"
TESTS = Counter({Path(f"test_{name}.py"): 1 + ord(name) % 7 for name in "abcdefghijklmnopqrst"})
SECONDS = {path: 2.0 * rank for rank, path in enumerate(sorted(TESTS))}


@pytest.fixture
def conftest(request):
    return request.config.pluginmanager.get_plugin(str(CONFTEST))


@pytest.fixture
def choose(conftest):
    return conftest.choose_files


@pytest.mark.parametrize("count", [1, 2, 3, 25])
def test_each_file_is_in_one_part(count, choose):
    parts = [choose(f"{number + 1}/{count}", TESTS, SECONDS) for number in range(count)]
    assert Counter(path for part in parts for path in part) == dict.fromkeys(TESTS, 1)
    loads = [sum(SECONDS[path] for path in part) for part in parts]
    longest = max(SECONDS.values())
    assert max(loads) <= max(longest, sum(loads) / count + longest / 2)


@pytest.mark.parametrize("part", ["0/3", "4/3", "2", "a/b", "1/2/3", "1/0"])
def test_part_without_meaning_is_refused(part, choose):
    with pytest.raises(pytest.UsageError, match=f"got '{part}', expected such as 2/3"):
        choose(part, TESTS, SECONDS)


def test_unrecorded_long_file_precedes_quick_files(conftest):
    def item(path, marker):
        return SimpleNamespace(path=Path(path), get_closest_marker=lambda name: marker)

    items = [item("test_new.py", "long"), item("test_quick.py", None)]
    seconds = conftest.expect_durations_s(items)
    assert seconds[Path("test_new.py")] == conftest.UNRECORDED_LONG_S
    assert Path("test_quick.py") not in seconds
    assert seconds.items() >= conftest.recorded_durations_s().items()
