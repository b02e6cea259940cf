"""Content of ``report.json``. A field without a description is described at the object that holds it."""

from typing import Literal

from pydantic import Field

from stcal.io.images import name_fault
from stcal.io.json import ByFace, ByGroup, ByLabel, Matrix3, Pair, Part, Points, Pose, ResultFile, Vector, Vector3
from stcal.sfm.adjust.calibration import Solve
from stcal.sfm.adjust.faces import FrameKind
from stcal.sfm.adjust.scale import ScaleSource
from stcal.sfm.checks.verdict import Verdict
from stcal.sfm.report.judgement import Judgement
from stcal.sfm.runs.crosscheck import Crosscheck
from stcal.sfm.runs.result import Comparison

Number = int | float
"""Number that remains an integer if it is one."""


class ReportOptions(Part):
    solve: Solve
    frame: FrameKind
    eccentricity: bool
    refine_camera: bool
    max_pair_angle_deg: float
    expect_faces: list[str] = Field(default=[])


class ReportCamera(Part):
    model: str
    size_px: list[int]
    focal_px: Pair
    centre_px: Pair
    distortion: Vector


class Summary(Part):
    files: int
    images: int
    images_mapped: int
    groups: int
    faces: int
    faces_not_seen: list[str]
    faces_expected: list[str]
    observations: int
    residual_rms_px: float
    centre_sigma_rms_px: float
    sigma_factor: float
    circle_sigma_factor: float
    dot_sigma_factor: float
    printed_sigma_factor: float | None = None
    scale_sigma_ppm: float | None
    sigma0: float | None
    redundancy: int | None
    last_move_px: float | None
    photographs_differ: float | None = None
    sigma_enlarged: float | None = None
    rim_mm: float | None = None
    rim_sigma_mm: float | None = None
    dot_rim_mm: float | None = None
    scale_from: list[ScaleSource] = Field(default=["board"])
    print_factor: float | None = None
    bend_factor: float | None = None
    camera_given: bool = True
    circle_sigma_px: float | None = None
    size_sigma_ppm: float | None = None
    edge_share: float | None = None
    printed_faces: list[str] = Field(default=[])


class FaceRow(Part):
    target_from_face: Pose
    translation_mm: Vector3
    angle_to_reference_deg: float
    translation_sigma_um: Vector3 | None
    rotation_sigma_mdeg: Vector3 | None
    translation_sources_um: dict[str, Vector3] = Field(default={})
    circles: int
    circles_of_design: int
    plane_rms_um: float
    groups: list[str]
    images: int


class BetweenFaces(Part):
    a: str
    b: str
    distance_mm: float
    distance_sigma_um: float | None
    angle_deg: float


class ChainRow(Part):
    faces: list[str]
    groups: list[str]
    translation_um: float
    rotation_mdeg: float


class MeasuredRow(Part):
    name: str
    value: Number
    limit: Number | None
    unit: str
    probability: float | None


class CheckRow(Part):
    """One check."""

    key: str = Field(description="short name")
    title: str = Field(description="what is checked")
    verdict: Verdict = Field(
        description="`passed`; `suspicious`: by chance in one honest run of 1000, and `agreement` where the joint "
        "adjustment has not settled; `failed`: of 100 000; `not possible` in this run (without a "
        "`remedy`: not applicable to what was photographed)"
    )
    reason: str = Field(description="the verdict in words")
    measured: list[MeasuredRow] = Field(
        description="at most 8 values, the worst first: `name` of what was tested (image, label, face, group, row …), "
        "`value`, `limit` beyond which it is suspicious (null where there is none), `unit`, `probability` of as much "
        "by chance before the number of things tested is allowed for (null where it is no test)"
    )
    tested: int = Field(description="how many things were")
    names: list[str] = Field(description="all that are beyond the limit, the worst first")
    remedy: str = Field(description="what to do about it; empty where nothing is")
    enlarges: float = Field(default=1.0, description="factor on the σ of the result by which they cover what was found")


class PairRow(Part):
    first: str
    second: str
    shared: int
    median_angle_deg: float
    in_front: float
    forward: float
    verdict: str


class ScaleRow(Part):
    mm_per_unit: float
    mm_per_unit_rows: float
    rows: list[int]
    difference_ppm: float
    sigma_ppm: float
    dots: int
    board_mean_um: float
    board_spread_um: float
    board_rms_um: float
    board_residuals_um: dict[ByLabel, Vector3]
    source: ScaleSource = "board"


class GroupRow(Part):
    name: str
    images: list[str]
    faces: list[str]
    points: int
    seeded: str
    rounds: int
    pairs: list[PairRow]
    scale: ScaleRow = Field(
        description="`mm_per_unit` by least squares over all dots, `mm_per_unit_rows` from all pairs of the two "
        "`rows`, `difference_ppm`, `sigma_ppm`, `dots`; residuals after the similarity, reconstructed minus design, "
        "board frame: `board_mean_um`, `board_spread_um` (standard deviation), `board_rms_um` of their lengths, "
        "`board_residuals_um` label → `[x, y, z]`; `source` of λ: `board`, `faces` of known shape, whose corners then "
        "stand for the dots, or known `distances`"
    )


class ImageResiduals(Part):
    image: str
    group: str
    observations: int
    rms_px: float
    max_px: float
    worst: str


class LabelResiduals(Part):
    label: str
    group: str | None
    observations: int
    rms_px: float
    max_px: float


class FileLeftOut(Part):
    name: str
    reason: str
    gate: str
    value: Number | str | None
    limit: Number | str | None


class CircleLeftOut(Part):
    image: str
    label: str
    reason: str
    gate: str
    value: Number
    limit: Number
    unit: str


class Note(Part):
    image: str
    note: str


class LeftOut(Part):
    files: list[FileLeftOut]
    images: list[FileLeftOut]
    circles: list[CircleLeftOut]
    notes: list[Note]


class ImageRow(Part):
    image_id: int
    name: str
    group: str
    circles: int


class FocusRow(Part):
    image: str
    focused_mm: float | None
    nearest_mm: float
    farthest_mm: float
    nearest_blur_px: float
    farthest_blur_px: float
    shift_px: float


class CameraInSpace(Part):
    image: str
    group: str
    position_mm: Vector3
    axes: Matrix3


class Space(Part):
    cameras: list[CameraInSpace]
    boards: dict[ByGroup, Points]
    circles: dict[ByLabel, Vector3]


class ReportFile(ResultFile):
    """Content of the report of a run."""

    format: Literal["stcal report 1"] = Field(description="the file's form and its version")
    version: str = Field(description="of stcal")
    target: str = Field(description="name of the design")
    reference_face: str = Field(description="face id")
    options: ReportOptions = Field(
        description="`solve`, `frame`, `eccentricity`, `refine_camera`, `expect_faces`, `max_pair_angle_deg`"
    )
    camera: ReportCamera = Field(
        description="COLMAP `model`, `size_px`, `focal_px`, `centre_px` (OpenCV pixel origin), `distortion` k1, k2, "
        "p1, p2, k3 … k6, and s1 … s4 of a lens with thin prisms"
    )
    summary: Summary = Field(
        description="counts: `files` (skipped ones included), `images`, `images_mapped`, `groups`, `faces`, "
        "`faces_not_seen`, `faces_expected` (by `--expect-faces`, or by the names of groups, where all are made of "
        "ids of faces), `observations`; `residual_rms_px` per coordinate; `centre_sigma_rms_px` of the σ used; "
        "`sigma_factor` by which the residuals of the single groups exceed the centres' own σ, `circle_sigma_factor` "
        "of the circles of the faces (not below 1), `dot_sigma_factor` of the dots and `printed_sigma_factor` of "
        "printed corners (not below 1; null without printed faces), which multiply these σ; `scale_sigma_ppm`: σ of "
        "the size; `sigma0` and `redundancy` of the joint adjustment, `last_move_px` by which its last step "
        "moved a projection at most (settled: less than 1e-6), `photographs_differ` by how much photographs differ "
        "more than their pixels explain, as a ratio of σ, and `sigma_enlarged` by which all σ are larger so that they "
        "cover how groups, ways and halves differ (both in the σ); these six are null with `chain` and `paper`; "
        "`rim_mm` mean height of the rims behind which the faces lie, `rim_sigma_mm` its σ (0 where stated), null "
        "where they are as seen; `dot_rim_mm` stated height of the rims before the board's dots, null without them; "
        "`scale_from` what the size rests on; `print_factor`, `bend_factor` by which corners "
        "of printed faces are off their design over their σ, in the plane and off it (null without such faces); "
        "`camera_given` false where the camera was found from the photographs; `circle_sigma_px` of the target's "
        "circles and corners, RMS per axis (null without joint adjustment); `size_sigma_ppm` the largest σ of a "
        "printed face's size, `edge_share` the share of its variance that is due to the edges of tags (null "
        "without such faces); `printed_faces` the ids of faces with boards or tags"
    )
    faces: dict[ByFace, FaceRow] = Field(
        description="`target_from_face`, `translation_mm`, `angle_to_reference_deg`, `translation_sigma_um` and "
        "`rotation_sigma_mdeg` (x, y, z of the target frame; null with `chain`), `translation_sources_um`: what each "
        "kind of observation (`circles`, `dots` in the images, the `board`, `flatness`, adjusted `intrinsics`, "
        "`print`, `sizes`, `distances`) contributes to the first (empty with `chain`), `circles` of "
        "`circles_of_design`, `plane_rms_um`, `groups`, `images`"
    )
    between_faces: list[BetweenFaces] = Field(
        description="faces `a`, `b`, `distance_mm` of their origins and its σ `distance_sigma_um` (null with `chain`), "
        "`angle_deg` of their normals"
    )
    chains: dict[ByFace, list[ChainRow]] = Field(
        description="each way from the reference face through `faces` and `groups`; its distance from the result, "
        "`translation_um`, `rotation_mdeg`"
    )
    checks: list[CheckRow] = Field(description="what residuals cannot show")
    groups: list[GroupRow] = Field(
        description="`name`, mapped `images`, `faces`, `points`; `seeded` how the initial pair was registered; "
        "`rounds` of refinement; `pairs`, the chosen one first: `first`, `second`, `shared` labels, `median_angle_deg` "
        "of the rays, `in_front` share, `forward` share of the baseline, `verdict`; `scale`"
    )
    residuals_by_image: list[ImageResiduals] = Field(
        description="`image`, `group`, `observations`, `rms_px` per coordinate, `max_px` length, `worst` label"
    )
    residuals_by_label: list[LabelResiduals] = Field(
        description="`label`, `group` (null for circles of the target: all groups together), `observations`, `rms_px`, "
        "`max_px`"
    )
    left_out: LeftOut = Field(
        description="`files` and `images`: `name`, `reason`; `circles`: `image`, `label`, `reason`, `unit`; all with "
        "`gate` that stopped it, `value` measured and `limit`, null without a number; `notes`: `image`, `note`"
    )
    notes: list[str] = Field(
        description="faces of a group that got no frame, and why; rows and columns of the board that no image shows; a "
        "joint adjustment that has not settled"
    )
    images: list[ImageRow] = Field(
        description="all images of the database in its order: `image_id`, `name`, `group`, `circles` labelled"
    )
    focus: list[FocusRow] = Field(
        [],
        description="blur of each `image` with enough circles: `focused_mm` distance of the plane of focus (null "
        "where the image does not tell it), depths of the `nearest_mm` and `farthest_mm` circle and the blur there, "
        "`nearest_blur_px` and `farthest_blur_px` (σ); `shift_px`: largest correction of a centre for blur that varies "
        "across its circle, 0 where none is needed",
    )
    scene: Space = Field(
        description="target frame, mm: `cameras`: `image`, `group`, `position_mm`, `axes` (rows X, Y, Z of the "
        "camera); `boards` group → mapped dots; `circles` label → `[x, y, z]`"
    )
    judgement: Judgement | None = Field(
        None, description="the summary in words, by the rules [below](#judgement); absent of an earlier version"
    )
    comparison: Comparison | None = Field(None, description="only of a run with `--compare paper`")
    crosscheck: Crosscheck | None = Field(None, description="only after `crosscheck`, with")


class InitialPair(Part):
    first: str
    second: str


class GroupRead(Part):
    name: str
    pairs: list[InitialPair] = Field(min_length=1)


class SummaryRead(Part):
    residual_rms_px: float


class ReportRead(Part):
    """Content of ``report.json`` that every command on a run needs, of whatever version."""

    format: Literal["stcal report 1"] = "stcal report 1"
    images: list[ImageRow]
    groups: list[GroupRead]
    summary: SummaryRead

    def names(self) -> list[tuple[str, str, int]]:
        """Returns (name, group, circles) of the images in the database's order; KeyError or ValueError if they are
        damaged."""
        pairs = {entry.name: entry.pairs[0] for entry in self.groups}
        names = [(entry.name, entry.group, entry.circles) for entry in self.images]
        for name, _, _ in names:
            if fault := name_fault(name):
                raise ValueError(f"image {name!r}: its name {fault}")
        for group in {group for _, group, _ in names}:
            images_of_group = {name for name, group_of_image, _ in names if group_of_image == group}
            if not {pairs[group].first, pairs[group].second} <= images_of_group:
                raise ValueError(f"group {group}: its initial pair is not of its images")
        return names
