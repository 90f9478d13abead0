"""What befalls a store besides kills: each fault is told in a line, and the next run ends right.

A fault is a function of a scene and a name; it answers with the exit code of the run that met it,
what that said, and what became of the store afterwards. Disks that are full or read-only are small
ones in memory, mounted for the purpose (as root; elsewhere these rows are left out).
"""

import contextlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from kill_case import STAGES, Scene, Subject, checkpoint_steps, checkpoints_in, content_of

from flows.run_records import COMPUTED, RunIndex
from stages.manifest import MANIFEST_NAME
from stages.store import MIN_FREE_MIB, Store

DAY_S = 86_400.0
LONG = "nerf"  # the stage during which faults come; it checkpoints
DISK_MIB = MIN_FREE_MIB + 64
DONE, FAILED, BAD_INPUT = 0, 1, 2


@dataclass
class Outcome:
    """What a fault came to.

    Attributes:
        code: exit code of the run that met it; None where it could not be tried.
        said: its last words.
        wrong: what was not as it should be.
        note: what else is worth knowing.
    """

    code: int | None
    said: str
    wrong: list[str] = field(default_factory=list)
    note: str = ""

    @property
    def is_well(self) -> bool:
        """Whether all was as it should be."""
        return not self.wrong

    @property
    def verdict(self) -> str:
        """The last cell of the row."""
        return "; ".join(self.wrong) if self.wrong else self.note or "equal bytes"


class Site:
    """A store that a fault befalls."""

    def __init__(self, scene: Scene, store: Path) -> None:
        self.scene = scene
        self.store = store
        self.out = scene.folder / f"out-{store.parent.name}-{store.name}"

    def start(self, trap: dict[str, float] | None = None) -> Subject:
        """Begin the run."""
        return self.scene.start(self.store, self.out, trap)

    def until_long(self, *, with_checkpoint: bool = True) -> Subject:
        """A run that is in its long stage, and has kept some of it."""
        subject = self.start()
        subject.until_inside(LONG, 0.0)
        if with_checkpoint:
            subject.until(lambda _: any(checkpoint_steps(self.store).values()))
        return subject

    def met(self, subject: Subject, expected: int) -> Outcome:
        """How the run that meets the fault ends."""
        code = subject.end()
        outcome = Outcome(code, subject.said())
        if code != expected:
            outcome.wrong.append(f"wanted exit code {expected}")
        outcome.wrong += subject.survivors()
        return outcome

    def then(self, outcome: Outcome, *, events: tuple[str, ...] = ()) -> Outcome:
        """The next run must end with the right bytes, and may have to tell of something."""
        subject = self.start()
        if (code := subject.end()) != DONE:
            outcome.wrong.append(f"the next run ended with code {code}: {subject.said()}")
        outcome.wrong += self.scene.differences(self.store, self.out)
        told = self.events()
        outcome.wrong += [f"no event {kind}" for kind in events if kind not in told]
        return outcome

    def events(self) -> list[str]:
        """Kinds of the events of the long stage."""
        for manifest in Store(self.store).recent(len(STAGES)):
            if manifest.recipe.stage == LONG:
                return [event["kind"] for event in manifest.record["events"]]
        return []


@contextlib.contextmanager
def small_disk() -> Iterator[Path]:
    """A disk of its own, which can be filled without harm."""
    with tempfile.TemporaryDirectory() as folder:
        mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MIB}M", "svim3d", folder]
        subprocess.run(mount, check=True, capture_output=True)
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", "--lazy", folder], check=True)


def fill(disk: Path, *, leave: int = 0) -> Path:
    """Take what is free, but for so many bytes; others may write at the same time."""
    ballast = disk / "ballast"
    with ballast.open("wb", buffering=0) as stream, contextlib.suppress(OSError):
        while shutil.disk_usage(disk).free > leave or not leave:
            stream.write(b"\0" * 2**18)
    return ballast


def full_disk_at_start(scene: Scene, _: Path) -> Outcome:
    with small_disk() as disk:
        ballast = fill(disk, leave=MIN_FREE_MIB * 2**20 // 2)
        site = Site(scene, disk / "store")
        outcome = site.met(site.start(), FAILED)
        ballast.unlink()
        return site.then(outcome)


def full_disk_in_a_stage(scene: Scene, _: Path) -> Outcome:
    with small_disk() as disk:
        site = Site(scene, disk / "store")
        subject = site.until_long()
        ballast = fill(disk)
        outcome = site.met(subject, FAILED)
        ballast.unlink()
        return site.then(outcome, events=("resumed",))


def read_only_at_start(scene: Scene, _: Path) -> Outcome:
    with small_disk() as disk:
        remount(disk, "ro")
        site = Site(scene, disk / "store")
        outcome = site.met(site.start(), BAD_INPUT)
        remount(disk, "rw")
        return site.then(outcome)


def read_only_with_all_in_it(scene: Scene, _: Path) -> Outcome:
    """A run that needs nothing new must be answered."""
    with small_disk() as disk:
        shutil.copytree(scene.folder / "undisturbed", disk / "store")
        remount(disk, "ro")
        site = Site(scene, disk / "store")
        outcome = site.met(site.start(), DONE)
        outcome.wrong += scene.differences(site.store, site.out)
        return outcome


def remount(disk: Path, how: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{how}", str(disk)], check=True)


def store_moved_away(scene: Scene, store: Path) -> Outcome:
    site = Site(scene, store)
    subject = site.until_long()
    away = store.with_name(f"{store.name}-away")
    store.rename(away)
    outcome = site.met(subject, FAILED)
    if store.exists():
        outcome.wrong.append("something was put in its place")
        shutil.rmtree(store)
    away.rename(store)
    return site.then(outcome, events=("resumed",))


def store_deleted(scene: Scene, store: Path) -> Outcome:
    site = Site(scene, store)
    subject = site.until_long(with_checkpoint=False)
    store.rename(gone := store.with_name(f"{store.name}-gone"))
    shutil.rmtree(gone, ignore_errors=True)
    return site.then(site.met(subject, FAILED))


def flip_bit(file: Path) -> None:
    """In the middle, where the content is."""
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def flipped_in_artifacts(choose: Callable[[Path], list[Path]]) -> Callable[[Scene, Path], Outcome]:
    """A bit flips in files of every artifact."""

    def befall(scene: Scene, store: Path) -> Outcome:
        shutil.copytree(scene.folder / "undisturbed", store)
        site = Site(scene, store)
        flipped = 0
        for artifact in store.glob("obj/*"):
            for file in choose(artifact):
                flip_bit(file)
                flipped += 1
        verify = scene.start_command(["store", "verify", "--store", str(store)], store)
        outcome = site.met(verify, FAILED)
        outcome.note = f"{flipped} flipped; "
        site.then(outcome)
        bad = len(list(store.glob("bad/*")))
        outcome.note += f"{bad} artifacts set aside and made anew, equal bytes"
        return outcome

    return befall


def payload(artifact: Path) -> list[Path]:
    return [file for file in artifact.glob("files/**/*") if file.is_file()]


def manifests_and_scalars(artifact: Path) -> list[Path]:
    return [f for n in (MANIFEST_NAME, "scalars.csv") if (f := artifact / n).exists()]


def spoilt_work(spoil: Callable[[Path], None], event: str) -> Callable[[Scene, Path], Outcome]:
    """What an unfinished stage keeps is damaged before it goes on."""

    def befall(scene: Scene, store: Path) -> Outcome:
        site = Site(scene, store)
        subject = site.until_long()
        subject.process.kill()
        subject.process.wait()
        (checkpoint,) = checkpoints_in(store)
        spoil(checkpoint)
        outcome = site.met(site.start(), DONE)
        outcome.wrong += scene.differences(store, site.out)
        if event not in site.events():
            outcome.wrong.append(f"no event {event}")
        outcome.note = f"event {event}, equal bytes"
        return outcome

    return befall


def cut(file: Path) -> None:
    os.truncate(file, file.stat().st_size // 2)


def spoil_records(checkpoint: Path) -> None:
    """The events and scalars beside it; a line cut in the middle is what a full disk leaves."""
    with (checkpoint.parent / "events.jsonl").open("ab") as stream:
        stream.write(b'{"kind": "\xff, cut')
    with (checkpoint.parent / "scalars.csv").open("ab") as stream:
        stream.write(b"1x,lo\xff,0.1\n2,lo")


def jumping_clock(days: float) -> Callable[[Scene, Path], Outcome]:
    """The clock jumps while the run computes."""

    def befall(scene: Scene, store: Path) -> Outcome:
        site = Site(scene, store)
        after_s = 0.5 * (scene.start_cpu_s + scene.total_cpu_s)
        outcome = site.met(site.start({"clock_s": days * DAY_S, "after_cpu_s": after_s}), DONE)
        outcome.wrong += scene.differences(store, site.out)
        clean = ["store", "gc", "--older-than", "1d", "--store", str(store)]
        if (code := scene.start_command(clean, store).end()) != DONE:
            outcome.wrong.append(f"gc ended with code {code}")
        if content_of(store) != scene.content:
            outcome.wrong.append("gc took what the newest run needs")
        (record,) = RunIndex(store).records()
        states = {stage.state for stage in record.stages.values()}
        if states != {COMPUTED} or record.duration_s < 0.0:
            outcome.wrong.append(f"the run shows {states}, {record.duration_s} s")
        return outcome

    return befall


def flipped_shared(scene: Scene, store: Path) -> Outcome:
    """A bit flips in what all runs derive from: a prefilter, kept beside the artifacts."""
    shutil.copytree(scene.folder / "undisturbed" / "shared", store / "shared")
    for file in store.glob("shared/prefilter/*"):
        flip_bit(file)
    site = Site(scene, store)
    outcome = site.met(site.start(), DONE)
    outcome.wrong += scene.differences(store, site.out)
    return outcome


FAULTS: dict[str, Callable[[Scene, Path], Outcome]] = {
    "full disk": full_disk_at_start,
    "disk fills up in a stage": full_disk_in_a_stage,
    "read-only store": read_only_at_start,
    "read-only store that has all": read_only_with_all_in_it,
    "store moved away": store_moved_away,
    "store deleted": store_deleted,
    "bit in payloads": flipped_in_artifacts(payload),
    "bit in manifests and scalars": flipped_in_artifacts(manifests_and_scalars),
    "bit in a checkpoint": spoilt_work(flip_bit, "damaged_checkpoint"),
    "cut checkpoint": spoilt_work(cut, "damaged_checkpoint"),
    "cut events and scalars": spoilt_work(spoil_records, "resumed"),
    "bit in a shared prefilter": flipped_shared,
    "clock a week back": jumping_clock(-7.0),
    "clock a week ahead": jumping_clock(7.0),
}
