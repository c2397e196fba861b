"""Names that imitate a person or the program, and every place of the program where a name enters."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import chdir
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import quote

import numpy as np
from typer.testing import CliRunner

from service.cli.main import app
from service.people.person import AccountError
from service.people.sessions import People
from service.store.backup import BackupOptions, back_up
from service.store.journal import NAME as JOURNAL_NAME
from service.store.records import SITE, NewJob
from service.store.store import Store
from simulators.sony_camera.exif import PLATE
from simulators.still_camera.exif import Shot, encode_jpeg
from tests.support.pages.web import PIN, QUICK_HASHES, WebSite, web_site
from tests.support.record.outsider import copy_data, is_postgres
from tests.support.record.stepped_clock import SteppedClock
from tests.support.runs.bench_run import PROTOCOL, begin_run
from tests.support.runs.import_folder import SETTINGS

# Names that look like the account emmy, or like nothing.
IMITATING = {
    "zero width": "emmy\u200b",
    "joiner": "em\u200dmy",
    "Cyrillic": "\u0435mmy",
    "Greek": "\u03b5mmy",
    "small capitals": "\u1d07mmy",
    "right to left": "\u202eymme",
    "newline": "emmy\n",
    "escapes": "\x1b[2Jemmy",
    "filler": "emmy\u3164",
    "variation": "emmy\ufe0f",
    "struck through": "e\u0336mmy",
    "NUL": "emmy\x00",
    "dot": "emmy.",
}
# Those under which the program itself acts.
PROGRAMS = ("runner", "Runner", "web", "worker", "site", "service", "\uff57\uff45\uff42", "s1te", "\u0441amera")
NAMES = (*IMITATING.values(), *PROGRAMS, "A Stranger", "claimed:emmy", "x" * 100)
OF_NOBODY = tuple(name for name in NAMES if name not in ("A Stranger", "emmy.", "emmy\n"))
# In full width, or with blanks around, it is emmy's own name, and needs her password.
HER_OWN = ("\uff45\uff4d\uff4d\uff59", " EMMY ", "emmy\n")
PEOPLE = ("Müller", "O'Brien", "O\u2019Brien", "李明", "Иван", "Αλέξης", "محمد", "राज कुमार", "Adébáyọ̀", "김철수")

# Place where a name enters → its words on the command line; {site} is the folder of the site, {job} a computation.
COMMANDS: dict[str, tuple[str, ...]] = {
    **{
        f"act {verb}": ("act", verb, "--reason", "no reason") for verb in ("confirm", "sign", "redo", "skip", "abort")
    },
    **{f"act {verb}": ("act", verb) for verb in ("accept", "resume", "release", "finish")},
    "draw-region": (
        *("draw-region", "[[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]"),
        *("--source", "ct", "--along", "[0, 0, 1]"),
    ),
    "cancel": ("cancel", "{job}", "--reason", "no reason"),
    "note": ("note", "seen"),
    "run": ("run", "{site}/short.yaml", "--rig", "{site}/none.yaml", "--specimen", "a spine", "--no-worker"),
    "resume": ("resume", "latest", "--no-worker"),
    "import": (
        *("import", "{site}/photographs", "--protocol", "{site}/photographs.yaml", "--simulated"),
        *("--specimen", "a spine", "--no-worker"),
    ),
    "accounts end-wait": ("accounts", "end-wait", "emmy"),
    "audit rotate-key": ("audit", "rotate-key", "--reason", "yearly"),
    "audit sign-here": ("audit", "sign-here"),
    "audit export": ("audit", "export", "latest", "made.zip", "--hashes-only"),
    "audit report": ("audit", "report", "latest", "--html", "made.html"),
    "audit release": ("audit", "release", "--yes"),
    "audit correct": ("audit", "correct", "1", "operator", "Somebody", "--reason", "no reason"),
    "export": ("export", "latest", "--format", "plain", "--out", "made"),
    "benchmark": ("benchmark", "run", "latest", "--method", "stereo", "--scenario", "dense", "--no-wait"),
    "store gc": ("store", "gc", "--remove", "--min-age-min", "0"),
    "store restore": ("store", "restore", "{site}/backup", "made"),
    "store rebuild": ("store", "rebuild"),
    "store copy": ("store", "copy", "{data}", "made"),
}
# Whoever gives whatever name may do this: pausing is always safe.
OF_EVERYBODY = {"act pause": ("act", "pause")}
# What is raised because of a name; any other refusal would say nothing about names.
OF_NAMES = frozenset({"NotAllowedError", "SignInRefusedError", "TooManyTriesError"})
_HEAD = PROTOCOL[: PROTOCOL.index("steps:")]
_SHORT = f"""{_HEAD}steps:
  - {{id: fixation, kind: checklist, title: Fix the specimen, checklist: [wires hold]}}
"""
_PHOTOGRAPHS = f"""{_HEAD}steps:
  - {{id: board, kind: image_import, title: Import those of the board, params: {{photographs: calibration}}}}
  - {{id: images, kind: image_import, title: Import the others, params: {{photographs: image}}}}
"""


@dataclass(frozen=True, slots=True)
class Attempt:
    """What came of acting under a name at one place.

    Attributes:
        site: "accounts" or "no accounts".
        place: where the name was entered.
        name: as it was typed.
        status: exit status of the command, or status of the page's answer.
        refusal: kind of the error; "" if there was none, or the page says it in words.
        since: who did what since, as the record has it, but for refused passwords.
    """

    site: str
    place: str
    name: str
    status: int
    refusal: str
    since: tuple[str, ...]

    @property
    def refused_for_its_name(self) -> bool:
        """Return whether a command was refused because of the name, and nothing was recorded."""
        return self.status == 1 and self.refusal in OF_NAMES and not self.since


@dataclass(frozen=True, slots=True)
class NamedSite:
    """A site at which names are entered.

    Attributes:
        kind: "accounts" or "no accounts".
        data: its data folder, with a run that waits for its first confirmation.
        job_id: of a computation of this run that no worker has begun.
    """

    kind: str
    data: Path
    job_id: str

    def attempt(self, place: str, name: str, password: str = "") -> Attempt:
        """Act under a name by a command; what it writes goes to a folder of its own."""
        words = [
            word.format(site=self.data.parent, data=self.data, job=self.job_id)
            for word in (COMMANDS | OF_EVERYBODY)[place]
        ]
        with TemporaryDirectory() as folder, chdir(folder):
            made = Path("made")
            if place in ("store restore", "store copy"):
                status, refusal = _called(words, name, password)
                since = tuple(path.name for path in made.iterdir()) if made.is_dir() else ()
            elif place == "store rebuild":  # there is something to rebuild only where the journal was lost
                copy_data(self.data, made)
                (made / JOURNAL_NAME).write_bytes(b"")
                status, refusal = _called([*words, "--data", str(made)], name, password)
                since = ("a journal",) if (made / JOURNAL_NAME).stat().st_size else ()
            else:
                before = Counter(self.actors())
                status, refusal = _called([*words, "--data", str(self.data)], name, password)
                since = tuple(f"{kind} by {actor}" for _, kind, actor in Counter(self.actors()) - before)
        return Attempt(self.kind, place, name, status, refusal, since)

    def actors(self) -> list[tuple[str, str, str]]:
        """Who did what by now, but for refused passwords and signatures, by run."""
        with Store.open(self.data) as store:
            return [
                (run, event.payload.kind, event.actor)
                for run in (SITE, *(run.run_id for run in store.runs()))
                for event in store.events(run)
                if event.payload.kind not in ("sign_in_recorded", "run_signed")
            ]


def site_with_accounts(folder: Path) -> NamedSite:
    """A site with its four people."""
    with web_site(folder) as site:
        job_id = _fill(site.store, site.begin_run().run_id, folder)
    return NamedSite("accounts", folder / "data", job_id)


def site_without_accounts(folder: Path) -> NamedSite:
    """A site where whoever gives a person's name acts under it."""
    with Store.open(folder / "data") as store:
        store.record_site([], actor="service")
        job_id = _fill(store, begin_run(store, PROTOCOL, folder).run_id, folder)
    return NamedSite("no accounts", folder / "data", job_id)


def _fill(store: Store, run_id: str, folder: Path) -> str:
    """Add what the commands need; returns the id of a computation of the run."""
    store.record(run_id, [], actor="runner", jobs=[NewJob("detect", "capture", 1, "key", {})])
    (folder / "none.yaml").write_text("name: none\nsimulated: true\ndevices: {}\n")
    (folder / "short.yaml").write_text(_SHORT)
    (folder / "photographs.yaml").write_text(_PHOTOGRAPHS)
    for number, part in enumerate(("calibration", "images"), start=1):
        picture = np.full((48, 64, 3), 50 * number, np.uint8)
        shot = Shot(SETTINGS, number, datetime(2026, 3, 1, 10, number, tzinfo=UTC), PLATE)
        (folder / "photographs" / part).mkdir(parents=True)
        (folder / "photographs" / part / f"{number}.jpg").write_bytes(encode_jpeg(picture, shot))
    if not is_postgres(folder / "data"):  # a server has backups of its own
        back_up(folder / "data", folder / "backup", BackupOptions())
    (job,) = store.jobs(run_id)
    return job.job_id


def _called(words: Sequence[str], name: str, password: str) -> tuple[int, str]:
    """Exit status and kind of error of a command that is given under a name."""
    options = ["--operator", name, "--password-stdin", "--json"]
    result = CliRunner().invoke(app, [*words, *options], input=f"{password}\n", catch_exceptions=False)
    found = json.loads(result.stdout or "{}")
    return result.exit_code, found.get("error", {}).get("kind", "")


# --- pages ---------------------------------------------------------------------------------------------------------

FORMS = ("account", "full name", "operator", "sign in", "link", "badge")  # of the pages, in which a name is typed


def form(site: WebSite, place: str) -> Callable[[str], int]:
    """Send a page's form with a name typed into it; returns the status of the answer."""
    administrator, technician = site.browser("administrator"), site.browser("technician")
    link = f"/set-up/{site.people.accounts.invite(administrator.person, 'mary', 'Mary Shelley', 'auditor')}"
    secrets = {"password": "a good password", "repeated": "a good password", "pin": PIN}
    run = {"protocol": "bench.yaml", "specimen": "a spine"}
    forms: dict[str, Callable[[str], int]] = {
        "account": lambda name: (
            administrator.send_form("/accounts", account=name, full_name="Some Body", role="auditor").status_code
        ),
        "full name": lambda name: (
            administrator.send_form("/accounts", account="somebody", full_name=name, role="auditor").status_code
        ),
        "operator": lambda name: technician.send_form("/runs", operator=name, **run).status_code,
        "sign in": lambda name: site.browser().sign_in(name, "guessed").status_code,
        "link": lambda name: site.browser().post(link, data={**secrets, "pin": "1", "account": name}).status_code,
        "badge": lambda name: (
            administrator.send_form(f"/badges/{quote(name)}", password="x", badge="0004711815").status_code
        ),
    }
    return forms[place]


def typed(site: WebSite, clock: SteppedClock, place: str, names: Iterable[str]) -> Iterator[Attempt]:
    """Type each of the names into a form, five minutes apart, as the waits after refused passwords need it."""
    send = form(site, place)
    for name in names:
        clock.passed_s += 300.0
        before, runs = len(site.store.events(SITE)), len(site.store.runs())
        status = send(name)
        since = [event.payload.kind for event in site.store.events(SITE)[before:]]
        changed = [kind for kind in since if kind not in ("sign_in_recorded", "key_changed", "signer_named")]
        yield Attempt(
            "accounts",
            f"form: {place}",
            name,
            status,
            "",
            (*changed, *(run.run_id for run in site.store.runs()[runs:])),
        )


def set_up_as(store: Store, name: str) -> Iterator[Attempt]:
    """Make the first account of a site under this name, or for an owner of this name."""
    people = People(store, QUICK_HASHES)
    link = people.first_link() or ""
    for place, account, owner in (("account", name, "Ada Lovelace"), ("full name", "ada", name)):
        refusal = ""
        try:
            people.accounts.set_up(link, account, owner, "a good password", PIN)
        except AccountError as error:
            refusal = type(error).__name__
        yield Attempt("no accounts", f"first {place}", name, 0, refusal, ())
