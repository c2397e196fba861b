"""Shell completion, as bash asks for it: commands, subcommands and options."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

COMMAND = Path(sys.executable).with_name("orthocapture")
ASK = """
source <(_ORTHOCAPTURE_COMPLETE=source_bash orthocapture)
COMP_WORDS=(orthocapture "$@")
COMP_CWORD=$#
_orthocapture_completion orthocapture
printf '%s\\n' "${COMPREPLY[@]}"
"""


def offered(*typed: str) -> list[str]:
    """What bash offers after `orthocapture` and these words, the last of which is not finished."""
    environment = os.environ | {"PATH": f"{COMMAND.parent}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "-c", ASK, "bash", *typed], capture_output=True, text=True, check=True, env=environment, timeout=60
    )
    return done.stdout.split()


@pytest.mark.parametrize(
    ("typed", "words"),
    [
        (("re",), {"register", "resume"}),
        (("audit", "ve"), {"verify"}),
        (("run", "--auto"), {"--auto-confirm"}),
    ],
)
def test_bash_completes_commands_and_options(typed: tuple[str, ...], words: set[str]) -> None:
    assert words <= set(offered(*typed))


def test_nothing_is_offered_for_an_unknown_beginning() -> None:
    assert offered("zz") == []
