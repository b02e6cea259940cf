"""What ``pairs`` writes with ``--json``; angles in degrees."""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from pydantic import Field

from stcal.io.json import Part, ResultFile
from stcal.sfm.interop.gates import Gate, GateVerdict, PairGates
from stcal.sfm.runs.report import Number, PairRow


class GateRow(Part):
    gate: str
    value: Number | str
    limit: Number | None
    passed: bool


class GatesRow(Part):
    relaxations: int | None
    gates: list[GateRow]


class RankedPair(PairRow):
    ranking: list[GateRow] = Field(
        description="our own gates: `labels`, `min_angle_deg`, `in_front`, `max_angle_deg`; only the first where it "
        "fails: `gate`, `value`, `limit`, `passed`"
    )
    as_set: GatesRow = Field(
        description="COLMAP with the options of `run`. `relaxations`: 0: the pair passes; n: after COLMAP has halved "
        "limits n times, in turn that of the inliers and that of the angle, which it does up to twice each while "
        "images stay out; null: never. `gates`: `gate`, `value`, `limit`, `passed`, at the limits not yet relaxed"
    )
    defaults: GatesRow = Field(
        description="COLMAP with its own options: `relaxations` and `gates` with `gate`, `value`, `limit`, `passed`"
    )


class GroupOfPairs(Part):
    name: str
    pairs: list[RankedPair] = Field(
        description="as in `report.json`: `first`, `second`, `shared`, `median_angle_deg`, `in_front`, `forward`, "
        "`verdict`; with"
    )


class PairsFile(ResultFile):
    """Of ``pairs``."""

    format: Literal["stcal pairs 1"] = Field(description="the file's form and its version")
    groups: list[GroupOfPairs] = Field(description="`name` of the group, and its pairs")

    @classmethod
    def of(cls, groups: Mapping[str, Sequence[PairGates]]) -> "PairsFile":
        """The file of the ranked pairs by group."""
        rows = [GroupOfPairs(name=name, pairs=[_pair(each) for each in own]) for name, own in groups.items()]
        return cls(format="stcal pairs 1", groups=rows)


def _pair(row: PairGates) -> RankedPair:
    score = row.score
    return RankedPair(
        first=score.first,
        second=score.second,
        shared=score.shared,
        median_angle_deg=_degrees(score.median_angle_rad),
        in_front=score.in_front,
        forward=score.forward,
        verdict=score.verdict,
        ranking=[_gate(gate) for gate in row.own],
        as_set=_gates(row.as_set),
        defaults=_gates(row.defaults),
    )


def _gates(verdict: GateVerdict) -> GatesRow:
    return GatesRow(relaxations=verdict.relaxations, gates=[_gate(gate) for gate in verdict.gates])


def _gate(gate: Gate) -> GateRow:
    if not gate.name.endswith("angle") or isinstance(gate.value, str) or gate.limit is None:
        return GateRow(gate=gate.name, value=gate.value, limit=gate.limit, passed=gate.passed)
    value, limit = _degrees(gate.value), _degrees(gate.limit)
    return GateRow(gate=f"{gate.name}_deg", value=value, limit=limit, passed=gate.passed)


def _degrees(angle_rad: float) -> float:
    """Without the last digits of the conversion, so that a limit reads as it was given."""
    return round(float(np.degrees(angle_rad)), 9)
