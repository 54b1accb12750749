"""A run of long tests alone does not read files without any, and loses none."""

from pathlib import Path
from types import SimpleNamespace

import pytest

CONFTEST = Path(__file__).parents[1] / "conftest.py"
MARK = "@pytest.mark." + "long\ndef test_it(): pass\n"  # in two parts: this file has none


@pytest.fixture
def ignored(request):
    hooks = request.config.pluginmanager.get_plugin(str(CONFTEST))

    def ask(path, asked="long"):
        config = SimpleNamespace(getoption={"markexpr": asked}.get)
        return hooks.pytest_ignore_collect(path, config)

    return ask


@pytest.mark.parametrize(("text", "expected"), [(MARK, None), ("def test_it(): pass\n", True)])
def test_file_collection_depends_on_long_tests(text, expected, tmp_path, ignored):
    path = tmp_path / "test_skin.py"
    path.write_text(text)
    assert ignored(path) is expected
    assert ignored(path, "not long") is None
    assert ignored(path, "") is None


@pytest.mark.parametrize("marks", ["pytest.mark.long", "[pytest.mark.render, pytest.mark.long]"])
def test_file_of_long_tests_alone_is_left_unread(marks, tmp_path, ignored):
    path = tmp_path / "test_skin.py"
    path.write_text(f"pytestmark = {marks}\n\ndef test_it(): pass\n")
    assert ignored(path, "not long") is True
    assert ignored(path, "long") is None
    assert ignored(path, "") is None


@pytest.mark.parametrize("shared", ["conftest.py", "box_harness.py"])
def test_file_is_collected_when_shared_code_marks_long(shared, tmp_path, ignored):
    path = tmp_path / "test_skin.py"
    path.write_text("def test_it(): pass\n")
    (tmp_path / shared).write_text(f"LONG = {MARK!r}")
    assert ignored(path) is None


def test_folders_and_common_files_are_always_read(tmp_path, ignored):
    (tmp_path / "test_folder").mkdir()
    (tmp_path / "conftest.py").write_text("")
    assert ignored(tmp_path / "conftest.py") is None
    assert ignored(tmp_path / "test_folder") is None
