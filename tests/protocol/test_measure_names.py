"""Every measure has one name for people, and pages, terminal, report and documents use it."""

from __future__ import annotations

import pytest

from docs.generate.pages import shipped_protocols
from docs.generate.steps import measures_of_kind, steps_text
from service.audit.report_blocks import measured
from service.core.gates import describe
from service.core.measure_names import MEASURE_NAMES, REGISTRATION_MEASURE_NAMES, measure_name
from service.core.records.run_events import GateVerdict
from service.steps import step_kinds
from service.web.run_frame import figure_line, limit


def declared() -> dict[str, str]:
    """The meaning of every measure of the kinds that come with the program, by its name in protocols."""
    kinds = [kind for kind in step_kinds().values() if kind.execute.__module__.startswith("service.")]
    return {name: one.meaning for kind in kinds for name, one in measures_of_kind(kind).items()}


def test_every_measure_has_a_name_for_people_and_a_meaning_and_no_name_is_left_over() -> None:
    measures = declared()
    assert {name for name in measures if not name.startswith("NAME_")} == set(MEASURE_NAMES)
    assert {name.removeprefix("NAME_") for name in measures if name.startswith("NAME_")} == set(
        REGISTRATION_MEASURE_NAMES
    )
    assert [name for name, meaning in measures.items() if not meaning] == []
    # A page shows one of them alone, so that it names no other measure and refers to none before it.
    assert [
        meaning for meaning in measures.values() if "`" in meaning or meaning.startswith(("the same", "that "))
    ] == []


def test_no_two_measures_have_the_same_name_and_none_repeats_its_unit() -> None:
    names = [*MEASURE_NAMES.values(), *REGISTRATION_MEASURE_NAMES.values()]
    assert len({name.lower() for name in names}) == len(names)
    assert [name for name in names if name.split()[-1] in ("mm", "mm2", "px", "deg") or "_" in name] == []


def test_every_gate_of_a_shipped_protocol_is_named() -> None:
    gates = [gate.measure for file in shipped_protocols().values() for step in file.steps for gate in step.gates]
    named = {*MEASURE_NAMES, *REGISTRATION_MEASURE_NAMES}
    assert [gate for gate in gates if gate not in named and "(" not in measure_name(gate)] == []


@pytest.mark.parametrize(
    ("measure", "name"),
    [
        ("layout_margin_of_five_mm", "Margin against confusing five spheres"),
        ("cut_by_ends_mm2", "Area cut off by the first and the last slice"),
        ("robot_corrected_rms_px", "RMS outline residual (corrected robot poses)"),
        ("colmap_1920x1280_images", "Images in the registration (COLMAP poses, images of 1920 × 1280 px)"),
        ("dose_of_a_plug_in_mm", "Dose of a plug in"),
    ],
)
def test_the_same_name_stands_everywhere(measure: str, name: str) -> None:
    verdict = GateVerdict(measure=measure, value=3.0, minimum=13, maximum=13, unit="mm", passed=False)
    assert measure_name(measure) == name
    assert describe(verdict) == f"{name} 3 mm, allowed exactly 13"
    assert figure_line(verdict) == f"{name} 3 mm (exactly 13 mm)"
    assert measured(verdict) == (name, "3 mm")


def test_equal_limits_are_one() -> None:
    assert limit(13, 13, "spheres") == "exactly 13 spheres"
    assert limit(0.2, 1, "mm") == "at least 0.2 and at most 1 mm"


def test_the_page_of_the_step_kinds_prints_the_names() -> None:
    text = steps_text(shipped_protocols())
    for name in (*MEASURE_NAMES.values(), *REGISTRATION_MEASURE_NAMES.values()):
        assert f"| {name} |" in text, name
