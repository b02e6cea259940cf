"""What ``locate run`` found, as text and CSV."""

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
    """A line for each scene, reasons below those that are not accepted; the target in the robot's base where a chain
    leads there."""
    width = max([5, *(len(each.name) for each in results)])
    head = f"{'scene':<{width}}  verdict    tags  exposures      x_mm      y_mm      z_mm  sigma_mm  sigma_deg   rms_px"
    lines = [head]
    for each in results:
        exposures = len(each.tags.readable())
        tags = len(each.merged.seen) if each.merged else 0
        start = f"{each.name:<{width}}  {each.verdict.decision:<9}  {tags:4d}  {exposures:9d}"
        pose = camera_from_obj(each)
        if pose is not None:
            start += "".join(f"{v:10.2f}" for v in pose.translation)
        if each.pose is not None:
            sigma = each.pose.sigma_mm(), np.degrees(each.pose.sigma_rad()), each.pose.rms_px()
            start += "{:10.3f}{:11.4f}{:9.3f}".format(*sigma)
        lines += [start, *(f"{'':<{width}}    {reason}" for reason in (*each.verdict.reasons, *each.notes))]
        if each.patent is not None:
            lines += [f"    {line}" for line in text_table(patent_cells(each))]
            lines += [f"    gates: {gates_text(each)}"]
    if chain and accepted(results):
        lines += ["", f"{'base_from_goal':<{width + 22}}      x_mm      y_mm      z_mm  rotation vector, deg"]
        for each in accepted(results):
            goal = chain.base_from_goal(each.name, uncertain(each)).rigid
            turn = np.degrees(goal.log()[:3])
            place = "".join(f"{v:10.2f}" for v in goal.translation)
            lines.append(f"{each.name:<{width + 22}}{place}" + "".join(f"{v:10.3f}" for v in turn))
    if any(each.patent is not None for each in results):
        lines += ["", f"patent: {ASSUMED}"]
    return "\n".join(lines)


def patent_cells(each: Located) -> list[list[str]]:
    """Heads, and a row for each exposure: how it fared by the published rules."""
    rows = [["<exposure", "<", "tags", "area px²", "error px", "of the other", "det J 1/mm²"]]
    if each.patent is None:
        return rows
    for name, own in zip((e.name for e in each.tags.readable()), each.patent.exposures, strict=True):
        kept = "kept" if own.exposure == each.patent.exposure else "candidate" if own.candidate else "left out"
        errors = own.errors_px or (None, None)
        det_j = NONE if own.det_j is None else f"{own.det_j:.3g}"
        rows.append([name, kept, str(own.tags), number(own.area_px2, 0), *(number(e, 3) for e in errors), det_j])
    return rows


def gates_text(each: Located) -> str:
    """Every gate with its value and limit, in words."""
    found = [
        f"{check.name} {check.value:.4g}{check.unit} {'≥' if check.at_least is not None else '≤'} "
        f"{check.at_least if check.at_least is not None else check.at_most:.4g}{'' if check.passed else ' failed'}"
        for check in each.verdict.checks
    ]
    if each.patent is not None and each.patent.same:
        found.append("both poses are one, no ratio")
    return "; ".join(found)


def camera_from_obj(each: Located) -> Rigid | None:
    """Of whatever method was asked for."""
    if each.patent is not None:
        return each.patent.camera_from_obj
    return None if each.pose is None else each.pose.camera_from_obj


def uncertain(each: Located) -> UncertainRigid:
    """camera_from_obj with its covariance; the patent's method states none."""
    if each.pose is None:
        pose = camera_from_obj(each)
        if pose is None:
            raise InputError("E-LOCATED-NO-POSE", f"{each.name}: no pose; {each.verdict.decision}")
        return UncertainRigid.exact(pose)
    return UncertainRigid(each.pose.camera_from_obj, each.pose.covariance)


def accepted(results: Sequence[Located]) -> list[Located]:
    """Those whose pose may be used."""
    return [each for each in results if each.verdict.decision == "accept"]


def poses_csv(results: Sequence[Located], chain: GoalChain | None = None) -> str:
    """Accepted poses only, so that nobody moves a robot to a rejected one; the others as comments."""
    out = io.StringIO()
    for each in results:
        if each.verdict.decision != "accept":
            out.write(f"# {each.name}: {each.verdict.decision}: {'; '.join(each.verdict.reasons)}\n")
    write = csv.writer(out, lineterminator="\n")
    full = all(each.pose is not None for each in accepted(results))
    columns = [*POSE, *(COVARIANCE if full else ())]
    base = [BASE + column for column in columns] if chain else []
    write.writerow(["scene", "tags", "exposures", *columns, "rms_px", "chi2_per_dof", *base])
    for each in accepted(results):
        own = uncertain(each)
        cells = pose_cells(own.rigid, own.covariance if full else None)
        fit = ["", ""] if each.pose is None else [f"{each.pose.rms_px():.4f}", f"{each.pose.chi2_per_redundancy():.4f}"]
        row = [each.name, len(each.merged.seen) if each.merged else 0, len(each.tags.readable()), *cells, *fit]
        if chain:
            goal = chain.base_from_goal(each.name, own)
            row += pose_cells(goal.rigid, goal.covariance if full else None)
        write.writerow(row)
    return out.getvalue()
