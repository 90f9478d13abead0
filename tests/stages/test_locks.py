"""A lock has one holder or many in common, and is free when they are gone."""

from stages.locks import file_lock, is_locked


def test_one_holder_keeps_all_others_out(tmp_path):
    file = tmp_path / "new" / "lock"
    with file_lock(file) as first, file_lock(file) as second, file_lock(file, shared=True) as third:
        assert (first, second, third) == (True, False, False)
        assert is_locked(file)
    with file_lock(file) as again:
        assert again


def test_many_hold_it_in_common_and_keep_out_who_wants_it_alone(tmp_path):
    file = tmp_path / "lock"
    with (
        file_lock(file, shared=True) as first,
        file_lock(file, shared=True) as second,
        file_lock(file) as alone,
    ):
        assert (first, second, alone) == (True, True, False)


def test_fault_inside_frees_it_and_is_not_mistaken_for_a_held_lock(tmp_path):
    file = tmp_path / "lock"
    try:
        with file_lock(file):
            raise BlockingIOError("of somebody else")
    except BlockingIOError as error:
        assert "somebody" in str(error)
    assert not is_locked(file)


def test_looking_for_a_lock_makes_no_file(tmp_path):
    assert not is_locked(tmp_path / "lock")
    assert not (tmp_path / "lock").exists()
