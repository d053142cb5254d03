"""Commands called in this process."""

import sys

import pytest

from lscan.cli.app import app
from lscan.cli.console import run_command_line


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of ``lscan ARGUMENTS``."""
    capsys.readouterr()
    sys.argv = ["lscan", *map(str, arguments)]
    with pytest.raises(SystemExit) as left:
        run_command_line(app, "lscan")
    code = left.value.code
    output = capsys.readouterr()
    assert isinstance(code, int)
    return code, output.out, output.err


def refused(result: tuple[int, str, str], *words: str) -> None:
    """The call ended with code 2 and one line on stderr that holds the words."""
    code, out, err = result
    assert code == 2, err
    assert out == ""
    assert err.count("\n") == 1, err
    for word in words:
        assert word in err
