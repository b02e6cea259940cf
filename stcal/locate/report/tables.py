"""Results of ``locate run`` as text and CSV."""

import csv
import io
from collections.abc import Sequence

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.geometry.uncertain import UncertainRigid
from stcal.io.table import COVARIANCE, POSE, pose_cells
from stcal.locate.pipeline import Located
from stcal.locate.pose.patent import ASSUMED
from stcal.locate.report.chain import GoalChain
from stcal.report.text import NONE, number, text_table

BASE = "base_from_goal_"


def run_text(results: Sequence[Located], chain: GoalChain | None = None) -> str:
    """Returns the results as text: a line for each scene, with reasons below scenes that are not accepted.

    With ``chain``, the poses of the target in the robot's base follow.
    """
    width = max([5, *(len(scene.name) for scene in results)])
    head = f"{'scene':<{width}}  verdict    tags  exposures      x_mm      y_mm      z_mm  sigma_mm  sigma_deg   rms_px"
    lines = [head]
    for scene in results:
        exposures = len(scene.tags.readable())
        tags = len(scene.merged.seen) if scene.merged else 0
        start = f"{scene.name:<{width}}  {scene.verdict.decision:<9}  {tags:4d}  {exposures:9d}"
        pose = camera_from_obj(scene)
        if pose is not None:
            start += "".join(f"{v:10.2f}" for v in pose.translation)
        if scene.pose is not None:
            sigma = scene.pose.sigma_mm(), np.degrees(scene.pose.sigma_rad()), scene.pose.rms_px()
            start += "{:10.3f}{:11.4f}{:9.3f}".format(*sigma)
        lines += [start, *(f"{'':<{width}}    {reason}" for reason in (*scene.verdict.reasons, *scene.notes))]
        if scene.patent is not None:
            lines += [f"    {line}" for line in text_table(patent_cells(scene))]
            lines += [f"    gates: {gates_text(scene)}"]
    if chain and accepted(results):
        lines += ["", f"{'base_from_goal':<{width + 22}}      x_mm      y_mm      z_mm  rotation vector, deg"]
        for scene in accepted(results):
            goal = chain.base_from_goal(scene.name, uncertain(scene)).rigid
            turn = np.degrees(goal.log()[:3])
            place = "".join(f"{v:10.2f}" for v in goal.translation)
            lines.append(f"{scene.name:<{width + 22}}{place}" + "".join(f"{v:10.3f}" for v in turn))
    if any(scene.patent is not None for scene in results):
        lines += ["", f"patent: {ASSUMED}"]
    return "\n".join(lines)


def patent_cells(each: Located) -> list[list[str]]:
    """Returns heads, and one row per exposure: its result by the rules of the patent."""
    rows = [["<exposure", "<", "tags", "area px²", "error px", "of the other", "det J 1/mm²"]]
    if each.patent is None:
        return rows
    for name, result in zip((e.name for e in each.tags.readable()), each.patent.exposures, strict=True):
        state = "kept" if result.exposure == each.patent.exposure else "candidate" if result.candidate else "left out"
        errors = result.errors_px or (None, None)
        det_j = NONE if result.det_j is None else f"{result.det_j:.3g}"
        rows.append([name, state, str(result.tags), number(result.area_px2, 0), *(number(e, 3) for e in errors), det_j])
    return rows


def gates_text(each: Located) -> str:
    """Returns every gate with its value and limit, in words."""
    gates = [
        f"{check.name} {check.value:.4g}{check.unit} {'≥' if check.at_least is not None else '≤'} "
        f"{check.at_least if check.at_least is not None else check.at_most:.4g}{'' if check.passed else ' failed'}"
        for check in each.verdict.checks
    ]
    if each.patent is not None and each.patent.same:
        gates.append("both poses are one, no ratio")
    return "; ".join(gates)


def camera_from_obj(each: Located) -> Rigid | None:
    """Returns camera_from_obj by the method that was asked for, or None."""
    if each.patent is not None:
        return each.patent.camera_from_obj
    return None if each.pose is None else each.pose.camera_from_obj


def uncertain(each: Located) -> UncertainRigid:
    """Returns camera_from_obj with its covariance, which is zero for the patent's method."""
    if each.pose is None:
        pose = camera_from_obj(each)
        if pose is None:
            raise InputError("E-LOCATED-NO-POSE", f"{each.name}: no pose; {each.verdict.decision}")
        return UncertainRigid.exact(pose)
    return UncertainRigid(each.pose.camera_from_obj, each.pose.covariance)


def accepted(results: Sequence[Located]) -> list[Located]:
    """Returns the results whose pose may be used."""
    return [each for each in results if each.verdict.decision == "accept"]


def poses_csv(results: Sequence[Located], chain: GoalChain | None = None) -> str:
    """Returns a table of the accepted poses only, so that no robot moves to a rejected one; the others are comments."""
    out = io.StringIO()
    for scene in results:
        if scene.verdict.decision != "accept":
            out.write(f"# {scene.name}: {scene.verdict.decision}: {'; '.join(scene.verdict.reasons)}\n")
    write = csv.writer(out, lineterminator="\n")
    full = all(scene.pose is not None for scene in accepted(results))
    columns = [*POSE, *(COVARIANCE if full else ())]
    base = [BASE + column for column in columns] if chain else []
    write.writerow(["scene", "tags", "exposures", *columns, "rms_px", "chi2_per_dof", *base])
    for scene in accepted(results):
        pose = uncertain(scene)
        cells = pose_cells(pose.rigid, pose.covariance if full else None)
        fit = (
            ["", ""]
            if scene.pose is None
            else [f"{scene.pose.rms_px():.4f}", f"{scene.pose.chi2_per_redundancy():.4f}"]
        )
        row = [scene.name, len(scene.merged.seen) if scene.merged else 0, len(scene.tags.readable()), *cells, *fit]
        if chain:
            goal = chain.base_from_goal(scene.name, pose)
            row += pose_cells(goal.rigid, goal.covariance if full else None)
        write.writerow(row)
    return out.getvalue()
