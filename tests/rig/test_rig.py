"""The simulated rig as a process: its files, its world, its end; and a rig with two controllers."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import trimesh
import yaml

from service.core.records.run_events import ViewpointCaptured
from service.rig import load_rig
from service.station import Station
from service.store.store import Store
from tests.support.processes.below import processes_below
from tests.support.processes.forked import Forked
from tests.support.processes.waiting import until
from tests.support.rig.gphoto_rig import PAPER, driver
from tests.support.rig.patience import PATIENT_UR
from tests.support.rig.rig import REPOSITORY, RigLock, orthocapture, simulated_rig, without_calibration_and_ct

pytestmark = [pytest.mark.timeout(300), pytest.mark.xdist_group("rig")]

SMALL = ("--scene", "3", "--image-width", "240", "--speed-up", "10", "--scan-spacing-mm", "1.2")
# These rigs use an address of their own, so that they do not wait for those of other tests.
OWN_HOST = "127.0.0.61"


class Hands:
    """A client of the world's socket."""

    def __init__(self, address: str) -> None:
        host, port = address.split(":")
        self._socket = socket.create_connection((host, int(port)), timeout=250)
        self._lines = self._socket.makefile("r")

    def __enter__(self) -> Hands:
        return self

    def __exit__(self, *_exc: object) -> None:
        self._lines.close()
        self._socket.close()

    def send(self, line: str) -> dict[str, Any]:
        self._socket.sendall(line.encode() + b"\n")
        return json.loads(self._lines.readline())

    def ask(self, op: str, **fields: object) -> dict[str, Any]:
        return self.send(json.dumps({"op": op, **fields}))

    def act(self, action: str, **fields: object) -> dict[str, Any]:
        return self.ask("act", action=action, **fields)


@contextmanager
def rig_process(
    folder: Path, start: type[subprocess.Popen[str]] = subprocess.Popen
) -> Generator[tuple[subprocess.Popen[str], dict[str, Any], list[psutil.Process]]]:
    """A rig that the test ends itself; yields it with its ready line and all its processes.

    `start`: Forked, or for real.
    """
    with RigLock(OWN_HOST), (folder / "rig.log").open("w") as log:
        process = start(
            [sys.executable, "-m", "simulators", "rig", "--dir", str(folder), "--host", OWN_HOST, *SMALL],
            cwd=REPOSITORY, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log, text=True,
        )  # fmt: skip
        assert process.stdout is not None
        try:
            line = process.stdout.readline()
            assert line, (folder / "rig.log").read_text()
            root = psutil.Process(process.pid)
            yield process, json.loads(line), [root, *root.children(recursive=True)]
        finally:
            process.kill()
            process.wait(timeout=90)
            process.stdout.close()


def listens(host: str, port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((host, port)) == 0


# --- one rig ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_files_world_and_hands(tmp_path: Path) -> None:
    with simulated_rig(tmp_path, *SMALL, host=OWN_HOST) as ready, Hands(ready["world"]) as hands:
        # Everything in the ready line exists, and the service can read it.
        assert ready["ready"] is True
        assert Path(ready["rig"]) == tmp_path / "rig.yaml"
        for key in ("rig", "truth", "ct_folder", "scan_folder"):
            assert Path(ready[key]).exists()
        for name in ("robot", "camera", "lightbox"):
            assert (tmp_path / "logs" / f"{name}.log").exists()
        assert (tmp_path / "lightbox").is_symlink()
        rig = load_rig(Path(ready["rig"]))
        assert rig.section.simulated
        assert rig.section.hands == ready["world"]
        assert set(rig.section.stations) == {"station_1", "station_2"}
        assert PATIENT_UR.items() <= rig.section.devices["robot"].items()

        # The ground truth is only in its own file.
        truth = json.loads(Path(ready["truth"]).read_text())
        assert truth["scene"] == 3
        assert "no operation 'truth'" in hands.ask("truth")["error"]
        text = Path(ready["rig"]).read_text()
        for secret in ("T_world", "dh_deltas", "registration_m", "intrinsics", "truth"):
            assert secret not in text
        nominal = rig.nominal_T_flange_camera()
        offset_m = np.linalg.norm(nominal[:3, 3] - np.array(truth["T_flange_camera"])[:3, 3])
        assert 1e-5 < offset_m < 5e-3
        for name, section in rig.section.stations.items():
            T_world_base = np.array(truth["T_world_base"][name])
            centre = T_world_base[:3, :3] @ np.array(section.scene_centre_m) + T_world_base[:3, 3]
            assert 0 < np.linalg.norm(centre - [0, 0, 0.05]) < 0.02

        # Bad requests are answered and do not affect the connection.
        for line in ("{", "[]", "7", '{"op": "fly"}', '{"op": "robot", "arm": "robot"}'):
            assert hands.send(line)["ok"] is False
        assert "juggle" in hands.act("juggle")["error"]
        assert "station_9" in hands.act("move_robot", station="station_9")["error"]

        before = hands.ask("view")
        assert (before["scene"]["board"], before["scene"]["spray"], before["station"]) == (None, False, "station_1")
        for action in ("place_board", "spray", "remove_control_spheres", "press_pedal"):
            assert hands.act(action)["ok"] is True
        assert hands.act("move_robot", station="station_2")["ok"] is True
        after = hands.ask("view")
        assert np.array(after["scene"]["board"]).shape == (4, 4)
        assert (after["scene"]["spray"], after["scene"]["control_spheres"]) == (True, False)
        assert (after["station"], after["pedal_presses"]) == ("station_2", 1)
        # The arm has been moved to the other side of the table.
        positions = [np.array(v["T_world_camera"])[:3, 3] for v in (before, after)]
        assert np.linalg.norm(positions[0] - positions[1]) > 0.1
        first = after["scene"]["board"]
        hands.act("remove_board")
        assert hands.ask("view")["scene"]["board"] is None
        hands.act("place_board")
        assert hands.ask("view")["scene"]["board"] != first

        # A scan arrives in the scan folder, its ground truth only in the truth file.
        answer = hands.act("hand_scan")
        assert answer["ok"] is True
        assert "truth" not in answer
        assert (Path(ready["scan_folder"]) / answer["export"]).stat().st_size > 100_000
        assert len(json.loads(Path(ready["truth"]).read_text())["scans"]) == 1

        station = Station(rig)
        try:
            assert station.scanner().report().identity.kind == "scanner"
            assert station.robot("station_1") is station.robot("station_2")
        finally:
            station.close()


@pytest.mark.slow
def test_what_is_computed_ahead_is_written_when_asked_for_and_shows_the_scene_as_it_is_then(tmp_path: Path) -> None:
    options = (*SMALL, "--ahead", "--ct-voxel-mm", "3")
    with (
        simulated_rig(tmp_path, *options, host=OWN_HOST, start=subprocess.Popen) as ready,
        Hands(ready["world"]) as hands,
    ):

        def ahead(simulator: str) -> list[int]:
            found = processes_below(lambda line: line[3:4] == [simulator] and "--when-told" in line)
            return [process.pid for process in found]

        until(lambda: len(ahead("ct")) == 1, "the CT is not computed ahead")
        assert list(Path(ready["ct_folder"]).iterdir()) == []
        answer = hands.act("ct_scan")
        assert answer["ok"] is True
        assert len(list(Path(ready["ct_folder"]).glob("series_01/*.dcm"))) == answer["slices"]
        assert ahead("ct") == []

        until(lambda: len(ahead("scanner")) == 1, "the scan is not computed ahead")
        hands.act("remove_control_spheres")
        answer = hands.act("hand_scan")
        assert answer["ok"] is True
        assert ahead("scanner") == []
        truth = json.loads(Path(ready["truth"]).read_text())
        assert (len(truth["ct"]), len(truth["scans"])) == (1, 1)
        scan = trimesh.load_mesh(Path(ready["scan_folder"]) / answer["export"], process=False)
        T_world_scan = np.array(truth["scans"][0]["T_world_scan"])
        points_m = trimesh.transform_points(1e-3 * np.asarray(scan.vertices), T_world_scan)
        away_m = np.linalg.norm(points_m[:, None] - np.array(truth["control_m"]), axis=2)
        assert away_m.min() > 0.012  # the spheres, whose radius is 15 mm, had been taken away
        hands.act("spray")
        until(lambda: len(ahead("scanner")) == 1, "the scan with spray is not computed ahead")
    # Its end leaves no export behind that nobody asked for.
    assert ahead("scanner") == []
    assert len(list(Path(ready["scan_folder"]).iterdir())) == 1


@pytest.mark.slow
def test_sigterm_leaves_nothing_behind(tmp_path: Path) -> None:
    with rig_process(tmp_path) as (process, ready, processes):
        assert len(processes) >= 4
        addresses = {
            (c.laddr.ip, c.laddr.port)
            for p in processes
            for c in p.net_connections(kind="tcp")
            if c.status == psutil.CONN_LISTEN
        }
        host, port = ready["world"].split(":")
        assert {(host, int(port)), (OWN_HOST, 30004)} <= addresses
        process.terminate()
        assert process.wait(timeout=90) == 0
        assert not any(p.is_running() and p.status() != psutil.STATUS_ZOMBIE for p in processes)
        assert not [address for address in addresses if listens(*address)]
        assert not (tmp_path / "lightbox").exists()
        assert "Traceback" not in (tmp_path / "rig.log").read_text()


def test_a_device_that_dies_ends_the_rig_with_a_reason(tmp_path: Path) -> None:
    with rig_process(tmp_path, Forked) as (process, ready, processes):
        port = int(load_rig(Path(ready["rig"])).section.devices["camera"]["port"].rpartition(":")[2])
        (camera,) = [p for p in processes if port in {c.laddr.port for c in p.net_connections("tcp") if not c.raddr}]
        os.kill(camera.pid, signal.SIGKILL)
        process.wait(timeout=90)
        until(lambda: not any(p.is_running() for p in processes), "all have ended")
        log = (tmp_path / "rig.log").read_text()
        assert "camera ended with status -9" in log
        assert "Traceback" not in log


def test_a_rig_has_the_camera_that_was_recorded(tmp_path: Path) -> None:
    with simulated_rig(tmp_path, *SMALL, "--recorded", "ilce-7rm5-2.02", host=OWN_HOST) as ready:
        camera = driver(load_rig(Path(ready["rig"])).section.devices["camera"]["port"])
        try:
            camera.open()
            assert camera.report().identity.firmware == "2.02"
            assert camera.apply(PAPER) == PAPER, "its ISO, of which it lists no values, was set by hand"
        finally:
            camera.close()


@pytest.mark.slow
def test_only_a_sony_can_be_one_that_was_recorded(tmp_path: Path) -> None:
    words = ("--scene", "3", "--dir", str(tmp_path), "--camera", "Canon EOS R5", "--recorded", "ilce-7rm5-2.02")
    answer = orthocapture("simulate", "rig", *words)
    assert answer.returncode != 0
    assert "--recorded is for a Sony" in answer.stderr


def test_sigterm_also_ends_a_ct_scan_that_is_under_way(tmp_path: Path) -> None:
    with (
        rig_process(tmp_path, Forked) as (process, ready, before),
        ThreadPoolExecutor(1) as pool,
        Hands(ready["world"]) as hands,
    ):
        pool.submit(hands.act, "ct_scan")
        root = psutil.Process(process.pid)

        def scans() -> list[psutil.Process]:
            return [child for child in root.children(recursive=True) if child not in before]

        until(lambda: len(scans()) == 1, "the CT does not scan")
        (scan,) = scans()
        scan.suspend()  # a scan that takes for ever
        process.terminate()
        assert process.wait(timeout=90) == 0
        assert not scan.is_running()


def test_devices_and_a_ct_scan_end_with_a_rig_that_was_killed(tmp_path: Path) -> None:
    with rig_process(tmp_path) as (process, ready, _), ThreadPoolExecutor(1) as pool, Hands(ready["world"]) as hands:
        pool.submit(hands.send, '{"op": "act", "action": "ct_scan"}')
        root = psutil.Process(process.pid)
        until(lambda: processes_below(lambda line: "ct" in line, root, recursive=False) != [], "the CT does not scan")
        children = root.children()
        assert len(children) == 4  # arm, camera, light box and scan
        process.kill()  # before the scan's own process has begun to look whose child it is
        process.wait(timeout=90)
        until(lambda: not any(child.is_running() for child in children), "its processes have not ended")


# --- two controllers --------------------------------------------------------------------------------------


def two_station_protocol(folder: Path) -> Path:
    """Two viewpoints at each station, with a step between that moves the camera to the other one."""
    protocol = yaml.safe_load((REPOSITORY / "protocols" / "demo.yaml").read_text())
    by_id = {step["id"]: step for step in protocol["steps"]}
    change = {
        "id": "change",
        "kind": "checklist",
        "title": "Move to the other station",
        "instructions": "Put the camera on the other arm.",
        "checklist": ["The camera is on the other arm"],
        "gates": [{"measure": "checklist_items_open", "max": 0, "unit": "items"}],
        "simulated_hands": [{"action": "move_robot", "station": "station_2"}],
    }
    captures = by_id["viewpoint_capture_1"], by_id["viewpoint_capture_2"]
    for step in captures:
        step["params"]["viewpoints"][0]["arcs"] = [
            {"tilt_deg": 25, "azimuth_from_deg": -20, "azimuth_to_deg": 20, "count": 2, "distance_m": 0.64}
        ]
        next(gate for gate in step["gates"] if gate["measure"] == "viewpoints_captured")["min"] = 2
        step.pop("requires", None)
        without_calibration_and_ct(step)
    protocol["steps"] = [captures[0], change, captures[1]]
    path = folder / "two_stations.yaml"
    path.write_text(yaml.safe_dump(protocol))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("arm", ["UR10e", pytest.param("LBR Med 14", marks=pytest.mark.sweep)])
def test_two_controllers_are_found_and_used(tmp_path: Path, arm: str) -> None:
    """An arm at each station, both running at once."""
    data = tmp_path / "data"
    with simulated_rig(tmp_path, *SMALL, "--arms", "2", "--arm", arm, host=OWN_HOST) as ready:
        answer = orthocapture("doctor", "--rig", ready["rig"], "--json")
        assert answer.returncode == 0, answer.stdout + answer.stderr
        devices = json.loads(answer.stdout)["devices"]
        assert devices["robot_1"]["identity"]["address"] != devices["robot_2"]["identity"]["address"]
        assert all(devices[name]["ok"] for name in ("robot_1", "robot_2", "camera", "lightbox"))
        assert {devices[name]["identity"]["model"] for name in ("robot_1", "robot_2")} == {arm}

        protocol = two_station_protocol(tmp_path)
        answer = orthocapture(
            "run", str(protocol), "--rig", ready["rig"], "--data", str(data), "--auto-confirm", "--no-worker",
            timeout_s=240,
        )  # fmt: skip
        assert answer.returncode == 0, answer.stdout + answer.stderr
        truth = json.loads(Path(ready["truth"]).read_text())
        exposures = [
            json.loads(line) for line in (tmp_path / "truth_exposures.jsonl").read_text().splitlines() if line
        ]
    T_world_camera = {exposure["sha256"]: np.array(exposure["T_world_camera"]) for exposure in exposures}
    with Store.open(data, create=False) as store:
        events = store.events(store.find_run("latest"))
    captured = [event.payload for event in events if isinstance(event.payload, ViewpointCaptured)]
    assert [e.station for e in captured] == ["station_1"] * 2 + ["station_2"] * 2
    T_flange_camera = np.array(truth["T_flange_camera"])
    for event in captured:
        true = T_world_camera[event.artefacts[0].sha256]
        for station, T_world_base in truth["T_world_base"].items():
            recorded = np.array(T_world_base) @ np.array(event.T_base_flange) @ T_flange_camera
            error_m = float(np.linalg.norm(recorded[:3, 3] - true[:3, 3]))
            # The arm's own error is below 5 mm; from the wrong base the camera would be somewhere else.
            assert (error_m < 0.005) == (station == event.station), (event.viewpoint, station, error_m)


@pytest.mark.slow
def test_a_device_that_dies_is_switched_on_again_at_its_address(tmp_path: Path) -> None:
    options = (*SMALL, "--revive-after-s", "0.2")
    with simulated_rig(tmp_path, *options, host=OWN_HOST, start=subprocess.Popen) as ready:
        before = load_rig(Path(ready["rig"])).source
        port = int(load_rig(Path(ready["rig"])).section.devices["camera"]["port"].rpartition(":")[2])
        camera = processes_below(lambda line: line[2:4] == ["simulators", "camera"])[0]
        camera.kill()

        def answers() -> bool:
            with socket.socket() as probe:
                return not camera.is_running() and probe.connect_ex(("127.0.0.1", port)) == 0

        until(answers, "the camera does not answer again")
        assert Path(ready["rig"]).read_bytes() == before


@pytest.mark.slow
def test_somebody_at_a_terminal_reads_what_to_type_next_and_a_program_does_not(tmp_path: Path) -> None:
    words = ("--dir", str(tmp_path / "a rig"), *SMALL, "--host", OWN_HOST)
    with RigLock(OWN_HOST):
        screen, terminal = os.openpty()
        with subprocess.Popen(
            [sys.executable, "-m", "simulators", "rig", *words], cwd=REPOSITORY, stdout=terminal, stderr=terminal
        ) as process:
            os.close(terminal)
            try:
                shown = ""
                while "orthocapture run demo" not in shown:
                    shown += os.read(screen, 4096).decode()
            finally:
                process.terminate()
                os.close(screen)
    assert f"orthocapture serve --rig '{tmp_path}/a rig/rig.yaml' --data runs" in shown
    with simulated_rig(tmp_path, *SMALL, host=OWN_HOST):
        assert "orthocapture run" not in (tmp_path / "rig.log").read_text()
