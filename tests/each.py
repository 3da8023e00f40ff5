"""One test for all rows of a long table: to start thousands of short tests would take a minute."""

from collections.abc import Iterable
from typing import Any


def for_each(rows: Iterable[Any]) -> Any:
    """Make a test of a row one test of all rows, which reports each row that fails."""

    def decorate(check: Any) -> Any:
        def test() -> None:
            failures = []
            for row in rows:
                try:
                    check(row)
                except AssertionError as error:
                    failures.append(f"{row}: {error}")
            assert not failures, "\n".join(failures)

        test.__name__ = check.__name__
        test.__doc__ = check.__doc__
        return test

    return decorate
