"""An output that cannot be written is refused before anything is done; a shipped protocol is found by its name."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli.common import (
    protocol_file,
    require_writable,
    require_writable_folder,
    shipped_protocols,
    write_whole,
)
from service.cli.main import app
from service.core.errors import ConfigurationError, ProtocolError
from service.store.records import SITE
from service.store.store import Store
from tests.support.runs.bench_run import record_runs

# {} is the output, {data} a data folder with a completed run, {file} some file.
OUTPUTS = {
    "report as PDF": ["audit", "report", "{run}", "--pdf", "{}", "--data", "{data}", "--operator", "Ada"],
    "report as HTML": ["audit", "report", "{run}", "--html", "{}", "--data", "{data}", "--operator", "Ada"],
    "figures": ["audit", "figures", "{run}", "--out", "{}", "--data", "{data}"],
    "bundle": ["audit", "export", "{run}", "{}", "--data", "{data}", "--operator", "Ada"],
    "data set": ["export", "{run}", "--format", "plain", "--out", "{}", "--data", "{data}", "--operator", "Ada"],
    "replay": ["replay", "{run}", "--out", "{}", "--data", "{data}"],
    "history": ["history", "--out", "{}", "--data", "{data}"],
    "backup": ["store", "backup", "{}", "--data", "{data}"],
    "restore": ["store", "restore", "{data}", "{}"],
    "develop": ["develop", "{file}", "--out", "{}"],
    "import-ros": ["import-ros", "{file}", "--out", "{}", "--base", "base", "--flange", "tool0"],
    "benchmark table": ["benchmark", "table", "--markdown", "{}"],
    "benchmark matching": ["benchmark", "matching", "{folder}", "--method", "sift", "--out", "{}"],
    "spheres": ["spheres", "--mesh", "{file}", "--radius-mm", "6", "--out", "{}"],
    "sfm": ["sfm", "--images", "{folder}", "--camera", "{file}", "--out", "{}"],
    "sfm workspace": ["sfm", "--images", "{folder}", "--camera", "{file}", "--out", "made", "--workspace", "{}"],
    "demonstration": ["demo", "--out", "{}"],
    "received series": ["dicom-listen", "--folder", "{}"],
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("recorded")
    completed, _ = record_runs(folder)
    return folder / "data", completed


def heads(data: Path, run: str) -> tuple[int, int]:
    with Store.open(data) as store:
        return store.head(run), store.head(SITE)


@pytest.mark.parametrize("command", OUTPUTS)
def test_an_output_with_no_place_is_refused_and_nothing_is_made_or_recorded(
    recorded: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.chdir(tmp_path)
    data, run = recorded
    file, folder = tmp_path / "file", tmp_path / "folder"
    file.write_text("a file")
    folder.mkdir()
    target = tmp_path / "no" / "such" / "output.zip"
    filled = {"{}": str(target), "{data}": str(data), "{run}": run, "{file}": str(file), "{folder}": str(folder)}
    before = heads(data, run)
    words = [filled.get(word, word) for word in OUTPUTS[command]]
    as_json = [] if command == "history" else ["--json"]  # what it prints is CSV
    done = CliRunner().invoke(app, [*words, *as_json], env={"COLUMNS": "200"})
    assert done.exit_code == (2 if command == "replay" else 1), done.output
    if as_json:
        told = json.loads(done.stdout)["error"]
        assert (told["kind"], told["where"]) == ("ConfigurationError", str(target))
    else:
        assert f"where: {target}" in done.output
    assert heads(data, run) == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]
    assert list(folder.iterdir()) == []
    assert file.read_text() == "a file"


def test_the_check_itself_leaves_nothing(tmp_path: Path) -> None:
    require_writable(tmp_path / "a.pdf")
    require_writable_folder(tmp_path / "folder")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("a file")
    require_writable(tmp_path / "file")
    assert (tmp_path / "file").read_text() == "a file"
    for check, path in ((require_writable, tmp_path), (require_writable_folder, tmp_path / "file")):
        with pytest.raises(ConfigurationError, match="this is a f"):
            check(path)
    for check in (require_writable, require_writable_folder):
        for within in ("file", "no"):
            with pytest.raises(ConfigurationError, match="does not exist"):
                check(tmp_path / within / "output")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


# --- protocols -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["exvivo_spine", "exvivo_spine.yaml", "protocols/exvivo_spine.yaml"])
def test_a_shipped_protocol_is_found_wherever_the_command_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert protocol_file(Path(name)) == shipped_protocols() / "exvivo_spine.yaml"
    own = tmp_path / "exvivo_spine.yaml"
    own.write_text("id: mine\n")
    assert protocol_file(Path("exvivo_spine.yaml")) == Path("exvivo_spine.yaml")  # a file of one's own comes first
    assert protocol_file(own) == own


@pytest.mark.parametrize(
    "words",
    [
        ["protocol", "check", "{}"],
        ["protocol", "diagram", "{}"],
        ["protocol", "ways", "{}"],
        ["run", "{}", "--rig", "rig.yaml", "--auto-confirm"],
        ["plan", "show", "{}", "--rig", "rig.yaml"],
        ["doctor", "--rig", "rig.yaml", "--protocol", "{}"],
        ["import", ".", "--protocol", "{}", "--specimen", "spine 1"],
    ],
    ids=" ".join,
)
def test_every_command_takes_the_name_of_a_shipped_protocol(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.yaml").write_text("name: bench\nsimulated: true\ndevices: {}\n")
    done = CliRunner().invoke(app, [word.format("demo.yaml") for word in words], env={"COLUMNS": "300"})
    assert "cannot read the protocol" not in done.output
    assert "no protocol of this name" not in done.output
    done = CliRunner().invoke(app, [word.format("demoo") for word in words], env={"COLUMNS": "300"})
    assert done.exit_code == 1
    assert "no protocol of this name comes with orthocapture" in done.output
    assert "exvivo_spine, handheld_spine" in done.output


def test_the_check_outside_a_checkout_names_the_file_that_it_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["protocol", "check", "exvivo_spine.yaml"], env={"COLUMNS": "300"})
    assert done.exit_code == 0, done.output
    assert done.output.startswith(f"{shipped_protocols() / 'exvivo_spine.yaml'} is valid: ")
    with pytest.raises(ProtocolError):
        protocol_file(Path("other.yaml"))


def test_a_file_is_written_as_a_whole_or_what_was_there_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, link = tmp_path / "out.json", tmp_path / "link.json"
    write_whole(out, "first")
    link.symlink_to(out)
    write_whole(link, b"second")  # through the link, which stays one
    assert (out.read_text(), link.is_symlink()) == ("second", True)

    def full(self: Path, data: bytes) -> int:
        with self.open("wb") as file:
            file.write(data[:3])
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(Path, "write_bytes", full)
        with pytest.raises(ConfigurationError, match="No space left on device"):
            write_whole(out, "third, which is longer")
    assert out.read_text() == "second"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link.json", "out.json"]
    write_whole(Path("/dev/null"), "nothing to be replaced")
    assert Path("/dev/null").is_char_device()
