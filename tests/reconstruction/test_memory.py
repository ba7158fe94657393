"""Memory that stages have freed goes back to the operating system."""

import platform

import numpy as np
import psutil
import pytest

from reconstruction.core.memory import return_free_memory


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries keep little")
def test_what_was_freed_below_a_kept_block_is_returned():
    blocks = [np.ones(12_000) for _ in range(2_000)]  # 190 MB, each below the size that glibc maps apart
    kept = blocks[-1]
    del blocks
    before = psutil.Process().memory_info().rss
    return_free_memory()
    assert before - psutil.Process().memory_info().rss > 100e6
    assert kept[0] == 1
