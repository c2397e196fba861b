"""Processes that are started often start without the libraries that only others need."""

from __future__ import annotations

import gc
import importlib
import json
import pkgutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import typer

from service.cli.main import app
from service.computations import SHARED_FOLDERS, job_kinds
from service.core.loading import end_loading, loading
from service.core.protocol import load_protocol
from service.rig import load_rig
from service.run_start import start_run
from service.steps import params_models, step_kinds
from service.store.store import Store
from tests.support.recorded.unpacked_run import unpack_recorded_run
from tests.support.rig.rig import REPOSITORY

NUMERICS = frozenset({"scipy", "cv2", "trimesh", "pycolmap", "plotly"})
OF_THE_WEB = frozenset({"fastapi", "uvicorn", "jinja2", "prometheus_client"})
OF_AN_OLD_STORE = frozenset({"alembic", "mako"})  # loaded to upgrade a database, not to make one
LOADED = """
import json, sys
from service.cli.main import main
sys.argv = ["orthocapture", *sys.argv[1:]]
try:
    main()
except SystemExit as end:
    print(json.dumps({"status": end.code or 0, "modules": sorted(sys.modules)}))
"""
AT_READY = """
import json, sys
from service.cli.main import main
from service.cli import serve
def ready(*_address, **_how):
    raise SystemExit
serve._announce = ready
sys.argv = ["orthocapture", *sys.argv[1:]]
try:
    main()
except SystemExit as end:
    print(json.dumps({"status": end.code or 0, "modules": sorted(sys.modules)}))
"""


def said_by(program: str, *words: str) -> Any:
    """What a Python program prints in its last line, as JSON."""
    said = subprocess.run(
        [sys.executable, "-c", program, *words], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    return json.loads(said.stdout.splitlines()[-1])


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
@pytest.mark.parametrize(
    "words",
    [
        "--help",
        pytest.param("--version", marks=pytest.mark.sweep),
        "status latest",
        pytest.param("act pause", marks=pytest.mark.sweep),
        pytest.param("resume --help", marks=pytest.mark.sweep),
    ],
)
def test_it_starts_without_numerics(words: str, data: Path) -> None:
    folder = () if "--" in words else ("--data", str(data))
    outcome = said_by(LOADED, *words.split(), *folder)
    assert outcome["status"] == 0
    assert "typer" in outcome["modules"]
    assert not (NUMERICS | OF_THE_WEB | OF_AN_OLD_STORE) & set(outcome["modules"])


@pytest.mark.slow
def test_the_state_of_a_run_that_computes_is_told_without_numerics(tmp_path: Path) -> None:
    data = unpack_recorded_run(tmp_path)
    Store.open(data).close()  # upgrades it once
    outcome = said_by(LOADED, "status", "latest", "--json", "--data", str(data))
    assert outcome["status"] == 0
    assert "service.steps.due_jobs" in outcome["modules"]
    assert not (NUMERICS | OF_THE_WEB | OF_AN_OLD_STORE | {"rich.progress"}) & set(outcome["modules"])
    not_of_this_run = {"service.steps.kinds.manual_capture", "service.steps.kinds.layout_check"}
    assert not not_of_this_run & set(outcome["modules"])


@pytest.mark.slow
def test_a_server_is_ready_before_it_has_what_single_pages_need(data: Path, tmp_path: Path) -> None:
    rig = data.parent / "rig.yaml"
    outcome = said_by(AT_READY, "serve", "--rig", str(rig), "--data", str(tmp_path / "new"), "--port", "0", "--json")
    assert outcome["status"] == 0
    assert set(outcome["modules"]) >= OF_THE_WEB
    of_single_pages = {"segno", "rfc3161_client", "service.steps.due_jobs"}
    assert not (NUMERICS | OF_AN_OLD_STORE | of_single_pages) & set(outcome["modules"])


@pytest.mark.parametrize(
    "place",
    ["drivers.host.serving", "simulators.kuka_controller", "simulators.ur_controller", "simulators.sony_camera"],
)
def test_drivers_processes_and_simulators_start_without_what_they_may_not_need(place: str) -> None:
    modules = said_by(f"import json, sys, {place}; print(json.dumps(sorted(sys.modules)))")
    needs = {"cv2"} if place == "simulators.sony_camera" else set[str]()  # a camera writes JPEG files
    assert not (NUMERICS - needs | OF_THE_WEB | {"sqlalchemy", "typer", "yaml"}) & set(modules)


@pytest.mark.parametrize(
    ("package", "kinds", "shared"),
    [("service.computations", job_kinds, SHARED_FOLDERS), ("service.steps.kinds", step_kinds, {})],
)
def test_a_kind_is_declared_where_it_is_looked_for(
    package: str, kinds: Callable[[], Mapping[str, Any]], shared: Mapping[str, tuple[str, ...]]
) -> None:
    path = importlib.import_module(package).__path__
    places = [found.name for found in pkgutil.walk_packages(path, f"{package}.")]
    folders = {name: folder for folder, names in shared.items() for name in names}
    for name, kind in kinds().items():
        modules = [importlib.import_module(p) for p in places if p.endswith(f".{folders.get(name, name)}")]
        kinds_there = [k for m in modules for k in (*vars(m).get("KINDS", ()), vars(m).get("KIND"))]
        declared = [k for k in kinds_there if k is not None and (name not in folders or k.name == name)]
        assert declared == [kind], f"{name} would not be found without importing all kinds"
        assert kinds()[name] is kind


def test_a_kind_is_found_without_the_others() -> None:
    modules = said_by(
        "import json, sys; from service.computations import job_kinds; assert job_kinds()['match'].name == 'match'; "
        "assert job_kinds().get('match') is job_kinds()['match']; print(json.dumps(sorted(sys.modules)))"
    )
    assert "service.computations.image_poses" in modules
    assert "service.computations.fuse" not in modules


def test_the_collector_rests_only_while_modules_are_loaded() -> None:
    assert gc.isenabled()
    frozen = gc.get_freeze_count()
    try:
        with loading():
            assert not gc.isenabled()
            with loading():
                pass
            assert not gc.isenabled()
        assert gc.isenabled()
        assert gc.get_freeze_count() > frozen
        with pytest.raises(ZeroDivisionError), loading():
            raise ZeroDivisionError
        assert gc.isenabled()
        end_loading()
        assert gc.isenabled()
    finally:
        gc.unfreeze()


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
    kinds, modules = said_by(program)
    assert {"scanner", "ct"} <= set(kinds)
    assert not {"scipy", "trimesh", "pydicom"} & set(modules)
