import platform
import resource

import pytest
import torch

from mapt.device import freed_memory_kept


def page_faults_of_allocation() -> int:
    """Pages that the system provides for 100 MB in blocks of activations' size."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    blocks = [torch.ones(2_500_000) for _ in range(10)]
    del blocks
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs the GNU C library")
def test_freed_memory_is_reused_within_the_context_and_returned_at_its_end():
    with freed_memory_kept():
        first, second = page_faults_of_allocation(), page_faults_of_allocation()
    after = page_faults_of_allocation()
    assert second < 0.3 * min(first, after)
