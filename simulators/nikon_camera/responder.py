"""Carries out the operations of a Nikon Z and builds their answers, without sockets."""

from __future__ import annotations

import struct

from simulators.faults import FaultPlan
from simulators.nikon_camera.body import FORMAT_NEF, NikonBody
from simulators.ptpip import codec
from simulators.ptpip.reply import DEVICE_BUSY, OK, Reply
from simulators.sony_camera.properties import TEXT, CameraProperty, Enabled
from simulators.still_camera.body import FORMAT_JPEG
from simulators.still_camera.card import STORAGE, CardOperations
from simulators.still_camera.operations import NotWritableError, Operation, Operations, accept

VENDOR = 0x0A
OBJECT_ADDED = 0x4002
NO_SUCH_PROPERTY = 0x200A
_ASSOCIATION = 0x3001
_VENDORS_FROM = 0xD000


class NikonResponder(Operations):
    """One session's operations on the camera. It has no live view."""

    def __init__(self, body: NikonBody, faults: FaultPlan) -> None:
        self._body = body
        card = CardOperations(body, "100NZ___", "XQD")
        operations: dict[int, tuple[str, Operation]] = {
            0x1001: ("get_device_info", self._device_info),
            0x1002: ("open_session", accept),
            0x1003: ("close_session", accept),
            0x1004: ("get_storage_ids", self._storage_ids),
            0x1005: ("get_storage_info", card.storage_info),
            0x1007: ("get_object_handles", card.object_handles),
            0x1008: ("get_object_info", card.object_info),
            0x1009: ("get_object", card.object),
            0x1014: ("describe", self._describe),
            0x1015: ("tell", self._tell),
            0x1016: ("set", self._set),
            0x90C2: ("set_remote_mode", accept),
            0x90C7: ("get_event", self._events),
            0x90C8: ("ready", self._ready),
            0x90CA: ("get_vendor_codes", self._vendor_codes),
            0x9207: ("shutter", self._shutter),
        }
        super().__init__(body, faults, operations)

    def _device_info(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        info = codec.DeviceInfo(
            manufacturer="Nikon Corporation",
            model=self._body.table.model,
            firmware=self._body.table.firmware,
            serial="0000000000000000000000006012345",
            operations=tuple(self.operations),
            events=(OBJECT_ADDED, 0x4006, 0x400D),
            properties=tuple(code for code in self._body.codes() if code < _VENDORS_FROM),
            image_formats=(_ASSOCIATION, FORMAT_JPEG, FORMAT_NEF),
            vendor_extension=VENDOR,
            vendor_description="",
        )
        return Reply(data=info.encode())

    def _vendor_codes(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        return Reply(data=codec.array_u16([code for code in self._body.codes() if code >= _VENDORS_FROM]))

    # --- properties ---

    def _property(self, request: codec.Request) -> CameraProperty | None:
        try:
            return self._body.property(request.parameters[0] if request.parameters else 0)
        except NotWritableError:
            return None

    def _describe(self, request: codec.Request, data: bytes) -> Reply:
        del data
        entry = self._property(request)
        return Reply(NO_SUCH_PROPERTY) if entry is None else Reply(data=described(entry))

    def _tell(self, request: codec.Request, data: bytes) -> Reply:
        del data
        entry = self._property(request)
        return Reply(NO_SUCH_PROPERTY) if entry is None else Reply(data=entry.pack(entry.value))

    def _set(self, request: codec.Request, data: bytes) -> Reply:
        entry = self._property(request)
        if entry is None:
            return Reply(NO_SUCH_PROPERTY)
        entry.accept(entry.unpack(data))
        return Reply()

    # --- exposures ---

    def _shutter(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        self._body.shoot()
        return Reply()

    def _ready(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        return Reply(DEVICE_BUSY if self._body.exposing else OK)

    def _events(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        news = self._body.news()
        return Reply(data=struct.pack("<H", len(news)) + b"".join(struct.pack("<HI", OBJECT_ADDED, h) for h in news))

    # --- card ---

    def _storage_ids(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        return Reply(data=codec.array_u32((STORAGE,)))


def described(entry: CameraProperty) -> bytes:
    """The DevicePropDesc dataset (PIMA 15740, 13.3.3): code, type, get/set, default, current, form."""
    head = struct.pack("<HHB", entry.code, entry.datatype, entry.enabled is Enabled.ON)
    head += entry.pack("" if entry.datatype == TEXT else 0) + entry.pack(entry.value)
    if entry.limits is not None:
        return head + b"\x01" + b"".join(entry.pack(number) for number in entry.limits)
    if entry.choices is None:
        return head + b"\x00"
    return head + b"\x02" + struct.pack("<H", len(entry.choices)) + b"".join(map(entry.pack, entry.choices))
