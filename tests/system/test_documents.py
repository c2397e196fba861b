"""The documents agree with the code: files, links, generated pages, and what they say was measured."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import pytest

from docs.generate.pages import REFERENCE, pages
from docs.generate.rooms import layers, pages_with_rooms, rooms_table
from docs.generate.steps import measures_of_kind
from service.steps import step_kinds

ROOT = Path(__file__).parents[2]
DOCUMENTS = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
_PATH = re.compile(r"`((?:service|drivers|simulators|protocols|bench|tests)/[\w/]*(?:\w|\.(?:py|yaml)|/))`")


def test_test_files_and_the_marker_are_there() -> None:
    """What the commands for a part of the tests name; they cannot be run within the tests themselves."""
    assert (ROOT / "tests" / "protocol" / "test_gate_words.py").is_file()
    assert '"slow: ' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def test_files_that_the_documents_name_exist() -> None:
    for document in DOCUMENTS:
        for path in _PATH.findall(document.read_text(encoding="utf-8")):
            assert (ROOT / path).exists(), f"{document.name}: {path}"


def test_every_page_is_reached_from_the_first() -> None:
    """Sphinx says so too, but only where it is installed."""
    listed = set(re.findall(r"^(\w+/\w+)$", (ROOT / "docs" / "index.md").read_text(encoding="utf-8"), re.MULTILINE))
    pages_there = {
        path.relative_to(ROOT / "docs").with_suffix("").as_posix()
        for part in ("tutorial", "howto", "reference", "explanation")
        for path in (ROOT / "docs" / part).glob("*.md")
    }
    assert pages_there == {page for page in listed if not page.startswith("decisions/")}


@pytest.mark.slow
def test_the_generated_documents_are_up_to_date() -> None:
    """`make reference` regenerates them."""
    for name, text in pages().items():
        assert (REFERENCE / name).read_text(encoding="utf-8") == text, f"{name}: run `make reference`"


def test_every_key_of_a_file_and_every_measure_is_explained() -> None:
    for name in ("protocol.md", "rig.md"):
        keys = [
            line for line in (REFERENCE / name).read_text(encoding="utf-8").splitlines() if line.startswith("| `")
        ]
        assert keys
        assert not [line for line in keys if line.endswith("|  |")], name
    for kind in step_kinds().values():
        assert all(measure.meaning for measure in measures_of_kind(kind).values()), kind.name


def test_links_of_the_documents_lead_somewhere() -> None:
    for document in DOCUMENTS:
        for target in re.findall(r"\]\(([^)#]+)\)", document.read_text(encoding="utf-8")):
            assert "://" in target or (document.parent / target).exists(), f"{document.name}: {target}"


def test_every_picture_beside_the_documents_is_shown_by_one() -> None:
    """`python -m bench.pages.screens` takes all others whenever somebody wants to look at them."""
    texts = "".join(document.read_text(encoding="utf-8") for document in DOCUMENTS)
    pictures = [path for part in ("screens", "images") for path in (ROOT / "docs" / part).iterdir()]
    assert [
        path.name for path in pictures if path.suffix != ".md" and f"{path.parent.name}/{path.name})" not in texts
    ] == []


def test_what_the_page_of_the_accuracy_says_of_a_corrected_arm_is_what_was_measured() -> None:
    """For errors of the simulated arm's own model, and for an arm with other errors (bench/calibration/hand_eye)."""
    measured = json.loads((ROOT / "bench" / "results" / "hand_eye-2026-11-27.json").read_text())
    text = " ".join((ROOT / "docs" / "explanation" / "accuracy.md").read_text().split())
    for kind, words in (("systematic", "poses good to {} mm once"), ("odd", "{} mm are left")):
        rows = [row for row in measured[kind] if row["session"].startswith("hand-eye step")]
        left = [row["error_mm"]["arm corrected"] for row in rows]
        least, most = f"{min(left):.2f}", f"{max(left):.2f}"
        assert words.format(least if least == most else f"{least} … {most}") in text


def test_make_targets_do_what_the_documents_say() -> None:
    """The last line of each target; tests/system/test_demo.py runs the command of `make demo`."""
    with_realtime = "$(grep -rlwE 'realtime' tests --include='test_*.py')"
    for target, last in (
        ("test", '.venv/bin/pytest -m "not (slow or realtime or packages or whole or sweep)" --ignore=tests/browser'),
        ("test-all", f".venv/bin/pytest -m realtime -n 2 {with_realtime}"),
        ("test-realtime", f".venv/bin/pytest -m realtime -n 2 {with_realtime}"),
        ("test-whole", ".venv/bin/pytest -m whole"),
        ("test-sweeps", ".venv/bin/pytest -m sweep"),
        ("marks", ".venv/bin/ruff format --quiet tests"),
        ("mutants SEED=1", ".venv/bin/python -m bench.suite.mutants --seed 1 --count 300 --at-least 0"),
        ("demo", ".venv/bin/orthocapture demo"),
        ("demo-site", ".venv/bin/python -m bench.whole_runs.demo_site"),
        ("lint", ".venv/bin/python -m bench.suite.marks --check"),
        (
            "lock",
            "sed -i '1i # The same with the tools of tests and lint; made by `make lock`.' .ci/constraints-dev.txt",
        ),
        ("docs", ".venv/bin/sphinx-build --quiet --fail-on-warning --keep-going docs build/docs"),
        ("reference", ".venv/bin/python -m docs.generate"),
        ("test-versions", ".ci/versions"),
        ("torture-audit", ".venv/bin/python -m bench.torture.audit"),
        ("torture-crash", ".venv/bin/python -m bench.torture.crash"),
        ("torture-faults", ".venv/bin/python -m bench.torture.faults"),
        ("torture-fuzz", ".venv/bin/python -m bench.torture.fuzz --seconds-per-target 60 --record"),
        ("soak", ".venv/bin/python -m bench.soak"),
        ("clean", "rm -rf .venv build *.egg-info"),
    ):
        done = subprocess.run(
            ["make", "--dry-run", "--no-print-directory", *target.split()],
            cwd=ROOT, capture_output=True, text=True, timeout=30, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert done.stdout.splitlines()[-1] == last


def test_every_room_of_the_service_is_named_from_one_source() -> None:
    """The contract of the layers names each room once; `make reference` writes them where people read them."""
    there = {
        path.stem for path in (ROOT / "service").iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()
    }
    rooms = [room for layer in layers() for room in layer]
    assert sorted(rooms) == sorted(there - {"__init__"})
    for path, text in pages_with_rooms().items():
        written = path.read_text(encoding="utf-8")
        assert written == text, f"{path.name}: run `make reference`"
        assert [room for room in rooms if not re.search(rf"[/>]{room}(?:/|\.py|<)", written)] == []
    assert all(line.rpartition(" | ")[2].strip(" |") for line in rooms_table().splitlines())


def test_the_readme_fits_a_screen_and_maps_the_top_level() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 100
    for folder in ("protocols", "drivers", "simulators", "service", "tests", "bench", "docs"):
        assert re.search(rf"(?m)^\|.*`{folder}/`.*\|.*\|$", text), folder
    assert len(re.findall(r"(?m)^\| .* \| `orthocapture .*` \|$", text)) == 10, "the commands of the first week"


def test_the_changelog_of_a_version_that_nobody_has_fits_a_screen() -> None:
    assert len((ROOT / "CHANGELOG.md").read_text(encoding="utf-8").splitlines()) <= 60
