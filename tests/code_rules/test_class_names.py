"""A public class of the service has a name of its own, so that a name says which one is meant."""

from __future__ import annotations

import ast
from collections import defaultdict

import pytest

from tests.support.rig.rig import REPOSITORY

# Every kind of step or job declares its records by these names, and they are read as `module.Name`.
_OF_A_KIND = {"Arguments", "Answer", "Params", "Measures", "Result"}
# Goes into data sets as it is; those who read them know it by this name.
_GIVEN_AWAY = {"compute/matching/loader.py", "dataset/h5_loader.py"}


def public_classes() -> dict[str, list[str]]:
    """The modules, relative to service/, that define each public class at their top level."""
    found: defaultdict[str, list[str]] = defaultdict(list)
    service = REPOSITORY / "service"
    for path in sorted(service.rglob("*.py")):
        module = path.relative_to(service).as_posix()
        if module not in _GIVEN_AWAY:
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    found[node.name].append(module)
    return found


@pytest.mark.slow
def test_a_public_class_has_a_name_of_its_own() -> None:
    shared = {name: modules for name, modules in public_classes().items() if len(modules) > 1}
    confusing = {name: modules for name, modules in shared.items() if name not in _OF_A_KIND and not _twins(modules)}
    assert not confusing, f"different things need different names: {confusing}"


def _twins(modules: list[str]) -> bool:
    """Whether a record of a job writes down the class of the numerics that has its name."""
    return [module.split("/")[0] for module in modules] == ["computations", "compute"]
