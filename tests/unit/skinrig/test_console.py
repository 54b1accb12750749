import json

import numpy as np

from skinrig.console import Console


def test_json_is_the_only_thing_on_stdout(capsys):
    console = Console(as_json=True)
    console.print_line("for people")
    console.progress("working")
    console.print_table(("a", "b"), [(1, 2.0)])
    console.print_document("skinrig.x/1", {"value": np.float32(2), "gone": float("nan")})
    out, err = capsys.readouterr()
    assert json.loads(out) == {"schema": "skinrig.x/1", "value": 2.0, "gone": None}
    assert "for people" in err
    assert "working" in err


def test_results_on_stdout_are_readable_without_json(capsys):
    console = Console()
    console.print_line("done")
    console.print_document("skinrig.x/1", {})
    assert capsys.readouterr().out == "done\n"


def test_table_has_dash_for_missing_number(capsys):
    Console().print_table(("what", "share, %"), [("known", 71.239), ("unknown", float("nan"))])
    assert capsys.readouterr().out.splitlines()[1:] == ["known    71.24", "unknown  –"]
