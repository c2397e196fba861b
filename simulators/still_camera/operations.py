"""Dispatches PTP operations to a camera's functions, with planned faults and the codes of refusals."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from simulators.faults import FaultPlan
from simulators.ptpip import codec
from simulators.ptpip.reply import (
    ACCESS_DENIED,
    DEVICE_BUSY,
    GENERAL_ERROR,
    INVALID_VALUE,
    NOT_SUPPORTED,
    REJECTIONS,
    STORE_FULL,
    Reply,
)
from simulators.serve import SimulatorError
from simulators.still_camera.body import BusyError, CameraBody, CardFullError
from simulators.still_camera.scene import NotReadyError


class RefusedValueError(Exception):
    """The camera does not offer this value."""


class NotWritableError(Exception):
    """The property cannot be set, or does not exist."""


_CODES: dict[type[Exception], int] = {
    BusyError: DEVICE_BUSY,
    CardFullError: STORE_FULL,
    NotWritableError: ACCESS_DENIED,
    RefusedValueError: INVALID_VALUE,
    SimulatorError: GENERAL_ERROR,
    NotReadyError: DEVICE_BUSY,
}
Operation = Callable[[codec.Request, bytes], Reply]


class Operations:
    """The operations of one camera by their codes; each has a name, by which fault plans refer to it."""

    def __init__(self, body: CameraBody, faults: FaultPlan, operations: Mapping[int, tuple[str, Operation]]) -> None:
        self._camera = body
        self._faults = faults
        self.operations = operations

    def message(self, name: str, request: codec.Request, data: bytes) -> str:
        """The name of a message in fault plans, if it is not that of its operation."""
        del request, data
        return name

    def handle(self, request: codec.Request, data: bytes) -> Reply:
        """Carry out one operation.

        Planned faults of the kinds busy, disk_full, reject, error, ignore and unconfirmed take effect here. With
        `unconfirmed` the operation is carried out, and an error answered (`value`, or a general one).
        """
        known = self.operations.get(request.operation)
        if known is None:
            return Reply(NOT_SUPPORTED)
        name, operation = known
        fault = self._faults.check("camera", self.message(name, request, data))
        if fault is not None and fault.kind == "disk_full":
            self._camera.free_bytes = 0
        if fault is not None and fault.kind in REJECTIONS:
            return Reply(REJECTIONS[fault.kind])
        try:
            reply = operation(request, data)
        except tuple(_CODES) as error:
            return Reply(_CODES[type(error)])
        if fault is not None and fault.kind == "unconfirmed":
            return Reply(int(fault.value or GENERAL_ERROR))
        return Reply(reply.code, reply.parameters, reply.data, fault)


def accept(request: codec.Request, data: bytes) -> Reply:
    """Do nothing, successfully."""
    del request, data
    return Reply()
