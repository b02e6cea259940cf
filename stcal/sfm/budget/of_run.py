"""The uncertainty budget of a run with its length tests, as ``budget`` makes it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from stcal.errors import InputError
from stcal.geometry.arrays import Brief, require_arguments
from stcal.report.document import Document
from stcal.sfm.budget.combine import Budget, budget_of_run
from stcal.sfm.budget.file import BudgetFile, refusals
from stcal.sfm.budget.lengths import LengthTest, against_run, against_stated, common_views
from stcal.sfm.budget.page import budget_report
from stcal.sfm.budget.sources import statement_of
from stcal.sfm.runs.saved import AnyRun, saved_run
from stcal.sfm.runs.verify import verify


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class UncertaintyBudget(Brief):
    """The budget of a run.

    ``budget`` : sources, and the covariance of each measurand by source; ``tests`` : length tests; ``file`` : all of
    it as the JSON file has it; ``refusals`` : why it must not be used, empty if it may.
    """

    budget: Budget
    tests: tuple[LengthTest, ...]
    file: BudgetFile
    refusals: tuple[str, ...]

    def document(self) -> Document:
        """Returns the report, for terminal (``.text()``) and page (``.page()``)."""
        return budget_report(self.file)


@require_arguments
def uncertainty_budget(
    run: AnyRun,
    statement: str | Path | None = None,
    fields: Mapping[str, str] | None = None,
    check_lengths: str | Path | None = None,
    lengths: AnyRun | None = None,
    lengths_statement: str | Path | None = None,
) -> UncertaintyBudget:
    """Returns the uncertainty budget of faces and of the longest distances of a run (GUM), each contribution apart.

    Parameters
    ----------
    run : str, Path, SavedRun or RunResult
        The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    statement : str or Path, optional
        File with temperatures, expansion, the σ of the board's pitch and fields of the head (TOML).
    fields : dict of str, optional
        Fields of the head by name, such as ``{"operator": "A. Smith"}``; they override those of ``statement``.
    check_lengths : str or Path, optional
        File of lengths with which distances between circles are compared (CSV: from, to, length_mm, sigma_mm).
    lengths : str, Path, SavedRun or RunResult, optional
        A second calibration of the target, with which the longest distances are compared.
    lengths_statement : str or Path, optional
        What is stated of that run; ``statement`` if None.

    Returns
    -------
    UncertaintyBudget
        ``file`` has every figure with its unit; ``refusals`` say why the budget must not be used.

    Raises
    ------
    InputError
        The run states no covariance or is damaged, a file is not of the required form, or an argument comes without the
        one that it belongs to.
    """
    if lengths_statement is not None and lengths is None:
        raise InputError(
            "E-OPTION-NEEDS",
            f"--lengths-statement {lengths_statement}: it is for a second calibration; give it with --lengths",
        )
    saved = saved_run(run)
    stated = statement_of(saved.board_design.stated, _path(statement), fields)
    budget, tests, others = budget_of_run(saved, stated), [], []
    if check_lengths is not None:
        tests.append(against_stated(budget, Path(check_lengths)))
    if lengths is not None:
        second = saved_run(lengths)
        others.append(second)
        other = budget_of_run(second, statement_of(second.board_design.stated, _path(lengths_statement or statement)))
        test = against_run(budget, other, second.folder, (saved.board_design, second.board_design))
        tests.append(replace(test, notes=common_views(saved.observations, second.observations) + test.notes))
    file = BudgetFile.of(budget, saved, verify(saved), tests, *others)
    return UncertaintyBudget(budget, tuple(tests), file, tuple(refusals([saved, *others], file.length_tests)))


def _path(path: str | Path | None) -> Path | None:
    return None if path is None else Path(path)
