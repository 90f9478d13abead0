"""Signed distances on grids against the exact sphere; hidden parts."""

import torch

from svim3d.fields.distance import redistance, signed_distance, without_hidden_parts
from svim3d.fields.sdf_grid import node_positions

NODES, HALF_EXTENT, RADIUS = 48, 0.55, 0.35
CELL = 2 * HALF_EXTENT / (NODES - 1)


def sphere(radius=RADIUS, centre=(0.0, 0.0, 0.0)):
    offset = node_positions(NODES, HALF_EXTENT, like=torch.zeros(1)) - torch.tensor(centre)
    return radius - offset.norm(dim=-1)


def test_distance_of_a_node_set_is_right_to_half_a_cell():
    exact = sphere()
    got = signed_distance(exact > 0, HALF_EXTENT, smoothing_cells=0.5)
    near = exact.abs() < 0.15
    assert float((got - exact)[near].abs().max()) < 0.75 * CELL
    assert abs(float((got - exact)[near].mean())) < 0.1 * CELL


def test_redistance_keeps_the_zero_and_mends_the_gradient():
    exact = sphere()
    got = redistance(torch.tanh(8.0 * exact) * (1.5 + exact), HALF_EXTENT)
    assert torch.equal(got > 0, exact > 0)
    near = exact.abs() < CELL
    assert float((got - exact)[near].abs().max()) < 0.1 * CELL
    assert float((got - exact).abs().max()) < 1.0 * CELL


def test_voids_are_filled_and_specks_dropped_but_parts_stay():
    shell = torch.minimum(sphere(), -sphere(0.15))
    part = sphere(0.1, (0.44, 0.44, 0.44))
    speck = sphere(0.02, (-0.45, 0.45, -0.45))
    solid = without_hidden_parts(
        torch.maximum(torch.maximum(shell, part), speck), smallest_share=1e-3
    )
    assert torch.equal(solid > 0, (sphere() > 0) | (part > 0))


def test_empty_grid_stays_empty():
    empty = torch.full((8, 8, 8), -1.0)
    assert torch.equal(without_hidden_parts(empty, smallest_share=0.1), empty)
    assert bool((signed_distance(empty > 0, HALF_EXTENT) < 0).all())
