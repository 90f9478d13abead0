"""Material field: ranges, bump's start, learning values at the ends of a range."""

import dataclasses
import json

import torch

from svim3d.fields.material_field import MaterialField, MaterialFieldSpec

SPEC = MaterialFieldSpec(levels=3, log2_entries=10, coarsest=4, finest=16, hidden=16)


def make_field(seed=0):
    field = MaterialField(SPEC)
    field.reset(torch.Generator().manual_seed(seed))
    return field


def test_values_lie_in_their_ranges_and_bump_starts_at_zero():
    field = make_field()
    with torch.no_grad():
        field.encoding.table.mul_(1e6)  # far from any start
    with torch.no_grad():
        materials = field(torch.rand(200, 3) * 2.0 - 1.0)
    for value in (materials.basecolor, materials.roughness, materials.metallic):
        assert float(value.min()) >= 0.0 and float(value.max()) <= 1.0
    assert torch.count_nonzero(materials.bump) == 0


def test_spec_survives_json():
    assert MaterialFieldSpec(**json.loads(json.dumps(dataclasses.asdict(SPEC)))) == SPEC


def test_state_restores_the_field():
    field, twin = make_field(), MaterialField(SPEC)
    twin.load_state_dict(field.state_dict())
    points = torch.rand(50, 3) - 0.5
    assert torch.equal(field(points).basecolor, twin(points).basecolor)


def test_a_saturated_channel_can_still_be_left():
    field = make_field()
    with torch.no_grad():
        field.network.second.bias[4] = 4.0  # metallic far beyond 1
    materials = field(torch.zeros(8, 3))
    assert bool((materials.metallic == 1.0).all())
    (inward,) = torch.autograd.grad(materials.metallic.sum(), field.network.second.bias)
    assert float(inward[4]) == 8.0
    outward = -field(torch.zeros(8, 3)).metallic.sum()
    assert float(torch.autograd.grad(outward, field.network.second.bias)[0][4]) == 0.0
