"""Commands suggested for a folder of maps run to their end."""

import shlex
from pathlib import Path

import pytest

from model import store
from skinrig.cli import main
from skinrig.consent import parse_subject
from skinrig.next_steps import suggest
from skinrig.viewer import faces
from skinrig.workspace import scan


@pytest.mark.long
def test_suggested_commands_run_to_their_end(patch, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(faces, "FACE_PX", 256)  # other tests build pages of 2048 texels
    consent = [parse_subject("none", None, None).to_json()]
    made = patch.face(source="measured", parameters={"consent": consent})
    store.write(tmp_path / "appearance", made)
    suggested = [step.command for step in suggest(scan(Path()), Path())]
    assert [command.split()[1] for command in suggested] == ["report", "view", "export"]
    for command in suggested:
        assert main(shlex.split(command)[1:]) == 0, (command, capsys.readouterr().err)
