"""What a check is: its verdict, its title, what does not hold where it fails, and in which order to read several."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from stcal.geometry.arrays import Brief, require_fields

Verdict = Literal["passed", "suspicious", "failed", "not possible"]
ORDER: tuple[Verdict, ...] = ("failed", "suspicious", "passed", "not possible")
NOT_APPLICABLE = "not applicable"  # as checks of circles where the photographs show tags
SUSPICIOUS = 1e-3  # limit of the probability that, among all values of a check, one is as large by chance
FAILED = 1e-5
BY_CHANCE = f"a check is suspicious by chance in one run in {1 / SUSPICIOUS:,.0f}, failed in one in {1 / FAILED:,.0f}"
CAUSE = "cause"  # key of the check that names what all images have in common and makes others fail
OF_WHOLE_SET = "Cause of the whole set: "  # how the title of that check begins, before the cause
EVERY_SIGMA, DISTANCES = "every σ", "all distances and the size"
PLACES, CENTRES = "the places of all faces", "all centres of circles"
ODD_CENTRES = "the centres of the circles whose radius stands out"
BENT_FACES = "the frames of the faces with circles off their plane"
CHECKS: dict[str, tuple[str, tuple[str, ...]]] = {
    CAUSE: (OF_WHOLE_SET, (PLACES, DISTANCES, EVERY_SIGMA)),
    "camera": ("Intrinsics against the images", (PLACES, DISTANCES, EVERY_SIGMA)),
    "residual-field": ("Residuals over the image", (PLACES, DISTANCES, EVERY_SIGMA)),
    "centres": ("Residuals against the centres' own σ", (EVERY_SIGMA,)),
    "agreement": ("Groups, board and faces against one another", (PLACES, EVERY_SIGMA)),
    "halves": ("Two halves of the images against each other", (PLACES, EVERY_SIGMA)),
    "groups": ("The result without each group", (PLACES, EVERY_SIGMA)),
    "loops": ("Ways to a face through different groups", (PLACES, EVERY_SIGMA)),
    "moved": ("Target against board, image by image", (PLACES, EVERY_SIGMA)),
    "image-residuals": ("Residuals of each image against its group", (PLACES, EVERY_SIGMA)),
    "sharpness": ("Sharpness of each image against its group", ()),
    "evenness": ("Brightness within the circles", ()),
    "labels": ("Each centre against all others", (PLACES, EVERY_SIGMA)),
    "board": ("Board against its stated σ", (DISTANCES, EVERY_SIGMA)),
    "board-lines": ("Scale of each row and column of the board against the rest", (DISTANCES, EVERY_SIGMA)),
    "pitch": ("Scale of the board against the target's design", (DISTANCES,)),
    "radius": ("Radius of each circle against others of its design radius", (ODD_CENTRES, EVERY_SIGMA)),
    "radius-design": ("Radii against the design", (CENTRES, PLACES)),
    "rim": ("Rim in front of the circles", ()),
    "flatness": ("Each point against the plane of its face", (BENT_FACES, EVERY_SIGMA)),
    "control": ("Uncorrected control", (CENTRES, PLACES)),
    "scales": ("Scales against one another", (PLACES, DISTANCES, EVERY_SIGMA)),
}
"""Title of each check, and what does not hold where it has failed: nothing of those that are suspicious at worst."""
GENERAL = ("centres", "agreement", "halves")
"""Keys of the checks that show that something is wrong, but not what. Other checks are named before them."""
IN_ONE_GROUP = ("board", "board-lines", "flatness", "control", "camera", "residual-field", "moved", "image-residuals")
"""Keys of the checks that test each group by itself, and need no agreement of groups."""
EXPLAINED_BY = {"radius-design": ("rim",), "groups": IN_ONE_GROUP, "loops": IN_ONE_GROUP}
"""Checks that fail because of what others found; those are said before them. A fault within a group makes it contradict
the others, but groups that contradict one another make no fault within one of them."""


@dataclass(frozen=True, slots=True)
class TestedValue:
    """One tested value."""

    name: str  # image, label, face, group, row …
    value: float
    limit: float | None  # in ``unit``; beyond it the value is suspicious
    unit: str
    probability: float | None  # of as much or more by chance, None if the value is not tested

    def words(self) -> str:
        """Returns value and limit as text."""
        return ", limit ".join(filter(None, self.texts()))

    def texts(self) -> list[str]:
        """Returns the value with its unit, and the limit, to three digits, large ones without an exponent."""
        value, limit = (
            "" if each is None else f"{float(f'{each:.3g}'):.0f}" if abs(each) >= 999.5 else f"{each:.3g}"
            for each in (self.value, self.limit)
        )
        return [f"{value} {self.unit}".strip(), limit]


@dataclass(frozen=True, slots=True, repr=False)
class Check(Brief):
    """Result of a check.

    Parameters
    ----------
    key : Short name by which files and programs know the check.
    title : Its name for people.
    verdict : A failed check makes the answer of the run "no".
    reason : The verdict in words.
    measured : Values, the worst first.
    tested : Number of values tested.
    names : Names of the values beyond their limits, the worst first.
    remedy : What to do about it; empty if there is nothing to do.
    enlarges : float
        Factor on the σ of the result by which they cover what the check found; 1 if it found nothing, or too much.
    """

    key: str
    title: str
    verdict: Verdict
    reason: str
    measured: tuple[TestedValue, ...]
    tested: int
    names: tuple[str, ...]
    remedy: str
    enlarges: float = 1.0

    def __post_init__(self):
        require_fields(self, f"check {self.key}", tested=0)

    @classmethod
    def read(cls, row: dict) -> "Check":
        """Returns the check of a row of ``report.json``."""
        measured = tuple(TestedValue(**value) for value in row["measured"])
        return cls(**row | {"measured": measured, "names": tuple(row["names"])})

    def told(self) -> str:
        """Returns the verdict; :data:`NOT_APPLICABLE` if nobody can make the check possible."""
        return NOT_APPLICABLE if self.verdict == "not possible" and not self.remedy else self.verdict

    @property
    def cause(self) -> str:
        """The name of the cause of the whole set."""
        return self.title.removeprefix(OF_WHOLE_SET)


def impossible(key: str, reason: str, remedy: str) -> Check:
    """Returns the result of a check that this run cannot make; ``remedy`` is empty if none could."""
    return Check(key, CHECKS[key][0], "not possible", reason, (), 0, (), remedy)


def ranked(checks: Sequence[Check], images: Collection[str]) -> list[Check]:
    """Returns the checks in the order in which to read them: the worst first, and of equal verdicts the cause of the
    whole set, then those that name an image, last those that cannot name the cause."""
    keys = {verdict: {check.key for check in checks if check.verdict == verdict} for verdict in ORDER}

    def place(check: Check) -> tuple:
        is_later = check.key in GENERAL or not keys[check.verdict].isdisjoint(EXPLAINED_BY.get(check.key, ()))
        return ORDER.index(check.verdict), check.key != CAUSE, set(images).isdisjoint(check.names), is_later

    return sorted(checks, key=place)


def count_verdicts(checks: Iterable[Check]) -> str:
    """Number of checks by verdict, the worst first; the cause that all photographs have in common is none."""
    told = [check.told() for check in checks if check.key != CAUSE]
    return ", ".join(f"{told.count(v)} {v}" for v in (*ORDER, NOT_APPLICABLE) if v in told) or "none"


def invalidated(failed: Iterable[str]) -> list[str]:
    """Returns what failed checks, by their keys, do not let hold, each once; of a caller's own check, every σ."""
    return list(dict.fromkeys(what for key in failed for what in CHECKS.get(key, ("", (EVERY_SIGMA,)))[1]))
