"""Receives series that a CT suite sends (DICOM C-STORE and C-ECHO), into the folder that `dicom_folder` watches."""

from __future__ import annotations

import io
import itertools
import threading
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import pydicom
from pydicom.dataset import Dataset

from drivers.dicom_folder.files import PARSE_ERRORS
from drivers.dicom_receiver.staging import Staging
from drivers.errors import (
    DeviceError,
    DeviceRefusedError,
    DeviceStorageFullError,
    DeviceUnavailableError,
    DriverMissingError,
)

if TYPE_CHECKING:
    from pynetdicom.transport import ThreadedAssociationServer

# What is received: CT, enhanced CT (also converted), segmentations (also as label maps).
_CLASSES = (
    "1.2.840.10008.5.1.4.1.1.2",
    "1.2.840.10008.5.1.4.1.1.2.1",
    "1.2.840.10008.5.1.4.1.1.2.2",
    "1.2.840.10008.5.1.4.1.1.66.4",
    "1.2.840.10008.5.1.4.1.1.66.7",
)
_VERIFICATION = "1.2.840.10008.1.1"
# Uncompressed, RLE, JPEG Lossless, JPEG-LS and JPEG 2000: what the driver of the folder reads.
_SYNTAXES = (
    "1.2.840.10008.1.2.1",
    "1.2.840.10008.1.2",
    "1.2.840.10008.1.2.2",
    "1.2.840.10008.1.2.5",
    "1.2.840.10008.1.2.4.57",
    "1.2.840.10008.1.2.4.70",
    "1.2.840.10008.1.2.4.80",
    "1.2.840.10008.1.2.4.90",
)
# Status of a C-STORE (DICOM PS3.4, B.2.3).
_SUCCESS, _OUT_OF_RESOURCES, _MISMATCH, _NOT_UNDERSTOOD = 0x0000, 0xA700, 0xA900, 0xC000
_INVALID_PDU = "Evt19"  # an event of the state machine of DICOM PS3.8, 9.2
_WAIT_S = 30.0  # for the other side; a connection that is silent for longer is closed
_MOST_ASSOCIATIONS = 32
_COMMENT = 64  # characters of an error comment


@dataclass(frozen=True, slots=True)
class ReceiverConfig:
    """How to listen.

    Attributes:
        folder: the folder for the CT suite's series.
        ae_title: this receiver's title; a sender that calls another one is refused.
        host: address to listen on.
        port: 0 takes a free one.
        callers: AE titles that may send; empty: any.
        reserve_bytes: space that stays free on the disk.
    """

    folder: Path
    ae_title: str = "ORTHOCAPTURE"
    host: str = "127.0.0.1"
    port: int = 11112
    callers: tuple[str, ...] = ()
    reserve_bytes: int = 1 << 30


class Receiver:
    """A DICOM storage provider. `tell` gets a sentence for all that a person should know, from several threads."""

    def __init__(self, config: ReceiverConfig, tell: Callable[[str], None]) -> None:
        """Prepare the folder. Raises DeviceUnavailableError if files cannot be written there."""
        self._config, self._tell = config, tell
        self._staging = Staging(config.folder, config.reserve_bytes)
        self._server: ThreadedAssociationServer | None = None
        self._names: dict[int, str] = {}  # of the open associations, by the identity of pynetdicom's object
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        """Start receiving; raises what `start` raises."""
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop; as `close`."""
        self.close()

    @property
    def port(self) -> int:
        """The port on which it listens; 0 before it was started."""
        listening = None if self._server is None else self._server.socket
        return 0 if listening is None else int(listening.getsockname()[1])

    def start(self) -> None:
        """Listen, in threads of its own.

        Raises:
            DriverMissingError: pynetdicom is not installed.
            DeviceRefusedError: an AE title is none.
            DeviceUnavailableError: the address is taken, or not of this machine.
        """
        try:
            from pynetdicom import AE, evt  # noqa: PLC0415 - optional, and only this program needs it
        except ImportError as error:
            raise DriverMissingError(
                "receiving series needs the package pynetdicom, which is not installed",
                where="dicom-listen",
                remedy="Install orthocapture[dicom]",
            ) from error
        where = f"{self._config.host}:{self._config.port}"
        try:
            ae: Any = AE(ae_title=self._config.ae_title)
            ae.require_called_aet = True
            ae.require_calling_aet = list(self._config.callers)
        except (ValueError, TypeError) as error:
            raise DeviceRefusedError(
                f"an AE title has 1 to 16 printable characters ({error})", where=where, remedy="Give another one"
            ) from error
        ae.maximum_associations = _MOST_ASSOCIATIONS
        ae.acse_timeout = ae.dimse_timeout = ae.network_timeout = _WAIT_S
        ae.add_supported_context(_VERIFICATION)
        for kind in _CLASSES:
            ae.add_supported_context(kind, list(_SYNTAXES))
        handlers: list[Any] = [
            (evt.EVT_CONN_OPEN, self._on_open),
            (evt.EVT_ACCEPTED, self._accepted),
            (evt.EVT_REJECTED, self._rejected),
            (evt.EVT_C_ECHO, self._echo),
            (evt.EVT_C_STORE, self._store),
            (evt.EVT_RELEASED, self._released),
            (evt.EVT_ABORTED, self._aborted),
            (evt.EVT_CONN_CLOSE, self._aborted),
        ]
        for held in self._staging.held():
            self._tell(held.words)
        try:
            self._server = ae.start_server((self._config.host, self._config.port), block=False, evt_handlers=handlers)
        except OSError as error:
            raise DeviceUnavailableError(
                f"it cannot listen there ({error.strerror})", where=where, remedy="Give another --host or --port"
            ) from error

    def close(self) -> None:
        """Stop listening; open associations are aborted, and what they brought of a series is held back."""
        if self._server is not None:
            self._server.shutdown()
            self._server.ae.shutdown()
            self._server = None

    def _on_open(self, event: Any) -> None:
        """End the association at a message that is none, which would end pynetdicom's thread without a word."""
        messages = event.assoc.dimse
        receive: Callable[[object], None] = messages.receive_primitive

        def receive_or_end(part: object) -> None:
            try:
                receive(part)
            except PARSE_ERRORS as error:
                name = self._names.get(id(event.assoc), "a sender")
                self._tell(f"{name}: the connection is ended, because a message cannot be read ({error})")
                event.assoc.dul.event_queue.put(_INVALID_PDU)

        messages.receive_primitive = receive_or_end

    def _accepted(self, event: Any) -> None:
        requestor = event.assoc.requestor
        with self._lock:
            name = f"{requestor.ae_title.strip()} at {requestor.address} (association {next(self._numbers)})"
            self._names[id(event.assoc)] = name

    def _rejected(self, event: Any) -> None:
        requestor = event.assoc.requestor
        self._tell(
            f"{requestor.ae_title.strip()} at {requestor.address} was refused: it is not among the allowed callers, "
            "or calls another AE title"
        )

    def _echo(self, event: Any) -> int:
        self._tell(f"{self._names.get(id(event.assoc), 'a sender')} asked whether this program listens (C-ECHO)")
        return _SUCCESS

    def _store(self, event: Any) -> Dataset:
        name = self._names.get(id(event.assoc), "a sender")
        try:
            data: bytes = event.encoded_dataset()
            series, instance = _uids(data)
            if instance != str(event.request.AffectedSOPInstanceUID):
                self._staging.refuse(name)
                self._tell(
                    f"{name}: a file was refused: it says that it is {instance}, and its sender says otherwise"
                )
                return _answer(_MISMATCH, "the data set has another SOP instance UID")
            self._staging.store(name, series, instance, data)
        except DeviceStorageFullError as error:
            self._tell(f"{name}: {error}")
            return _answer(_OUT_OF_RESOURCES, error.what)
        except DeviceError as error:
            self._tell(f"{name}: a file was refused: {error}")
            return _answer(_NOT_UNDERSTOOD, error.what)
        except PARSE_ERRORS as error:
            self._staging.refuse(name)
            self._tell(f"{name}: a file was refused: it cannot be read as DICOM ({error})")
            return _answer(_NOT_UNDERSTOOD, "the data set cannot be read")
        return _answer(_SUCCESS)

    def _released(self, event: Any) -> None:
        self._end(event, released=True)

    def _aborted(self, event: Any) -> None:
        self._end(event, released=False)

    def _end(self, event: Any, *, released: bool) -> None:
        """The end of an association, which pynetdicom may announce several times; the first counts."""
        with self._lock:
            name = self._names.pop(id(event.assoc), None)
        if name is None:
            return
        try:
            outcomes = self._staging.ended(name, released=released)
        except DeviceError as error:
            self._tell(f"{name}: {error}")
            return
        for outcome in outcomes:
            self._tell(f"{name}: {outcome.words}")


def _uids(data: bytes) -> tuple[str, str]:
    """UIDs of the series and of the instance of a file. Raises one of PARSE_ERRORS."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        dataset = pydicom.dcmread(
            io.BytesIO(data), stop_before_pixels=True, specific_tags=["SeriesInstanceUID", "SOPInstanceUID"]
        )
        return str(dataset.SeriesInstanceUID), str(dataset.SOPInstanceUID)


def _answer(status: int, comment: str = "") -> Dataset:
    answer = Dataset()
    answer.Status = status
    if comment:
        answer.ErrorComment = comment[:_COMMENT]
    return answer
