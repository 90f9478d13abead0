import pytest
import torch

from svim3d.mesh.topology import Topology
from svim3d.shading.prefilter import PyramidOperator
from svim3d.synthesis.hazards.catalogue import HAZARDS
from svim3d.synthesis.hazards.faults import VARIANTS
from svim3d.synthesis.hazards.torture import FACES, KINDS, torture_mesh
from svim3d.synthesis.hazards.trials import Darkroom


@pytest.fixture(scope="module")
def room():
    return Darkroom(PyramidOperator.build(16), size=24, views=5)


ON_VIEWS = [n for n, h in HAZARDS.items() if h.measured == "asset" and n != "numeric"]
ONE_OF_EACH_KIND = [v for v in VARIANTS if v.endswith(" huge")]


def differing(one, other):
    """Images of which some view is not the same."""
    if one.cameras.c2w.shape != other.cameras.c2w.shape:
        return set(one.images)
    return {n for n, i in one.images.items() if not torch.equal(i, other.images[n])}


@pytest.mark.parametrize("name", ON_VIEWS)
def test_severity_changes_what_is_given_and_a_seed_tells_it_all(room, name):
    hazard = HAZARDS[name]
    variant = hazard.variants[0]
    harmless = hazard.make(room, hazard.severities[0], 3, variant)
    worst = hazard.make(room, hazard.severities[-1], 3, variant)
    again = hazard.make(room, hazard.severities[-1], 3, variant)
    assert differing(harmless, worst)
    assert not differing(worst, again)
    for trial in (harmless, worst):
        assert all(bool(torch.isfinite(image).all()) for image in trial.images.values())
        assert bool((trial.truth.images["mask"] > 0.5).any())


@pytest.mark.parametrize("name", ["outlier", "clipped", "soft-mask"])
def test_the_truth_does_not_know_of_the_hazard(room, name):
    hazard = HAZARDS[name]
    harmless, worst = (hazard.make(room, s, 1, "") for s in (0.0, hazard.severities[-1]))
    assert torch.equal(harmless.truth.relit, worst.truth.relit)
    for image, same in zip(
        harmless.truth.images.values(), worst.truth.images.values(), strict=True
    ):
        assert torch.equal(image, same)


@pytest.mark.parametrize("variant", [*ONE_OF_EACH_KIND, "radiance nan", "normal_world zero"])
def test_a_numeric_fault_is_in_one_kind_of_tensor(room, variant):
    hazard = HAZARDS["numeric"]
    sound, spoilt = (hazard.make(room, severity, 0, variant) for severity in (0.0, 2.0))
    name = variant.partition(" ")[0]
    same_poses = torch.equal(sound.cameras.c2w, spoilt.cameras.c2w)
    assert same_poses == (name != "camera")
    if name == "light":
        assert not torch.equal(sound.light, spoilt.light)
    changed = differing(sound, spoilt)
    assert changed == (set() if name in ("light", "camera") else {name})


def test_an_object_turned_off_its_pose_keeps_its_normals_in_the_world(room):
    trial = HAZARDS["outlier"].make(room, 1.0, 0, "")
    normal, mask = trial.images["normal_world"], trial.images["mask"]
    view = len(trial.cameras) // 3
    facing = -trial.cameras.rays(view)[1].view_as(normal[view])
    # As seen: what is visible faces the camera that claims to have seen it.
    cosine = (normal[view] * facing).sum(-1)[mask[view][..., 0] > 0.99]
    assert float((cosine > -0.05).float().mean()) > 0.98


@pytest.mark.parametrize("kind", KINDS)
def test_torture_meshes_are_as_bad_as_they_say(kind):
    vertices, faces = torture_mesh(kind, 1.0, 0)
    assert len(faces) == pytest.approx(FACES[1], rel=0.1)
    corners = vertices[faces.long()]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(
        dim=1
    )
    topology = Topology.of(vertices, faces)
    if kind == "zero-area":
        assert float((area < 1e-7).float().mean()) == pytest.approx(0.3, abs=0.05)
    elif kind == "non-manifold":
        assert topology.open_edges > 0
    else:
        assert topology.is_closed
        longest = (corners - corners.roll(1, 1)).norm(dim=2).amax(1)
        if kind == "sliver-fan":
            assert float((longest.square() / area).min()) > 100.0
