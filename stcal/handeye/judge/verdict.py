"""The verdict on a hand-eye calibration, and the findings that it rests on."""

from dataclasses import dataclass
from typing import Literal, get_args

Word = Literal["good", "use with care", "do not use"]
GOOD, CARE, BAD = get_args(Word)


@dataclass(frozen=True, slots=True)
class Finding:
    """Verdict on one matter.

    Parameters
    ----------
    title : str
        Name of the matter.
    word : {"good", "use with care", "do not use"}
        The verdict.
    said : str
        What was found, in words.
    value, limit : str
        What was measured, and the limit of ``good``; empty where there is none.
    remedy : str
        What to do; empty where nothing has to be done.
    """

    title: str
    word: Word
    said: str
    value: str = ""
    limit: str = ""
    remedy: str = ""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdict on a calibration.

    Parameters
    ----------
    findings : tuple of Finding
        In the order in which they were made.
    """

    findings: tuple[Finding, ...]

    @property
    def word(self) -> Word:
        """The worst word of all findings."""
        return max(self.findings, key=lambda each: get_args(Word).index(each.word)).word

    def reasons(self) -> list[Finding]:
        """Returns the findings behind the word: all that are not good, the worst first; or all if all are good."""
        doubts = [each for each in self.findings if each.word != GOOD]
        return sorted(doubts, key=lambda each: each.word != BAD) or list(self.findings)

    def failed(self) -> list[str]:
        """Returns the reasons against use of the calibration."""
        return [each.said for each in self.findings if each.word == BAD]

    def remedies(self) -> list[str]:
        """Returns what to do against the reasons that forbid to use the calibration, each once."""
        return list(dict.fromkeys(each.remedy for each in self.findings if each.word == BAD and each.remedy))

    def doubt(self) -> str:
        """Returns the sentence of a verdict that is not good; empty for a good one."""
        return "" if self.word == GOOD else f"verdict: {self.sentence()}"

    def sentence(self) -> str:
        """Returns the word and its reasons in one line."""
        return f"{self.word}: {'; '.join(each.said for each in self.reasons())}"
