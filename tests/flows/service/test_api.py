"""The service by its answers: a picture's way, results, refusals, nothing of the machine."""

import errno
import importlib.metadata

import pytest
from fake_run import BAD, GLB, SILENT, SLOW, STUBBORN
from fake_service import png, send, wait_for

from flows.config import PipelineConfig, load_config
from flows.service import api, queue
from flows.service.forms import JobForm
from flows.service.serve import run_options

NOBODY = "0" * 32


def problem(answer) -> dict:
    said = answer.json()
    assert set(said) == {"code", "wanted", "came", "todo"} and all(said.values())
    return said


def test_a_picture_becomes_an_asset(client):
    answer = client.post(
        "/jobs", files={"picture": ("../../x.exe", png())}, data={"preset": "preview"}
    )
    assert answer.status_code == 202
    job = answer.json()["id"]
    assert answer.headers["location"] == f"/jobs/{job}"
    view = wait_for(client, job, "done")
    assert [event["message"] for event in view["events"]] == ["queued", "started", "done"]
    assert view["settings"] == {"preset": "preview", "seed": 0, "skip": []}
    assert view["progress"] == {
        "stage": None,
        "step": None,
        "total": None,
        "finished": {"prepare": "cached, square of 576 px"},
        "notes": ["prepare: no network in run: took the plain background"],
    }
    fetched = {path.rpartition("/")[2]: client.get(path) for path in view["files"]}
    assert set(fetched) == {"asset.glb", "preview.png", "report"}
    assert fetched["asset.glb"].content == GLB
    assert fetched["asset.glb"].headers["content-type"] == "model/gltf-binary"
    assert f'filename="{job[:8]}-asset.glb"' in fetched["asset.glb"].headers["content-disposition"]
    missing = client.get(f"/jobs/{job}/views.png")
    assert missing.status_code == 404 and problem(missing)["code"] == "no_such_file"


def test_a_file_is_fetched_in_parts_and_once(client):
    job = send(client)
    wait_for(client, job, "done")
    path = f"/jobs/{job}/asset.glb"
    etag = client.get(path).headers["etag"]
    assert client.get(path, headers={"If-None-Match": etag}).status_code == 304
    for asked, expected in (
        ("bytes=0-3", GLB[:4]),
        ("bytes=4-", GLB[4:]),
        ("bytes=-5", GLB[-5:]),
        (f"bytes=200-{10**6}", GLB[200:]),
    ):
        part = client.get(path, headers={"Range": asked})
        assert (part.status_code, part.content) == (206, expected)
    for asked in ("bytes=5-2", "bytes=0-1,3-4", "lines=1-2", "bytes=", "bytes=\u0661-2".encode()):
        whole = client.get(path, headers={"Range": asked})
        assert (whole.status_code, whole.content) == (200, GLB)
    for asked in ("bytes=204-", "bytes=-0"):
        beyond = client.get(path, headers={"Range": asked})
        assert beyond.status_code == 416 and problem(beyond)["code"] == "no_such_range"
        assert beyond.headers["content-range"] == f"bytes */{len(GLB)}"


def test_answers_hold_no_path_of_the_machine(client, home):
    good, bad = send(client), send(client, BAD)
    wait_for(client, good, "done")
    view = wait_for(client, bad, "failed")
    assert view["error"] == "photo.png: wanted an object, got none; take another photo"
    assert view["events"][-1]["message"] == "the input cannot work"
    report = client.get(f"/jobs/{good}/report")
    assert report.json()["input"] == "photo.png"
    for answer in (report, client.get("/jobs"), client.get(f"/jobs/{bad}")):
        assert str(home.parent.parent) not in answer.text and "/usr" not in answer.text
    refused = client.get(f"/jobs/{bad}/asset.glb")
    assert refused.status_code == 409 and "failed" in problem(refused)["came"]


def test_a_run_without_a_word_is_explained(client):
    assert "exit code 1" in wait_for(client, send(client, SILENT), "failed")["error"]


def test_jobs_wait_are_counted_and_cancelled(client):
    first, second, third = (send(client, SLOW) for _ in range(3))
    view = wait_for(client, first, "running")
    while view["progress"]["stage"] is None:
        view = client.get(f"/jobs/{first}").json()
    assert view["progress"]["stage"] == "nerf"
    assert [client.get(f"/jobs/{job}").json()["position"] for job in (second, third)] == [0, 1]
    health = client.get("/health").json()
    assert (health["queued"], health["running"], health["slots"]) == (2, 1, 1)
    assert client.delete(f"/jobs/{second}").json()["state"] == "cancelled"
    assert client.delete(f"/jobs/{first}").json()["state"] == "cancelling"
    wait_for(client, first, "cancelled")
    wait_for(client, third, "running")
    # What has ended is removed.
    assert client.delete(f"/jobs/{second}").status_code == 200
    assert problem(client.get(f"/jobs/{second}"))["code"] == "no_such_job"
    assert problem(client.delete(f"/jobs/{second}"))["code"] == "no_such_job"


def test_a_run_that_does_not_stop_is_killed(client, monkeypatch):
    monkeypatch.setattr(queue, "STOP_GRACE_S", 0.1)
    job = send(client, STUBBORN)
    while client.get(f"/jobs/{job}").json()["progress"] is None:
        pass
    client.delete(f"/jobs/{job}")
    wait_for(client, job, "cancelled")


def test_pages_go_through_all_jobs_newest_first(serving):
    with serving(slots=1) as client:
        jobs = [send(client, SLOW) for _ in range(5)]
        listed, offset = [], 0
        while offset is not None:
            page = client.get("/jobs", params={"limit": 2, "offset": offset}).json()
            assert page["total"] == 5 and len(page["jobs"]) <= 2
            listed += [view["id"] for view in page["jobs"]]
            offset = page["next"]
        assert listed == jobs[::-1]


@pytest.mark.parametrize(
    ("fields", "code"),
    [
        ({"preset": "fast"}, "invalid_value"),
        ({"seed": "-1"}, "invalid_value"),
        ({"fill": "nan"}, "invalid_value"),
        ({"elevation_deg": "inf"}, "invalid_value"),
        ({"skip": ["nerf"]}, "invalid_value"),
        ({"device": "cuda"}, "invalid_value"),
        ({"views": "text"}, "invalid_value"),
        ({"samples": "5"}, "invalid_value"),
    ],
)
def test_values_are_checked(client, fields, code):
    answer = client.post("/jobs", files={"picture": ("x", png())}, data=fields)
    assert answer.status_code == 422 and problem(answer)["code"] == code
    assert next(iter(fields)) in problem(answer)["wanted"]


def test_one_input_is_wanted(client):
    neither = client.post("/jobs", data={"preset": "preview"})
    both = client.post("/jobs", files={"picture": ("x", png()), "views": ("y", b"")})
    for answer in (neither, both):
        assert answer.status_code == 422 and problem(answer)["code"] == "no_input"


@pytest.mark.parametrize(
    "path",
    [
        f"/jobs/{NOBODY}",
        "/jobs/..",
        "/jobs/../../etc/passwd",
        "/jobs/..%2f..%2fetc%2fpasswd",
        f"/jobs/{NOBODY[:-1]}%00",
        f"/jobs/{NOBODY}%0a",
        f"/jobs/{NOBODY}/..%2fjob.json",
        f"/jobs/{NOBODY}/asset.glb/..%2f..%2fjob.json",
        f"/jobs/{NOBODY}/job.json",
        f"/jobs/{NOBODY}/log.txt",
        "/jobs/" + "\u0660" * 32,
        "/jobs/" + "A" * 10_000,
    ],
)
@pytest.mark.parametrize("method", ["GET", "DELETE"])
def test_no_path_of_a_request_reaches_the_disk(client, home, path, method):
    send(client)
    (home / "job.json").write_text("secret")
    answer = client.request(method, path)
    assert answer.status_code in (404, 405, 422), answer.text
    assert "secret" not in answer.text
    problem(answer)


def test_a_broken_form_and_an_unknown_page_are_problems(client):
    broken = client.post(
        "/jobs", content=b"--", headers={"Content-Type": "multipart/form-data; boundary=x"}
    )
    assert problem(broken)["code"] in ("broken_request", "no_input")
    assert problem(client.get("/admin"))["code"] == "no_such_page"
    wrong = client.put("/jobs")
    assert wrong.status_code == 405 and problem(wrong)["code"] == "no_such_method"


def test_a_defect_is_told_to_nobody_but_the_log(client, monkeypatch):
    monkeypatch.setattr(queue.JobQueue, "newest", lambda _: 1 / 0)
    answer = client.get("/jobs")
    assert answer.status_code == 500 and problem(answer)["code"] == "defect"
    assert "ZeroDivision" not in answer.text and "Traceback" not in answer.text


def test_a_full_disk_is_told_and_leaves_nothing(client, home, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device", str(home))

    monkeypatch.setattr(api, "keep_picture", full)
    answer = client.post("/jobs", files={"picture": ("x", png())})
    assert answer.status_code == 507 and problem(answer)["code"] == "disk_full"
    assert not list((home / "incoming").iterdir())


def test_pages_of_other_sites_are_refused(client):
    files = {"picture": ("x", png())}
    other = client.post("/jobs", files=files, headers={"Origin": "https://elsewhere.example"})
    assert other.status_code == 403 and problem(other)["code"] == "other_site"
    own = client.post("/jobs", files=files, headers={"Origin": "http://testserver"})
    assert own.status_code == 202


def test_every_permitted_form_is_a_valid_configuration(client):
    """Bounds of the form lie within those of the settings that its fields stand for."""
    least = {
        "samples": 1,
        "elevation_deg": -59.9,
        "matting": "alpha",
        "fill": 0.2,
        "texture_size": 64,
        "max_faces": 100,
        "skip": ["capacity", "env_preopt", "dmtet", "uv_bake", "preview"],
    }
    most = {
        "samples": 4,
        "elevation_deg": 88.9,
        "matting": "plain",
        "fill": 1.0,
        "texture_size": 4096,
        "max_faces": 100_000,
    }
    assert set(least) == set(JobForm.model_fields) - {"picture", "views", "preset", "seed"}
    for values in (least, most):
        form = JobForm(preset="preview", **values)
        config = load_config(PipelineConfig, form.preset, form.overrides(), form.skip)
        assert config.uv_bake.max_faces == values["max_faces"]
        assert config.generation.elevation_deg == values["elevation_deg"]
        assert config.prepare.matting == values["matting"]


def test_a_job_is_an_ordinary_run(client, monkeypatch, tmp_path):
    from flows import cli, commands
    from flows.service.child import run_command
    from flows.service.records import Record

    asked = []
    monkeypatch.setattr(commands, "run", lambda request: asked.append(request) or 0)
    record = Record(
        id=NOBODY,
        input="photo.png",
        preset="preview",
        seed=7,
        overrides=JobForm(fill=0.5, matting="plain").overrides(),
        skip=("dmtet",),
        created=0.0,
    )
    words = run_command(
        tmp_path / "photo.png",
        tmp_path / "run",
        store=tmp_path / "store",
        device="cpu",
        options=run_options(record),
    )
    assert cli.main(words[words.index("flows.cli") + 1 :]) == 0
    request = asked[0]
    assert request.overrides == ('prepare.matting="plain"', "prepare.fill=0.5")
    assert (request.seed, request.preset, request.skip) == (7, "preview", {"dmtet"})
    assert (request.path, request.out) == (tmp_path / "photo.png", tmp_path / "run")


def test_the_document_describes_every_answer(client):
    document = client.get("/openapi.json").json()
    assert document["info"]["version"] == importlib.metadata.version("svim3d")
    assert "HTTPValidationError" not in document["components"]["schemas"]
    for operations in document["paths"].values():
        for operation in operations.values():
            assert operation["description"] and operation["summary"]
    form = document["components"]["schemas"]["JobForm"]["properties"]
    assert all("description" in field for field in form.values())
    assert client.get("/docs").status_code == 200
