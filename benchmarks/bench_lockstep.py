"""What a run in lock-step costs, against the bare mj_step loop of the same plant, and what its pieces cost.

Each repetition runs, in turn and in one process: the bare loop (same model, as many steps as the run), and a whole run
from power-up to disabled drives, without and with mechanical stops. CPU time of the process, medians. Building the rig
is not in it; the collector of reference cycles is off while measuring, as it is during the runs of `exo-hil`.
Nothing is asserted about time: the budgets stand beside the figures.

The bare loop falls from rest without torques. Beside it stands the same loop under the torques of the run, written
before each step as the plant does: that is the physics the run contains, state for state. The budget is for the former.
"""

import argparse
import gc
import json
import statistics
import struct
import sys
import time
from collections.abc import Callable
from typing import Final

import mujoco

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER, SECOND, Out
from canopen_exo.bus.wire import Wire
from canopen_exo.plan import RPDO1, SDO_REQUEST, SYNC, TPDO1, BusPlan
from fi_gateway.effects import Effect, Frames, Infinite
from fi_gateway.events import At, Event, Every, Never
from fi_gateway.faults import Bias, BitFlip, Drop, Fault
from fi_gateway.gateway import DRIVE_PORT, Gateway
from fi_gateway.injector import Injector, Target, stream
from fi_gateway.trigger import Trigger
from fi_gateway.wire_faults import BitErrorRate
from testbench.rig import Rig, RigParams, build_rig
from testbench.run import drive_through
from testbench.scenario import default_joints

STRIDE_NS: Final = 1500 * MS
DURATION_NS: Final = 7 * SECOND

RATIO_BUDGET: Final = 13.0
"""Most that a run may cost, in bare mj_step loops."""
REALTIME_BUDGET: Final = 10.0
"""Least simulated seconds per second of CPU time."""

NOISE: Final = 1e-5
"""Bit error rate of the noisy run, on both buses."""
NOISE_BUDGET: Final = 1.5
"""Most that it may cost, in clean runs."""

CALLS: Final = 2000
"""Calls of a piece between two looks at the clock."""

Figures = dict[str, float]


class Sink(Out):
    """Takes frames and forgets them."""

    def send(self, port: int, frame: Frame) -> None:
        pass


def seconds(work: Callable[[], object]) -> float:
    """CPU time of one call, with the collector off."""
    gc.collect()
    gc.disable()
    try:
        started = time.process_time()
        work()
        return time.process_time() - started
    finally:
        gc.enable()


def rig_of(stops: bool, duration_ns: int = DURATION_NS) -> Rig:
    """A rig at power-up, without injectors."""
    return build_rig(RigParams(BusPlan(default_joints()), stops, STRIDE_NS, duration_ns), [])


def bare_seconds(rig: Rig, steps: int) -> float:
    """The plant's model alone, from its rest, without torques."""
    model = rig.rack.plant.model
    data = mujoco.MjData(model)

    def loop() -> None:
        for _ in range(steps):
            mujoco.mj_step(model, data)

    return seconds(loop)


def torques_of(stops: bool, steps: int) -> list[list[float]]:
    """What a run writes into the inputs of the plant's model, step by step."""
    rig = rig_of(stops)
    found = []
    for step in range(1, steps + 1):
        rig.loop.run_until(step * MS)
        found.append(rig.rack.plant.data.ctrl.tolist())
    return found


def driven_seconds(rig: Rig, torques: list[list[float]]) -> float:
    """The plant's model alone, from its rest, under the torques of a run."""
    model = rig.rack.plant.model
    data = mujoco.MjData(model)
    inputs = memoryview(data.ctrl).cast("B")
    pack = struct.Struct(f"{model.nu}d").pack_into

    def loop() -> None:
        for row in torques:
            pack(inputs, 0, *row)
            mujoco.mj_step(model, data)

    return seconds(loop)


def run_seconds(rig: Rig) -> float:
    """From power-up to disabled drives."""
    return seconds(lambda: drive_through(rig, lambda share: None))


def run_figures(stops: bool, repeat: int) -> Figures:
    """Medians of `repeat` bare loops and runs in turn."""
    bare, whole, ratios, driven = [], [], [], []
    steps = 1
    torques: list[list[float]] = []
    for _ in range(repeat):
        rig = rig_of(stops)
        ran = run_seconds(rig)
        steps = len(rig.rack.truth)
        alone = bare_seconds(rig, steps)
        torques = torques or torques_of(stops, steps)
        bare.append(alone)
        whole.append(ran)
        ratios.append(ran / alone)
        driven.append(ran / driven_seconds(rig, torques))
    return {
        "simulated_s": steps / 1e3,
        "bare_us_per_step": statistics.median(bare) / steps * 1e6,
        "run_us_per_ms": statistics.median(whole) / steps * 1e6,
        "ratio": statistics.median(ratios),
        "ratio_to_driven": statistics.median(driven),
        "x_realtime": steps / 1e3 / statistics.median(whole),
    }


def noise_figures(repeat: int) -> Figures:
    """Medians of runs without errors, with errors possible, and with noise, in turn."""
    possible, noisy, errors = [], [], 0
    for number in range(repeat):
        clean = run_seconds(rig_of(False))
        rig = rig_of(False)
        for medium in rig.loop.media:
            rig.loop.install(Wire(medium, []), medium)
        possible.append(run_seconds(rig) / clean)
        rig = rig_of(False)
        for medium in rig.loop.media:
            noise = BitErrorRate(NOISE, medium.bit_ns, stream(number, 0, medium.name))
            noise.begin(0)
            rig.loop.install(Wire(medium, [noise]), medium)
        noisy.append(run_seconds(rig) / clean)
        errors = sum(medium.errors for medium in rig.loop.media)
    if errors == 0:
        raise RuntimeError("bench_lockstep: the noise made no error, its figure would be that of a clean run")
    return {
        "possible_ratio": statistics.median(possible),
        "noisy_ratio": statistics.median(noisy),
        "error_frames": errors,
    }


def piece_us(work: Callable[[], object], repeat: int) -> float:
    """Median CPU time of one call [us]."""

    def calls() -> None:
        for _ in range(CALLS):
            work()

    return statistics.median(seconds(calls) / CALLS * 1e6 for _ in range(repeat))


def piece_figures(repeat: int) -> Figures:
    """What single steps of the machinery cost [us], on a rig in mid-motion."""
    rig = rig_of(False)
    rig.loop.run_until(2 * SECOND + STRIDE_NS)
    now, out = rig.loop.now, Sink()
    device = rig.rack.devices[0]
    sample = next(row.frame for row in reversed(rig.loop.trace) if row.frame.can_id == TPDO1 + device.node_id)
    command = next(row.frame for row in reversed(rig.loop.trace) if row.frame.can_id == RPDO1 + device.node_id)
    sync = next(row.frame for row in reversed(rig.loop.trace) if row.frame.can_id == SYNC)
    read = Frame(SDO_REQUEST + device.node_id, bytes.fromhex("4018100100000000"))  # upload 1018:01

    def command_and_sync() -> None:
        device.receive(now, 0, command, out)
        device.receive(now, 0, sync, out)

    received = piece_us(lambda: device.receive(now, 0, command, out), repeat)
    return {
        "frame_new": piece_us(lambda: Frame(sample.can_id, sample.data), repeat),
        "frame_length_8_bytes": piece_us(sample.measure, repeat),
        "frame_length_4_bytes": piece_us(command.measure, repeat),
        "rpdo_received": received,
        "sync_to_tpdo": piece_us(command_and_sync, repeat) - received,
        "sdo_answer": piece_us(lambda: device.receive(now, 0, read, out), repeat),
        "gateway_frame_no_injector": piece_us(lambda: rig.gateway.receive(now, DRIVE_PORT, sample, out), repeat),
        **engine_figures(sample, rig.params.plan, repeat),
    }


def engine_figures(frame: Frame, plan: BusPlan, repeat: int) -> Figures:
    """A frame through a gateway with injectors [us]: not their target, one that waits, a bias, a flip, a chain of four.

    Of the chain each link starts the next one with the same frame and has a window of one frame, so that each frame
    opens, acts on and closes four windows.
    """
    signal = next(one for one in plan.signals() if one.cob_id == frame.can_id and one.name == "position")
    here, elsewhere = Target(True, False, (signal.cob_id,)), Target(True, False, (signal.cob_id + 1,))

    def injector(
        name: str, target: Target, fault: Fault, event: Event, effect: Effect, source: Trigger | None = None
    ) -> Injector:
        return Injector(name, target, fault, event, effect, source, stream(1, 0, name), True, True)

    at_once, later = At((0,)), At((NEVER - 1,))
    chain = [injector("link0", here, Bias(signal, 1), Every(1), Frames(1))]
    for number in range(1, 4):
        source = Trigger((f"link{number - 1}",))
        chain.append(injector(f"link{number}", here, Bias(signal, 1), Never(), Frames(1), source))
    loads = {
        "engine_miss": [injector("elsewhere", elsewhere, Drop(), at_once, Infinite())],
        "engine_armed": [injector("armed", here, Drop(), later, Infinite())],
        "engine_bias": [injector("bias", here, Bias(signal, 100), at_once, Infinite())],
        "engine_flip": [injector("flip", here, BitFlip(signal), at_once, Infinite())],
        "engine_chain_of_four": chain,
    }
    return {name: through_us(injectors, frame, plan, repeat) for name, injectors in loads.items()}


def through_us(injectors: list[Injector], frame: Frame, plan: BusPlan, repeat: int) -> float:
    """A frame through a gateway with these injectors, 10 us after the one before [us]."""
    gateway, out = Gateway(injectors, plan.cycle_ns), Sink()
    gateway.receive(0, DRIVE_PORT, frame, out)
    now = MS

    def receive() -> None:
        nonlocal now
        now += 10_000
        gateway.receive(now, DRIVE_PORT, frame, out)

    spent = piece_us(receive, repeat)
    for one in injectors:
        if one.activated and one.target.cob_ids == (frame.can_id,) and one.manifested < CALLS * repeat:
            raise RuntimeError(f"bench_lockstep: {one.name} did not change every frame, its figure would be too good")
    return spent


def verdict(met: bool) -> str:
    """Beside a budget."""
    return "met" if met else "NOT met"


def show(figures: dict[str, Figures]) -> None:
    """The figures as text."""
    for name, title in (("stops_off", "without stops"), ("stops_on", "with stops")):
        run = figures[name]
        print(f"lock-step run {title}: {run['simulated_s']:.1f} s simulated, two buses, gateway, full trace")
        print(f"  bare mj_step loop  {run['bare_us_per_step']:8.2f} us per step")
        print(f"  whole run          {run['run_us_per_ms']:8.2f} us per simulated ms")
        print(
            f"  ratio              {run['ratio']:8.1f} x the bare loop   "
            f"(budget <= {RATIO_BUDGET:g}: {verdict(run['ratio'] <= RATIO_BUDGET)})"
        )
        print(f"  the same           {run['ratio_to_driven']:8.1f} x the bare loop under the run's own torques")
        print(
            f"  speed              {run['x_realtime']:8.1f} x real time       "
            f"(budget >= {REALTIME_BUDGET:g}: {verdict(run['x_realtime'] >= REALTIME_BUDGET)})"
        )
    noise = figures["noise"]
    print(f"errors on the wire, against a run on ideal buses (last run: {noise['error_frames']:.0f} error frames)")
    print(f"  possible, none     {noise['possible_ratio']:8.2f} x")
    print(
        f"  bit error rate {NOISE:g} {noise['noisy_ratio']:7.2f} x   "
        f"(budget <= {NOISE_BUDGET:g}: {verdict(noise['noisy_ratio'] <= NOISE_BUDGET)})"
    )
    print("pieces, for information [us]")
    for name, value in figures["pieces"].items():
        print(f"  {name.replace('_', ' '):28} {value:6.2f}")


def main() -> int:
    """Measure and print; 0 whatever the figures are."""
    parser = argparse.ArgumentParser(description="lock-step runs against the bare mj_step loop of the same plant")
    parser.add_argument("--repeat", type=int, default=5, help="repetitions, of which medians are printed (default 5)")
    parser.add_argument("--json", action="store_true", help="print one JSON document instead of text")
    arguments = parser.parse_args()
    if arguments.repeat < 1:
        parser.error(f"--repeat {arguments.repeat} given, allowed 1 and more")
    figures = {
        "stops_off": run_figures(False, arguments.repeat),
        "stops_on": run_figures(True, arguments.repeat),
        "noise": noise_figures(arguments.repeat),
        "pieces": piece_figures(arguments.repeat),
    }
    if arguments.json:
        budget = {"ratio": RATIO_BUDGET, "x_realtime": REALTIME_BUDGET, "noisy_ratio": NOISE_BUDGET}
        print(json.dumps({"repeat": arguments.repeat, "budget": budget, **figures}, indent=2))
    else:
        show(figures)
    return 0


if __name__ == "__main__":
    sys.exit(main())
