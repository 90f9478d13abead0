"""The service against its own document: whatever may be sent, the answers are those promised.

Schemathesis draws requests from the OpenAPI document, right and wrong ones; each answer's status,
type, headers and body must be documented, right ones accepted, wrong ones refused.
"""

import pytest
import schemathesis
from fake_run import QUICK
from fake_service import command, png, send, wait_for
from fake_views import exr, index, packed
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from schemathesis import GenerationMode
from schemathesis.specs.openapi.checks import negative_data_rejection

from flows.service.api import make_app
from flows.service.limits import Limits
from flows.service.queue import JobQueue

EXAMPLES = 25
OPERATIONS = [
    ("GET", "/jobs"),
    ("POST", "/jobs"),
    ("GET", "/jobs/{job}"),
    ("DELETE", "/jobs/{job}"),
    ("GET", "/jobs/{job}/report"),
    ("GET", "/jobs/{job}/asset.glb"),
    ("GET", "/jobs/{job}/preview.png"),
    ("GET", "/jobs/{job}/views.png"),
    ("GET", "/health"),
]


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    store = tmp_path_factory.mktemp("store")

    def always_quick(record, folder):
        return command(record.model_copy(update={"seed": QUICK}), folder)

    queue = JobQueue(store / "service", always_quick, Limits(queue=10_000), slots=1)
    app = make_app(queue, store)
    with queue, TestClient(app) as client:
        job = send(client)
        wait_for(client, job, "done")
        yield schemathesis.openapi.from_asgi("/openapi.json", app), job


def views(folder) -> bytes:
    return packed({"orbit.json": index(["x.exr"]), "x.exr": exr(folder)}).getvalue()


@pytest.mark.parametrize(("method", "path"), OPERATIONS)
def test_answers_are_those_that_the_document_promises(service, method, path, tmp_path):
    schema, job = service
    operation = schema[path][method]
    files = {"picture": png(), "views": views(tmp_path)}

    @given(
        case=st.one_of(operation.as_strategy(mode) for mode in GenerationMode),
        known=st.booleans(),
    )
    @settings(
        max_examples=EXAMPLES,
        deadline=None,
        derandomize=True,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    def check(case, known):
        if known and "{job}" in path and method == "GET":
            case.path_parameters = {"job": job}
        excluded = []
        is_right = case.meta.generation.mode is GenerationMode.POSITIVE
        if is_right and isinstance(case.body, dict):
            # No document tells what makes bytes a picture; and bytes are no text to the checker.
            case.body |= {name: file for name, file in files.items() if name in case.body}
            excluded = [negative_data_rejection]
        response = case.call_and_validate(excluded_checks=excluded)
        if excluded:
            assert response.status_code == 202, response.text
        assert response.status_code < 500

    check()


def test_every_operation_is_tried(service):
    schema, _ = service
    listed = {
        (result.ok().method.upper(), result.ok().path) for result in schema.get_all_operations()
    }
    assert listed == set(OPERATIONS)
