"""Commands that people type often start without the numerics that others need."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer

from service.cli.main import app
from service.core.protocol.models import load_protocol
from service.rig import load_rig
from service.run_start import start_run
from service.steps import params_models
from service.store.store import Store
from tests.support.rig.rig import REPOSITORY

NUMERICS = ("scipy", "cv2", "trimesh", "pycolmap", "plotly")
LOADED = """
import json, sys
from service.cli.main import main
sys.argv = ["orthocapture", *sys.argv[1:]]
try:
    main()
except SystemExit as end:
    print(json.dumps({"status": end.code or 0, "modules": sorted(name for name in sys.modules if "." not in name)}))
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that waits for its first confirmation."""
    folder = tmp_path_factory.mktemp("begun")
    (folder / "rig.yaml").write_text("name: small\nsimulated: true\ndevices: {}\n")
    protocol = load_protocol(REPOSITORY / "protocols" / "exvivo_spine.yaml", params_models())
    with Store.open(folder / "data") as store:
        start_run(store, protocol, load_rig(folder / "rig.yaml"), operator="Ada", auto_confirm=False)
    return folder / "data"


@pytest.mark.slow
@pytest.mark.parametrize("words", ["--help", "--version", "status latest", "act pause", "resume --help"])
def test_it_starts_without_numerics(words: str, data: Path) -> None:
    folder = () if "--" in words else ("--data", str(data))
    said = subprocess.run(
        [sys.executable, "-c", LOADED, *words.split(), *folder],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    )
    outcome = json.loads(said.stdout.splitlines()[-1])
    assert outcome["status"] == 0, said.stderr
    assert "typer" in outcome["modules"]
    assert not set(NUMERICS) & set(outcome["modules"])


def test_the_list_of_commands_says_what_each_says_itself() -> None:
    group: Any = typer.main.get_command(app)
    context = typer.Context(group)
    for name in group.list_commands(context):
        listed = group.get_command(context, name)
        _, command, _ = group.resolve_command(context, [name])
        assert " ".join((command.help or "").split("\n\n")[0].split()) == listed.help


def test_the_drivers_of_a_rig_are_declared_without_numerics() -> None:
    program = """
import json, sys
from importlib.metadata import entry_points
kinds = {point.load().kind for point in entry_points(group="orthocapture.drivers")}
print(json.dumps([sorted(kinds), sorted(name for name in sys.modules if "." not in name)]))
"""
    said = subprocess.run([sys.executable, "-c", program], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    kinds, modules = json.loads(said.stdout)
    assert {"scanner", "ct"} <= set(kinds)
    assert not {"scipy", "trimesh", "pydicom"} & set(modules)
