"""A run with `-k` reads the files that can hold a test of the expression, and loses none."""

from types import SimpleNamespace

import keyword_files
import pytest

NAMES = "tests\ntest_color.py\ntest_skin_is_red[fiber-probe]\nlong"


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "test_color.py"
    path.write_text("def test_skin_is_red(): pass\n")
    return path


def recorded(path):
    return {str(path): [keyword_files.stamp(path), NAMES]}


@pytest.mark.parametrize(
    ("expression", "is_read"),
    [
        ("skin", True),
        ("SKIN_is", True),
        ("fiber-probe", True),
        ("long", True),
        ("pass", False),
        ("color", True),
        ("skin and red", True),
        ("skin and blue", False),
        ("blue or red", True),
        ("blue", False),
        ("not blue", True),
        ("not skin", True),
        ("skin and", True),
    ],
)
def test_unchanged_file_is_read_when_it_can_match(expression, is_read, path):
    assert keyword_files.can_match(path, expression, recorded(path)) is is_read


def test_changed_or_unrecorded_file_is_read(path):
    old = {str(path): [keyword_files.stamp(path) - 1, NAMES]}
    assert keyword_files.can_match(path, "blue", old)
    assert keyword_files.can_match(path, "blue", {})


def test_names_are_those_that_pytest_compares(request):
    own = [item for item in request.session.items if item.path == request.path]
    record = keyword_files.make_record(own)
    for expression in ("keyword_files and names_are_those", "skin and-True", "architecture"):
        assert keyword_files.can_match(request.path, expression, record)
    assert not keyword_files.can_match(request.path, "nobody_has_it", record)


@pytest.mark.parametrize(
    ("change", "is_recorded"),
    [
        ({}, True),
        ({"args": ["tests/test_color.py::test_skin"]}, False),
        ({"lf": True}, False),
        ({"workerinput": {}}, False),
    ],
)
def test_file_is_recorded_unless_read_in_part(change, is_recorded, request):
    written = {}
    kept = SimpleNamespace(get=lambda key, default: default, set=written.__setitem__)
    own = {"cache": kept, "args": ["tests"], "getoption": lambda *_: change.get("lf", False)}

    class Config(SimpleNamespace):
        __hash__ = object.__hash__

    config = Config(**own | change)
    keyword_files.pytest_collection_modifyitems(config, [request.node])
    assert bool(written) is is_recorded


def test_folder_is_left_unread_with_all_its_files(tmp_path, path, monkeypatch):
    (tmp_path / "conftest.py").write_text("")
    (tmp_path / "library").mkdir()
    monkeypatch.setattr(keyword_files, "read_record", lambda _: recorded(path))

    def is_left(folder, expression):
        config = SimpleNamespace(getoption={"keyword": expression}.get)
        return keyword_files.pytest_ignore_collect(folder, config)

    assert is_left(tmp_path, "blue") is True
    assert is_left(tmp_path, "skin") is None
    assert is_left(tmp_path, "") is None
    assert is_left(tmp_path / "conftest.py", "blue") is None
    assert is_left(tmp_path / "library", "blue") is None
    (tmp_path / "test_new.py").write_text("")
    assert is_left(tmp_path, "blue") is None
