"""The files of docs/deploy: their commands are those that tests start, and the programs that read them take them."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import typer
import typer.main
import yaml
from typer.core import TyperGroup

from service.cli.main import app
from service.store.objects.opening import open_objects
from service.store.site import load_site
from tests.support.processes.object_store import Weed, weed_program
from tests.support.processes.site import serve_command, worker_command
from tests.support.rig.rig import REPOSITORY

DEPLOY = REPOSITORY / "docs" / "deploy"
UNITS = sorted(DEPLOY.glob("*.service"))
COMPOSE: dict[str, Any] = yaml.safe_load((DEPLOY / "compose.yaml").read_text(encoding="utf-8"))
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
OWN = {name: service for name, service in SERVICES.items() if service["image"].startswith("orthocapture:")}
PROGRAM = "/opt/orthocapture/.venv/bin/orthocapture"
HERE = Path("x")


def settings(unit: Path) -> dict[str, list[str]]:
    """The settings of a unit, by name; a line that ends with a backslash goes on."""
    found: dict[str, list[str]] = {}
    for line in unit.read_text(encoding="utf-8").replace("\\\n", " ").splitlines():
        name, equals, value = line.partition("=")
        if equals and not line.startswith("#"):
            found.setdefault(name, []).append(value.strip())
    return found


def unit_command(unit: Path) -> list[str]:
    (start,) = settings(unit)["ExecStart"]
    program, *arguments = shlex.split(start)
    assert program == PROGRAM
    return arguments


def parsed(arguments: Sequence[str]) -> tuple[str, dict[str, Any]]:
    """Parse a command line as the program does; returns the command, and the options that were given."""
    command: Any = typer.main.get_command(app)
    names: list[str] = []
    while isinstance(command, TyperGroup):
        names.append(arguments[len(names)])
        command = command.resolve_command(typer.Context(command), [names[-1]])[1]
    context = command.make_context(names[-1], list(arguments[len(names) :]))
    given = [name for name in context.params if context.get_parameter_source(name).name == "COMMANDLINE"]
    return " ".join(names), {name: context.params[name] for name in given}


COMMANDS = {
    **{unit.stem: unit_command(unit) for unit in UNITS},
    **{f"compose: {name}": [str(word) for word in service["command"]] for name, service in OWN.items()},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_the_commands_are_those_that_tests_start_as_processes(name: str) -> None:
    command, given = parsed(COMMANDS[name])
    if command == "store prepare":
        assert set(given) == {"owner_url", "role"}  # tests/store/test_postgres.py gives the same
        return
    by_the_whole_site = [parsed(serve_command(HERE, HERE, HERE, HERE)), parsed(worker_command(HERE))]
    (started,) = (options for started, options in by_the_whole_site if started == command)
    if name == "orthocapture-cart":
        assert set(given) == {"rig", "data"}  # on this machine alone
    else:
        assert set(given) == set(started)


def test_units_and_containers_are_all_there() -> None:
    assert [unit.stem for unit in UNITS] == ["orthocapture-cart", "orthocapture-server", "orthocapture-worker"]
    assert set(SERVICES) == {"database", "objects", "prepare", "server", "worker"}
    assert SERVICES["worker"]["deploy"] == {"replicas": 2}
    for service in SERVICES.values():
        assert "healthcheck" in service or service["command"][0] in ("worker", "store")
        assert set(service["secrets"]) <= set(COMPOSE["secrets"])
        named = {volume.partition(":")[0] for volume in service.get("volumes", ())}
        assert {name for name in named if not name.startswith(".")} <= set(COMPOSE["volumes"])
        for name in named:
            assert not name.startswith("./") or name == "./rig.yaml" or (DEPLOY / name).is_file()


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_a_unit_stops_the_program_as_it_wants_to_be_stopped(unit: Path) -> None:
    found = settings(unit)
    assert found["User"] == ["orthocapture"]
    assert found["KillSignal"] == ["SIGTERM"]
    # Runs go on when a server is restarted (tests/server); a worker's processes end with it.
    assert found["KillMode"] == (["mixed"] if "worker" in unit.stem else ["process"])
    assert ("PrivateTmp" in found) == ("worker" in unit.stem)
    (data,) = found["StateDirectory"]
    assert f"--data /var/lib/{data}" in found["ExecStart"][0]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="this machine has no systemd")
def test_systemd_takes_the_units(tmp_path: Path) -> None:
    program = Path(sys.executable).with_name("orthocapture")
    for unit in UNITS:
        text = unit.read_text(encoding="utf-8").replace(PROGRAM, str(program))
        (tmp_path / unit.name).write_text(text.replace("User=orthocapture", "User=root"), encoding="utf-8")
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *(str(tmp_path / unit.name) for unit in UNITS)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    said = [line for line in done.stderr.splitlines() if str(tmp_path) in line or "orthocapture" in line]
    assert said == []


def test_seaweedfs_is_started_with_options_that_it_has_and_that_tests_give(tmp_path: Path) -> None:
    arguments = [str(word) for word in SERVICES["objects"]["command"]]
    assert arguments[0] == "server"
    helped = subprocess.run([weed_program(), "help", "server"], capture_output=True, text=True, check=False)
    known = set(re.findall(r"^  -([\w.]+)", helped.stdout + helped.stderr, re.MULTILINE))
    given = {re.split("[-=]", word, maxsplit=2)[1] for word in arguments[1:]}
    assert given <= known
    tested = {re.split("[-=]", word, maxsplit=2)[1] for word in Weed(tmp_path / "weed").command[2:]}
    assert given <= tested


def test_the_secrets_are_made_once_and_fit_the_programs_files(tmp_path: Path) -> None:
    made = [subprocess.run([DEPLOY / "make_secrets.sh", "secrets"], cwd=tmp_path, check=False) for _ in range(2)]
    assert [trial.returncode for trial in made] == [0, 1], "nothing is overwritten"
    secrets = tmp_path / "secrets"
    named = {Path(secret["file"]).name for secret in COMPOSE["secrets"].values()}
    assert {path.name for path in secrets.iterdir()} == named - {"certificate.pem", "key.pem"}
    assert stat.S_IMODE(secrets.stat().st_mode) == 0o700
    assert stat.S_IMODE((secrets / "pgpass").stat().st_mode) == 0o600
    assert len({path.read_text() for path in secrets.glob("*_password")}) == 3
    if os.geteuid() == 0:
        (secrets / "store_keys.yaml").chmod(0o600)
        os.chown(secrets / "store_keys.yaml", 0, 0)
    site = yaml.safe_load((DEPLOY / "site.yaml").read_text(encoding="utf-8"))
    assert site["object_store"]["keys"] == "/run/secrets/store_keys"
    site["object_store"]["keys"] = str(secrets / "store_keys.yaml")
    (tmp_path / "site.yaml").write_text(yaml.safe_dump(site), encoding="utf-8")
    loaded = load_site(tmp_path)
    assert loaded is not None
    assert loaded.object_store is not None
    assert open_objects(tmp_path, loaded.object_store).place == "s3://evidence/site at http://objects:8333"
    keys = yaml.safe_load((secrets / "store_keys.yaml").read_text(encoding="utf-8"))
    for_the_server = yaml.safe_load((secrets / "seaweedfs_keys.json").read_text(encoding="utf-8"))
    assert for_the_server["identities"][0]["credentials"] == [
        {"accessKey": keys["access_key_id"], "secretKey": keys["secret_access_key"]}
    ]


SECRET = re.compile(r"(?i)(password|secret_access_key|secretKey)\"?\s*[:=]\s*[\"']?[A-Za-z0-9/+]{8,}")


@pytest.mark.slow
def test_the_demonstration_of_a_site_names_what_is_missing(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "bench.whole_runs.demo_site", "--out", str(tmp_path / "out")],
        cwd=REPOSITORY, env={**os.environ, "PATH": str(tmp_path)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert "sudo apt-get install postgresql" in done.stderr
    assert not (tmp_path / "out").exists()


def test_no_secret_is_in_the_files() -> None:
    for file in DEPLOY.iterdir():
        text = file.read_text(encoding="utf-8")
        assert SECRET.search(text) is None, file
