"""Form of the file that ``doctor`` writes with ``--json``."""

from typing import Annotated, Literal

from pydantic import Field

from stcal.io.json import Part, ResultFile
from stcal.sfm.diagnose.findings import Diagnosis, Finding, GateCount, by_gate

ByGate = Annotated[str, "gate"]


class Counts(Part):
    files: int
    images: int
    mapped: int
    circles: int


class DoctorFile(ResultFile):
    """The JSON file of ``doctor``."""

    format: Literal["stcal doctor 1"] = Field(description="the file's form and its version")
    summary: Counts = Field(
        description="`files` given, `images` of them that could be used, `mapped` images, `circles` observed in the "
        "model"
    )
    gates: dict[ByGate, GateCount] = Field(
        description="`circles` and `images` that it stopped, `by_option` circles that an option lets in"
    )
    findings: tuple[Finding, ...] = Field(
        description="in the order of the table: `image`, empty for the whole run; `labels`, none for a whole file or "
        "image; `gate`, `value`, `limit`, `unit`, null without a number; `remedy`, what to do with the scene; "
        "`options`, each of which lets it in: detection was run with it on this image, for `views` on those of the "
        "group that lack circles. `EllipseOptions(…)` is an option of Python, `RunOptions(ellipses=…)`"
    )

    @classmethod
    def of(cls, diagnosis: Diagnosis) -> "DoctorFile":
        """Returns the file of a diagnosis."""
        return cls(
            format="stcal doctor 1",
            summary=Counts.model_validate(diagnosis),
            gates=by_gate(diagnosis.findings),
            findings=diagnosis.findings,
        )
