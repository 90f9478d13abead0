"""`svim3d view`: what it refuses, and what a viewer on loopback gets to show."""

import importlib.util
import os
import socket
import urllib.request

import pytest
import torch
from made_run import VIEWS, MadeRun
from textured_sphere import sphere_glb

from flows.cli import main
from flows.view import LiveScene, start_server
from stages.artifacts import FittedField, RefinedSurface
from stages.live_scene import mesh_of_field, mesh_of_surface, placed_pictures
from svim3d.fields.material_field import MaterialField, MaterialFieldSpec
from svim3d.fields.sdf_grid import node_positions

SPEC = MaterialFieldSpec(levels=2, log2_entries=8, coarsest=4, finest=8, hidden=8)


def ball(nodes=24):
    """Phase 1's result: a ball of radius 0.4."""
    position = node_positions(nodes, 0.55, like=torch.zeros(()))
    return FittedField(
        sdf=0.4 - position.norm(dim=-1),
        half_extent=0.55,
        material_spec=SPEC,
        material_state=MaterialField(SPEC).state_dict(),
        environment=torch.ones(4, 4, 3),
    )


def test_what_cannot_be_shown_is_refused(tmp_path, capsys, monkeypatch):
    store = str(tmp_path / "store")
    assert main(["view", str(tmp_path / "none.glb"), "--store", store]) == 2
    assert "there is no file" in capsys.readouterr().err
    assert main(["view", "nobody", "--store", store]) == 2
    assert "there is no run nobody" in capsys.readouterr().err
    (tmp_path / "asset.glb").write_bytes(sphere_glb())
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main(["view", str(tmp_path / "asset.glb"), "--store", store]) == 2
    assert "pip install 'svim3d[view]'" in capsys.readouterr().err


def test_cameras_look_at_what_they_show(tmp_path):
    made = MadeRun(tmp_path)
    made.views()
    payload = made.store.artifact(made.stages["generation"].key) / "files"
    placed = list(placed_pictures(payload))
    assert [p.view for p in placed] == list(range(VIEWS))
    for one in placed:
        ahead = one.rotation[:, 2]  # the third axis of a camera that looks along +z
        distance = (one.position @ one.position) ** 0.5
        assert abs(ahead @ one.position + distance) < 1e-4  # straight at the origin
        assert one.rotation[1, 1] < 0.0  # y points down
        middle = one.picture[one.picture.shape[0] // 2, one.picture.shape[1] // 2]
        corner = one.picture[0, 0]
        assert abs(int(corner[0]) - 28) <= 1 and middle.max() > 60


def test_surfaces_of_both_phases_are_balls(tmp_path):
    ball().save(tmp_path)
    first = mesh_of_field(tmp_path)
    own = ball().own_surface()
    RefinedSurface(**vars(own)).save(tmp_path)
    for mesh in (first, mesh_of_surface(tmp_path)):
        radius = (mesh.vertices**2).sum(1) ** 0.5
        assert len(mesh.faces) > 500 and abs(radius - 0.4).max() < 0.01


@pytest.fixture
def server():
    pytest.importorskip("viser", reason="needs svim3d[view]")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    server = start_server("127.0.0.1", port)
    yield server
    server.stop()


def names(server):
    """What is in the scene."""
    return sorted(server.scene._handle_from_node_name)


def test_a_run_is_shown_as_it_goes_on(server, tmp_path):
    made = MadeRun(tmp_path)
    made.views()
    record = made.record("running", "nerf")
    scene = LiveScene(server)
    scene.show_run(record, made.store)
    assert sum(name.startswith("/views/") for name in names(server)) == VIEWS
    assert "/phase 1" not in names(server)
    made.publish("nerf", ball().save)
    made.publish("export", lambda folder: (folder / "asset.glb").write_bytes(sphere_glb()))
    scene.show_run(made.record(), made.store)
    assert {"/phase 1", "/asset"} <= set(names(server))
    # The asset has come in front of the surface.
    handles = server.scene._handle_from_node_name
    assert handles["/asset"].visible and not handles["/phase 1"].visible
    assert "done" in scene._said
    address = f"http://127.0.0.1:{server.get_port()}"
    with urllib.request.urlopen(address) as answer:
        assert answer.status == 200 and b"<html" in answer.read()


def test_a_file_is_shown_anew_when_it_changes(server, tmp_path):
    file = tmp_path / "asset.glb"
    file.write_bytes(sphere_glb())
    scene = LiveScene(server)
    scene.show_file(file)
    first = server.scene._handle_from_node_name["/asset"]
    scene.show_file(file)
    assert server.scene._handle_from_node_name["/asset"] is first
    file.write_bytes(sphere_glb(texture=0))
    os.utime(file, ns=(1, 1))
    scene.show_file(file)
    assert server.scene._handle_from_node_name["/asset"] is not first
    file.unlink()
    scene.show_file(file)  # gone for a moment: what is shown stays
    assert "/asset" in names(server)
