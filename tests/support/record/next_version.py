"""A next version of this program, as a tree of its own: one more migration, and else the same files.

It is another program than the one that runs the tests, and is started as processes.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import service
from tests.support.processes.forked import ROOT

NEXT = "0008"
_CHANGED = Path("store/database")
_MIGRATION = f'''"""Add inspections, which are evidence, and where a run came from."""

import sqlalchemy as sa
from alembic import op

from service.store.database.database import refuse_changes
from service.store.database.tables import DOUBLE, INTEGER, TEXT

revision = "{NEXT}"
down_revision = "0007"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "inspections",
        sa.Column("run_id", TEXT, nullable=False),
        sa.Column("seq", INTEGER, nullable=False),
        sa.Column("size_mm", DOUBLE),
        sa.PrimaryKeyConstraint("run_id", "seq"),
        sa.ForeignKeyConstraint(["run_id", "seq"], ["events.run_id", "events.seq"]),
        sa.CheckConstraint("seq >= 1", name="inspections_seq"),
        sqlite_strict=True,
    )
    op.create_index("inspections_by_size", "inspections", ["size_mm"])
    refuse_changes(op.get_bind(), "inspections", "run_id = NEW.run_id AND seq = NEW.seq")
    op.add_column("runs", sa.Column("origin", TEXT, nullable=False, server_default=""))
'''
_TABLES = """
inspections = Table(
    "inspections",
    metadata,
    Column("run_id", TEXT, nullable=False),
    Column("seq", INTEGER, nullable=False),
    Column("size_mm", DOUBLE),
    PrimaryKeyConstraint("run_id", "seq"),
    ForeignKeyConstraint(["run_id", "seq"], ["events.run_id", "events.seq"]),
    CheckConstraint("seq >= 1", name="inspections_seq"),
    Index("inspections_by_size", "size_mm"),
    sqlite_strict=True,
)
runs.append_column(Column("origin", TEXT, nullable=False, server_default=""))
"""
_ADDED = {
    "tables.py": _TABLES,
    "database.py": f'REVISIONS = (*REVISIONS, "{NEXT}")\n',
    "postgres.py": 'EVIDENCE = (*EVIDENCE, "inspections")\n',
    f"migrations/versions/{NEXT}_inspections.py": _MIGRATION,
}
_SEVERAL = """
import json, sys
from typer.testing import CliRunner
from service.cli.main import app
for command in json.loads(sys.argv[1]):
    done = CliRunner().invoke(app, command)
    print(json.dumps([done.exit_code, " ".join(done.output.split())]), flush=True)
"""


class NextVersion:
    """The program of the next version."""

    def __init__(self, folder: Path) -> None:
        """Write it into a folder: links to this version's files, and changed copies of those about the database."""
        here, there = Path(service.__file__).parent, folder / "service"
        _link_all_but(here, there, _CHANGED.parts)
        shutil.copytree(here / _CHANGED, there / _CHANGED)
        for name, text in _ADDED.items():
            with (there / _CHANGED / name).open("a", encoding="utf-8") as file:
                file.write(text)
        # Python finds the packages of the working folder first.
        self._place: dict[str, Any] = {"cwd": folder, "env": os.environ | {"PYTHONPATH": f"{folder}:{ROOT}"}}
        subprocess.run([sys.executable, "-m", "tests.support.record.new_schema"], check=True, **self._place)

    def start(self, *arguments: object) -> subprocess.Popen[str]:
        """Start a command; its output can be read together with its errors."""
        command = [sys.executable, "-m", "service.cli.main", *map(str, arguments)]
        return subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **self._place)

    def run(self, *commands: Sequence[object]) -> list[tuple[int, str]]:
        """Run commands, one after another in one process; returns the exit status and output of each."""
        given = json.dumps([[str(argument) for argument in command] for command in commands])
        ended = subprocess.run(
            [sys.executable, "-c", _SEVERAL, given], text=True, check=True, stdout=subprocess.PIPE, **self._place
        )
        return [(status, said) for status, said in map(json.loads, ended.stdout.splitlines())]


def _link_all_but(here: Path, there: Path, changed: Sequence[str]) -> None:
    """Link each entry of a folder into a new one, but for the folders on the way to the one that is changed."""
    if not changed:
        return
    there.mkdir(parents=True)
    for entry in here.iterdir():
        if entry.name != changed[0]:
            (there / entry.name).symlink_to(entry)
    _link_all_but(here / changed[0], there / changed[0], changed[1:])
