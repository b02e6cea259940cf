"""Result file and text of a cross-check."""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from pydantic import Field

from stcal.io.json import Part, ResultFile
from stcal.report.text import number, text_table
from stcal.sfm.adjust.calibration import Calibration
from stcal.sfm.interop.crosscheck import face_differences
from stcal.sfm.interop.export import FORMS, ExportedRun
from stcal.sfm.interop.export_database import Exported
from stcal.sfm.interop.export_model import ExportedModel
from stcal.sfm.interop.gates import Gate, GateVerdict, PairGates
from stcal.sfm.runs.report import Number, PairRow
from stcal.sfm.runs.saved import SavedRun


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


def database_text(written: Exported) -> str:
    """What is in the copy, and how to open it."""
    return (
        f"schema {written.schema}, checked: {written.images} images, {written.pairs} pairs, "
        f"camera model {', '.join(written.camera_models)}\n"
        f"open it with: colmap gui --database_path {written.path} --image_path IMAGES"
    )


def model_text(written: ExportedModel, kind: str) -> str:
    """What is in the model, and the ideal camera of a format that knows no other."""
    holds = f"{written.images} images and {written.points} points"
    if kind == "ply":
        holds = f"{written.points} points, not the cameras of the {written.images} images, which other formats hold"
    lines = [f"{holds}; mm, target frame: {written.path}", f"labels: {written.labels}"]
    if written.focal_px is not None and written.centre_px is not None:
        x, y = written.centre_px
        lines.append(
            f"{kind} knows one focal length and a principal point at the centre: the keypoints are those of an ideal "
            f"camera without distortion, f = {written.focal_px:.4f} px, principal point ({x:g}, {y:g}) px; undistort "
            "the photographs to it to match"
        )
    return "\n".join(lines)


def export_text(written: ExportedRun) -> str:
    """What is in the file, and what of the run is not."""
    content = written.content
    lines = [
        f"{len(content.faces)} faces and {len(content.circles)} circles, frame {content.root}, as {written.form}: "
        f"{written.path}"
    ]
    if not content.covariances:
        lines.append(f"no σ: the run was solved by {content.run.faces.solve}, which states none; run it with joint")
    if lost := FORMS[written.form].lost:
        lines.append(f"not in it: {lost}")
    return "\n".join([*lines, *written.notes])


def faces_text(calibration: Calibration, run: SavedRun) -> str:
    """Scale of each model, and the faces beside those of the run."""
    lines = [*calibration.notes]
    for each in calibration.models:
        scale = calibration.scales[each.group]
        lines.append(
            f"group {each.group}: {len(each.images)} images, {len(each.labels)} circles, {scale.mm_per_unit:.6g} mm "
            f"per unit, board within {1e3 * scale.rms_mm():.1f} µm RMS"
        )
    difference = face_differences(calibration.target, run)
    rows = [["face", "x", "y", "z", "mm   against the run: µm", "mdeg"]]
    for face_id, pose in calibration.target.target_from_face.items():
        row = difference.get(face_id)
        beside = [number(row.translation_um, 2), number(row.rotation_mdeg, 3)] if row else ["not in the run", ""]
        rows.append([face_id, *(number(x, 4) for x in pose.translation), *beside])
    return "\n".join([*lines, *text_table(rows, least=(6, 11, 11, 11, 24, 8), gap=1)])
