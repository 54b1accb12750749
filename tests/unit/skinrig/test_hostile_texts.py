"""Names and notes of a stranger's session are text in pages and terminals, never commands."""

import csv
import io
from html.parser import HTMLParser
from pathlib import Path

import pytest

from capture.plan import flash_plan
from capture.rig import load_rig
from capture.session import Session, SubjectRecord
from skinrig import unit_format
from skinrig.cli import main
from skinrig.console import Console
from skinrig.reporting import report
from skinrig.unit_format import format_csv

RIG = load_rig("flash").resized(16)
HOSTILE = "</script></style>--><hostile onload=1>\"'<hostile a=`x`>${1}&lt;\x1b[2J\x9b31m\u202e"


class Tags(HTMLParser):
    def __init__(self):
        super().__init__()
        self.tags, self.handlers = [], []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.handlers += [name for name, _ in attributes if name.startswith("on")]


def make_session(path, text):
    with Session.create(
        path,
        plan=flash_plan(RIG, darks=1),
        rig=RIG,
        devices={"flash": text, "cam": text},
        subject=SubjectRecord("P042", ("research",)),
        source="measured",
        extra={"effects": [{"name": text, "verdict": text, "reason": text}], text: text},
    ) as made:
        made.omit_steps(["S000"], reason=text, about={"why": text}, t_host_s=0.0)
        made.attach("note.txt", b"x", about={"kind": text})
        made.close(missing_reason=text)
    return path


def test_report_of_hostile_session_has_no_foreign_tag(tmp_path):
    parsed = []
    for text in ("plain", HOSTILE):
        path = make_session(tmp_path / ("a" if text == "plain" else "b"), text)
        tags = Tags()
        tags.feed(html := report.build([path]))
        parsed.append(tags)
        assert ("hostile" in html) == (text == HOSTILE)
    assert "hostile" not in parsed[1].tags
    assert parsed[1].tags == parsed[0].tags
    assert parsed[1].handlers == parsed[0].handlers


def test_report_keeps_hostile_text_as_text(tmp_path):
    html = report.build([make_session(tmp_path / "s", HOSTILE)])
    assert "&lt;hostile" in html


def test_verify_of_hostile_session_commands_no_terminal(tmp_path, capsys):
    main(["verify", str(make_session(tmp_path / "s", HOSTILE))])
    out, err = capsys.readouterr()
    assert "<hostile" in out + err
    assert not set("\x1b\x9b\u202e") & set(out + err)


@pytest.mark.parametrize("as_json", [False, True])
def test_console_escapes_what_commands_a_terminal(as_json, capsys):
    console = Console(as_json)
    console.print_line("a\x1b]0;title\x07b\udc80")
    console.progress("\aprompt\r")
    console.print_table(("n",), [("\x1b[1m",)])
    out, err = capsys.readouterr()
    text = out + err
    assert "\\x1b]0;title" in text
    assert "\\udc80" in text
    assert not {"\x1b", "\r"} & set(text)


@pytest.mark.parametrize("text", ["=cmd|' /C calc'!A0", "+1+1", "-2+3", "@SUM(A1)", "\r=1"])
def test_text_in_csv_is_not_a_formula(text):
    (cells,) = csv.reader(io.StringIO(format_csv([(text, -1.5, "-1.5", "a=b")]), newline=""))
    assert cells == ["'" + text.replace("\r", " "), "-1.5", "-1.5", "a=b"]


def test_text_after_semicolon_is_not_a_formula():
    assert format_csv([("a;=1", "b; @x", "c-d")]) == "a;'=1,b; '@x,c-d\n"


def test_every_written_csv_passes_the_guard():
    root = Path(unit_format.__file__).parent
    writers = [p.name for p in root.rglob("*.py") if "csv.writer(" in p.read_text("utf-8")]
    assert writers == ["unit_format.py"]
    assert not [p for p in root.rglob("*.py") if "DictWriter" in p.read_text("utf-8")]
