"""What `--timeout` means."""

from flows.limits import parse_limits

STAGES = ("nerf", "dmtet", "export")


def test_a_stage_of_its_own_counts_more_than_all_whatever_the_order():
    assert parse_limits([], STAGES) == {}
    for given in (["60", "nerf=600"], ["nerf=600", "60"]):
        assert parse_limits(given, STAGES) == {"nerf": 600.0, "dmtet": 60.0, "export": 60.0}
    assert parse_limits(["nerf=1.5"], STAGES) == {"nerf": 1.5}
