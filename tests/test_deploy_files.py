"""Recipes for containers and services: they name what there is."""

import re
from pathlib import Path

import yaml

PROJECT = Path(__file__).resolve().parents[1]
DEPLOY = PROJECT / "deploy"
POOL = yaml.safe_load((PROJECT / "prefect.yaml").read_text())["definitions"]["work_pool"]["name"]


def test_image_copies_what_there_is_and_the_context_holds_it():
    lines = (DEPLOY / "Dockerfile").read_text().splitlines()
    copied = [name for line in lines if line.startswith("COPY") for name in line.split()[1:-1]]
    kept = re.findall(r"^!(.+)$", (PROJECT / ".dockerignore").read_text(), re.MULTILINE)
    assert sorted(copied) == sorted(kept)
    assert all((PROJECT / name).exists() for name in copied)
    assert {"flows", "stages", "svim3d", "configs"} <= set(copied)


def test_cluster_runs_one_worker_of_the_pool_on_its_own_volume():
    claim, worker = yaml.safe_load_all((DEPLOY / "kubernetes" / "worker.yaml").read_text())
    assert worker["spec"]["replicas"] == 1
    pod = worker["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    assert container["args"][:5] == ["prefect", "worker", "start", "--pool", POOL]
    (volume,) = pod["volumes"]
    assert volume["persistentVolumeClaim"]["claimName"] == claim["metadata"]["name"]
    assert container["volumeMounts"][0]["name"] == volume["name"]
    labels = worker["spec"]["template"]["metadata"]["labels"]
    assert worker["spec"]["selector"]["matchLabels"] == labels


def test_service_starts_a_worker_of_the_pool():
    unit = (DEPLOY / "systemd" / "svim3d-worker@.service").read_text()
    (start,) = re.findall(r"^ExecStart=(.+)$", unit, re.MULTILINE)
    assert f"prefect worker start --pool {POOL} " in start
