"""A real PostgreSQL server for tests: a cluster of their own, which another user than root runs, behind a socket."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import psutil
import psycopg

from service.store.database.postgres import prepare

OWNER, ROLE, OTHER = "oc_owner", "oc_app", "postgres"
_LIVED_WITH_ROOT = "nobody"  # initdb refuses root


class Cluster:
    """One server. `kill` ends all its processes as a power failure would; `start` starts it again."""

    def __init__(self, base: Path | None = None) -> None:
        """Make a new cluster, or one from a base backup, which restores its archive when it starts."""
        # A path of a socket is short, and every folder above it is open to the other user.
        self._folder = Path(tempfile.mkdtemp(prefix="oc-", dir="/tmp"))
        self._data = self._folder / "data"
        self._count = 0
        if os.geteuid() == 0:
            self._folder.chmod(0o755)
            shutil.chown(self._folder, _LIVED_WITH_ROOT)
        if base is not None:
            shutil.copytree(base, self._data)
            (self._data / "recovery.signal").touch()
            for path in (self._data, *self._data.rglob("*")):
                shutil.chown(path, *self._owner())
            return
        self._run(
            "initdb", "-D", str(self._data), "-U", OTHER, "--auth=trust", "--no-locale", "-E", "UTF8", "--no-sync"
        )

    def _owner(self) -> tuple[int, int]:
        held = self._folder.stat()
        return held.st_uid, held.st_gid

    def configure(self, settings: Mapping[str, str]) -> None:
        """Set parameters that the server reads when it starts."""
        with (self._data / "postgresql.conf").open("a") as file:
            file.writelines(f"{name} = '{value}'\n" for name, value in settings.items())

    def base_backup(self) -> Path:
        """Copy the running cluster as a base backup; returns its folder, which is gone when the server is stopped."""
        base = self._folder / "base"
        self._run("pg_basebackup", "-D", str(base), "-h", str(self._folder), "-U", OTHER, "--checkpoint=fast")
        return base

    @property
    def host(self) -> str:
        """The folder of its socket, which clients take for a host."""
        return str(self._folder)

    @property
    def archive(self) -> Path:
        """The folder beside the cluster into which docs/deploy has the log of transactions copied."""
        return self._folder / "archive"

    def _run(self, program: str, *arguments: str) -> None:
        as_whom: dict[str, Any] = {}
        if os.geteuid() == 0:
            user = pwd.getpwnam(_LIVED_WITH_ROOT)
            as_whom = {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": []}
        command = [_program(program), *arguments]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=self._folder, **as_whom)

    def start(self) -> None:
        """Start the server and wait until it answers."""
        options = f"-c listen_addresses='' -c unix_socket_directories={self._folder} -c max_connections=50"
        self._run("pg_ctl", "-w", "-D", str(self._data), "-l", str(self._folder / "log"), "-o", options, "start")

    def stop(self) -> None:
        """Stop the server without waiting for clients, and remove it."""
        self._run("pg_ctl", "-w", "-m", "immediate", "-D", str(self._data), "stop")
        shutil.rmtree(self._folder)

    @property
    def pid(self) -> int:
        """The id of the server's first process."""
        return int((self._data / "postmaster.pid").read_text().split()[0])

    def kill(self) -> None:
        """Kill the server's first process and wait until the others have ended with it."""
        first = psutil.Process(self.pid)
        others = first.children(recursive=True)
        os.kill(first.pid, signal.SIGKILL)
        psutil.wait_procs([first, *others])

    def url(self, database: str, role: str) -> str:
        """The address of a database for a role."""
        return f"postgresql://{role}@/{database}?host={self._folder}"

    def run(self, database: str, *statements: str, role: str = OTHER) -> list[tuple[Any, ...]]:
        """Execute statements in one transaction; returns the rows of the last."""
        with closing(psycopg.connect(self.url(database, role))) as connection, connection.cursor() as cursor:
            for statement in statements:
                cursor.execute(statement.encode())
            found = cursor.fetchall() if cursor.description else []
            connection.commit()
        return found

    def new_database(self, *, prepared: bool = True) -> str:
        """Make a database that the owner's role has prepared for the program's; returns its name."""
        self._count += 1
        name = f"site{self._count}"
        with closing(psycopg.connect(self.url("postgres", OTHER), autocommit=True)) as connection:
            roles = {row[0] for row in connection.execute("SELECT rolname FROM pg_roles").fetchall()}
            for role in {OWNER, ROLE} - roles:
                connection.execute(f"CREATE ROLE {role} LOGIN".encode())
            connection.execute(f"CREATE DATABASE {name} OWNER {OWNER}".encode())
        if prepared:
            prepare(self.url(name, OWNER), ROLE)
        return name

    def site(self, folder: Path, database: str = "", role: str = ROLE) -> Path:
        """Make a data folder whose record is in a new database of this server, or in the one named."""
        folder.mkdir(parents=True, mode=0o700)
        address = self.url(database or self.new_database(), role)
        (folder / "site.yaml").write_text(f"database: {address}\n")
        return folder


def _program(name: str) -> str:
    """The newest of Debian's versions, or what is on the path."""
    versions = sorted(Path("/usr/lib/postgresql").glob(f"*/bin/{name}"), key=lambda path: int(path.parts[-3]))
    return str(versions[-1]) if versions else name
