"""Commands of `semiparam`, called within the process of a test."""

import json
from pathlib import Path
from typing import Any

from semiparam_ros.cli.main import main


def semiparam(*arguments: object) -> int:
    """Exit code of a command, whose arguments may be paths and numbers."""
    return main([*map(str, arguments)])


def document(path: Path, *arguments: object) -> dict[str, Any]:
    """Run a command that must succeed; return what it writes to the JSON file ``path``."""
    assert semiparam(*arguments, '--json', path) == 0
    return json.loads(path.read_text())


def refusal(capsys: Any, *arguments: object) -> str:
    """Run a command that must refuse with 2; return its one sentence, beside which stands nothing."""
    capsys.readouterr()
    assert semiparam(*arguments) == 2
    told = capsys.readouterr()
    assert told.err.count('\n') == 1 and not told.out, told
    return told.err
