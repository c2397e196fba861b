"""`orthocapture serve`: the guided screen and the auditor's view, in the browser."""

from __future__ import annotations

import signal
import socket
import threading
from collections.abc import Generator
from contextlib import contextmanager
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated

import typer
import uvicorn
from rich.markup import escape

from service.audit.start_up import record_start
from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    console,
    error_console,
    print_json,
    reporting_errors,
)
from service.core.errors import ConfigurationError
from service.logs.file_log import file_log
from service.people.people import People
from service.rig import load_rig
from service.runs import signature_copy
from service.steps import params_models
from service.store.records import SITE
from service.store.signature_copy import keep_elsewhere
from service.store.signing import checkpoint
from service.store.store import Store
from service.web.app import create_app
from service.web.launch import Launcher
from service.web.site import Site

_PROTOCOLS = Path(__file__).parents[2] / "protocols"


def serve_command(
    rig: Annotated[Path, typer.Option("--rig", help="The rig file: devices and stations of this site.")],
    data: DataOption = DEFAULT_DATA,
    protocols: Annotated[Path, typer.Option("--protocols", help="Folder with the protocols to offer.")] = _PROTOCOLS,
    host: Annotated[str, typer.Option("--host", help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", help="0 takes a free one.", min=0, max=65535)] = 8000,
    tls_certificate: Annotated[Path | None, typer.Option("--tls-certificate", help="PEM, chain included.")] = None,
    tls_key: Annotated[Path | None, typer.Option("--tls-key", help="PEM file of its private key.")] = None,
    insecure_lan: Annotated[
        bool, typer.Option("--insecure-lan", help="Other machines without TLS: passwords can be read on the way.")
    ] = False,
    name: Annotated[
        list[str] | None, typer.Option("--name", help="Further host name by which browsers reach this machine.")
    ] = None,
    idle_lock_min: Annotated[
        float, typer.Option("--idle-lock-min", help="Minutes without a touch until the PIN is asked for.", min=0.05)
    ] = 10.0,
    json: JsonOption = False,
) -> None:
    """Serve the guided screen and the audit. Runs go on when this ends; stop them on the screen."""
    with reporting_errors(json):
        tls = _tls(tls_certificate, tls_key)
        lan = _leaves_this_machine(host)
        if lan and tls is None and not insecure_lan:
            raise ConfigurationError(
                f"{host} is not this machine alone, and there is no TLS",
                where="--host",
                remedy="Give --tls-certificate and --tls-key, or say --insecure-lan in a network you trust",
            )
        rig_file = load_rig(rig)
        with _listening(host, port) as listener, Store.open(data) as store, file_log(data, "web"):
            address = f"{'https' if tls else 'http'}://{_shown(host)}:{listener.getsockname()[1]}"
            people = People(store)
            site = Site(
                data=data.resolve(),
                rig=rig_file,
                protocols=protocols,
                store=store,
                people=people,
                launcher=Launcher(data.resolve(), store),
                secure=tls is not None or not lan,
                idle_lock_s=60 * idle_lock_min,
                hosts=_names(host, name or []),
            )
            record_start(store, rig_file, site.protocol_files(), address)
            link = people.first_link()
            checkpoint(store, SITE)
            keep_elsewhere(data, signature_copy(rig_file), error_console.print)
            config = uvicorn.Config(
                create_app(site),
                log_level="warning",
                access_log=False,
                server_header=False,
                timeout_graceful_shutdown=2,  # streams of news never end by themselves
                ssl_certfile=tls and str(tls[0]),
                ssl_keyfile=tls and str(tls[1]),
            )
            server = _Server(config)
            with server.capture_signals():
                _announce(address, f"{address}/set-up/{link}" if link else "", json=json)
                # The numerics behind steps and protocols take seconds to load: while the first page is being read.
                threading.Thread(target=params_models, daemon=True).start()
                server.run(sockets=[listener])
            checkpoint(store, SITE)
            keep_elsewhere(data, signature_copy(rig_file), error_console.print)


class _Server(uvicorn.Server):
    """Ends in order when told to; uvicorn's own would raise the signal again, past what is left to do here."""

    @contextmanager
    def capture_signals(self) -> Generator[None]:
        """Ctrl-C and SIGTERM end the server."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self.handle_exit)
        yield


def _announce(address: str, set_up: str, *, json: bool) -> None:
    if json:
        print_json({"url": address, "set_up": set_up})
        return
    console.print(f"orthocapture is ready at {escape(address)}")
    if set_up:
        console.print(f"First set-up, once and within a day: {escape(set_up)}")


def _tls(certificate: Path | None, key: Path | None) -> tuple[Path, Path] | None:
    if (certificate is None) != (key is None):
        raise ConfigurationError("TLS needs a certificate and its key", where="--tls-certificate, --tls-key")
    if certificate is None or key is None:
        return None
    for path in (certificate, key):
        if not path.is_file():
            raise ConfigurationError("the file for TLS is not there", where=str(path))
    return certificate, key


def _leaves_this_machine(host: str) -> bool:
    try:
        return not ip_address(host).is_loopback
    except ValueError:
        return host != "localhost"


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


@contextmanager
def _listening(host: str, port: int) -> Generator[socket.socket]:
    """The socket, bound before anything is recorded: a second server on the port changes nothing."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, port))
        except OSError as error:
            raise ConfigurationError(
                f"cannot listen on {host}:{port}: {error.strerror or error}",
                where="--host, --port",
                remedy="Another program may use the port; choose one with --port, or 0 for any",
            ) from error
        listener.listen(128)
        yield listener
