"""The waits and lives that concern people: screens, sign-ins, passwords, links and control of a run."""

from __future__ import annotations

from service.core.records.events import ServiceStarted, SignInRecorded
from service.people.accounts import INVITATION_S
from service.people.control import UNANSWERED_S, Control
from service.people.credentials import FIRST_WAIT_S, failed_tries
from service.people.person import SESSION_S, Person
from service.web.security import TRIES_WINDOW_S, Limiter
from tests.support.clocks.world import Duration, Seen, World, above, allows, below
from tests.support.pages.web import password_of
from tests.support.record.store import start_run

_IDLE_S, _ADDRESS = 600.0, "10.0.0.1"


def _enter(world: World, account: str = "grace") -> tuple[str, Person]:
    token = world.people.sign_in(account, password_of(account))
    person = world.people.person(token, idle_lock_s=1e9, deliberate=False)
    assert person is not None
    return token, person


def _idle(world: World, true_s: float) -> Seen:
    token, _ = _enter(world)
    world.wait(true_s)
    person = world.people.person(token, idle_lock_s=_IDLE_S, deliberate=True)
    opens = person is not None and not person.locked
    return Seen(opens, "the screen is open" if opens else "the screen asks for the PIN")


def _sign_in_life(world: World, true_s: float) -> Seen:
    token, _ = _enter(world)
    world.wait(true_s)
    lives = world.people.person(token, idle_lock_s=1e9, deliberate=True) is not None
    return Seen(lives, "the sign-in lives" if lives else "the sign-in has ended")


def _wrong_passwords(world: World, true_s: float) -> Seen:
    for _ in range(5):
        allows(lambda: world.people.sign_in("grace", "wrong"))
    world.wait(true_s)
    enters = allows(lambda: world.people.sign_in("grace", password_of("grace")))
    return Seen(enters, "the right password is taken" if enters else "the account waits on")


def _started(world: World) -> ServiceStarted:
    nothing = {"software": {}, "configuration": {}, "changed": {}, "heads": {}, "clock_jump_s": None}
    more = {"unsigned_runs": (), "open_runs": (), "host": "here", "pid": 1, "address": "x"}
    return ServiceStarted.model_validate({"boot": world.clock.boot(), **nothing, **more})


def _tries(world: World, true_s: float, *, restart: bool) -> Seen:
    """An address that has failed too often, in the memory of a service or after its restart."""
    failed = SignInRecorded(account="grace", outcome="refused", address=_ADDRESS)
    world.store.record_site([_started(world), *[failed] * 20], actor="service")
    limiter = Limiter(world.clock, failed_tries(world.store, TRIES_WINDOW_S))
    world.wait(true_s)
    if restart or world.fault.boot_monotonic_s is not None:
        world.store.record_site([_started(world)], actor="service")
        limiter = Limiter(world.clock, failed_tries(world.store, TRIES_WINDOW_S))
    free = allows(lambda: limiter.require(_ADDRESS))
    return Seen(free, "the address may try" if free else "the address waits on")


def _control(world: World, true_s: float) -> Seen:
    run = start_run(world.store)
    (_, grace), (_, emmy) = _enter(world), _enter(world, "emmy")
    Control(world.store).take(run, grace)
    world.people.lock(grace)
    Control(world.store).ask(run, emmy)
    world.wait(true_s)
    takes = allows(lambda: Control(world.store).take(run, emmy))
    return Seen(takes, "the one who asked has taken control" if takes else "the locked screen keeps control")


def _link(world: World, true_s: float) -> Seen:
    _, ada = _enter(world, "ada")
    link = world.people.accounts.invite(ada, "mary", "Mary Shelley", "auditor")
    world.wait(true_s)
    valid = allows(lambda: world.people.accounts.invitation(link))
    return Seen(valid, "the link is good" if valid else "the link is too old")


PEOPLE_DURATIONS = (
    Duration("idle time until a screen locks", _IDLE_S, below(_IDLE_S), _idle, "the PIN is asked for"),
    Duration("life of a sign-in", SESSION_S, below(SESSION_S), _sign_in_life, "the password is asked for"),
    Duration("wait after wrong passwords", FIRST_WAIT_S, above(FIRST_WAIT_S), _wrong_passwords, "it waits longer"),
    Duration(
        "tries of an address, in memory",
        TRIES_WINDOW_S,
        above(TRIES_WINDOW_S),
        lambda world, true_s: _tries(world, true_s, restart=False),
        "it waits longer",
    ),
    Duration(
        "tries of an address, service restarted",
        TRIES_WINDOW_S,
        above(TRIES_WINDOW_S),
        lambda world, true_s: _tries(world, true_s, restart=True),
        "it waits longer",
    ),
    Duration("wait for a locked screen in control", UNANSWERED_S, above(UNANSWERED_S), _control, "it waits longer"),
    Duration("life of a one-time link", INVITATION_S, below(INVITATION_S), _link, "a new link is needed"),
)
