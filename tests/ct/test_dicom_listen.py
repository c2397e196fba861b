"""`orthocapture dicom-listen`, to which other programs send: pynetdicom's storescu and dcmtk's, and broken ones."""

from __future__ import annotations

import json
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pydicom
import pytest
from pydicom.dataset import Dataset
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, MRImageStorage, RLELossless
from pynetdicom import AE
from pynetdicom.association import Association

from drivers.dicom_folder import DicomFolderConfig
from drivers.dicom_folder.folder import DicomFolder
from drivers.dicom_receiver import Receiver, ReceiverConfig
from drivers.errors import DeviceRefusedError, DeviceUnavailableError
from tests.support.ct.ct_series import SHAPE, hospital, pixels, write_series
from tests.support.processes.forked import Forked, run
from tests.support.processes.waiting import until
from tests.support.rig.rig import REPOSITORY

LISTEN = [sys.executable, "-m", "service.cli.main", "dicom-listen", "--port", "0", "--json"]
UID = "1.2.826.0.1.3680043.8.498.1"


@contextmanager
def listening(folder: Path, *options: str) -> Generator[tuple[int, Iterator[str]]]:
    """The command in a process of its own: its port, and the sentences that it tells."""
    process = Forked([*LISTEN, "--folder", str(folder), *options], stdout=subprocess.PIPE, text=True, cwd=REPOSITORY)
    assert process.stdout is not None
    lines = (json.loads(line) for line in process.stdout)
    try:
        ready = next(line for line in lines if "port" in line)
        yield ready["port"], (line["told"] for line in lines if "told" in line)
        process.terminate()
        assert process.wait(90) == 0
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


@dataclass
class Listener:
    """A receiver in this process, and what it told."""

    folder: Path
    receiver: Receiver
    told: list[str] = field(default_factory=list[str])
    more: threading.Condition = field(default_factory=threading.Condition)

    def tell(self, text: str) -> None:
        with self.more:
            self.told.append(text)
            self.more.notify_all()

    def wait_for(self, words: str) -> str:
        with self.more:
            assert self.more.wait_for(lambda: any(words in text for text in self.told), 60), self.told
            return next(text for text in self.told if words in text)

    def series(self) -> list[tuple[int, tuple[str, ...]]]:
        found = DicomFolder(DicomFolderConfig(folder=self.folder, stable_s=0)).series()
        return [(one.slices, one.problems) for one in found]


@contextmanager
def receiving(folder: Path, reserve_bytes: int = 0, callers: tuple[str, ...] = ()) -> Generator[Listener]:
    listener: Listener

    def tell(text: str) -> None:
        listener.tell(text)

    config = ReceiverConfig(folder, port=0, callers=callers, reserve_bytes=reserve_bytes)
    listener = Listener(folder, Receiver(config, tell))
    with listener.receiver:
        yield listener


def calling(port: int, title: str = "CTSUITE") -> Association:
    """An association of a sender, opened."""
    ae = AE(ae_title=title)
    ae.add_requested_context(CTImageStorage, ExplicitVRLittleEndian)
    return ae.associate("127.0.0.1", port, ae_title="ORTHOCAPTURE")


def slices(folder: Path) -> list[Dataset]:
    return [pydicom.dcmread(path) for path in sorted(folder.iterdir())]


# --- whole series -----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("sender", ["pynetdicom", pytest.param("dcmtk", marks=pytest.mark.packages("dcmtk"))])
def test_another_program_sends_a_series_and_the_importer_reads_it(tmp_path: Path, sender: str) -> None:
    T = write_series(tmp_path / "suite", uid=UID, change=hospital)
    program = [sys.executable, "-m", "pynetdicom"] if sender == "pynetdicom" else []
    subfolders = "-r" if sender == "pynetdicom" else "+sd"
    with listening(tmp_path / "ct") as (port, told):
        address = ["127.0.0.1", str(port), "-aet", "CTSUITE", "-aec", "ORTHOCAPTURE"]
        subprocess.run([*program, "echoscu", *address], check=True, timeout=60)
        assert "CTSUITE at 127.0.0.1" in next(told)
        subprocess.run([*program, "storescu", *address, subfolders, str(tmp_path / "suite")], check=True, timeout=60)
        assert f"series {UID}: 5 files are in {tmp_path / 'ct' / UID}" in next(told)
    ct = DicomFolder(DicomFolderConfig(folder=tmp_path / "ct", stable_s=0))
    (series,) = ct.series()
    assert (series.uid, series.slices, series.problems) == (UID, SHAPE[0], ())
    volume = ct.read(series)
    np.testing.assert_array_equal(volume.hounsfield, 2 * pixels() - 1000)
    np.testing.assert_allclose(volume.T_ct_voxel, T, atol=1e-9)


def test_pynetdicoms_program_sends_compressed_slices_as_they_are(tmp_path: Path) -> None:
    write_series(tmp_path / "suite", uid=UID, syntax=RLELossless)
    with receiving(tmp_path / "ct") as listener:
        subprocess.run(
            [sys.executable, "-m", "pynetdicom", "storescu", "127.0.0.1", str(listener.receiver.port),
             str(tmp_path / "suite"), "-r", "-cx", "-aet", "CTSUITE", "-aec", "ORTHOCAPTURE"],
            check=True, timeout=60,
        )  # fmt: skip
        listener.wait_for("5 files are in")
        assert listener.series() == [(5, ())]
    sent = {ds.SOPInstanceUID: ds.PixelData for ds in slices(tmp_path / "suite")}
    assert {ds.SOPInstanceUID: ds.PixelData for ds in slices(tmp_path / "ct" / UID)} == sent


# --- half a series ----------------------------------------------------------------------------------------------


def test_half_a_series_is_held_back_until_the_rest_has_come(tmp_path: Path) -> None:
    write_series(tmp_path / "suite", uid=UID)
    every = slices(tmp_path / "suite")
    with receiving(tmp_path / "ct") as listener:
        first = calling(listener.receiver.port)
        assert [first.send_c_store(ds).Status for ds in every[:3]] == [0, 0, 0]
        first.abort()
        assert "3 files are held back, because the connection ended before" in listener.wait_for("held back")
        assert listener.series() == []  # three slices look like a whole series
    with receiving(tmp_path / "ct") as listener:  # another day
        assert "3 files are held back, because they came before this program began" in listener.told[0]
        second = calling(listener.receiver.port)
        assert [second.send_c_store(ds).Status for ds in every[2:]] == [0, 0, 0]  # one of them again
        second.release()
        listener.wait_for("5 files are in")
        assert listener.series() == [(5, ())]
        assert not list((tmp_path / "ct" / ".receiving").iterdir())


def test_two_associations_of_one_series_are_waited_for(tmp_path: Path) -> None:
    write_series(tmp_path / "suite", uid=UID)
    every = slices(tmp_path / "suite")
    with receiving(tmp_path / "ct") as listener:
        one, other = calling(listener.receiver.port), calling(listener.receiver.port)
        for ds in every[:2]:
            one.send_c_store(ds)
        for ds in every[2:]:
            other.send_c_store(ds)
        one.release()
        assert listener.series() == []
        other.release()
        listener.wait_for("5 files are in")
        assert listener.series() == [(5, ())]


def test_a_full_disk_is_told_to_both_sides_and_the_series_is_held_back(tmp_path: Path) -> None:
    write_series(tmp_path / "suite", uid=UID)
    every = slices(tmp_path / "suite")
    with receiving(tmp_path / "ct", reserve_bytes=1 << 60) as listener:  # as if nothing were free
        sender = calling(listener.receiver.port)
        answer = sender.send_c_store(every[0])
        assert answer.Status == 0xA700
        assert "the disk is full" in answer.ErrorComment
        sender.release()
        assert f"the disk is full: {every[0].SOPInstanceUID} was not stored" in listener.wait_for("disk is full")
        assert "0 files are held back, because 1 more could not be stored" in listener.wait_for("held back")
    with receiving(tmp_path / "ct") as listener:
        sender = calling(listener.receiver.port)
        for ds in every[1:]:  # all but the one that was lost
            assert sender.send_c_store(ds).Status == 0
        sender.release()
        assert "4 files are held back, because 1 more could not be stored" in listener.wait_for("4 files")
        assert listener.series() == []
        again = calling(listener.receiver.port)
        assert again.send_c_store(every[0]).Status == 0
        again.release()
        listener.wait_for("5 files are in")
        assert listener.series() == [(5, ())]


def test_a_series_is_held_back_if_a_file_that_came_with_it_cannot_be_read(tmp_path: Path) -> None:
    """The file is of any series; without it the series was shown as whole."""
    write_series(tmp_path / "suite", uid=UID)
    every = slices(tmp_path / "suite")
    whole = every[2].SeriesInstanceUID
    del every[2].SeriesInstanceUID
    with receiving(tmp_path / "ct") as listener:
        first = calling(listener.receiver.port)
        assert [first.send_c_store(ds).Status for ds in every] == [0, 0, 0xC000, 0, 0]
        first.release()
        assert "4 files are held back, because a file that came with them was refused" in listener.wait_for("held")
        assert listener.series() == []
        every[2].SeriesInstanceUID = whole
        second = calling(listener.receiver.port)
        assert [second.send_c_store(ds).Status for ds in every] == [0] * 5
        second.release()
        listener.wait_for("5 files are in")
        assert listener.series() == [(5, ())]


def test_a_message_that_is_none_ends_its_connection_at_once(tmp_path: Path) -> None:
    write_series(tmp_path / "suite", uid=UID)
    with receiving(tmp_path / "ct") as listener:
        sender = calling(listener.receiver.port)
        assert sender.send_c_store(slices(tmp_path / "suite")[0]).Status == 0
        command = bytes.fromhex("0000000004000000 00000000")  # a command's length, and no command
        value = struct.pack(">IBB", 2 + len(command), 1, 3) + command
        assert sender.dul.socket is not None
        sender.dul.socket.send(struct.pack(">BBI", 4, 0, len(value)) + value)
        listener.wait_for("the connection is ended, because a message cannot be read")
        listener.wait_for("1 files are held back, because the connection ended")
        until(lambda: sender.is_aborted, "the sender is not told")


# --- who may send, and what -------------------------------------------------------------------------------------


def test_only_the_allowed_callers_may_send_and_only_to_its_own_title(tmp_path: Path) -> None:
    with receiving(tmp_path / "ct", callers=("CTSUITE",)) as listener:
        port = listener.receiver.port
        assert not calling(port, "SOMEBODY").is_established
        assert "SOMEBODY at 127.0.0.1 was refused" in listener.wait_for("was refused")
        ae = AE(ae_title="CTSUITE")
        ae.add_requested_context(CTImageStorage)
        assert not ae.associate("127.0.0.1", port, ae_title="OTHER").is_established
        right = calling(port)
        assert right.is_established
        right.release()


def test_what_is_no_ct_is_not_accepted(tmp_path: Path) -> None:
    with receiving(tmp_path / "ct") as listener:
        ae = AE(ae_title="CTSUITE")
        ae.add_requested_context(MRImageStorage)
        ae.add_requested_context(CTImageStorage)
        association = ae.associate("127.0.0.1", listener.receiver.port, ae_title="ORTHOCAPTURE")
        assert [cx.abstract_syntax for cx in association.accepted_contexts] == [CTImageStorage]
        association.release()


def test_a_file_with_a_path_for_a_uid_or_other_content_under_a_known_uid_is_refused(tmp_path: Path) -> None:
    write_series(tmp_path / "suite", uid=UID)
    every = slices(tmp_path / "suite")
    with receiving(tmp_path / "ct") as listener:
        sender = calling(listener.receiver.port)
        assert sender.send_c_store(every[0]).Status == 0
        every[0].SeriesDescription = "other"
        answer = sender.send_c_store(every[0])
        assert (answer.Status, "another file with this UID" in answer.ErrorComment) == (0xC000, True)
        evil = every[1]
        evil["SeriesInstanceUID"] = pydicom.DataElement("SeriesInstanceUID", "LO", "../../evil")
        sender.release()
        listener.wait_for("1 files are in")
        sender = calling(listener.receiver.port)
        assert sender.send_c_store(evil).Status == 0xC000
        sender.release()
    assert not list(tmp_path.rglob("*evil*"))
    assert {path.name for path in tmp_path.iterdir()} == {"suite", "ct"}


@pytest.mark.slow
def test_connections_that_say_nothing_or_nonsense_block_nobody(tmp_path: Path) -> None:
    write_series(tmp_path / "suite", uid=UID)
    with receiving(tmp_path / "ct") as listener:
        silent = [socket.create_connection(("127.0.0.1", listener.receiver.port)) for _ in range(20)]
        for k, one in enumerate(silent):
            if k % 4 == 1:
                one.sendall(b"GET / HTTP/1.1\r\n\r\n")
            elif k % 4 == 2:
                one.sendall(b"\x01\x00\x00\x00\xff\xff\x00\x01")  # the beginning of a request
            elif k % 4 == 3:
                one.sendall(b"\x04\x00" + b"\xff" * 4)  # data of 4 GB, outside of an association
        sender = calling(listener.receiver.port)
        assert sender.is_established
        assert [sender.send_c_store(ds).Status for ds in slices(tmp_path / "suite")] == [0] * 5
        sender.release()
        listener.wait_for("5 files are in")
        for one in silent:
            one.close()


def test_it_listens_elsewhere_only_when_told_who_may_send(tmp_path: Path) -> None:
    refused = run([*LISTEN, "--folder", str(tmp_path), "--host", "0.0.0.0"], cwd=REPOSITORY, timeout_s=100)
    assert refused.returncode == 1
    assert "any caller may send" in json.loads(refused.stdout)["error"]["what"]


def test_a_taken_port_and_a_bad_title_are_told(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(DeviceUnavailableError, match="it cannot listen there"):
            Receiver(ReceiverConfig(tmp_path, port=port), print).start()
    with pytest.raises(DeviceRefusedError, match="an AE title has 1 to 16"):
        Receiver(ReceiverConfig(tmp_path, ae_title="x" * 17), print).start()
