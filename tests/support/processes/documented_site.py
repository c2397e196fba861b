"""A working folder as the documents assume it, and ways to run a documented command in it."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from urllib.request import urlopen

import cv2
import numpy as np
import trimesh

from service.compute.poses.pose_files import write_camera_json, write_poses_csv
from service.core.records.run_events import JobFailed
from service.store.records import NewJob
from service.store.store import Store
from tests.support.processes.forked import Forked, run
from tests.support.processes.waiting import until
from tests.support.record.store import enqueue
from tests.support.scenes.sphere_images import RADIUS_M, REGISTRATION_M, render, scene

ROOT = Path(__file__).parents[3]
SCRIPTS = Path(sys.executable).parent
COMPLETE_RIG = """\
name: a complete site
devices:
  robot: {driver: ur, host: 127.0.0.1}
  camera: {driver: gphoto, port: "ptpip:127.0.0.1"}
  scanner: {driver: scan_folder, folder: scans}
  ct: {driver: dicom_folder, folder: ct}
stations:
  station_1: {robot: robot, scene_centre_m: [0.0, 0.8, 0.0], approach_azimuth_deg: -90}
  station_2: {robot: robot, scene_centre_m: [0.0, 0.8, 0.0], approach_azimuth_deg: 90}
T_flange_camera_nominal: [[1, 0, 0, 0], [0, 1, 0, -0.06], [0, 0, 1, 0.09], [0, 0, 0, 1]]
"""


@dataclass(frozen=True)
class Site:
    """A working directory as the documents assume it: a rig file, recorded runs, a data set taken by hand."""

    folder: Path
    begun: str  # the latest run; it waits for its first confirmation

    def run(self, command: str, *, typed: str = "") -> subprocess.CompletedProcess[str]:
        """Run the command to its end, as its reader would type it."""
        words = shlex.split(command)
        words[0] = str(SCRIPTS / words[0])
        return run(words, cwd=self.folder, typed=typed, timeout_s=110)


def succeeds(site: Site, command: str) -> None:
    done = site.run(command)
    assert done.returncode == 0, done.stdout + done.stderr


def asks_and_is_aborted(site: Site, command: str) -> None:
    """A run asks its first question; the typed answer ends it with status 1, since it is not completed."""
    done = site.run(command, typed="abort only reading the manual\n")
    assert done.returncode == 1, done.stderr
    assert "Type one of: confirm" in done.stderr.replace("\n", " ")
    assert "is aborted" in done.stdout


def starts_and_is_aborted(site: Site, command: str) -> None:
    """`asks_and_is_aborted` on a rig with all devices that a whole protocol needs; none of them is opened.

    In a terminal, the command first asks for the specimen (tests/cli/test_terminal.py); a pipe is asked nothing.
    """
    (site.folder / "ct").mkdir()
    (site.folder / "rig.yaml").write_text(COMPLETE_RIG)
    asks_and_is_aborted(site, f"{command} --specimen S1")


def says_how_to_get_the_data(site: Site, command: str) -> None:
    """With no data set present; the committed table stays unchanged."""
    before = sorted(path.name for path in (ROOT / "bench" / "results").glob("real_data*"))
    words = [sys.executable, *shlex.split(command)[1:-1], str(site.folder)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=110, check=False)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) > 10
    assert all(": not run. " in line for line in lines)
    assert sorted(path.name for path in (ROOT / "bench" / "results").glob("real_data*")) == before


def serves_until_terminated(site: Site, command: str) -> None:
    """The worker takes a job that it must refuse, and ends when told to."""
    words = shlex.split(command)
    with Store.open(site.folder / "runs") as store:
        job = NewJob("locate_spheres", "fixation", 1, "docs", {"mesh": "0" * 64, "radius_m": 0.015, "expected": 10})
        enqueue(store, site.begun, job, actor="test")
        with Forked([SCRIPTS / words[0], *words[1:]], cwd=site.folder, stdout=subprocess.DEVNULL) as worker:

            def refused() -> bool:
                assert worker.poll() is None
                return any(isinstance(event.payload, JobFailed) for event in store.events(site.begun))

            try:
                until(refused, "the worker does not take the job")
            finally:
                worker.terminate()
            assert worker.wait(timeout=90) == 0


def registers(site: Site, command: str) -> None:
    """Photographs, camera, poses and mesh under the names in the command; DIR is the folder of the images."""
    made = scene(4, 800, seed=11)
    images = site.folder / "images"
    images.mkdir()
    for i in range(4):
        picture = render(made.camera, made.centres_camera(i, REGISTRATION_M), i, oversample=2)
        assert cv2.imwrite(str(images / f"view_{i}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 95])
    write_camera_json(site.folder / "camera.json", made.camera)
    write_poses_csv(site.folder / "poses.csv", {f"view_{i}.jpg": T for i, T in enumerate(made.T_world_camera)})
    spheres = [
        trimesh.creation.icosphere(subdivisions=3, radius=1e3 * RADIUS_M).apply_translation(1e3 * centre)
        for centre in REGISTRATION_M
    ]
    trimesh.util.concatenate(spheres).export(site.folder / "scan.ply")
    done = site.run(command.replace(" DIR ", " images ") + " --json")
    assert done.returncode == 0, done.stdout + done.stderr
    T = np.array(json.loads((site.folder / "result.json").read_text())["T_world_scan"])
    assert np.abs(T - made.T_world_scan).max() < 5e-4


def serves_pages(site: Site, command: str) -> None:
    """The web process answers on a free port, and ends when told to."""
    words = shlex.split(command + " --port 0 --json")
    with Forked([SCRIPTS / words[0], *words[1:]], cwd=site.folder, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            ready = json.loads(server.stdout.readline())
            assert "/set-up/" in ready["set_up"]
            with urlopen(ready["url"] + "/sign-in", timeout=90) as page:
                assert b"Sign in" in page.read()
        finally:
            server.terminate()
        assert server.wait(timeout=90) == 0


Check = Callable[[Site, str], None]
