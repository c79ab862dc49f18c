"""Injectors added to a running gateway: Gateway.add, Additions, LiveControl.add, and `add` over the control socket."""

import copy
import json
from collections.abc import Callable

import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER, SECOND, Out
from canopen_exo.plan import BusPlan, JointNode
from canopen_exo.signal import Signal
from fi_gateway import boundary
from fi_gateway.addition import Additions, plain, read_injector
from fi_gateway.bus_control import BusControl
from fi_gateway.control import LiveControl
from fi_gateway.control_socket import answer_request
from fi_gateway.effects import ConstantTime
from fi_gateway.errors import FaultError
from fi_gateway.events import At, Event, Never
from fi_gateway.faults import Bias, Drop, Fault
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT, Gateway
from fi_gateway.injector import Injector, Target, stream
from fi_gateway.phase import Phase
from fi_gateway.trigger import Trigger

POSITION = Signal("position", "right_knee", "right_knee_TPDO1", 0x185, 0, 32, True, 1.0, "rad", 0x6064, 0)
PLAN = BusPlan((JointNode("right_knee", 5, 54_900, 131_072),))
CYCLE = 2 * MS
ZERO = 100 * MS
NOW = ZERO + SECOND

BIAS = {
    "target": {"bus": "to_controller", "node": "right_knee", "signal": "position"},
    "fault": {"type": "bias", "value": "100 counts"},
    "event": {"type": "at", "time": "0 s"},
    "effect": {"type": "constant_time", "duration": "10 ms"},
}


class Sink(Out):
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.sent: list[Frame] = []

    def send(self, port: int, frame: Frame) -> None:
        self.sent.append(frame)


def injector(
    name: str = "x",
    event: Event | None = None,
    *,
    fault: Fault | None = None,
    trigger: Trigger | None = None,
    enabled: bool = True,
    from_power_up: bool = False,
) -> Injector:
    return Injector(
        name,
        Target(True, False, (0x185,)),
        fault or Bias(POSITION, 1),
        event or Never(),
        ConstantTime(10 * MS),
        trigger,
        stream(1, 0, name),
        enabled,
        from_power_up,
    )


def walking(*injectors: Injector) -> Gateway:
    gateway = Gateway(list(injectors), CYCLE)
    gateway.begin(ZERO)
    return gateway


def read(gateway: Gateway, now: int) -> int | None:
    """What a position of 0 reads behind the gateway; None: lost."""
    sink = Sink()
    gateway.receive(now, DRIVE_PORT, Frame(0x185, bytes(8)), sink)
    return POSITION.read(sink.sent[0].data) if sink.sent else None


# ---- Gateway.add ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("offset", "value"), [(-1, 0), (0, 1), (10 * MS - 1, 1), (10 * MS, 0)])
def test_an_injector_added_at_once_has_its_window_from_the_call_on(offset: int, value: int) -> None:
    """faults.md: window [t0, t0 + D), t0 the time of the call."""
    gateway = walking()
    gateway.add(injector(event=At((0,))), NOW, at_once=True)
    assert read(gateway, NOW + offset) == value
    assert [(one.cause, one.start_ns) for one in gateway.records] == [("event", NOW)]


def test_an_injector_can_be_added_at_once_before_time_zero_is_known() -> None:
    """At once hangs on nothing but the call, and time 0 does not start it again."""
    gateway = Gateway([], CYCLE)
    gateway.add(injector(event=At((0,))), 50 * MS, at_once=True)
    gateway.begin(ZERO)
    gateway.settle(NOW)
    assert [one.start_ns for one in gateway.records] == [50 * MS]


def test_times_of_an_added_injector_count_from_time_zero() -> None:
    """As one in the file; what was due before it was added is not made up for."""
    gateway = walking()
    gateway.add(injector(event=At((SECOND // 2, 2 * SECOND))), NOW)
    assert gateway.wake_at == ZERO + 2 * SECOND
    gateway.settle(NOW + SECOND)
    assert [one.start_ns for one in gateway.records] == [ZERO + 2 * SECOND]


def test_an_injector_added_before_time_zero_waits_for_it() -> None:
    """Injectors are inert before time 0."""
    gateway = Gateway([], CYCLE)
    gateway.add(injector(event=At((SECOND,))), 50 * MS)
    assert gateway.wake_at == NEVER
    gateway.begin(ZERO)
    assert gateway.wake_at == ZERO + SECOND


def test_an_added_injector_acts_behind_the_others() -> None:
    """Faults of one frame act in the order written; what is lost does not reach the next."""
    gateway = walking(injector("first", At((0,)), fault=Drop()))
    gateway.settle(ZERO)
    gateway.add(injector("second", At((0,))), ZERO + 1, at_once=True)
    assert [one.name for one in gateway.injectors] == ["first", "second"]
    for running in (gateway, copy.deepcopy(gateway)):
        assert read(running, ZERO + 2) is None
        assert running.records[1].frames_seen == 0


def test_an_added_injector_starts_by_trigger_of_one_that_was_there() -> None:
    """Triggers go from the injectors of the file to added ones."""
    gateway = walking(injector("source", At((2 * SECOND,))))
    gateway.add(injector("added", trigger=Trigger(("source",))), NOW)
    gateway.settle(ZERO + 2 * SECOND)
    assert [(one.injector, one.cause) for one in gateway.records] == [("source", "event"), ("added", "trigger:source")]


def test_a_disabled_injector_stays_silent_until_it_is_armed() -> None:
    """`enabled: false` holds for added ones as well."""
    gateway = walking()
    added = injector(event=At((0,)), enabled=False)
    gateway.add(added, NOW, at_once=True)
    assert added.phase is Phase.INERT
    assert gateway.wake_at == NEVER
    added.arm(NOW)
    gateway.settle(NOW)
    assert [one.start_ns for one in gateway.records] == [NOW]


@pytest.mark.parametrize(
    ("added", "words"),
    [
        (lambda: injector("there"), "given twice"),
        (lambda: injector("new", trigger=Trigger(("nobody",))), "trigger names 'nobody'"),
        (lambda: injector("new", from_power_up=True), "power-up is over"),
    ],
)
def test_what_cannot_be_added_leaves_the_gateway_as_it_was(added: Callable[[], Injector], words: str) -> None:
    """An error changes nothing."""
    gateway = walking(injector("there"))
    with pytest.raises(FaultError, match=words):
        gateway.add(added(), NOW)
    assert [one.name for one in gateway.injectors] == ["there"]
    assert read(gateway, NOW) == 0


def test_the_frames_of_live_control_take_no_injector() -> None:
    """No fault may have its hands on what arms and disarms it."""
    gateway = walking()
    gateway.attach(BusControl(LiveControl(gateway), CONTROLLER_PORT, 0x185, 0x186))
    with pytest.raises(FaultError, match="live control"):
        gateway.add(injector(), NOW)


def test_an_injector_from_power_up_may_be_added_while_the_bus_is_silent() -> None:
    """Power-up is the first frame: before it nothing is over."""
    gateway = Gateway([injector("first", from_power_up=True)], CYCLE)
    gateway.add(injector("second", At((MS,)), from_power_up=True), 0)
    read(gateway, 5 * MS)
    assert gateway.wake_at == 6 * MS


# ---- LiveControl.add and the socket's word ---------------------------------------------------------------------------


def live() -> LiveControl:
    additions = Additions({}, PLAN, 7)
    return LiveControl(walking(), additions)


def test_an_addition_is_read_as_in_a_file_and_leaves_a_row() -> None:
    """Each call of live control is a row."""
    control = live()
    control.add("bias", BIAS, NOW, "test", at_once=True)
    assert read(control.gateway, NOW + 1) == 100
    assert [(row.what, row.name, row.source, row.refused) for row in control.rows] == [("add", "bias", "test", "")]


def test_an_addition_draws_from_the_stream_of_its_name() -> None:
    """Same seed and name, same faults: as if the injector had been in the file."""
    flip = {**BIAS, "fault": {"type": "bit_flip", "count": 3}}
    values = []
    for _ in range(2):
        control = live()
        control.add("flip", flip, NOW, at_once=True)
        values.append([read(control.gateway, NOW + at) for at in range(5)])
    assert values[0] == values[1]
    in_file = Additions({}, PLAN, 7)
    in_file.read("flip", flip)
    gateway = Gateway(in_file.built(), CYCLE)
    gateway.begin(NOW)
    assert [read(gateway, NOW + at) for at in range(5)] == values[0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fault": {"type": "biass", "value": 1}}, r"fault.type: unknown fault 'biass'; did you mean 'bias'\?"),
        ({"target": {"bus": "to_drives", "node": "knee", "pdo": "RPDO1"}}, "target.node: unknown joint 'knee'"),
        ({"trigger": {"any": ["nobody"]}}, "trigger.any.0: no injector is called 'nobody'"),
        ({"surprise": 1}, "surprise: unknown key"),
        ({"fault": {"type": "bias", "value": object}}, "fault.value"),
    ],
)
def test_a_wrong_addition_is_refused_in_the_words_of_a_file(change: dict[str, object], words: str) -> None:
    """Key, what is wrong, what is allowed; the row says it too."""
    control = live()
    with pytest.raises(FaultError, match=words):
        control.add("bad", {**BIAS, **change}, NOW)
    assert control.gateway.injectors == []
    assert control.rows[-1].refused
    control.add("bad", BIAS, NOW)  # the name is still free


def test_a_name_is_given_once() -> None:
    """Every injector needs its own name."""
    control = live()
    control.add("bias", BIAS, NOW)
    with pytest.raises(FaultError, match="the name is taken"):
        control.add("bias", BIAS, NOW)


def test_nothing_is_added_while_injection_is_stopped() -> None:
    """Safe by default: stop means that nothing is injected until resume."""
    control = live()
    control.pass_through(NOW)
    with pytest.raises(FaultError, match="resume"):
        control.add("bias", BIAS, NOW, at_once=True)
    assert control.gateway.injectors == []


def test_a_gateway_without_a_scenario_takes_nothing() -> None:
    """Where nobody reads files, an addition is refused with the remedy."""
    with pytest.raises(FaultError, match="in its scenario"):
        LiveControl(walking()).add("bias", BIAS, NOW)


def test_the_socket_adds() -> None:
    """docs/live_control.md: do add, name, injector, at_once."""
    control = live()
    request = json.loads(json.dumps({"do": "add", "name": "bias", "injector": BIAS, "at_once": True}))
    assert answer_request(control, request, NOW) == {"ok": True, "done": True, "time_ns": NOW}
    assert read(control.gateway, NOW + 1) == 100
    assert control.rows[-1].source == "socket"


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"do": "add", "injector": BIAS}, "needs the name"),
        ({"do": "add", "name": "bias"}, "expected a mapping"),
        ({"do": "add", "name": "bias", "injector": [1, None, {"a": 2.5}]}, "expected a mapping"),
        ({"do": "add", "name": "bias", "injector": BIAS, "more": 1}, "allowed: do, name, injector, at_once"),
        ({"do": "arm", "name": "bias", "injector": BIAS}, "no such key, allowed: do, name"),
    ],
)
def test_a_wrong_request_to_add_gets_an_answer_and_changes_nothing(request_: dict[str, object], words: str) -> None:
    """Whatever the request, it is answered."""
    control = live()
    answer = answer_request(control, request_, NOW)
    assert answer["ok"] is False
    assert words in str(answer["error"])
    assert control.gateway.injectors == []


def test_plain_keeps_what_a_file_can_hold() -> None:
    """Tuples become lists, keys texts; everything else is shown to the schema as text."""
    assert plain({"a": (1, 2.5, None, True), 3: {"b": []}}) == {"a": [1, 2.5, None, True], "3": {"b": []}}
    assert plain({1}) == "{1}"


def test_the_first_addition_finds_all_checks_prepared() -> None:
    """Preparing them takes 0.1 s, and no frame passes meanwhile: it is over when there is something to add to."""
    boundary._made_once.cache_clear()
    additions = Additions({}, PLAN, 7)
    additions.read("other", plain(BIAS))
    additions.prepare()
    before = boundary._made_once.cache_info().misses
    assert before > 0
    read_injector("flip", plain({**BIAS, "fault": {"type": "bit_flip", "count": 3}}), additions.specs, PLAN)
    assert boundary._made_once.cache_info().misses == before
