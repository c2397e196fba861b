"""The documents are correct: every command in them is run, and generated parts are up to date."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.support.processes.documented_site import (
    ROOT,
    Check,
    Site,
    asks_and_is_aborted,
    registers,
    says_how_to_get_the_data,
    serves_pages,
    serves_until_terminated,
    starts_and_is_aborted,
    succeeds,
)
from tests.support.runs.bench_run import record_runs

DOCUMENTS = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
HELP_TEXTS = "commands.md"  # the help of the commands, put together
SHELLS = ("sh", "bash", "shell", "console")
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
_SPAN = re.compile(r"`((?:orthocapture|make|python3?|pip|\.venv/bin/\S+) [^`]+)`")


def commands_of(text: str) -> list[str]:
    """Every command in a document: the lines of its shell blocks, and commands in backticks."""
    found: list[str] = []
    for language, block in _FENCE.findall(text):
        if language in SHELLS:
            lines = block.replace("\\\n", " ").splitlines()
            found += [line.removeprefix("$ ").split(" #")[0].strip() for line in lines if line.strip()]
    found += [" ".join(span.split()) for span in _SPAN.findall(_FENCE.sub("", text))]
    return [command for command in found if command and not command.startswith("#")]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A data folder with a completed run and one that waits, and the name of the latter."""
    folder = tmp_path_factory.mktemp("recorded")
    _, begun = record_runs(folder)
    return folder / "data", begun


@pytest.fixture
def site(tmp_path: Path, recorded: tuple[Path, str]) -> Site:
    data, begun = recorded
    shutil.copytree(data, tmp_path / "runs")
    (tmp_path / "protocols").symlink_to(ROOT / "protocols")
    (tmp_path / "scans").mkdir()
    rig = "name: a small site\ndevices:\n  scanner: {driver: scan_folder, folder: scans}\n"
    (tmp_path / "rig.yaml").write_text(rig)
    return Site(tmp_path, begun)


RUN_HERE: dict[str, Check] = {
    "orthocapture protocol check exvivo_spine": succeeds,
    "orthocapture protocol check dry_run": succeeds,
    "orthocapture doctor --rig rig.yaml": succeeds,
    "orthocapture doctor --rig rig.yaml --record devices.json": succeeds,
    "orthocapture run exvivo_spine --rig rig.yaml --data runs "
    '--operator "A. Name" --specimen "Spine 7"': starts_and_is_aborted,
    'orthocapture run dry_run --rig rig.yaml --data runs --operator "A. Name"': starts_and_is_aborted,
    "orthocapture resume latest --data runs": asks_and_is_aborted,
    "orthocapture status latest --data runs": succeeds,
    "orthocapture plan next latest --data runs": succeeds,
    "orthocapture act pause --run latest --data runs": succeeds,
    'orthocapture note "a wire slipped" --run latest --data runs': succeeds,
    "orthocapture store rebuild --data runs": succeeds,
    "orthocapture runs --search spine --data runs": succeeds,
    "orthocapture history --out history.csv --data runs": succeeds,
    "orthocapture worker --data runs": serves_until_terminated,
    "orthocapture serve --rig rig.yaml --data runs": serves_pages,
    "orthocapture audit report latest --pdf report.pdf --data runs": succeeds,
    "orthocapture audit report latest --pdf report.pdf --html report.html --data runs": succeeds,
    "orthocapture audit figures latest --out figures --data runs": succeeds,
    "orthocapture audit export latest bundle.zip --data runs": succeeds,
    "orthocapture audit release latest --data runs": succeeds,
    "orthocapture register --images DIR --camera camera.json --poses poses.csv --mesh scan.ply --radius-mm 15 "
    "--out result.json": registers,
    "orthocapture audit show latest --data runs": succeeds,
    "orthocapture store backup BACKUP --data runs": succeeds,
    "orthocapture audit verify latest --data runs": succeeds,
    "orthocapture audit verify all --data runs": succeeds,
    "orthocapture audit verify latest --json --data runs": succeeds,
    "orthocapture audit keys --data runs": succeeds,
    "orthocapture store gc --data runs": succeeds,
    "python -m bench.real_data --data DIR": says_how_to_get_the_data,
}
# Commands that take minutes, a whole rig or a network, with the test of what they run, at a smaller size if need be.
RUN_ELSEWHERE = {
    "orthocapture worker --data runs --scheduler tcp://head:8786": (
        "tests/cluster/test_cluster.py::test_a_worker_of_a_cluster_records_the_processors_that_computed_an_answer"
    ),
    "orthocapture store upload --data runs": (
        "tests/objects/test_uploads.py::test_the_command_says_what_waits_and_why"
    ),
    "orthocapture store gc --spool --data runs": (
        "tests/objects/test_freed_files.py::test_the_command_lists_and_frees"
    ),
    "orthocapture store gc --spool --remove --data runs": (
        "tests/objects/test_freed_files.py::test_the_command_lists_and_frees"
    ),
    "orthocapture audit verify all --data runs --anchors FOLDER": (
        "tests/objects/test_anchors.py::test_who_takes_the_lock_out_of_the_site_file_is_found_with_a_copy_of_it"
    ),
    "orthocapture compare RUN OTHER --data runs": (
        "tests/audit/test_runs_beside_runs.py::test_two_runs_side_by_side_in_the_terminal"
    ),
    "orthocapture accounts end-wait emmy --operator ada --data runs": (
        "tests/people/test_tries.py::test_an_administrator_clears_it_on_the_command_line"
    ),
    "orthocapture replay latest --data runs": "tests/audit/test_replay.py::test_command_says_equal_with_status_0",
    "orthocapture calibrate intrinsics --images DIR --board 16x23 --square-mm 15 --out camera.json": (
        "tests/calibration/test_intrinsics_command.py::test_a_folder_of_photographs_becomes_a_camera_that_every_command_reads"
    ),
    "orthocapture sfm --images DIR --camera camera.json --out MODEL_DIR": (
        "tests/poses/test_sfm_command.py::test_robot_poses_of_two_frames_are_noticed_and_not_believed"
    ),
    "orthocapture calibrate hand-eye --images DIR --robot-poses poses.csv --joints joints.csv --camera camera.json "
    "--board 16x23 --square-mm 15 --out hand_eye.json": (
        "tests/calibration/test_hand_eye_arm.py::test_the_command_calibrates_photographs"
    ),
    "orthocapture plan show exvivo_spine --rig rig.yaml": (
        "tests/steps/test_planning.py::test_the_command_plans_from_files_alone"
    ),
    "orthocapture plan show dry_run --rig rig.yaml": (
        "tests/rig/test_dry_run.py::test_every_viewpoint_is_planned_from_the_documented_rig_file"
    ),
    "orthocapture spheres --mesh scan.ply --radius-mm 15 --out spheres.json": (
        "tests/scanner/test_mesh_spheres_hard.py::test_command_reads_clouds_and_writes_spheres"
    ),
    "orthocapture evaluate chamfer mesh.ply truth.ply --heat-map heat.ply": (
        "tests/ground_truth/test_chamfer.py::test_the_command_writes_heat_maps_in_the_unit_of_the_surface"
    ),
    "orthocapture fuse --ct ct.ply --scan scan.ply --radius-mm 15 --out truth.ply": (
        "tests/ground_truth/test_fuse_command.py::test_the_command_fuses_measures_and_cuts_out_the_spheres"
    ),
    **dict.fromkeys(
        (
            "orthocapture export latest --format hdf5 --out dataset --data runs",
            "orthocapture benchmark run dataset --method stereo --scenario dense --out benchmark",
            "orthocapture benchmark run dataset --method stereo --scenario sparse --out benchmark",
            "orthocapture benchmark run dataset --method neus2 --scenario dense --mesh 15000.obj --out benchmark",
            "orthocapture benchmark table --out benchmark --markdown table.md --figure figure.png",
        ),
        "tests/benchmark/test_benchmark_command.py::test_methods_are_run_scored_and_put_into_the_table",
    ),
    **dict.fromkeys(
        (
            "orthocapture benchmark run latest --method gsplat --scenario dense --out benchmark --data runs",
            "orthocapture worker --kinds benchmark --data runs",
        ),
        "tests/benchmark/test_benchmark_job.py::test_the_machine_with_the_method_answers_and_the_answer_is_evidence",
    ),
    "orthocapture layout --spheres spheres.json": "tests/layout/test_layout.py::test_command",
    "orthocapture export latest --format colmap --out dataset --data runs": (
        "tests/dataset/test_export_command.py::test_a_run_is_exported_recorded_and_still_verifies"
    ),
    "orthocapture export latest --format matching --out pairs --data runs": (
        "tests/matching/test_matching_export.py::test_corresponding_pixels_show_the_same_place"
    ),
    "orthocapture benchmark matching pairs --method sift --out matching": (
        "tests/matching/test_benchmark.py::test_sift_finds_poses_and_fewer_matches_of_difficult_pairs"
    ),
    'pip install "kornia==0.9.0" "torch>=2.5.1"': (  # needs a package index, which tests have not
        "tests/matching/test_methods.py::test_a_learned_method_says_what_to_install_and_which_file_to_give"
    ),
    'pip install "orthocapture[grounded]"': (  # the same
        "tests/markers/test_grounded.py::test_without_weights_the_message_names_the_files_and_their_place"
    ),
    "orthocapture register --images DIR --camera camera.json --poses poses.csv --mesh scan.ply --radius-mm 15 "
    "--detector grounded --weights WEIGHTS --out result.json": (
        "tests/registration/test_register_command.py::test_grounded_and_vote_record_the_hashes_of_their_weights"
    ),
    "python -m bench.markers.detectors": (
        "tests/markers/test_grounded.py::test_all_detectors_are_measured_side_by_side"
    ),
    **dict.fromkeys(
        (". .venv/bin/activate", "orthocapture --help"),
        "tests/system/test_docs.py::test_the_environment_is_activated_and_the_command_is_there",
    ),
    "orthocapture demo": "tests/system/test_demo.py::test_table_has_the_papers_rows_and_its_reason",
    "make demo": "tests/system/test_demo.py::test_table_has_the_papers_rows_and_its_reason",
    'python -m pip install ".[fuzz]"': (  # needs a package index, which tests have not
        "tests/system/test_docs.py::test_the_extras_that_documents_install_are_declared"
    ),
    **dict.fromkeys(
        ("make test-drawn", "make test-realtime", "make test-whole", "make test-sweeps"),
        "tests/code_rules/test_suite_rules.py::"
        "test_whole_runs_are_drawn_by_file_sweeps_by_row_and_what_was_drawn_is_printed",
    ),
    "make test-postgres": "tests/store/test_store_crash.py::test_crash_at_every_point_of_a_record",
    **dict.fromkeys(
        ("make marks", "make marks FILES=tests/core"),
        "tests/code_rules/test_suite_rules.py::test_the_list_is_written_from_records_and_then_the_check_is_content",
    ),
    "python -m tests.support.record.new_schema": (
        "tests/store/test_store_chain.py::test_a_new_database_is_what_the_migrations_make"
    ),
    "make torture-crash": ("tests/torture/test_crash_sweep.py::test_a_death_there_leaves_nothing_behind"),
    "python -m bench.torture.crash --sample 100 --random-runs 1": (
        "tests/torture/test_crash_sweep.py::test_a_death_there_leaves_nothing_behind"
    ),
    **dict.fromkeys(
        ("python -m bench.suite.mutants --reach", "python -m bench.suite.mutants --seed 20261127 --count 60"),
        "tests/torture/test_mutants.py::test_a_mutation_is_killed_by_a_test_that_fails_and_the_tree_is_as_before",
    ),
    "python -m bench.soak --only large --viewpoints 2000 --gigabytes 5": (
        "tests/torture/test_soak.py::test_a_large_run_is_read_at_four_sizes"
    ),
    **dict.fromkeys(
        (
            "make test",
            "make test-all",
            "make lint",
            "make docs",
            "make reference",
            "make lock",
            "make test-versions",
            "make torture-audit",
            "make torture-faults",
            "make torture-fuzz",
            "make mutants",
            "make soak",
            "make clean",
            "make demo-site",
        ),
        "tests/system/test_documents.py::test_make_targets_do_what_the_documents_say",
    ),
    "orthocapture import FOLDER --data runs": (
        "tests/imports/test_import.py::test_an_import_killed_and_begun_again_is_a_run_that_says_so_everywhere"
    ),
    "orthocapture simulate rig --scene 7 --dir rig --second-camera stereo": (
        "tests/second_camera/test_second_camera_whole_run.py::test_the_extrinsics_are_true_within_their_covariance"
    ),
    "orthocapture simulate rig --scene 7 --dir rig --hand usual": (
        "tests/handheld/test_handheld.py::test_the_evidence_verifies"
    ),
    **dict.fromkeys(
        (
            "python -m bench.torture.faults --only 'robot/rtde/*'",
            "python -m bench.torture.faults --sample 40 --seed 7 --minutes 10",
            "python -m bench.torture.faults --record",
        ),
        "tests/torture/test_torture_faults.py::test_the_case_goes_as_the_table_says",
    ),
    **dict.fromkeys(
        (
            "orthocapture store restore BACKUP restored",
            "orthocapture audit verify all --data restored",
            "orthocapture resume latest --data restored",
        ),
        "tests/store/test_backup.py::test_a_run_goes_on_in_the_restored_folder",
    ),
    'orthocapture audit rotate-key --lost --reason "disk died" --data restored': (
        "tests/store/test_backup.py::test_the_signing_key_leaves_only_when_asked_and_a_restored_run_can_be_signed"
    ),
    "orthocapture doctor --rig rig.yaml --protocol exvivo_spine --data runs": (
        "tests/rig/test_space.py::test_doctor_and_pages_say_it_before_a_run"
    ),
    "orthocapture audit verify --signatures FILE": (
        "tests/verify/test_signature_log.py::test_a_run_keeps_the_copy_that_its_rig_file_names"
    ),
    "orthocapture serve --rig rig/rig.yaml --data runs": (
        "tests/browser/test_browser_run.py::test_a_technician_is_led_through_a_run_and_a_second_person_releases_it"
    ),
    "orthocapture register --images DIR --camera camera.json --poses MODEL_DIR --estimate-scale --mesh scan.ply "
    "--radius-mm 15 --out result.json": (
        "tests/registration/test_register_command.py::test_scale_of_poses_that_are_not_metric"
    ),
    ".venv/bin/python -m pip wheel --no-deps --no-build-isolation --wheel-dir dist .": (
        "tests/system/test_package.py::test_wheel_and_sdist_hold_every_file_of_the_packages"
    ),
    **dict.fromkeys(
        (
            ".venv/bin/pytest tests/protocol/test_gate_words.py -n 0",
            '.venv/bin/pytest -m "not slow" -k gate',
        ),
        "tests/system/test_documents.py::test_test_files_and_the_marker_are_there",
    ),
    "orthocapture act release": "tests/web/test_web_held.py::test_the_buttons_ask_the_step",
    **dict.fromkeys(
        (
            "orthocapture simulate rig --scene 3 --dir rig --hand steady",
            "orthocapture simulate grbl --link rig/table --world HOST:PORT",
        ),
        "tests/grbl/test_grbl_run.py::test_a_run_with_the_turntable_instead_of_the_arm",
    ),
    "orthocapture dicom-listen --folder ct --from CTSUITE": (
        "tests/ct/test_dicom_listen.py::test_another_program_sends_a_series_and_the_importer_reads_it"
    ),
    "orthocapture export latest --format mcap --out bag --data runs": (
        "tests/dataset/test_mcap.py::test_rosbags_opens_the_folder_as_a_recording_of_ros"
    ),
    "orthocapture import-ros bag --out files --base base_link --flange tool0 --camera-frame camera_optical": (
        "tests/imports/test_import_ros.py::test_a_recording_calibrates_a_hand_eye_as_its_files_would"
    ),
    "orthocapture develop DSC00001.ARW --out developed": (
        "tests/photos/test_develop.py::test_the_command_writes_a_tiff_and_its_record"
    ),
    'orthocapture simulate rig --scene 7 --dir rig --arm "LBR Med 14"': (
        "tests/kuka/test_kuka_run.py::test_it_comes_to_its_end_with_every_view"
    ),
    **dict.fromkeys(
        (
            "orthocapture simulate rig --scene 7 --dir rig --scanner zivid",
            "orthocapture simulate rig --ct-sends-to 127.0.0.1:11112 --scene 7 --dir rig",
        ),
        "tests/second_camera/test_second_camera_whole_run.py::test_the_series_was_sent_and_the_scan_is_of_its_profile",
    ),
    'orthocapture simulate rig --scene 7 --dir rig --camera "Canon EOS R5"': (
        "tests/second_camera/test_second_camera_whole_run.py::test_it_comes_to_its_end_with_every_view"
    ),
    "orthocapture simulate ct --scene 7 --folder ct --once --products": (
        "tests/scanner/test_scan_ct_simulators.py::test_the_products_of_one_acquisition_are_delivered_together"
    ),
    "orthocapture simulate canon": "tests/canon/test_canon_driver.py::test_identity_and_report",
    "orthocapture simulate canon --recorded eos-r5-1.2.0": (
        "tests/canon/test_recorded_canons.py::test_a_recorded_body_is_driven_or_refused_in_words_that_help"
    ),
    "orthocapture simulate camera --recorded ilce-7rm5-2.02": (
        "tests/camera/test_recorded_bodies.py::test_a_recorded_body_is_driven_or_refused_in_words_that_help"
    ),
    "orthocapture simulate nikon": (
        "tests/camera/test_recorded_nikons.py::test_a_recorded_body_is_driven_or_refused_in_words_that_help"
    ),
    "orthocapture simulate camera --replay devices.json": (
        "tests/recording/test_round_trips.py::test_a_body_is_the_same_on_the_replay_of_its_recording"
    ),
    "orthocapture simulate nikon --replay devices.json": (
        "tests/recording/test_round_trips.py::test_a_body_is_the_same_on_the_replay_of_its_recording"
    ),
    "orthocapture simulate canon --replay devices.json": (
        "tests/recording/test_replayed_canon.py::test_a_canon_is_the_same_on_the_replay_of_what_the_doctor_recorded"
    ),
    "orthocapture simulate kuka --replay devices.json": (
        "tests/recording/test_replayed_machines.py::test_a_kuka_is_the_same_on_the_replay_of_its_recording"
    ),
    "orthocapture simulate grbl --replay devices.json": (
        "tests/recording/test_replayed_machines.py::test_a_grbl_machine_is_the_same_on_the_replay_of_its_recording"
    ),
    "orthocapture simulate lightbox --replay devices.json": (
        "tests/recording/test_replayed_machines.py::test_a_light_box_is_the_same_on_the_replay_of_its_recording"
    ),
    "orthocapture simulate ur --replay devices.json": (
        "tests/recording/test_round_trips.py::test_an_arm_is_the_same_on_the_replay_of_its_recording"
    ),
    "orthocapture simulate rig --scene 7 --dir rig --replay devices.json": (
        "tests/recording/test_doctor_records.py::test_a_whole_rig_is_the_same_on_its_replay"
    ),
    "orthocapture simulate kuka": "tests/kuka/test_kuka_driver.py::test_a_day_without_trouble",
    '.venv/bin/python -m pip install ".[site]"': (
        "tests/store/test_postgres.py::test_the_tables_are_those_of_the_metadata"
    ),
    "orthocapture store prepare postgresql://orthocapture_owner@db.example/orthocapture --role orthocapture": (
        "tests/store/test_postgres.py::test_a_database_is_prepared_by_its_owner_with_one_command"
    ),
    "orthocapture store copy runs site-folder": (
        "tests/store/test_postgres.py::test_a_record_goes_to_postgresql_and_back_with_every_number_the_same"
    ),
    "orthocapture store copy site-folder archive": (
        "tests/store/test_postgres.py::test_a_record_goes_to_postgresql_and_back_with_every_number_the_same"
    ),
    **dict.fromkeys(
        (
            "orthocapture audit report latest --pdf report.pdf --data runs --operator sam",
            "orthocapture doctor --rig rig/rig.yaml",
            'orthocapture run exvivo_spine --rig rig/rig.yaml --data runs --operator "A. Name" --specimen "Spine 7"',
        ),
        "tests/browser/whole_runs/test_browser_first_hour.py::"
        "test_the_tutorial_and_the_readme_lead_to_a_verified_run",
    ),
    "orthocapture store copy runs site-folder --run latest": (
        "tests/store/test_moving.py::test_a_run_goes_to_another_record_and_back_with_every_number_the_same"
    ),
    "orthocapture audit sign-here --data runs": (
        "tests/store/test_who_signs.py::test_signing_is_handed_over_with_key_and_log"
    ),
    "orthocapture simulate rig --scene 7 --dir rig": (
        "tests/recovery/test_resume.py::test_sigkill_in_the_capture_loses_and_repeats_nothing"
    ),
}


# What a user types first, an auditor last; of the others a tenth are drawn.
ALWAYS = ("orthocapture status latest --data runs", "orthocapture audit verify latest --data runs")


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [pytest.param(command, marks=pytest.mark.sweep(always=command in ALWAYS)) for command in RUN_HERE],
)
def test_the_command_works_as_it_is_written(site: Site, command: str) -> None:
    RUN_HERE[command](site, command)


def test_every_command_of_the_documents_is_run_and_none_is_listed_in_vain() -> None:
    texts = [document.read_text(encoding="utf-8") for document in DOCUMENTS if document.name != HELP_TEXTS]
    written = {command for text in texts for command in commands_of(text)}
    listed = {*RUN_HERE, *RUN_ELSEWHERE}
    assert written - listed == set(), "in the documents, but run by no test"
    assert listed - written == set(), "listed here, but in no document"


@pytest.mark.parametrize(("command", "test"), RUN_ELSEWHERE.items())
def test_the_test_that_runs_it_exists(command: str, test: str) -> None:
    file, name = test.split("::")
    module = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    assert name in {node.name for node in module.body if isinstance(node, ast.FunctionDef)}, command


def test_the_environment_is_activated_and_the_command_is_there(tmp_path: Path) -> None:
    """As the README has it; `.venv` is where the Makefile puts what these tests run in."""
    (tmp_path / ".venv").symlink_to(sys.prefix)
    words = ". .venv/bin/activate && command -v orthocapture && orthocapture --help"
    shell = subprocess.run(
        ["/bin/sh", "-c", words], cwd=tmp_path, env={**os.environ, "PATH": "/usr/bin:/bin", "COLUMNS": "80"},
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert shell.returncode == 0, shell.stderr
    assert "╭─ Capture" in shell.stdout


def test_commands_are_found_in_blocks_tables_and_text() -> None:
    text = (
        "Say `make it so`, not `orthocapture.drivers`.\n```sh\n# a note\n$ ls -l  # all\nfind . \\\n  -name x\n```\n"
    )
    text += "```yaml\nmake: no\n```\n| a | `orthocapture status latest` |\n"
    assert commands_of(text) == ["ls -l", "find .    -name x", "make it so", "orthocapture status latest"]


def test_the_extras_that_documents_install_are_declared() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = {
        name for text in RUN_ELSEWHERE for name in re.findall(r'pip install "(?:\.|orthocapture)\[(\w+)\]"', text)
    }
    assert named
    assert named <= set(project["optional-dependencies"])


# Their snippets run in an exported data set: tests/dataset/test_formats.py, tests/matching/test_matching_export.py.
_OF_EXPORTS = ("dataset.md", "matching.md")


@pytest.mark.slow
def test_snippets_of_python_run(site: Site) -> None:
    snippets = [
        block
        for document in DOCUMENTS
        for language, block in _FENCE.findall(document.read_text(encoding="utf-8"))
        if language == "python" and document.name not in _OF_EXPORTS
    ]
    assert snippets
    for snippet in snippets:
        done = subprocess.run(
            [sys.executable, "-c", snippet], cwd=site.folder, capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 0, done.stderr
    assert "viewpoint,sha256" in (site.folder / "captures.csv").read_text()
