"""One case of an evaluation, in a process of its own: the asset, then its scores.

Called with the file of a request; writes what went wrong, or nothing, where that says.
"""

import json
import sys
import traceback
from pathlib import Path
from typing import Any

from flows.case_work import CLEAR, Listener
from flows.evaluate_cases import LAST_STAGE, VIEWS_STAGE, Case, Row, Subject, plan_case
from flows.steps import Bench, obtain_steps
from stages.execution import choose_device, run_stage
from stages.settings.table_scores import TableScoresConfig
from stages.store import Store, Stored
from stages.table_scores import TABLE_SCORES


def carry_out(request: dict[str, Any]) -> str | None:
    """Bring the scores of a request into the store; what went wrong."""
    listener = Listener()
    try:
        store = Store(Path(request["store"]))
        name, preset, overrides, skip = request["row"]
        case = plan_case(
            Subject(request["subject"], Path(request["truth"])),
            Row(name, preset, tuple(overrides), tuple(skip)),
            store,
            from_photo=request["from_photo"],
            config=TableScoresConfig(**request["config"]),
            seed=request["seed"],
        )
        _score(case, store, request["device"], listener)
    except CLEAR as error:
        return f"{listener.stage or 'input'}: {error}"
    except Exception:
        return f"{listener.stage or 'scores'}: {traceback.format_exc(limit=-3)}"
    return None


def _score(case: Case, store: Store, device: str, listener: Listener) -> None:
    chosen = choose_device(device)
    artifacts = obtain_steps(Bench(case.plan, store, chosen, listener))
    novel = None
    if case.novel is not None:
        novel = obtain_steps(Bench(case.novel, store, chosen, listener))[VIEWS_STAGE]
    inputs: dict[str, Stored | Path | None] = {
        "truth": case.subject.truth,
        LAST_STAGE: artifacts[LAST_STAGE],
        VIEWS_STAGE: artifacts[VIEWS_STAGE],
        "novel": novel,
    }
    run_stage(store, case.recipe, TABLE_SCORES, inputs, config=case.config, device=chosen)


def main() -> None:
    """Carry out the request in the file that the command line names."""
    request = json.loads(Path(sys.argv[1]).read_text())
    Path(request["out"]).write_text(json.dumps({"error": carry_out(request)}))


if __name__ == "__main__":
    main()
