"""Carries out the operations of a Canon EOS in remote mode and builds their answers, without sockets."""

from __future__ import annotations

import struct

from simulators.canon_camera.body import FORMAT_CR3, CanonBody
from simulators.canon_camera.events import Event, pressed
from simulators.canon_camera.properties import MEMORY, Code
from simulators.faults import FaultPlan
from simulators.ptpip import codec
from simulators.ptpip.reply import (
    GENERAL_ERROR,
    INVALID_HANDLE,
    INVALID_PARAMETER,
    SESSION_NOT_OPEN,
    Reply,
)
from simulators.still_camera.body import FORMAT_JPEG
from simulators.still_camera.card import STORAGE, CardOperations
from simulators.still_camera.operations import Operation, Operations, accept

VENDOR = 0x0B
_ASSOCIATION = 0x3001
_HALF, _FULL, _BOTH = 1, 2, 3  # what of the release button is pressed; libgphoto2 presses an EOS M at once
_VIEWFINDER_TO_COMPUTER = 2
_NOT_READY = 0xA102
_JPEG_PART = 1
_ROOM_ON_COMPUTER = 9999  # pictures, once the computer has said that it has space


class CanonResponder(Operations):
    """One session's operations on the camera."""

    def __init__(self, body: CanonBody, faults: FaultPlan) -> None:
        self._body = body
        self._remote = False
        card = CardOperations(body, "100EOSR5", "CFexpress")
        operations: dict[int, tuple[str, Operation]] = {
            0x1001: ("get_device_info", self._device_info),
            0x1002: ("open_session", self._open_session),
            0x1003: ("close_session", accept),
            0x1004: ("get_storage_ids", self._storage_ids),
            0x1005: ("get_storage_info", card.storage_info),
            0x1007: ("get_object_handles", card.object_handles),
            0x1008: ("get_object_info", card.object_info),
            0x1009: ("get_object", card.object),
            0x101B: ("get_object", self._partial_object),
            0x9101: ("get_eos_storage_ids", self._storage_ids),
            0x9102: ("get_eos_storage_info", card.storage_info),
            0x9108: ("get_eos_device_info", self._eos_device_info),
            0x9110: ("set", self._set),
            0x9114: ("set_remote_mode", self._set_remote_mode),
            0x9115: ("set_event_mode", self._set_event_mode),
            0x9116: ("get_event", self._event),
            0x9117: ("transfer_complete", self._transfer_complete),
            0x911A: ("computer_has_space", self._computer_has_space),
            0x911D: ("keep_on", accept),
            0x9127: ("tell", self._tell),
            0x9128: ("press", self._press),
            0x9129: ("let_go", self._let_go),
            0x9153: ("preview", self._preview),
            0x9155: ("drive_lens", self._drive_lens),
        }
        super().__init__(body, faults, operations)

    def message(self, name: str, request: codec.Request, data: bytes) -> str:
        """The name of a message in fault plans: a full press is `shutter`, as with other cameras."""
        del data
        return "shutter" if name == "press" and request.parameters[:1] in ((_FULL,), (_BOTH,)) else name

    # --- identity and card ---

    def _open_session(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        self._remote = False
        return Reply()

    def _device_info(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        info = codec.DeviceInfo(
            manufacturer="Canon.Inc",
            model=self._body.table.model,
            firmware=self._body.table.firmware,
            serial="3f0c1b8e5d2a4c6791e0a2b4c6d8e0f1",
            operations=tuple(self.operations),
            events=(0x4009, 0xC101),
            properties=self._body.table.controls,
            image_formats=(_ASSOCIATION, FORMAT_JPEG, FORMAT_CR3),
            vendor_extension=VENDOR,
            vendor_description="",
        )
        return Reply(data=info.encode())

    def _eos_device_info(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        arrays = b"".join(
            codec.array_u32(values) for values in (tuple(Event), self._body.properties.codes, (STORAGE,))
        )
        return Reply(data=struct.pack("<I", 4 + len(arrays)) + arrays)

    def _storage_ids(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        return Reply(data=codec.array_u32((STORAGE,) if self._body.has_card else ()))

    def _partial_object(self, request: codec.Request, data: bytes) -> Reply:
        del data
        if len(request.parameters) < 3:
            return Reply(INVALID_PARAMETER)
        handle, offset, count = request.parameters[:3]
        file = self._body.file(handle)
        if file is None:
            return Reply(INVALID_HANDLE)
        part = file.data[offset : offset + count]
        return Reply(parameters=(len(part),), data=part)

    def _transfer_complete(self, request: codec.Request, data: bytes) -> Reply:
        del data
        self._body.fetched(request.parameters[0] if request.parameters else 0)
        return Reply()

    # --- remote mode ---

    def _set_remote_mode(self, request: codec.Request, data: bytes) -> Reply:
        del data
        self._remote = bool(request.parameters and request.parameters[0])
        return Reply()

    def _set_event_mode(self, request: codec.Request, data: bytes) -> Reply:
        del data
        if request.parameters and request.parameters[0]:
            self._body.properties.announce_all()
        return Reply()

    def _event(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        return Reply(data=self._body.properties.news())

    def _set(self, request: codec.Request, data: bytes) -> Reply:
        del request
        if not self._remote:
            return Reply(SESSION_NOT_OPEN)
        self._body.properties.set_from_client(data)
        return Reply()

    def _tell(self, request: codec.Request, data: bytes) -> Reply:
        del data
        number = request.parameters[0] if request.parameters else 0
        if number not in self._body.properties.codes:
            return Reply(GENERAL_ERROR)
        self._body.properties.tell(number)
        return Reply()

    def _computer_has_space(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        if self._body.properties.value(Code.DESTINATION) == MEMORY:
            self._body.properties.put(Code.AVAILABLE_SHOTS, _ROOM_ON_COMPUTER)
        return Reply()

    def _press(self, request: codec.Request, data: bytes) -> Reply:
        del data
        if not self._remote:
            return Reply(SESSION_NOT_OPEN)
        if request.parameters[:1] in ((_FULL,), (_BOTH,)):
            if request.parameters[:1] == (_BOTH,):
                self._body.properties.announce(pressed())  # libgphoto2 drops what comes before it
            self._body.shoot()
        elif request.parameters[:1] != (_HALF,):
            return Reply(INVALID_PARAMETER)
        return Reply()

    def _let_go(self, request: codec.Request, data: bytes) -> Reply:
        del data
        known = request.parameters[:1] in ((_HALF,), (_FULL,), (_BOTH,))
        return Reply() if known else Reply(INVALID_PARAMETER)

    def _drive_lens(self, request: codec.Request, data: bytes) -> Reply:
        # A body drives its lens only while live view goes to the computer.
        del data
        if not self._body.properties.value(Code.VIEWFINDER_OUTPUT) & _VIEWFINDER_TO_COMPUTER:
            return Reply(_NOT_READY)
        amount = request.parameters[0] if request.parameters else 0
        if amount & 0x7FFF not in (1, 2, 3):
            return Reply(INVALID_PARAMETER)
        self._body.drive_lens(amount)
        return Reply()

    def _preview(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        if not self._body.properties.value(Code.VIEWFINDER_OUTPUT) & _VIEWFINDER_TO_COMPUTER:
            return Reply(_NOT_READY)
        jpeg = self._body.preview_jpeg()
        return Reply(data=struct.pack("<II", 8 + len(jpeg), _JPEG_PART) + jpeg)
