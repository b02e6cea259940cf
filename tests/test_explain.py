"""One loop tries what may be mistaken: the smaller change first, several if they cannot be told apart."""

from stcal.errors import DegenerateError
from stcal.explain import Candidate, explain


def candidates(*sizes: tuple[float, float]) -> list[Candidate]:
    return [Candidate(f"{misfit}", lambda misfit=misfit: misfit, size) for misfit, size in sizes]


def words(found) -> list[str]:
    return [each.words for each, _ in found]


def test_the_smaller_change_is_named_though_a_larger_one_fits_better():
    assert words(explain(candidates((5, 0), (0.9, 1), (0.1, 2)), lambda misfit: misfit, 1)) == ["0.9"]


def test_changes_that_explain_alike_are_all_named_the_best_first():
    assert words(explain(candidates((0.92, 0), (0.9, 0), (0.99, 0)), lambda misfit: misfit, 1)) == ["0.9", "0.92"]


def test_nothing_is_named_where_nothing_fits_or_gives_a_solution():
    def fit(_):
        raise DegenerateError("E-TEST", "no solution")

    assert explain(candidates((0.1, 0)), fit, 1) == []
    assert explain(candidates((1.1, 0)), lambda misfit: misfit, 1) == []
