from accord.domain.ids import check_id, new_id


def test_ids_are_unique_and_sort_by_creation():
    ids = [new_id("seg") for _ in range(20_000)]
    assert ids == sorted(ids)
    assert len(set(ids)) == len(ids)
    check_id(ids[-1], "seg")
