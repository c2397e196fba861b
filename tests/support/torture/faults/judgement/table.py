"""The table in docs/reference/faults.md and the results: what went wrong, what was done about it, how it ended."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from tests.support.rig.rig import REPOSITORY
from tests.support.torture.faults.case import Case
from tests.support.torture.faults.judgement.verdict import Verdict

DOCUMENT = REPOSITORY / "docs" / "reference" / "faults.md"

_HEAD = """\
# What happens when something goes wrong

Made by `make torture-faults`, which tries each case with the real drivers and the real runner, and checks this
table ([torture.md](../howto/torture.md)). Each row is one case: what goes wrong, what the program does about it, how
the run ends for a person who takes the first way on that the screen lists, and the words that the person reads first
(N stands for a figure).

What is done: *again*, the same view at once, on a device that is opened again where it had gone; *reopen*, the
device is opened again; *retry*, the step is tried again after a wait; *skip*, a view is given up; *ask*, the run
waits for a person; *told*, the person reads it, and the run goes on; *stop*, the program ends with these words and
the run is resumed later. Where nothing is done, the case does no harm: what comes out is right all the same.

The words are those of the revision on which the case was tried last (see `bench/results/torture_faults-*.json`).
A message may have been reworded since. What is done, how it ends and the errors are compared at every sweep.

"""
_COLUMNS = "| case | what goes wrong | what is done | how it ends | errors | words on the screen |"
_LONGEST = 140  # length of a command in the results; the JSON has all of it
_RULE = "|---|---|---|---|---|---|"


@dataclass(frozen=True, slots=True)
class Row:
    """One row of the table, with its cells as written there."""

    case: str
    what: str
    done: str
    end: str
    errors: str
    words: str

    @classmethod
    def of(cls, case: Case, verdict: Verdict) -> Row:
        """The row for the result of a case."""
        done = ", ".join(verdict.policy) or "nothing"
        return cls(case.name, case.what, done, verdict.end, ", ".join(verdict.errors), _cell(verdict.words))

    def line(self) -> str:
        """Format the row as Markdown."""
        return f"| {self.case} | {self.what} | {self.done} | {self.end} | {self.errors} | {self.words} |"


def _cell(text: str) -> str:
    """Escape text for a table cell."""
    plain = " ".join(text.split()).replace("|", "/").replace("`", "'").replace("<", "&lt;")
    return plain if len(plain) <= 400 else f"{plain[:400]} …"


def read_table(document: Path) -> dict[str, Row]:
    """Read the rows of the table by case; empty if the document does not exist."""
    if not document.exists():
        return {}
    rows: dict[str, Row] = {}
    for line in document.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split(" | ")]
        if line.startswith("| ") and line != _COLUMNS and len(cells) == 6:
            rows[cells[0]] = Row(*cells)
    return rows


def differences(verdicts: Sequence[Verdict], rows: Mapping[str, Row]) -> list[str]:
    """The rows whose policy, end or error differs from the table."""
    found: list[str] = []
    for verdict in verdicts:
        row = rows.get(verdict.name)
        now = (", ".join(verdict.policy) or "nothing", verdict.end, ", ".join(verdict.errors))
        if row is None:
            found.append(f"{verdict.name}: not in the table")
        elif (row.done, row.end, row.errors) != now:
            was = (row.done, row.end, row.errors)
            found.append(f"{verdict.name}: {' / '.join(now)}; the table says {' / '.join(was)}")
    return found


def table(cases: Sequence[Case], verdicts: Sequence[Verdict], before: Mapping[str, Row]) -> str:
    """Format the document: tried rows are replaced, the others stay."""
    new = {verdict.name: verdict for verdict in verdicts if not verdict.broken}
    parts: dict[str, list[str]] = defaultdict(list)
    for case in cases:
        row = Row.of(case, new[case.name]) if case.name in new else before.get(case.name)
        if row is not None:
            parts["/".join(case.name.split("/")[:2])].append(row.line())
    sections = [f"## {name}\n\n{_COLUMNS}\n{_RULE}\n" + "\n".join(lines) + "\n" for name, lines in parts.items()]
    return _HEAD + "\n".join(sections)


def report(about: Mapping[str, Any], known: Container[str], new: Sequence[Mapping[str, Any]], stem: Path) -> None:
    """Write the results as JSON and Markdown; cases that were not tried again keep their last results.

    Args:
        about: date, commit, machine, options, number of cases and duration of this sweep.
        known: names of the cases that there are.
        new: the verdicts of this sweep as plain data, each with its commit.
        stem: path of the results without suffix; earlier results are beside it.
    """
    path = stem.with_suffix(".json")
    today: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    rows = {row["name"]: row for row in today.get("verdicts") or _earlier(path) if row["name"] in known}
    rows |= {row["name"]: {**row, "date": about["date"]} for row in new}
    now: dict[str, Any] = {key: about[key] for key in ("options", "commit", "seconds")}
    sweeps: list[dict[str, Any]] = [*today.get("sweeps", []), now | {"tried": len(new)}]
    whole = {key: about[key] for key in ("date", "machine", "cases")}
    whole |= {"sweeps": sweeps, "verdicts": list(rows.values())}
    path.write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")
    stem.with_suffix(".md").write_text(_page(about, sweeps, list(rows.values())), encoding="utf-8")


def _earlier(path: Path) -> list[dict[str, Any]]:
    """The last verdict of each case in the results of earlier days."""
    rows: dict[str, dict[str, Any]] = {}
    for one in sorted(path.parent.glob("torture_faults-*.json")):
        if one.name < path.name:
            day = json.loads(one.read_text(encoding="utf-8"))
            rows |= {row["name"]: {"date": day["date"], **row} for row in day["verdicts"]}
    return list(rows.values())


def _revisions(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """A table of the revisions on which the cases were tried last."""
    counts = Counter((row["date"], row["commit"]) for row in rows)
    return [
        "| last tried on | revision | cases |",
        "|---|---|---:|",
        *(f"| {date} | {commit} | {counts[date, commit]} |" for date, commit in sorted(counts)),
    ]


def _page(about: Mapping[str, Any], sweeps: Sequence[Mapping[str, Any]], rows: Sequence[Mapping[str, Any]]) -> str:
    """The results for people: the sweeps, a table of the wires and states, and the faults."""
    told = {field.name for field in fields(Verdict)}
    verdicts = [Verdict(**{key: row[key] for key in row if key in told}) for row in rows]
    broken = [verdict for verdict in verdicts if verdict.broken]
    commands = [" ".join(["python -m bench.torture.faults", *sweep["options"]]) for sweep in sweeps]
    commands = [words if len(words) < _LONGEST else f"{words[:_LONGEST]} …" for words in commands]
    lines = [
        "# Fault matrix",
        "",
        f"{about['date']}; {about['machine']['processor']}, {about['machine']['cores']} cores shared with others.",
        "",
        *(
            f"- `{c}`, {s['commit']}: {s['tried']} cases, {s['seconds']} s"
            for c, s in zip(commands, sweeps, strict=True)
        ),
        "",
        f"{len(verdicts)} of {about['cases']} cases were tried, "
        f"{sum(v.reached for v in verdicts)} in which the planned fault occurred, **{len(broken)} with a fault**.",
        "",
        *_revisions(rows),
        "",
        "| wire or state | cases | nothing | again, reopen or retry | asked | stopped | completed "
        "| left open | longest s |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    groups: dict[str, list[Verdict]] = defaultdict(list)
    for verdict in verdicts:
        groups["/".join(verdict.name.split("/")[:2])].append(verdict)
    for name, some in sorted(groups.items()):
        done = [set(verdict.policy) for verdict in some]
        lines.append(
            f"| {name} | {len(some)} | {sum(not one for one in done)} | "
            f"{sum(bool(one) and not one & {'ask', 'stop'} for one in done)} | {sum('ask' in one for one in done)} | "
            f"{sum('stop' in one for one in done)} | {sum(v.end == 'completed' for v in some)} | "
            f"{sum(v.end.startswith('waits') for v in some)} | {max(v.seconds for v in some):.0f} |"
        )
    if broken:
        lines += ["", "Faults:", ""]
        lines += [f"- {verdict.name}: {fault}" for verdict in broken for fault in verdict.broken]
    return "\n".join(lines) + "\n"
