"""The simulated Sony camera on its sockets."""

from __future__ import annotations

from simulators.faults import FaultPlan
from simulators.ptpip.server import PtpIpServer
from simulators.sony_camera.body import SonyBody
from simulators.sony_camera.responder import OBJECT_ADDED, SHOT_HANDLE, SOMETHING_ADDED, SonyResponder


class SonyServer(PtpIpServer):
    """Serves a body and announces its files. A context manager."""

    def __init__(self, host: str, port: int, body: SonyBody, faults: FaultPlan) -> None:
        super().__init__(host, port, body.table.model, SonyResponder(body, faults), faults)
        if body.sony.bare_event:
            body.on_object = lambda: self.send_event(SOMETHING_ADDED, ())
        else:
            body.on_object = lambda: self.send_event(OBJECT_ADDED, (SHOT_HANDLE,))
