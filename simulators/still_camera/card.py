"""Answers what a computer asks about a card in a body: its space, folders and files (PTP, PIMA 15740)."""

from __future__ import annotations

from typing import Protocol

from simulators.ptpip import codec
from simulators.ptpip.reply import INVALID_HANDLE, INVALID_STORAGE, Reply
from simulators.still_camera.body import CARD_BYTES, CameraFile

STORAGE, FOLDER_DCIM, FOLDER_PICTURES = 0x00010001, 0x30000000, 0x30100000
_ASSOCIATION, _ROOT = 0x3001, 0xFFFFFFFF
_PICTURE_BYTES = 60_000_000  # of a picture, for the number that still fit


class FilesOfBody(Protocol):
    """A body's files."""

    free_bytes: int

    def file(self, handle: int) -> CameraFile | None:
        """The file of a handle, in the memory or on the card; None if there is none."""
        ...

    def on_card(self) -> tuple[int, ...]:
        """The handles of the files on the card."""
        ...


class CardOperations:
    """The operations on a card with one folder of pictures."""

    def __init__(self, body: FilesOfBody, pictures: str, kind: str) -> None:
        """Serve the files of a body; `pictures` is the name of the folder, `kind` that of the card."""
        self._body, self._kind = body, kind
        self._folders = {FOLDER_DCIM: ("DCIM", 0), FOLDER_PICTURES: (pictures, FOLDER_DCIM)}

    def storage_info(self, request: codec.Request, data: bytes) -> Reply:
        """GetStorageInfo."""
        del data
        if request.parameters[:1] != (STORAGE,):
            return Reply(INVALID_STORAGE)
        free = self._body.free_bytes
        return Reply(data=codec.StorageInfo(CARD_BYTES, free, free // _PICTURE_BYTES, self._kind).encode())

    def object_handles(self, request: codec.Request, data: bytes) -> Reply:
        """GetObjectHandles of a folder, of the root, or of all."""
        del data
        parent = request.parameters[2] if len(request.parameters) > 2 else 0
        inside: dict[int, tuple[int, ...]] = {
            _ROOT: (FOLDER_DCIM,),
            FOLDER_DCIM: (FOLDER_PICTURES,),
            FOLDER_PICTURES: self._body.on_card(),
            0: (*self._folders, *self._body.on_card()),
        }
        return Reply(data=codec.array_u32(inside[parent])) if parent in inside else Reply(INVALID_HANDLE)

    def object_info(self, request: codec.Request, data: bytes) -> Reply:
        """GetObjectInfo of a folder or a file."""
        del data
        handle = request.parameters[0] if request.parameters else 0
        if handle in self._folders:
            name, parent = self._folders[handle]
            info = codec.ObjectInfo(STORAGE, _ASSOCIATION, 0, 0, 0, name, "", parent, folder=True)
            return Reply(data=info.encode())
        file = self._body.file(handle)
        if file is None:
            return Reply(INVALID_HANDLE)
        size = len(file.data)
        info = codec.ObjectInfo(
            STORAGE, file.format, size, file.width, file.height, file.name, file.captured, FOLDER_PICTURES
        )
        return Reply(data=info.encode())

    def object(self, request: codec.Request, data: bytes) -> Reply:
        """GetObject."""
        del data
        file = self._body.file(request.parameters[0] if request.parameters else 0)
        return Reply(INVALID_HANDLE) if file is None else Reply(data=file.data)
