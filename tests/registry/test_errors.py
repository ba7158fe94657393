"""Error messages suggest the closest known name."""

import pytest

from registry.errors import did_you_mean


@pytest.mark.parametrize(
    ("wrong", "cutoff", "told"),
    [
        ("kitchn", 0.6, " Did you mean 'kitchen'?"),
        ("kt", 0.6, ""),
        ("kt", 0.4, " Did you mean 'kitchen'?"),  # 2 of 2 and of 7 letters: similarity 4 / 9
        ("garage", 0.6, ""),
        ("", 0.6, ""),
    ],
)
def test_the_nearest_name_is_quoted_and_none_where_none_is_near(wrong, cutoff, told):
    assert did_you_mean(wrong, ["bedroom", "kitchen"], cutoff=cutoff) == told
