"""`orthocapture dicom-listen`: receive the series that a CT suite sends, into the folder of the rig's CT."""

from __future__ import annotations

import ipaddress
import threading
from pathlib import Path
from typing import Annotated

import typer

from drivers.dicom_receiver import Receiver, ReceiverConfig
from service.cli.common import JsonOption, console, print_json, reporting_errors, require_writable_folder
from service.cli.stop_request import stop_requested
from service.core.errors import ConfigurationError
from service.core.units import bytes_of_gigabytes


def dicom_listen_command(
    folder: Annotated[
        Path, typer.Option("--folder", metavar="DIR", help="Where series go: the folder of the rig's dicom_folder.")
    ],
    ae_title: Annotated[str, typer.Option("--ae-title", help="The AE title of this program.")] = "ORTHOCAPTURE",
    host: Annotated[str, typer.Option("--host", help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[
        int, typer.Option("--port", help="Port to listen on; 0 takes a free one.", min=0, max=65535)
    ] = 11112,
    callers: Annotated[
        list[str] | None,
        typer.Option("--from", metavar="TITLE", help="AE title that may send; may be repeated. Default: any."),
    ] = None,
    reserve_gb: Annotated[
        float, typer.Option("--reserve-gb", help="Space that stays free on the disk.", min=0.0)
    ] = 1.0,
    json: JsonOption = False,
) -> None:
    """Receive CT series and segmentations that a CT suite sends (DICOM C-STORE), until it is terminated.

    A series appears in the folder when its sender has finished; the rig's CT then reads it from there.
    """
    with reporting_errors(json):
        if not _only_here(host) and not callers:
            raise ConfigurationError(
                f"{host} is reachable from other machines, and any caller may send",
                where="--host",
                remedy="Name the AE titles that may send with --from. A title is not a password: also restrict the "
                "port to the CT suite in the firewall",
            )
        require_writable_folder(folder)
        folder.mkdir(exist_ok=True)
        config = ReceiverConfig(folder, ae_title, host, port, tuple(callers or ()), bytes_of_gigabytes(reserve_gb))
        told = threading.Lock()

        def tell(text: str) -> None:
            with told:
                if json:
                    print_json({"told": text})
                else:
                    console.print(text)

        with stop_requested() as stopped, Receiver(config, tell) as receiver:
            if json:
                print_json({"ae_title": ae_title, "host": host, "port": receiver.port, "folder": str(folder)})
            else:
                console.print(f"Listening as {ae_title} on {host}:{receiver.port}; series go to {folder}")
            stopped.wait()


def _only_here(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
