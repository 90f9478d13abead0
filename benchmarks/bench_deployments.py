"""What becomes of deployed runs when jobs, workers or both are killed.

    python benchmarks/bench_deployments.py [--cases job worker both ...]

Starts a Prefect server of its own, a process work pool with one worker, and deploys the tiny
pipeline of the tests beside the flow that resumes, scheduled every minute. Each case runs a walk
of about ten seconds, kills, and waits for what the automations make of it. An asset's bytes must
equal those of a run that nobody disturbed. One table, with seconds from the kill.
"""

import argparse
import contextlib
import signal
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from pool_case import Pool, Run, server

# A walk of 40 steps, long enough to be killed in the middle.
WALK = ("walk.pause_s=0.25",)
RESUME_CRON = "* * * * *"  # in place of five minutes


def kill_nothing(pool: Pool, run: Run) -> list[str]:
    run.until_walking()
    return [f"completed after {run.until('Completed', 'Failed', 'Crashed'):.0f} s"]


def kill_job(pool: Pool, run: Run) -> list[str]:
    run.until_walking()
    run.kill()
    crashed_s = run.until("Crashed")
    again_s = crashed_s + run.until("Running")
    return [f"crashed {crashed_s:.0f} s", f"running again {again_s:.0f} s"]


def kill_worker(pool: Pool, run: Run) -> list[str]:
    run.until_walking()
    pool.worker.kill()
    pool.worker.wait()
    done_s = run.until("Completed", "Crashed")
    seen = f"the job is {run.flow_run.state.name} {done_s:.0f} s"
    pool.start_worker()
    return [seen]


def kill_both(pool: Pool, run: Run) -> list[str]:
    run.until_walking()
    pool.worker.kill()
    pool.worker.wait()
    run.kill()
    pool.start_worker()
    crashed_s = run.until("Crashed")
    again_s = crashed_s + run.until("Running")
    return [f"crashed {crashed_s:.0f} s", f"running again {again_s:.0f} s"]


def stop_worker(pool: Pool, run: Run) -> list[str]:
    run.until_walking()
    pool.worker.send_signal(signal.SIGTERM)
    pool.worker.wait(60)
    state = run.flow_run.state.name
    pool.start_worker()
    crashed_s = run.until("Crashed", "Completed")
    again_s = crashed_s + run.until("Running", "Completed")
    return [
        f"{state} when the worker is gone",
        f"crashed {crashed_s:.0f} s",
        f"again {again_s:.0f} s",
    ]


def crash_always(pool: Pool, run: Run) -> list[str]:
    done_s = run.until("Failed", "Completed")
    return [f"given up {done_s:.0f} s after it was asked for", run.flow_run.state.message]


def cancel(pool: Pool, run: Run) -> list[str]:
    from prefect.states import Cancelling

    from flows.run_records import RunIndex

    run.until_walking()
    pool.client.set_flow_run_state(run.id, Cancelling())
    done_s = run.until("Cancelled", "Crashed")
    page = RunIndex(run.store).records()[0].now
    return [f"{run.flow_run.state.name} {done_s:.0f} s", f"svim3d status says {page}"]


FAULTY = ("walk.fault=killed", "walk.faults=99")
CASES: dict[str, tuple[Callable[[Pool, Run], list[str]], tuple[str, ...], str]] = {
    "nothing": (kill_nothing, WALK, "Completed"),
    "job": (kill_job, WALK, "Completed"),
    "worker": (kill_worker, WALK, "Completed"),
    "both": (kill_both, WALK, "Completed"),
    "worker, SIGTERM": (stop_worker, WALK, "Completed"),
    "every try": (crash_always, FAULTY, "Failed"),
    "cancelled": (cancel, WALK, "Cancelled"),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--folder", type=Path, help="kept afterwards (a temporary one)")
    options = parser.parse_args()
    failures = 0
    with contextlib.ExitStack() as stack:
        folder = options.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        stack.enter_context(server(folder / "home"))
        (folder / "digits.txt").write_text("1 2 3")
        pool = Pool(folder, RESUME_CRON)
        stack.enter_context(pool.workers)
        pool.start_worker()
        truth = None
        print("| killed | what was seen | end | crashes | same bytes |\n|---|---|---|---|---|")
        for name in options.cases:
            case, settings, wanted = CASES[name]
            place = folder / name.replace(", ", "-").replace(" ", "-")
            run = pool.ask(folder / "digits.txt", place / "out", place / "store", settings)
            try:
                seen = case(pool, run)
                run.until("Completed", "Failed", "Cancelled")
            except TimeoutError as error:
                seen = [str(error)]
            end, same = run.flow_run.state.name, "-"
            if end == "Completed":
                truth = truth or run.total
                same = "yes" if run.total == truth else "NO"
            failures += end != wanted or same == "NO"
            inner = ", ".join(run.inner_states())
            print(
                f"| {name} | {'; '.join(seen)} (inner: {inner}) | {end} | {run.crashes} | {same} |",
                flush=True,
            )
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
