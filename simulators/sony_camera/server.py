"""The simulated Sony camera on its sockets."""

from __future__ import annotations

from simulators.faults import FaultPlan
from simulators.ptpip.server import PtpIpServer
from simulators.sony_camera.body import SonyBody
from simulators.sony_camera.responder import OBJECT_ADDED, SHOT_HANDLE, SonyResponder


class SonyServer(PtpIpServer):
    """Serves a body and announces its files. A context manager."""

    def __init__(self, host: str, port: int, body: SonyBody, faults: FaultPlan) -> None:
        super().__init__(host, port, "ILCE-7RM5", SonyResponder(body, faults), faults)
        body.on_object = lambda: self.send_event(OBJECT_ADDED, (SHOT_HANDLE,))
