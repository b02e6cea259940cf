"""Result file, table and report of measured poses."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.rigid import Poses
from stcal.io.json import Finite, Matrix6, Named, NamedReason, Part, Pose, ResultFile
from stcal.io.table import COVARIANCE, POSE, Table, common_columns, csv_text, pose_cells, require_pose_table_written
from stcal.report.document import Answer, Document, Printed, Section, legend, page_only, plot, plots
from stcal.report.document import Table as ShownTable
from stcal.report.svg import COLOURS, Axes, Drawing, round_below
from stcal.report.text import number, significant
from stcal.sfm.data.group_model import Outlier
from stcal.sfm.measurement.measure_images import MeasuredImage, MeasureResult
from stcal.sfm.measurement.pose import TargetPose, fit_verdict


class ImagePose(Part):
    image: str
    faces: list[str]
    status: str
    camera_from_target: Pose
    covariance: Matrix6
    covariance_parts: dict[str, Matrix6] = Field(
        description="what it is the sum of: `image`, `target`, `intrinsics`, `curvature`: by which the likelihood is "
        "wider, or narrower, than its linearisation says (zero unless a face is frontal, far and noisy)"
    )
    alternative: Annotated[TargetPose, Named("camera_from_target covariance")] | None = Field(
        description="`camera_from_target` and `covariance` of the other pose that fits, null where there is none"
    )
    delta_chi2: Finite = Field(
        description="by which the other pose fits worse (null: there is no other; below 0: this one does, and "
        "`--previous` chose it)"
    )
    delta_chi2_needed: float | None = Field(description="from where on this one is certain")
    rms_px: float = Field(description="of the residuals, per coordinate")
    chi2: float = Field(description="of the residuals")
    dof: int = Field(description="their degrees of freedom")
    p_value: float = Field(description="of as much by chance")
    fit: Literal["passed", "suspicious", "failed"] = Field(description="suspicious: p < 0.001, failed: p < 0.00001")
    circles: list[Annotated[Any, Named("label residual_px weight")]] = Field(
        description="`label`, `residual_px` measured minus projected ellipse centre, Huber's `weight`"
    )
    outliers: list[Annotated[Outlier, Named("label residual_px limit_px")]] = Field(
        description="`label`, `residual_px`, `limit_px` of circles that contradict the others and are left out"
    )
    notes: list[str] = Field(description="what detection saw and left out")


class PosesFile(ResultFile):
    """The JSON file of ``measure``."""

    format: Literal["stcal poses 1"] = Field(description="the file's form and its version")
    unit: Literal["mm"] = Field(description="of all lengths")
    sigma_factor: float = Field(
        description="factor on the centres' own σ: `centre_sigma_factor` of `faces.json`, or `--sigma-factor`"
    )
    intrinsics_held: bool = Field(description="whether the camera file states no σ")
    notes: list[str] = Field(description="what `faces.json` lacks for the covariance")
    images: list[ImagePose] = Field(
        description="`image`, `faces`, `status`, `camera_from_target` 4×4, `covariance` 6×6, and"
    )
    left_out: list[NamedReason] = Field(description="`name`, `reason` of files and images without a pose")


IMAGE = "image"
COMMON_SHARE = 0.5  # share of the variance from which on it is told that poses err in common
MOST_LISTED = 20  # largest number of images for which the terminal has a line each


@require_arguments
def poses_csv(result: MeasureResult, joints: Table | None = None) -> tuple[str, tuple[str, ...]]:
    """Returns the table of measured poses, and notes on images that could not be joined.

    Parameters
    ----------
    result : Of :func:`~stcal.sfm.measure`.
    joints : Further columns by ``image``, of :func:`stcal.load_table`. Only images of this table are then written.

    Returns
    -------
    text : CSV with camera_from_target, mm, and its covariance, rad and mm (form: ``data_layout.md``).
    notes : Images of only one of both.

    Raises
    ------
    InputError : The table has no column ``image``, an image twice, a column of the name of a measured one, or no image
        that was measured.
    """
    header = [IMAGE, "faces", "circles", "status", *POSE, *COVARIANCE, "rms_px", "chi2_per_dof"]
    common = common_columns(result.common.shape[2])
    further, joined = ([], {}) if joints is None else _joint_cells(joints, header + common)
    table: list[Sequence] = [header + further + common]
    unmatched = []
    for image, common_error in zip(result.images, result.common, strict=True):
        if joints is not None and image.name not in joined:
            unmatched.append(f"{image.name}: measured, but not in {joints.where}")
            continue
        pose = image.pose
        table.append(
            [image.name, "+".join(pose.faces), len(pose.labels), pose.status]
            + pose_cells(pose.camera_from_target, pose.covariance)
            + [f"{pose.rms_px():.5f}", f"{pose.chi2_per_redundancy():.4f}", *joined.get(image.name, ())]
            + [f"{v:.7g}" for v in common_error.T.ravel()]
        )
    if joints is not None:
        names = {image.name for image in result.images}
        unmatched += [f"{name}: in {joints.where}, but without a pose" for name in joined if name not in names]
        if not joined.keys() & names:
            reason = f"{joints.where}: none of its images was measured; names are like {result.images[0].name}"
            raise InputError("E-IMAGES-UNMATCHED", reason)
    return csv_text(table), tuple(unmatched)


def require_table_written(path: str | Path, result: MeasureResult, joints: Table | None = None) -> None:
    """Read a written ``poses.csv`` again, and require the poses that were measured; arguments as :func:`poses_csv`."""
    joined = set(joints.text(IMAGE)) if joints is not None else {image.name for image in result.images}
    poses = [image.pose.camera_from_target for image in result.images if image.name in joined]
    require_pose_table_written(path, {"": Poses.of(poses)})


def _joint_cells(joints: Table, header: list[str]) -> tuple[list[str], dict[str, list[str]]]:
    """Returns the names of the further columns, and their cells by image, as they stand in the file."""
    further = [name for name in joints.columns if name != IMAGE]
    if conflicts := [name for name in further if name in header]:
        reason = f"{joints.where}: column {conflicts[0]} is an output of this command; leave it out"
        raise InputError("E-TABLE-COLUMNS-CONFLICT", reason)
    cells = [joints.columns[name] for name in further]
    rows: dict[str, list[str]] = {}
    for i, name in enumerate(joints.text(IMAGE)):
        if name in rows:
            reason = f"{joints.where}: line {joints.lines[i]}: image {name} a second time; every image once"
            raise InputError("E-TABLE-ROW-REPEATED", reason)
        rows[name] = [c[i] if isinstance(c, list) else repr(float(c[i])) for c in cells]
    return further, rows


def poses_file(result: MeasureResult) -> PosesFile:
    images = []
    for image in result.images:
        pose = image.pose
        circles = zip(pose.labels, pose.residuals_px.tolist(), pose.weights.tolist(), strict=True)
        named = {
            "image": image.name,
            "notes": image.notes,
            "covariance_parts": pose.parts,
            "alternative": pose.second,
            "delta_chi2_needed": pose.needed_chi2,
            "rms_px": pose.rms_px(),
            "dof": pose.redundancy,
            "p_value": pose.p_value(),
            "fit": fit_verdict(pose),
            "circles": [{"label": label, "residual_px": px, "weight": weight} for label, px, weight in circles],
        }
        alike = {name: getattr(pose, name) for name in ImagePose.model_fields.keys() - named}
        images.append(ImagePose.model_validate(named | alike))
    own = {"format": "stcal poses 1", "unit": "mm", "images": images}
    return PosesFile.model_validate({n: getattr(result, n) for n in PosesFile.model_fields.keys() - own} | own)


def summary(result: MeasureResult) -> list[str]:
    """Returns the counts of poses by status, followed by warnings and notes."""
    poses = [image.pose for image in result.images]
    count = {s: sum(pose.status == s for pose in poses) for s in COLOUR_OF}
    lines = [
        f"{len(poses)} poses: {', '.join(f'{n} {s}' for s, n in count.items() if n)}; centres' σ × "
        f"{result.sigma_factor:.3g}, intrinsics "
        f"{'held: their errors are not in σ' if result.intrinsics_held else 'with their σ'}"
    ]
    if poses and result.common.size:
        whole = np.array([np.diag(pose.covariance)[3:].sum() for pose in poses])
        share = np.median((result.common[:, 3:] ** 2).sum((1, 2)) / whole)
        if share > COMMON_SHARE:
            alone = 1e3 * np.sqrt(np.median(whole) * max(1 - share, 0.0) / 3)
            lines.append(
                f"{100 * share:.0f} % of the variance of positions is common to all poses (target and intrinsics); "
                f"between poses σ is about {significant(alone)} µm along an axis"
            )
    if result.searched is not None:
        total = len(poses) + sum(image.gate == "pose" for image in result.left_out)
        lines.append(
            f"sequence: {total - result.searched} images followed from the one before, "
            f"{result.searched} searched as a whole"
        )
    if count["ambiguous"]:
        lines.append(
            "ambiguous: two poses fit, mirrored at the line of sight; the likelier one is given, --json has both; "
            "show a second face, come nearer, or use --previous for small motions"
        )
    failed = [image.name for image in result.images if fit_verdict(image.pose) == "failed"]
    if failed:
        remedy = result.remedy("check that camera file, faces.json and images belong together")
        lines.append(
            f"χ² failed in {len(failed)} images, first {failed[0]}: residuals beyond their σ by chance in one image of "
            f"100 000; {remedy}"
        )
    return [*lines, *result.notes]


COLOUR_OF = {"certain": COLOURS[0], "resolved": COLOURS[2], "ambiguous": COLOURS[1]}
HEADS = ("<image", "<faces", "circles", "<status", "x mm", "y", "z", "σ µm", "σ mdeg", "RMS px", "χ²/dof", "<fit")


def measure_report(result: MeasureResult, where: str, every: bool = False) -> Document:
    """Returns the report of ``measure``; ``every`` : whether its text has a line for each of many images."""
    images, left_out = result.images, [[each.name, each.reason] for each in result.left_out]
    at = np.array([image.pose.camera_from_target.translation for image in images])
    largest = np.sqrt(max(np.linalg.eigvalsh(image.pose.covariance[3:, 3:])[-1] for image in images))
    times = round_below(0.06 * max(float(np.ptp(at, axis=0).max()), 1.0) / largest)
    statuses = {image.pose.status for image in images}
    counts, *remarks = summary(result)
    every = every or len(images) <= MOST_LISTED
    fits = ("certain", "passed", ())
    doubtful = [i for i in images if (i.pose.status, fit_verdict(i.pose), i.pose.outliers) != fits]
    listed = images if every else doubtful[:MOST_LISTED]
    values = np.array([(*_largest_sigma(image.pose), image.pose.rms_px()) for image in images]).T
    rows = [
        [what, f"{np.median(v):.4g}", f"{v.max():.4g}", images[int(v.argmax())].name]
        for what, v in zip(("σ position µm", "σ rotation mdeg", "residuals RMS px"), values, strict=True)
    ]
    figures = ShownTable((f"<{len(at)} poses", "median", "worst", "<in image"), rows).lines()
    rest = f"{len(listed)} of them need a look; the table that is written has all, and --verbose prints them"
    outliers = [
        [image.name, outlier.label, number(outlier.residual_px, 3), number(outlier.limit_px, 3)]
        for image in images
        for outlier in image.pose.outliers
    ]
    views = [
        plot(partial(_view, result, at, 0, j, times), f"path of the target {seen}", seen.capitalize(), "")
        for j, seen in ((1, "as the camera sees it"), (2, "from above, the camera below"))
    ]
    poses = [
        *remarks,
        Printed([] if every else [*figures, rest]),
        Printed(ShownTable(HEADS, [_row(image) for image in listed]).lines() if listed else []),
        page_only(
            "σ: the largest of the three axes, of position and of rotation",
            ShownTable(HEADS, [_row(image) for image in images]),
        ),
    ]
    path = [
        f"Origin of the target, mm. Ellipses: σ{f', {times:g} times enlarged' if times != 1 else ''}. "
        "Lines join the images of a folder by name",
        legend({s: c for s, c in COLOUR_OF.items() if s in statuses} if len(statuses) > 1 else {}),
        plots(*views),
    ]
    out = [
        ShownTable(["<image or file", "<reason"], left_out, css="text"),
        f"{len(outliers)} circles contradict the others of their image" if outliers else "",
        ShownTable(["<image", "<circle", "residual px", "limit px"], outliers),
    ]
    count, sound = len(images), len(images) - len(doubtful)
    asked = count + sum(each.gate == "pose" for each in result.left_out)
    usable = "yes" if sound == asked else "part" if sound else "no"
    return Document(
        "Poses of the target",
        f"{where}: {counts}",
        [
            Section("Poses", poses, terminal=True),
            Section("Path in the camera frame", path),
            Section("Left out", out, terminal=True),
        ],
        [Answer(usable, f"{sound} of {asked} images give a certain pose that fits")],
    )


def _largest_sigma(pose: TargetPose) -> tuple[float, float]:
    """Returns the largest σ of three axes: position, µm, and rotation, mdeg."""
    sigma = 1e3 * np.sqrt(np.diag(pose.covariance))
    return float(sigma[3:].max()), float(np.degrees(sigma[:3].max()))


def _row(each: MeasuredImage) -> list[str]:
    pose = each.pose
    um, mdeg = _largest_sigma(pose)
    return [
        *(each.name, "+".join(pose.faces), str(len(pose.labels)), pose.status),
        *(number(v, 3) for v in pose.camera_from_target.translation),
        *(number(um, 1), number(mdeg, 2), number(pose.rms_px(), 4), number(pose.chi2_per_redundancy(), 2)),
        fit_verdict(pose),
    ]


def _view(result: MeasureResult, at: np.ndarray, i: int, j: int, times: float) -> Drawing:
    """Returns a plot of two coordinates of the path, with enlarged ellipses of σ."""
    drawing = Drawing(5, 4.4)
    turn = np.linspace(0, 2 * np.pi, 40)
    circle, ellipses = times * np.stack([np.cos(turn), np.sin(turn)], axis=1), []
    folders: dict[str, list[np.ndarray]] = {}
    for image, place in zip(result.images, at, strict=True):  # in order of name
        values, directions = np.linalg.eigh(image.pose.covariance[np.ix_([3 + i, 3 + j], [3 + i, 3 + j])])
        ellipses.append(place[[i, j]] + circle * np.sqrt(values) @ directions.T)
        folders.setdefault(image.name.rpartition("/")[0], []).append(place[[i, j]])
    # y of a camera points down
    axes = Axes.equal(drawing, drawing.panels()[0], np.concatenate(ellipses), down=j == 1)
    axes.frame(f"{'xyz'[i]}, mm", f"{'xyz'[j]}, mm", "xy")
    axes.lines([np.transpose(path) for path in folders.values()], "#9aa0a8", 0.7)
    for image, place, ellipse in zip(result.images, at, ellipses, strict=True):
        colour = COLOUR_OF[image.pose.status]
        axes.lines([ellipse.T], colour, 0.6, fill=colour, opacity=0.3)
        axes.marks(place[i], place[j], "dot", 3.2, colour)
    return drawing
