"""Runs killed at random moments: does the next one end with the same bytes, and what is left?

    python benchmarks/bench_kills.py [--rounds 3] [--seed 0] [--stages nerf dmtet] [--faults]

Each round takes a fresh store through the real pipeline at tiny settings and kills a run at its
start, inside each of the stages, at a moment of publishing one, and beside a second run with the
same keys, which is killed a little later; the next run then goes on. Signal (SIGKILL or SIGTERM),
moment and whether the whole process group is hit are drawn from the seed. The last run of a round
is let alone: its store must hold the bytes of the undisturbed run's, all artifacts, and `status`,
`verify` and `gc` must find it in order. A round also kills a training run three times and a batch
once. `--faults` goes through what else befalls a store instead: see `kill_faults.py`.

    killed       where: the stage at work, "start" before the first
    equal        kills after which the round ended with equal bytes
    steps kept   steps of stages that checkpoint which the next run did not repeat
    lost         CPU seconds since it began or last kept a checkpoint or an artifact, mean
    stopped in   seconds until the killed process was gone, the slowest
    harm         half artifacts, held locks, living processes, runs shown in a wrong state
"""

import argparse
import contextlib
import random
import signal
import sys
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

from kill_case import (
    STAGES,
    STOP_S,
    Scene,
    Subject,
    checkpoint_steps,
    grow_old,
    harm_in,
    leftovers_in,
)
from kill_faults import FAULTS
from kill_subject import MOMENTS
from kill_training import Batch, Training, moments_of

from stages.store import Store

BESIDE = "beside another run"
TRAINING_KILLS = 3  # of a round
COLUMNS = ("killed", "SIGKILL", "SIGTERM", "equal", "steps kept", "lost", "stopped in", "harm")


@dataclass
class Kill:
    """One kill and what followed.

    Attributes:
        where: the row that it belongs to.
        number: the signal.
        steps: at which checkpoints lay then, by key.
        lost_cpu_s: CPU seconds of the process since it last kept something.
        stopped_s: seconds until it was gone.
        harm: what it left that would hurt somebody.
        is_equal: whether the round ended well.
    """

    where: str
    number: int
    steps: dict[str, int] = field(default_factory=dict)
    lost_cpu_s: float = 0.0
    stopped_s: float = 0.0
    harm: list[str] = field(default_factory=list)
    is_equal: bool = False


def strike(subject: Subject, draw: random.Random, where: str | None = None) -> Kill | None:
    """Kill a run and see what it leaves; None if it had ended before."""
    number = draw.choice([signal.SIGKILL, signal.SIGTERM])
    record = subject.look()
    if subject.is_over:
        return None
    subject.kill(number, whole_group=draw.random() < 0.5)
    return _examine(subject, number, where or (record and record.stage) or "start")


def _examine(subject: Subject, number: int, where: str) -> Kill:
    """What a process that was hit leaves."""
    start = time.monotonic()
    code = subject.end(STOP_S)
    kill = Kill(where, number, stopped_s=time.monotonic() - start)
    kill.harm = harm_in(subject.store, subject)
    if code is None:
        kill.harm.append(f"did not stop within {STOP_S:.0f} s")
    if number == signal.SIGTERM and code not in (None, 0, 130, -signal.SIGTERM):
        kill.harm.append(f"ended with code {code}: {subject.said()}")
    kill.steps = checkpoint_steps(subject.store)
    kill.lost_cpu_s = subject.cpu_s - subject.kept_cpu_s
    print(
        f"  {where}: signal {number}, {sum(kill.steps.values())} steps kept, "
        f"{kill.lost_cpu_s:.1f} CPU s lost{'; HARM: ' + '; '.join(kill.harm) if kill.harm else ''}",
        flush=True,
    )
    return kill


class Round:
    """A store of its own, runs that are killed in it, and the one that ends well."""

    def __init__(self, scene: Scene, name: str, draw: random.Random) -> None:
        self._scene = scene
        self._draw = draw
        self.store = scene.folder / name
        self._out = scene.folder / f"out-{name}"
        self.kills: list[Kill] = []

    def _note(self, kill: Kill | None) -> None:
        if kill is not None:
            self.kills.append(kill)

    def kill_at_start(self) -> None:
        """Before the first stage."""
        subject = self._scene.start(self.store, self._out)
        moment = self._draw.uniform(0.0, self._scene.start_cpu_s)
        subject.until(lambda record: subject.cpu_s > moment)
        self._note(strike(subject, self._draw))

    def _moment(self, stage: str) -> float:
        """CPU seconds into a stage; late ones may miss it, as no two runs take equally long."""
        return self._draw.uniform(0.0, 0.9 * self._scene.seconds[stage])

    def kill_inside(self, stage: str) -> None:
        """While a stage computes."""
        subject = self._scene.start(self.store, self._out)
        subject.until_inside(stage, self._moment(stage))
        self._note(strike(subject, self._draw))

    def kill_two(self, stage: str) -> None:
        """Two runs want the same keys; one is killed, and then the one that took over."""
        out = self._out.with_name(f"{self._out.name}-beside")
        subjects = [self._scene.start(self.store, place) for place in (self._out, out)]
        self._draw.shuffle(subjects)
        first, second = subjects
        first.until_inside(stage, self._moment(stage))
        first.look()
        was_over = first.is_over
        # The other one is alive and may hold locks: harm is judged when it is gone as well.
        first.kill(signal.SIGKILL, whole_group=self._draw.random() < 0.5)
        first.process.wait()
        second.until_inside(stage, self._moment(stage))
        self._note(strike(second, self._draw, BESIDE))
        if not was_over:
            self._note(_examine(first, signal.SIGKILL, BESIDE))

    def kill_publishing(self, stage: str) -> None:
        """While a stage's artifact is published."""
        moment = self._draw.choice(MOMENTS)
        number = self._draw.choice([signal.SIGKILL, signal.SIGTERM])
        trap = {"stage": stage, "moment": moment, "signal": number, "group": False}
        subject = self._scene.start(self.store, self._out, trap)
        subject.until(lambda _: False)
        self._note(_examine(subject, number, f"publishing, {moment}"))

    def end(self) -> list[str]:
        """Let a run go to its end; tells what is wrong then."""
        subject = self._scene.start(self.store, self._out)
        code = subject.end()
        wrong = [] if code == 0 else [f"the last run ended with code {code}: {subject.said()}"]
        wrong += subject.survivors()
        wrong += self._scene.differences(self.store, self._out)
        wrong += [
            f"step {step} of {key[:8]} was repeated"
            for key, step in {pair for kill in self.kills for pair in kill.steps.items()}
            if step and not _has_resumed(self.store, key, step)
        ]
        wrong += self._in_order()
        return wrong

    def _in_order(self) -> list[str]:
        """What the commands that look after a store find amiss, or leave."""
        wrong = []
        grow_old(self.store, days=2.0)
        for command in (["status"], ["store", "verify"], ["store", "gc", "--older-than", "1d"]):
            subject = self._scene.start_command([*command, "--store", str(self.store)], self.store)
            if (code := subject.end()) != 0:
                wrong.append(f"svim3d {' '.join(command)} ended with code {code}")
        return wrong + leftovers_in(self.store) + self._scene.differences(self.store)


def _has_resumed(store: Path, key: str, step: int) -> bool:
    stored = Store(store).check(key).stored
    events = stored.manifest.record["events"] if stored else []
    return any(e["kind"] == "resumed" and f"step {step} " in e["message"] for e in events)


def go_round(scene: Scene, name: str, stages: list[str], draw: random.Random) -> list[Kill]:
    """Kills in the order of the pipeline, then a run to the end."""
    this = Round(scene, name, draw)
    shared, published = draw.choice(stages), draw.choice(stages)
    this.kill_at_start()
    for stage in stages:
        this.kill_inside(stage)
        if stage == shared:
            this.kill_two(stage)
        if stage == published:
            this.kill_publishing(stage)
    return _judged(this.kills, this.end())


def go_training(training: Training, out: Path, draw: random.Random) -> list[Kill]:
    """A training that is killed again and again, then ends."""
    kills = []
    for moment in moments_of(draw, training.cpu_s, TRAINING_KILLS):
        subject = training.start(out)
        subject.until(lambda _, s=subject, m=moment: s.cpu_s > m)
        kills.append(strike(subject, draw, "training"))
    subject = training.start(out)
    code = subject.end()
    wrong = [] if code == 0 else [f"training ended with code {code}: {subject.said()}"]
    return _judged([kill for kill in kills if kill], wrong + training.differences(out))


def go_batch(batch: Batch, draw: random.Random) -> list[Kill]:
    """A batch whose own process is killed, and which goes on."""
    subject = batch.start()
    batch.until_published(subject, draw.randrange(1, len(STAGES)))
    kill = strike(subject, draw, "batch")
    return _judged([kill] if kill else [], batch.end())


def _judged(kills: list[Kill], wrong: list[str]) -> list[Kill]:
    for problem in wrong:
        print(f"  WRONG: {problem}", flush=True)
    for kill in kills:
        kill.is_equal = not wrong
    return kills


def table(kills: list[Kill]) -> str:
    """A line for each place."""
    rows = defaultdict(list)
    for kill in kills:
        rows[kill.where].append(kill)
    order = ["start", *STAGES, *(f"publishing, {m}" for m in MOMENTS), BESIDE]
    order += [where for where in rows if where not in order]
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS)]
    for where, of_row in [*((w, rows[w]) for w in order if w in rows), ("all", kills)]:
        lost = sum(kill.lost_cpu_s for kill in of_row) / len(of_row)
        cells = [
            where,
            sum(kill.number == signal.SIGKILL for kill in of_row),
            sum(kill.number == signal.SIGTERM for kill in of_row),
            f"{sum(kill.is_equal for kill in of_row)} of {len(of_row)}",
            sum(sum(kill.steps.values()) for kill in of_row),
            f"{lost:.1f}",
            f"{max(kill.stopped_s for kill in of_row):.1f}",
            sum(bool(kill.harm) for kill in of_row),
        ]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stages", nargs="+", default=list(STAGES), choices=STAGES)
    parser.add_argument("--source", default="photo", help="input of the runs")
    parser.add_argument("--faults", nargs="*", metavar="NAME", choices=list(FAULTS))
    parser.add_argument("--folder", type=Path, help="where the temporary folder is made")
    given = parser.parse_args()
    with (
        tempfile.TemporaryDirectory(dir=given.folder) as folder,
        contextlib.closing(Scene(Path(folder), given.source)) as scene,
    ):
        scene.measure()
        print(
            f"undisturbed: {scene.total_cpu_s:.1f} CPU s, {scene.start_cpu_s:.1f} of them before "
            f"the first stage; {scene.seconds}",
            flush=True,
        )
        if given.faults is not None:
            return go_through_faults(scene, given.faults or list(FAULTS))
        training = Training(scene)
        kills: list[Kill] = []
        for number in range(given.rounds):
            print(f"round {number}", flush=True)
            draw = random.Random(f"{given.seed}/{number}")
            kills += go_round(scene, f"round{number}", given.stages, draw)
            kills += go_training(training, scene.folder / f"training{number}", draw)
            kills += go_batch(Batch(scene, f"batch{number}"), draw)
            print(table(kills), flush=True)
    return int(any(kill.harm or not kill.is_equal for kill in kills))


def go_through_faults(scene: Scene, names: list[str]) -> int:
    """A row for each fault."""
    lines, failed = [], 0
    for name in names:
        outcome = FAULTS[name](scene, scene.folder / name.replace(" ", "-"))
        failed += not outcome.is_well
        lines.append(f"| {name} | {outcome.code} | {outcome.said} | {outcome.verdict} |")
        print(lines[-1], flush=True)
    print("\n".join(["| fault | exit code | what it said | then |", "|---|---|---|---|", *lines]))
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
