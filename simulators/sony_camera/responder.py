"""Carries out PTP operations on the camera and builds their answers, without sockets."""

from __future__ import annotations

import time

from simulators.faults import FaultPlan
from simulators.ptpip import codec
from simulators.ptpip.reply import (
    INVALID_HANDLE,
    INVALID_STORAGE,
    INVALID_VALUE,
    STORE_NOT_AVAILABLE,
    Reply,
)
from simulators.sony_camera.body import FORMAT_ARW, SonyBody
from simulators.sony_camera.properties import Code
from simulators.still_camera.body import FORMAT_JPEG
from simulators.still_camera.operations import Operation, Operations, accept

STORAGE = 0x00010000  # what objects in the memory state; it is not listed
_ALL_STORES = 0xFFFFFFFF
SHOT_HANDLE, LIVE_VIEW_HANDLE = 0xFFFFC001, 0xFFFFC002
OBJECT_ADDED, SOMETHING_ADDED = 0xC201, 0xC206
_STEPPED = 200  # the protocol in which aperture, shutter time and ISO go by steps
# A real camera takes milliseconds to answer a poll during an exposure; the client polls as fast as it is answered.
_POLL_WHILE_EXPOSING_S = 0.005


class SonyResponder(Operations):
    """One session's operations on the camera."""

    def __init__(self, body: SonyBody, faults: FaultPlan) -> None:
        self._body = body
        operations: dict[int, tuple[str, Operation]] = {
            0x1001: ("get_device_info", self._device_info),
            0x1002: ("open_session", self._open_session),
            0x1003: ("close_session", accept),
            0x1004: ("get_storage_ids", self._storage_ids),
            0x1005: ("get_storage_info", self._storage_info),
            0x1006: ("get_num_objects", self._object_count),
            0x1007: ("get_object_handles", self._object_handles),
            0x1008: ("get_object_info", self._object_info),
            0x1009: ("get_object", self._object),
            0x9201: ("connect", self._connect),
            0x9202: ("get_extension_info", self._extension_info),
            0x9205: ("set", self._set),
            0x9207: ("button", self._button),
            0x9209: ("get_properties", self._all_properties),
        }
        super().__init__(body, faults, operations)

    def message(self, name: str, request: codec.Request, data: bytes) -> str:
        """The name of a message in fault plans: shutter presses and live-view frames have their own names."""
        first = request.parameters[0] if request.parameters else 0
        if name == "button" and first == Code.FULL_PRESS and data[:1] == b"\x02":
            return "shutter"
        if name == "get_object" and first == LIVE_VIEW_HANDLE:
            return "preview"
        return name

    def _device_info(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        info = codec.DeviceInfo(
            manufacturer="Sony Corporation",
            model=self._body.table.model,
            firmware=self._body.table.firmware,
            serial="00000000000000003282933005318008",
            operations=tuple(self.operations),
            events=(0x4004, 0x4005, OBJECT_ADDED, *range(0xC202, 0xC20A)),
            properties=(),
            image_formats=(0x3001, FORMAT_JPEG, FORMAT_ARW),
            vendor_extension=0x11,
            vendor_description="Sony PTP Extensions",
        )
        return Reply(data=info.encode())

    def _open_session(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        self._body.session_opened()
        return Reply()

    def _storage_ids(self, request: codec.Request, data: bytes) -> Reply:
        # In PC Remote mode no body lists its cards: it tells of them by properties.
        del request, data
        return Reply(data=codec.array_u32(()))

    def _storage_info(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        return Reply(INVALID_STORAGE)

    def _object_count(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        return Reply(parameters=(0,))

    def _object_handles(self, request: codec.Request, data: bytes) -> Reply:
        # In PC Remote mode the card's files are not listed; only the pseudo handles exist.
        del data
        if request.parameters[:1] == (_ALL_STORES,):
            return Reply(STORE_NOT_AVAILABLE)
        return Reply(data=codec.array_u32(()))

    def _object_info(self, request: codec.Request, data: bytes) -> Reply:
        del data
        handle = request.parameters[0] if request.parameters else 0
        if handle == LIVE_VIEW_HANDLE:
            return Reply(data=codec.ObjectInfo(STORAGE, FORMAT_JPEG, 0, 640, 424, "LIVEVIEW.JPG", "").encode())
        file = self._body.next_file() if handle == SHOT_HANDLE else None
        if file is None:
            return Reply(INVALID_HANDLE)
        return Reply(data=codec.ObjectInfo(STORAGE, file.format, len(file.data), 0, 0, file.name, "").encode())

    def _object(self, request: codec.Request, data: bytes) -> Reply:
        del data
        handle = request.parameters[0] if request.parameters else 0
        if handle == LIVE_VIEW_HANDLE:
            return Reply(data=self._body.live_view())
        file = self._body.pop_file() if handle == SHOT_HANDLE else None
        return Reply(INVALID_HANDLE) if file is None else Reply(data=file.data)

    def _connect(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        return Reply(data=bytes(8))

    def _extension_info(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        return Reply(data=self._body.properties.extension_info())

    def _set(self, request: codec.Request, data: bytes) -> Reply:
        self._body.properties.set_from_client(request.parameters[0] if request.parameters else 0, data)
        return Reply()

    def _button(self, request: codec.Request, data: bytes) -> Reply:
        code = request.parameters[0] if request.parameters else 0
        least = 1 if self._body.table.protocol == _STEPPED else 2  # a step is one byte
        if code not in self._body.controls or len(data) < least:
            return Reply(INVALID_VALUE)
        self._body.button(code, int.from_bytes(data[:2], "little"))
        return Reply()

    def _all_properties(self, request: codec.Request, data: bytes) -> Reply:
        del request, data
        if self._body.exposing:
            time.sleep(_POLL_WHILE_EXPOSING_S)
        self._body.count_shots()
        return Reply(data=self._body.properties.encode_all())
