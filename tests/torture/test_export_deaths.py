"""An export that is killed at any of its operations on files leaves nothing that looks whole, and goes on."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from service.dataset.export_folder import check_folder
from service.dataset.exporter import exporter, write_data_set
from service.dataset.records import DataSet
from tests.support.scenes.posed import posed_data_set

pytestmark = [pytest.mark.sweep, pytest.mark.timeout(300)]
ROUNDS = 7  # the last two die at the last operations

#: Exports into a folder and kills itself at the n-th operation on its files; says how many there were if it lives.
CHILD = """
import os, signal, sys
from pathlib import Path
from service.dataset.exporter import exporter, write_data_set
from tests.support.scenes.posed import posed_data_set

photographs, out, name, death = Path(sys.argv[1]), sys.argv[2], sys.argv[3], int(sys.argv[4])
done, at_work = 0, False

def operation(event, arguments):
    global done
    if at_work and event in ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir"):
        if any(os.path.basename(out) in str(argument) for argument in arguments):
            done += 1
            if done == death:
                os.kill(os.getpid(), signal.SIGKILL)

sys.addaudithook(operation)
dataset = posed_data_set(photographs)
at_work = True
write_data_set(dataset, exporter(name), Path(out))
at_work = False
print(done)
"""


def attempt(photographs: Path, out: Path, name: str, death: int) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", CHILD, str(photographs), str(out), name, str(death)]
    return subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False)


def contents(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@dataclass(frozen=True)
class Undisturbed:
    """An export that nobody killed: the photographs, what it wrote, and how many operations on files that took."""

    photographs: Path
    whole: dict[str, bytes]
    operations: int


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("photographs")


@pytest.fixture(scope="module")
def dataset(photographs: Path) -> DataSet:
    return posed_data_set(photographs)


@pytest.fixture(scope="module", params=["plain", "nerfstudio"])
def name(request: pytest.FixtureRequest) -> str:
    """A form of data set."""
    return request.param


@pytest.fixture(scope="module")
def undisturbed(
    dataset: DataSet, photographs: Path, tmp_path_factory: pytest.TempPathFactory, name: str
) -> Undisturbed:
    folder = tmp_path_factory.mktemp(name)
    write_data_set(dataset, exporter(name), folder / "at_once")
    counted = attempt(photographs, folder / "counted", name, 0)
    assert counted.returncode == 0, counted.stderr
    whole, operations = contents(folder / "at_once"), int(counted.stdout)
    assert operations > 2 * len(whole), "each file is written and gets its name"
    return Undisturbed(photographs, whole, operations)


@pytest.mark.slow
@pytest.mark.parametrize("round_", range(ROUNDS))
def test_a_death_at_a_random_point_leaves_nothing_that_looks_whole(
    dataset: DataSet, undisturbed: Undisturbed, tmp_path: Path, name: str, round_: int
) -> None:
    whole, operations, out = undisturbed.whole, undisturbed.operations, tmp_path / "killed"
    dice = random.Random(14 + round_)
    last = {ROUNDS - 2: operations - 1, ROUNDS - 1: operations}
    for point in (
        last.get(round_, dice.randrange(1, operations)),
        dice.randrange(1, operations // 2),
    ):  # while it goes on
        died = attempt(undisturbed.photographs, out, name, point)
        assert died.returncode in (-signal.SIGKILL, 0, 1), died.stderr
        if out.exists():
            assert check_folder(out) == len(whole) - 1
            break
    if not out.exists():
        write_data_set(dataset, exporter(name), out)
    assert contents(out) == whole
    check_folder(out)
