"""The command of mutants draws from files that are there."""

from tests.mutants import MODULES, ROOT, drawn


def test_every_group_has_mutants_and_tests() -> None:
    assert {group for group, _, _ in drawn(1, len(MODULES))} == set(MODULES)
    assert all((ROOT / test).is_file() for _, tests in MODULES.values() for test in tests)
