"""`orthocapture serve`: serve the guided screen and the auditor's view to browsers."""

from __future__ import annotations

import fcntl
import getpass
import importlib
import json as json_module
import os
import socket
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from io import FileIO
from pathlib import Path
from typing import Annotated

import typer

from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    console,
    error_console,
    only_here,
    print_json,
    reporting_errors,
    shipped_protocols,
)
from service.core.errors import ConfigurationError, StoreError
from service.core.records.entered import cleaned_name
from service.core.words import local_time
from service.logs import file_log
from service.people.sessions import People
from service.rig import load_rig
from service.station import devices_of
from service.steps import params_models
from service.store.data_folder import kept_to
from service.store.database.engine import BUSY_TIMEOUT_S
from service.store.durable_effects import utc_text
from service.store.records import SITE
from service.store.signatures.second_place import away_words
from service.store.signatures.signing import checkpoint_here
from service.store.store import Store
from service.web.app import create_app
from service.web.connections import ConnectionLimits, affordable_connections
from service.web.server import known_proxies, listening, server, sparing_log, told
from service.web.site import Launcher, Site, record_start

_PROTOCOLS = shipped_protocols()
_SERVED = "serving.json"  # in the data folder, locked while a server uses it
_LIMITS = ConnectionLimits()


@dataclass(frozen=True, slots=True)
class _Server:
    """The server of a data folder, as other processes find it."""

    address: str
    user: str
    pid: int
    host: str
    since_utc: str


def serve_command(
    rig: Annotated[Path, typer.Option("--rig", help="The rig file: devices and stations of this site.")],
    data: DataOption = DEFAULT_DATA,
    protocols: Annotated[
        Path,
        typer.Option("--protocols", help="Folder of the protocols to offer.", show_default="the shipped protocols"),
    ] = _PROTOCOLS,
    host: Annotated[str, typer.Option("--host", help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[
        int, typer.Option("--port", help="Port to listen on; 0 takes a free one.", min=0, max=65535)
    ] = 8000,
    tls_certificate: Annotated[
        Path | None, typer.Option("--tls-certificate", help="PEM file of the TLS certificate with its chain.")
    ] = None,
    tls_key: Annotated[Path | None, typer.Option("--tls-key", help="PEM file of its private key.")] = None,
    insecure_lan: Annotated[
        bool, typer.Option("--insecure-lan", help="Serve other machines without TLS; passwords can be intercepted.")
    ] = False,
    name: Annotated[
        list[str] | None, typer.Option("--name", help="Another host name by which browsers reach this machine.")
    ] = None,
    idle_lock_min: Annotated[
        float, typer.Option("--idle-lock-min", help="Idle minutes until the PIN is asked for.", min=0.05)
    ] = 10.0,
    trusted_proxy: Annotated[
        list[str] | None,
        typer.Option(
            "--trusted-proxy",
            help="Address of a reverse proxy whose X-Forwarded-For is trusted; may be repeated.",
        ),
    ] = None,
    connections: Annotated[
        int, typer.Option("--connections", help="Most simultaneous connections in all.", min=1)
    ] = _LIMITS.in_all,
    address_connections: Annotated[
        int, typer.Option("--address-connections", help="Most simultaneous connections from one address.", min=1)
    ] = _LIMITS.per_address,
    client_wait_s: Annotated[
        float,
        typer.Option(
            "--client-wait-s", help="Seconds that a client has to send a request, and may pause reading.", min=0.1
        ),
    ] = _LIMITS.wait_s,
    json: JsonOption = False,
) -> None:
    """Serve the guided screen and the audit. Runs continue when this command ends; stop them on the screen."""
    with reporting_errors(json):
        tls = _tls(tls_certificate, tls_key)
        lan = not only_here(host)
        if lan and tls is None and not insecure_lan:
            raise _unprotected(host)
        rig_file = load_rig(rig)
        proxies = known_proxies(trusted_proxy or [])
        limits = ConnectionLimits(affordable_connections(connections), address_connections, client_wait_s)
        with (
            Store.open(data, patience_s=BUSY_TIMEOUT_S) as store,  # a page does not wait for minutes
            kept_to(data),
            _only_server(store) as say_where,
            listening(host, port, limits, proxies) as listener,
            sparing_log(store.clock) as log,
            file_log(data, "web", admits=told),
        ):
            address = f"{'https' if tls else 'http'}://{_shown(host)}:{listener.getsockname()[1]}"
            say_where(address)
            people = People(store)
            site = Site(
                data=data.resolve(),
                rig=rig_file,
                protocols=protocols,
                store=store,
                people=people,
                launcher=Launcher(data.resolve(), store),
                devices_of=devices_of,
                secure=tls is not None or not lan,
                idle_lock_s=60 * idle_lock_min,
                hosts=_names(host, name or []),
            )
            record_start(store, rig_file, site.protocol_files(), address)
            link = people.first_link()
            _seal(site)
            http = server(create_app(site), listener, proxies, tls, log)
            with http.capture_signals():
                _announce(address, f"{address}/set-up/{link}" if link else "", json=json)
                threading.Thread(target=_load_the_rest, daemon=True).start()
                ended = store.clock.signal()
                threading.Thread(target=site.second_place.look_after, args=(ended,), daemon=True).start()
                http.run(sockets=[listener])
                ended.set()
            _seal(site)


@contextmanager
def _only_server(store: Store) -> Generator[Callable[[str], None]]:
    """Be the only server of a data folder; yields a function that publishes the address of this one.

    The system lets go of the lock when the process ends, however it ends. Raises ConfigurationError where the folder
    is served already, StoreError if the folder cannot be written to.
    """
    path = store.database_path.with_name(_SERVED)
    with _locked(path) as file:

        def say_where(address: str) -> None:
            since_utc = utc_text(store.clock.utc_now())
            who = _Server(address, cleaned_name(getpass.getuser()), os.getpid(), socket.gethostname(), since_utc)
            file.write(json_module.dumps(asdict(who)).encode())

        try:
            yield say_where
        finally:
            file.truncate(0)


def _locked(path: Path) -> FileIO:
    """Return the file that announces this server, empty and locked. Raises ConfigurationError, StoreError."""
    try:
        file = FileIO(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600), "r+")
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # which no child process inherits
        except (BlockingIOError, PermissionError):
            with file:
                raise _served_already(path, file.read()) from None
        file.truncate(0)
    except OSError as error:
        raise StoreError(
            f"the data folder cannot be written to: {error.strerror or error}",
            where=str(path),
            remedy="Check free space and permissions of the data folder",
        ) from error
    return file


def _served_already(path: Path, said: bytes) -> ConfigurationError:
    what = "another server is using this data folder"
    try:
        one = _Server(**json_module.loads(said))
    except (ValueError, TypeError):  # it has just started, or writes this
        return ConfigurationError(what, where=str(path), remedy="It is starting: wait for its address, or end it")
    since = f"{local_time(one.since_utc) or one.since_utc}"
    return ConfigurationError(
        f"{what}: process {one.pid} of {one.user} on {one.host}, since {since}",
        where=one.address,
        remedy=f"Open {one.address} in a browser, or end that server first",
    )


def _load_the_rest() -> None:
    """Load what pages need to be shown but not to be listed: a server is ready earlier, and no page waits for it."""
    list(params_models())
    for late in ("service.steps.due_jobs", "service.store.signatures.timestamps"):
        importlib.import_module(late)


def _unprotected(host: str) -> ConfigurationError:
    return ConfigurationError(
        f"{host} is reachable from other machines, and there is no TLS",
        where="--host",
        remedy="Give --tls-certificate and --tls-key, or --insecure-lan in a network you trust",
    )


def _seal(site: Site) -> None:
    """Sign the end of the site's chain, and keep a copy of the signature where the rig says."""
    if checkpoint_here(site.store, SITE) is None:
        error_console.print(
            "Another data folder signs this site; what is recorded here is signed there", markup=False
        )
    away = site.second_place.update()
    if away is not None:
        error_console.print(away_words(away), markup=False)


def _announce(address: str, set_up: str, *, json: bool) -> None:
    if json:
        print_json({"url": address, "set_up": set_up})
        return
    console.print(f"orthocapture is ready at {address}")
    if set_up:
        console.print(f"First set-up, once and within a day: {set_up}")


def _tls(certificate: Path | None, key: Path | None) -> tuple[Path, Path] | None:
    if (certificate is None) != (key is None):
        raise ConfigurationError("TLS needs a certificate and its key", where="--tls-certificate, --tls-key")
    if certificate is None or key is None:
        return None
    for path in (certificate, key):
        if not path.is_file():
            raise ConfigurationError("the TLS file does not exist", where=str(path))
    return certificate, key


def _names(host: str, more: list[str]) -> tuple[str, ...]:
    own = {"127.0.0.1", "localhost", "[::1]", *more}
    if host in ("0.0.0.0", "::"):
        own |= {socket.gethostname(), socket.getfqdn()}
    else:
        own.add(_shown(host))
    return tuple(sorted(own))


def _shown(host: str) -> str:
    if host in ("0.0.0.0", "::"):
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host
