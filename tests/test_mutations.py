"""tests/mutations.py takes ten minutes and runs by hand. Here: whether it still fits the code."""

import mutations
import pytest


@pytest.mark.parametrize("mutation", mutations.MUTATIONS, ids=lambda mutation: mutation.name)
def test_the_line_is_there(mutation):
    for file in mutation.files:
        assert mutation.right in (mutations.ROOT / file).read_text()
