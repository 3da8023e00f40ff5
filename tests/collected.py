"""A key of the stash of pytest, in a file that imports nearly nothing."""

import pytest

# of a session: all tests, before -m or -k deselects any
ALL_ITEMS = pytest.StashKey[list[pytest.Item]]()
