"""A CT suite that sends its series to `orthocapture dicom-listen`, each in a process of its own."""

from __future__ import annotations

import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pydicom

from tests.support.rig.rig import REPOSITORY
from tests.support.torture.faults.place.material import CT, other_ct, spoilt_ct
from tests.support.torture.faults.wire.proxy import Wire

if TYPE_CHECKING:
    from tests.support.torture.faults.trial import Trial

_PORT = 11112
_GIVES_UP_S = 5  # a sender waits so long for each answer
_LONGEST_S = 90.0
_FULL_GB = "1000000"  # to stay free on the disk: as if it were full
_HIDDEN = ".receiving"


class Suite:
    """The receiver, the senders, and what must hold of the folder: a series that can be seen there is whole."""

    def __init__(self, trial: Trial) -> None:
        self._trial, self._folder = trial, trial.scene_folder
        self._folder.mkdir()
        self._host = trial.arm_host
        self._receiver: subprocess.Popen[str] | None = None
        self._senders: list[subprocess.Popen[bytes]] = []
        self._shortest = 0  # files of a series that was sent with a slice missing, which nobody can tell
        self.faults: list[str] = []

    def rig(self, *, full: bool) -> dict[str, Any]:
        """Begin to listen; returns the devices' section of the rig file."""
        trial = self._trial
        self.listen(full=full)
        trial.wired(Wire("ct", "dicom", (self._near, _PORT), (self._host, _PORT)))
        trial.ends.append(self.end)
        scans = trial.folder / "scans"
        scans.mkdir()
        return {
            "scanner": {"driver": "scan_folder", "folder": str(scans), "stable_s": 0.5},
            "ct": {"driver": "dicom_folder", "folder": str(self._folder), "stable_s": 0.5},
        }

    @property
    def _near(self) -> str:
        return self._host[:-1] + "2"

    def listen(self, *, full: bool = False) -> None:
        """Start or restart the receiver. Raises RuntimeError if it does not start."""
        self._end_receiver()
        command = [sys.executable, "-m", "service.cli.main", "dicom-listen", "--json", "--folder", str(self._folder)]
        options = ["--host", self._host, "--port", str(_PORT), "--reserve-gb", _FULL_GB if full else "0"]
        with self.log.open("a") as log:
            self._receiver = subprocess.Popen(
                [*command, *options], cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=log, text=True
            )
        assert self._receiver.stdout is not None
        told = self._receiver.stdout
        if not any('"port"' in line for line in told):
            raise RuntimeError(f"the receiver did not start: {self.log.read_text()}")
        threading.Thread(target=lambda: [None for _ in told], daemon=True).start()  # it must not block on its pipe

    @property
    def log(self) -> Path:
        """Return what the receiver wrote to its standard error."""
        return self._trial.folder / "received.log"

    def kill_receiver(self) -> None:
        """Kill the receiver when half of a series has come."""
        self._await_half()
        self._end_receiver()

    def send(self, source: Path | None = None) -> None:
        """Begin to send a series, without waiting."""
        host = self._near if self._trial.proxy else self._host
        times = [word for option in ("-ta", "-td", "-tn") for word in (option, str(_GIVES_UP_S))]
        titles = ["-aet", "CTSUITE", "-aec", "ORTHOCAPTURE"]
        source = source or self._trial.material / CT
        command = [sys.executable, "-m", "pynetdicom", "storescu", host, str(_PORT), str(source), "-r", "-cx", "-q"]
        self._senders.append(
            subprocess.Popen(
                [*command, *titles, *times], cwd=REPOSITORY, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
        )

    def cut(self) -> None:
        """Begin to send, and die when half of the series has come."""
        self.send()
        self._await_half()
        self._senders[-1].kill()

    def send_again(self) -> None:
        """Wait for the senders of before, then send the series and wait for its end."""
        self._await_senders()
        self.send()
        self._await_senders()

    def send_afresh(self) -> None:
        """Remove what has come, and send again."""
        self._await_senders()
        for path in list(self._folder.iterdir()):
            shutil.rmtree(path)
        self.listen()
        self.send_again()

    def send_spoilt(self, kind: str) -> None:
        """Send a faulty series."""
        spoilt = self._trial.folder / "spoilt"
        spoilt_ct(spoilt, kind)
        self._shortest = len(list(spoilt.iterdir()))
        self.send(spoilt)

    def send_two(self) -> None:
        """Send two series at once, one of them of another specimen."""
        other_ct(self._trial.folder)
        self.send()
        self.send(self._trial.folder / "other")

    def look(self) -> None:
        """Note a series that can be seen and is not whole.

        If the wire spoils content, a file may have come under the number of another series.
        """
        whole = len(list((self._trial.material / CT).iterdir()))
        spoil = self._trial.case.spoil
        renumbered = spoil is not None and spoil.column in ("corrupt", "mutated")
        for series in self._visible():
            count = len(list(series.glob("*.dcm")))
            everywhere = len(list(self._folder.rglob("*.dcm")))
            if count and count not in (whole, self._shortest) and not (renumbered and everywhere >= whole):
                self.faults.append(f"{count} of {whole} files of a series can be seen")

    def check(self, *, content: bool) -> None:
        """Look for the last time, also whether the files have what was sent; not if the wire spoilt `content`."""
        self.look()
        sent = {ds.SOPInstanceUID: ds for ds in map(pydicom.dcmread, (self._trial.material / CT).iterdir())}
        for path in (path for series in self._visible() for path in series.glob("*.dcm")):
            got = pydicom.dcmread(path)
            known = sent.get(got.SOPInstanceUID)
            if content and known is not None and known.PixelData != got.PixelData:
                self.faults.append(f"{path.name} has not what was sent")
        self.faults = list(dict.fromkeys(self.faults))

    def end(self) -> None:
        """End the receiver and the senders."""
        for sender in self._senders:
            sender.kill()
            sender.wait()
        self._end_receiver()

    def _visible(self) -> list[Path]:
        return [path for path in self._folder.iterdir() if path.is_dir() and path.name != _HIDDEN]

    def _await_half(self) -> None:
        deadline_s = time.monotonic() + _LONGEST_S
        while len(list((self._folder / _HIDDEN).glob("*/*.dcm"))) < 20 and time.monotonic() < deadline_s:
            time.sleep(0.01)

    def _await_senders(self) -> None:
        for sender in self._senders:
            try:
                sender.wait(_LONGEST_S)
            except subprocess.TimeoutExpired:
                sender.kill()
                sender.wait()
        self._senders.clear()

    def _end_receiver(self) -> None:
        if self._receiver is not None:
            self._receiver.kill()
            self._receiver.wait()
            self._receiver = None
