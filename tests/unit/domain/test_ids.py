from accord.domain.ids import check_id, new_id


def test_ids_sort_by_the_order_they_were_made_in():
    made = [new_id("seg") for _ in range(20_000)]
    assert made == sorted(made)
    assert len(set(made)) == len(made)
    check_id(made[-1], "seg")
