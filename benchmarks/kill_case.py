"""A run of the real pipeline as a process that is watched and killed, and what it leaves behind."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from flows.pipeline import IMAGE_TO_ASSET  # noqa: E402
from flows.run_records import (  # noqa: E402
    CANCELLED,
    COMPUTING,
    DIED,
    DONE,
    WAITING,
    RunIndex,
    RunRecord,
)
from stages.locks import is_locked  # noqa: E402
from stages.store import Store  # noqa: E402
from svim3d.io.weights import open_tensors  # noqa: E402

STAGES = IMAGE_TO_ASSET.names
SETTINGS = (
    "skip=[]",
    "env_preopt.size=16",
    "env_preopt.steps=60",
    "env_preopt.max_pixels=4000",
    "nerf.steps=80",
    "nerf.rays_per_step=512",
    "nerf.grid_nodes=[24, 32]",
    "nerf.coarse_nodes=[8]",
    "nerf.hash_levels=4",
    "nerf.hash_log2_entries=11",
    "nerf.hash_finest=48",
    "nerf.hidden=16",
    "nerf.environment_size=16",
    "dmtet.steps=40",
    "dmtet.cells=16",
    "uv_bake.texture_size=128",
    "uv_bake.max_faces=800",
    "uv_bake.occlusion_rays=16",
    "uv_bake.fit_iterations=6",
    "preview.views=2",
    "preview.cell=96",
    "preview.supersample=1",
)
MARK = "SVIM3D_KILL_MARK"  # in the environment of a run and of all that it starts
POLL_S = 0.01
PATIENCE_S = 1800.0  # with a run that does not end; the machine may be busy
STOP_S = 180.0  # with a process that was told to stop
TICKS = os.sysconf("SC_CLK_TCK")


@dataclass
class Subject:
    """A run at work.

    Attributes:
        process: what was started, leader of its group.
        store: root of its store.
        output: where what it says is kept.
        mark: that it and its children carry in their environment.
        cpu_s: that it has used, as far as was looked.
        kept_cpu_s: those when it last kept an artifact or a checkpoint.
    """

    process: subprocess.Popen[bytes]
    store: Path
    output: Path
    mark: str
    cpu_s: float = 0.0
    kept_cpu_s: float = 0.0
    _kept: object = None
    _page: Path | None = None

    @property
    def is_over(self) -> bool:
        """Whether it has ended, however."""
        return self.process.poll() is not None

    def look(self) -> RunRecord | None:
        """What its page says now; notes CPU seconds and what is kept."""
        with contextlib.suppress(OSError):
            fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
            if fields[0] != "Z":
                self.cpu_s = (int(fields[11]) + int(fields[12])) / TICKS
        kept = kept_in(self.store)
        if kept != self._kept:
            self._kept, self.kept_cpu_s = kept, self.cpu_s
        return self.record()

    def record(self) -> RunRecord | None:
        """Its page, once there is one."""
        if self._page is None:
            pid = self.process.pid
            found = [r for r in RunIndex(self.store).records() if r.process.pid == pid]
            if not found:
                return None
            self._page = RunIndex(self.store).page(found[0].id)
        with contextlib.suppress(OSError, ValueError):
            return RunRecord.parse(self._page.read_bytes())
        return None

    def until(self, condition: Callable[[RunRecord | None], bool]) -> None:
        """Watch until something is so, or the run has ended."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition(self.look()) and not self.is_over:
            if time.monotonic() > deadline:
                self.kill(signal.SIGKILL, whole_group=True)
                raise TimeoutError(f"a run goes on and on; see {self.output}")
            time.sleep(POLL_S)

    def until_inside(self, stage: str, cpu_s: float) -> None:
        """Watch until a stage has computed for so many CPU seconds, or is over."""
        later = STAGES[STAGES.index(stage) + 1 :]
        began: float | None = None

        def is_there(record: RunRecord | None) -> bool:
            nonlocal began
            if record is None:
                return False
            if any(record.stages[name].state not in (WAITING, "cached") for name in later):
                return True
            if began is None and record.stages[stage].state == COMPUTING:
                began = self.cpu_s
            return began is not None and self.cpu_s - began >= cpu_s

        self.until(is_there)

    def kill(self, number: signal.Signals, *, whole_group: bool) -> None:
        """Send a signal to it, or to all of its group."""
        with contextlib.suppress(ProcessLookupError):
            (os.killpg if whole_group else os.kill)(self.process.pid, number)

    def end(self, patience_s: float = PATIENCE_S) -> int | None:
        """Exit code, or None if it had to be killed."""
        try:
            self.until_over(patience_s)
        except subprocess.TimeoutExpired:
            self.kill(signal.SIGKILL, whole_group=True)
            self.process.wait()
            return None
        return self.process.returncode

    def until_over(self, patience_s: float) -> None:
        """Watch until it has ended."""
        deadline = time.monotonic() + patience_s
        while not self.is_over:
            self.look()
            if time.monotonic() > deadline:
                raise subprocess.TimeoutExpired("svim3d", patience_s)
            time.sleep(POLL_S)

    def said(self) -> str:
        """Its last words."""
        lines = self.output.read_text(errors="replace").strip().splitlines()
        return next((line for line in lines if line.startswith("svim3d: ")), (lines or [""])[-1])

    def survivors(self, patience_s: float = 90.0) -> list[str]:
        """Commands of processes that outlive it."""
        deadline = time.monotonic() + patience_s
        while (found := _marked(self.mark)) and time.monotonic() < deadline:
            time.sleep(0.2)
        return found


def _marked(mark: str) -> list[str]:
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if f"{MARK}={mark}".encode() in (folder / "environ").read_bytes().split(b"\0"):
                command = (folder / "cmdline").read_bytes().replace(b"\0", b" ")
                found.append(command.decode(errors="replace").strip())
    return [command for command in found if command]  # remains of a process have none


@dataclass
class Scene:
    """Where runs are made: a folder, an input, and the undisturbed run that all must equal.

    Attributes:
        folder: for stores, run folders and outputs.
        source: input of `svim3d run`.
        seconds: CPU seconds of each stage of the undisturbed run.
        start_cpu_s: CPU seconds before its first stage.
        content: by key, digests of all files that the undisturbed run published.
        subjects: all that were started.
    """

    folder: Path
    source: str
    seconds: dict[str, float] = field(default_factory=dict)
    start_cpu_s: float = 0.0
    total_cpu_s: float = 0.0
    content: dict[str, dict[str, str]] = field(default_factory=dict)
    subjects: list[Subject] = field(default_factory=list)

    def close(self) -> None:
        """Leave nothing running, whatever went wrong."""
        for subject in self.subjects:
            if not subject.is_over:
                subject.kill(signal.SIGKILL, whole_group=True)
                subject.process.wait()

    def run_arguments(self, store: Path, out: Path) -> list[str]:
        """Of `svim3d`, for the run that all is about."""
        settings = [f"--set={setting}" for setting in SETTINGS]
        where = ["--store", str(store), "-o", str(out), "--device", "cpu"]
        return ["run", self.source, "--preset", "preview", *settings, *where]

    def start(self, store: Path, out: Path, trap: dict[str, Any] | None = None) -> Subject:
        """Begin that run; see `kill_subject` for traps."""
        return self.start_command(self.run_arguments(store, out), store, trap)

    def start_command(
        self, arguments: Sequence[str], store: Path, trap: dict[str, Any] | None = None
    ) -> Subject:
        """Begin any command of `svim3d`."""
        mark = uuid.uuid4().hex
        output = self.folder / f"{mark}.txt"
        environment = os.environ | {
            MARK: mark,
            "PYTHONPATH": str(ROOT),
            "OMP_NUM_THREADS": "1",
            "NUMBA_NUM_THREADS": "1",
        }
        environment.pop("PREFECT_API_URL", None)
        script = str(Path(__file__).with_name("kill_subject.py"))
        with output.open("wb") as stream:
            process = subprocess.Popen(
                [sys.executable, script, json.dumps(trap or {}), *arguments],
                cwd=self.folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=stream,
                start_new_session=True,
            )
        self.subjects.append(Subject(process, store, output, mark))
        return self.subjects[-1]

    def measure(self) -> None:
        """Make the undisturbed run."""
        store = self.folder / "undisturbed"
        subject = self.start(store, self.folder / "out-undisturbed")
        starts: list[float] = []

        def note(record: RunRecord | None) -> bool:
            if record is not None and record.stage and not starts:
                starts.append(subject.cpu_s)
            return False

        subject.until(note)
        if subject.process.returncode != 0:
            raise RuntimeError(f"the undisturbed run failed: {subject.said()}")
        self.start_cpu_s, self.total_cpu_s = starts[0], subject.cpu_s
        for manifest in Store(store).recent(len(STAGES)):
            self.seconds[manifest.recipe.stage] = manifest.record["cpu_seconds"]
        self.content = content_of(store)

    def differences(self, store: Path, out: Path | None = None) -> list[str]:
        """What is not as in the undisturbed run."""
        found, wanted = content_of(store), self.content
        wrong = [key[:8] for key in sorted({*found, *wanted}) if found.get(key) != wanted.get(key)]
        for name in ("asset.glb", "environment.exr", "preview.png") if out else ():
            undisturbed = (self.folder / "out-undisturbed" / name).read_bytes()
            if not (out / name).is_file() or (out / name).read_bytes() != undisturbed:
                wrong.append(name)
        return wrong


def content_of(store: Path) -> dict[str, dict[str, str]]:
    """Digests of all published files by key, "damaged" where one is not what its manifest says."""
    content = {}
    for key in Store(store).keys():  # noqa: SIM118 (a store is no mapping)
        health = Store(store).check(key)
        files = health.stored.manifest.files if health.stored else {}
        content[key] = {name: file.sha256 for name, file in files.items()} or {"": "damaged"}
    return content


def kept_in(store: Path) -> object:
    """Names of artifacts and ages of checkpoints: changes when something more is kept."""
    kept: list[object] = []
    with contextlib.suppress(OSError):
        kept += sorted(entry.name for entry in (store / "obj").iterdir())
    for file in checkpoints_in(store):
        with contextlib.suppress(OSError):
            kept.append((file.parent.name, file.stat().st_mtime_ns))
    return kept


def checkpoints_in(store: Path) -> list[Path]:
    """Of a store, or of the folder of a training."""
    name = "checkpoint.safetensors"
    return [*store.glob(f"work/*/{name}"), *store.glob(f"*/{name}")]


def checkpoint_steps(store: Path) -> dict[str, int]:
    """Steps that are kept of stages half done, by key.

    A kill between publishing and tidying up leaves a checkpoint that nothing needs any more.
    """
    steps = {}
    published = set(Store(store).keys())
    for file in checkpoints_in(store):
        if file.parent.name in published:
            continue
        with open_tensors(file) as opened:
            steps[file.parent.name] = int(opened.read("__step__"))
    return steps


def harm_in(store: Path, subject: Subject) -> list[str]:
    """What a killed process left that would hurt somebody."""
    harm = [f"lives on: {command}" for command in subject.survivors()]
    for key in Store(store).keys():  # noqa: SIM118
        if (health := Store(store).check(key)).state != "ok":
            harm.append(f"artifact {key[:8]}: {health.damage}")
    locks = [*(store / "lock").glob("*"), store / "lease"]
    harm += [f"lock {file.name[:8]} is held" for file in locks if is_locked(file)]
    record = subject.record()
    if record is None:
        return harm
    # A signal that comes once all is published finds a run that is done, and shown so.
    is_whole = all(stage.state not in (WAITING, COMPUTING) for stage in record.stages.values())
    if record.now not in ((DIED, CANCELLED, DONE) if is_whole else (DIED, CANCELLED)):
        harm.append(f"shown as {record.now}")
    return harm


def leftovers_in(store: Path) -> list[str]:
    """What no run needs: half-done work, trash, temporaries, quarantined artifacts."""
    found = [*store.glob("work/*"), *store.glob("trash/*"), *store.glob("bad/*")]
    found += [*store.glob("incoming/*"), *store.glob("shared/**/*.tmp"), *store.glob("runs/.*")]
    return sorted(str(path.relative_to(store)) for path in found)


def grow_old(store: Path, days: float) -> None:
    """Let everything but artifacts be as if it had been left so many days ago."""
    then = time.time() - 86_400.0 * days
    for name in ("work", "shared", "runs", "trash", "incoming"):
        for path in [store / name, *(store / name).rglob("*")]:
            with contextlib.suppress(FileNotFoundError):
                os.utime(path, (then, then), follow_symlinks=False)
