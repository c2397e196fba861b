"""Runs the tests of the record on PostgreSQL: `pytest --database postgresql`.

Each folder in which a test opens a store for the first time gets a `site.yaml` that names a database of its own, on a
server that is started once for all workers. Whatever else a test does is as on SQLite. A test that is about SQLite's
file alone says so by the mark `sqlite("why")`; such tests are left out, counted and printed. A test in whose folder a
database of SQLite lies in the end has failed: it would prove nothing about PostgreSQL.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import pytest

from service.store.data_folder import SITE_FILE
from service.store.database.engine import DATABASE_NAME
from service.store.database.opening import has_database
from service.store.store import Store
from tests.support.processes.postgres import Cluster, cluster_of

_FOLDER, _LEFT_OUT = "postgres_cluster", "left_out_of_postgresql"


class OnPostgres:
    """The plug-in of a worker, or of the one process: gives new data folders databases."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        given: str | None = getattr(config, "workerinput", {}).get(_FOLDER)
        self._own = Cluster(brief=True) if given is None else None
        self.cluster = self._own or Cluster(Path(str(given)))
        self.left_out: Counter[str] = Counter()
        if self._own is not None:
            self._own.start()
            self._own.drop(self._own.new_database())  # prepares the one of which the others are copies
        self._open: Callable[..., Store] = Store.open

    def pytest_sessionstart(self) -> None:
        """Let a store that is opened in a new folder find a site's file there."""

        def open_on_postgres(data_dir: Path, *arguments: Any, create: bool = True, **more: Any) -> Store:
            if create and not has_database(data_dir):
                data_dir.mkdir(parents=True, exist_ok=True, mode=0o700)
                site = self.cluster.address()
                written = data_dir / SITE_FILE
                written.touch(0o600)
                written.write_text(f"database: {site}\n{written.read_text()}")
            return self._open(data_dir, *arguments, create=create, **more)

        Store.open = open_on_postgres

    @pytest.hookimpl(optionalhook=True)
    def pytest_configure_node(self, node: Any) -> None:
        """Give a worker the address of the server."""
        node.workerinput[_FOLDER] = str(self.cluster.folder)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:
        """Take over what a worker has left out: all of them leave out the same."""
        self.left_out |= Counter(getattr(node, "workeroutput", {}).get(_LEFT_OUT, {}))

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        """Leave out what is about SQLite alone."""
        alone = {item: mark.args[0] for item in items if (mark := item.get_closest_marker("sqlite")) is not None}
        self.left_out.update(alone.values())
        config.hook.pytest_deselected(items=list(alone))
        items[:] = [item for item in items if item not in alone]

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_teardown(self, item: pytest.Item) -> Generator[None]:
        """Remove the databases of the test's folder. Fails if it has used SQLite."""
        folder: Path | None = getattr(item, "funcargs", {}).get("tmp_path")
        yield
        if folder is None:
            return
        for site in folder.rglob(SITE_FILE):
            self._drop(site)
        lying = sorted(str(path.relative_to(folder)) for path in folder.rglob(DATABASE_NAME))
        if lying:
            pytest.fail(f"this test was to run on PostgreSQL, and has made {', '.join(lying)}", pytrace=False)

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Stop the server."""
        output: dict[str, Any] | None = getattr(session.config, "workeroutput", None)
        if output is not None:
            output[_LEFT_OUT] = dict(self.left_out)
        Store.open = self._open
        if self._own is not None:
            self._own.stop()

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Say what was left out."""
        count = sum(self.left_out.values())
        terminalreporter.section(f"on PostgreSQL; {count} tests are about SQLite alone and were left out")
        for why, tests in sorted(self.left_out.items()):
            terminalreporter.line(f"{tests:4}  {why}")

    def _drop(self, site: Path) -> None:
        for line in site.read_text().splitlines():
            address = line.removeprefix("database: ")
            if address != line and f"host={self.cluster.folder}" in address:
                self.cluster.drop(cluster_of(address)[1])
