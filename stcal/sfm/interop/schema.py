"""The database schema of each COLMAP version, as data.

Each was read from the empty database that the version itself makes: 3.8 from the native program, 3.9 (3.9.1) from
pycolmap 0.6.0 and 0.6.1, 3.10 from pycolmap 3.10.0, 3.11 from 3.11.0 and 3.11.1, 3.12 from 3.12.0 and 3.12.6, 3.13
from 3.13.0, 4.0 from 4.0.0 and 4.0.4, 4.1 from 4.1.0 and 4.1.1, 4.2 from 4.2.0 and 4.2.1; releases of one version
differ in nothing but the last digits of ``user_version``, which 4.x stamps as major, minor and patch. The tables of
4.1 are those of 4.0. COLMAP's source (``src/colmap/scene/database.cc``, from 3.13 on ``database_sqlite.cc``) was read
beside it. The names of camera models, pair configurations and descriptor types are the enumerations of the same
pycolmap releases; 3.8 has those of 3.9. Declared defaults do not occur in any of them.
"""

import re
from dataclasses import dataclass, replace

from stcal.errors import InputError


@dataclass(frozen=True, slots=True)
class Column:
    """A column as declared; ``default`` : None in every published schema."""

    name: str
    type: str
    not_null: bool = False
    key: bool = False
    default: str | None = None

    def __str__(self) -> str:
        words = [self.name, self.type]
        if self.not_null:
            words.append("NOT NULL")
        if self.default is not None:
            words.append(f"DEFAULT {self.default}")
        if self.key:
            words.append("PRIMARY KEY")
        return " ".join(words)


@dataclass(frozen=True, slots=True)
class Reference:
    """A foreign key: ``column`` refers to the column of the same name in ``table``."""

    column: str
    table: str
    cascade: bool = True


@dataclass(frozen=True, slots=True)
class Index:
    """A unique index. ``name`` : None for an index that SQLite makes by itself for UNIQUE columns."""

    name: str | None
    columns: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class SchemaTable:
    """A table. ``check`` : condition of its CHECK constraint."""

    name: str
    columns: tuple[Column, ...]
    references: frozenset[Reference] = frozenset()
    indices: frozenset[Index] = frozenset()
    autoincrement: bool = False
    check: str | None = None

    def column_names(self) -> tuple[str, ...]:
        """Returns the names of the columns in their order."""
        return tuple(column.name for column in self.columns)

    def statements(self) -> list[str]:
        """Returns the SQL statements that make the table and its named indices."""
        parts = [f"{c} AUTOINCREMENT" if c.key and self.autoincrement else str(c) for c in self.columns]
        parts += [f"UNIQUE ({', '.join(index.columns)})" for index in self.indices if index.name is None]
        if self.check:
            parts.append(f"CHECK ({self.check})")
        for reference in self.references:
            rule = " ON DELETE CASCADE" if reference.cascade else ""
            parts.append(f"FOREIGN KEY ({reference.column}) REFERENCES {reference.table} ({reference.column}){rule}")
        return [f"CREATE TABLE {self.name} ({', '.join(parts)})"] + [
            f"CREATE UNIQUE INDEX {index.name} ON {self.name} ({', '.join(index.columns)})"
            for index in self.indices
            if index.name is not None
        ]


@dataclass(frozen=True, slots=True)
class Schema:
    """The database schema of a COLMAP version."""

    name: str
    user_version: int  # the stamp of the version's first release
    tables: dict[str, SchemaTable]
    camera_models: dict[int, str]  # name by number in ``cameras.model``
    pair_configurations: dict[int, str]  # in ``two_view_geometries.config``
    descriptor_types: dict[int, str]  # in ``descriptors.type``, a column from 4.0 on

    def following(self, name: str, *changed: SchemaTable, **others) -> "Schema":
        """Returns the schema of a later version, with changed tables added or replaced, and changed fields."""
        return replace(self, name=name, tables=self.tables | {table.name: table for table in changed}, **others)


def _integers(*names: str) -> tuple[Column, ...]:
    return tuple(Column(name, "INTEGER", not_null=True) for name in names)


def _blobs(*names: str) -> tuple[Column, ...]:
    return tuple(Column(name, "BLOB") for name in names)


def _key(name: str) -> Column:
    return Column(name, "INTEGER", not_null=True, key=True)


def _unique(name: str | None, *columns: str) -> frozenset[Index]:
    return frozenset({Index(name, columns)})


_MATRIX = (*_integers("rows", "cols"), *_blobs("data"))
_OF_IMAGE = frozenset({Reference("image_id", "images")})
_OF_RIG = frozenset({Reference("rig_id", "rigs")})

_CAMERAS = SchemaTable(
    "cameras",
    (
        _key("camera_id"),
        *_integers("model", "width", "height"),
        *_blobs("params"),
        *_integers("prior_focal_length"),
    ),
    autoincrement=True,
)
_IMAGES = SchemaTable(
    "images",
    (_key("image_id"), Column("name", "TEXT", not_null=True), *_integers("camera_id")),
    references=frozenset({Reference("camera_id", "cameras", cascade=False)}),
    indices=_unique(None, "name") | _unique("index_name", "name"),
    autoincrement=True,
    check="image_id >= 0 and image_id < 2147483647",
)
_PRIORS = ("prior_qw", "prior_qx", "prior_qy", "prior_qz", "prior_tx", "prior_ty", "prior_tz")
_IMAGES_WITH_PRIORS = replace(_IMAGES, columns=(*_IMAGES.columns, *(Column(name, "REAL") for name in _PRIORS)))
_KEYPOINTS = SchemaTable("keypoints", (_key("image_id"), *_MATRIX), references=_OF_IMAGE)
_DESCRIPTORS = replace(_KEYPOINTS, name="descriptors")
_TYPED_DESCRIPTORS = replace(_DESCRIPTORS, columns=(_key("image_id"), *_integers("type"), *_MATRIX))
_MATCHES = SchemaTable("matches", (_key("pair_id"), *_MATRIX))
_GEOMETRIES = SchemaTable(
    "two_view_geometries",
    (*_MATCHES.columns, *_integers("config"), *_blobs("F", "E", "H", "qvec", "tvec")),
)
_GEOMETRIES_WITH_CAMERAS = replace(_GEOMETRIES, columns=(*_GEOMETRIES.columns, *_blobs("camera1", "camera2")))
_POSITION_PRIORS = SchemaTable(
    "pose_priors", (_key("image_id"), *_blobs("position"), *_integers("coordinate_system")), references=_OF_IMAGE
)
_COVARIANCE_PRIORS = replace(_POSITION_PRIORS, columns=(*_POSITION_PRIORS.columns, *_blobs("position_covariance")))
_SENSOR_PRIORS = SchemaTable(
    "pose_priors",
    (
        _key("pose_prior_id"),
        *_integers("corr_data_id", "corr_sensor_id", "corr_sensor_type"),
        *_blobs("position", "position_covariance", "gravity"),
        *_integers("coordinate_system"),
    ),
    indices=_unique("pose_prior_data_assignment", "corr_data_id", "corr_sensor_id", "corr_sensor_type"),
)
_RIGS = SchemaTable(
    "rigs",
    (_key("rig_id"), *_integers("ref_sensor_id", "ref_sensor_type")),
    indices=_unique("rig_ref_sensor_assignment", "ref_sensor_id", "ref_sensor_type"),
    autoincrement=True,
)
_RIG_SENSORS = SchemaTable(
    "rig_sensors",
    (*_integers("rig_id", "sensor_id", "sensor_type"), *_blobs("sensor_from_rig")),
    references=_OF_RIG,
    indices=_unique("rig_sensor_assignment", "sensor_id", "sensor_type"),
)
_FRAMES = SchemaTable("frames", (_key("frame_id"), *_integers("rig_id")), references=_OF_RIG, autoincrement=True)
_FRAME_DATA = SchemaTable(
    "frame_data",
    _integers("frame_id", "data_id", "sensor_id", "sensor_type"),
    references=frozenset({Reference("frame_id", "frames")}),
    indices=_unique("frame_sensor_assignment", "data_id", "sensor_type"),
)


def _numbered(first: int, names: str) -> dict[int, str]:
    return dict(enumerate(names.split(), start=first))


_3_8 = Schema(
    "3.8",
    3800,
    {t.name: t for t in (_CAMERAS, _IMAGES_WITH_PRIORS, _KEYPOINTS, _DESCRIPTORS, _MATCHES, _GEOMETRIES)},
    camera_models=_numbered(
        0,
        "SIMPLE_PINHOLE PINHOLE SIMPLE_RADIAL RADIAL OPENCV OPENCV_FISHEYE FULL_OPENCV FOV SIMPLE_RADIAL_FISHEYE "
        "RADIAL_FISHEYE THIN_PRISM_FISHEYE",
    ),
    pair_configurations=_numbered(
        0,
        "UNDEFINED DEGENERATE CALIBRATED UNCALIBRATED PLANAR PANORAMIC PLANAR_OR_PANORAMIC WATERMARK MULTIPLE",
    ),
    descriptor_types={0: "SIFT"},
)
_3_9 = _3_8.following("3.9", user_version=3900)
_3_10 = _3_9.following("3.10", _IMAGES, _POSITION_PRIORS)
_3_11 = _3_10.following(
    "3.11", _COVARIANCE_PRIORS, camera_models=_3_10.camera_models | {11: "RAD_TAN_THIN_PRISM_FISHEYE"}
)
_3_12 = _3_11.following("3.12", _RIGS, _RIG_SENSORS, _FRAMES, _FRAME_DATA)
_3_13 = _3_12.following("3.13", pair_configurations=_3_12.pair_configurations | {9: "CALIBRATED_RIG"})
_4_0 = _3_13.following(
    "4.0",
    _TYPED_DESCRIPTORS,
    _SENSOR_PRIORS,
    user_version=4_00_00_00,
    camera_models=_3_13.camera_models | _numbered(12, "SIMPLE_DIVISION DIVISION SIMPLE_FISHEYE FISHEYE"),
    descriptor_types=_numbered(-1, "UNDEFINED SIFT ALIKED_N16ROT ALIKED_N32"),
)
_4_2 = _4_0.following(
    "4.2",
    _GEOMETRIES_WITH_CAMERAS,
    user_version=4_02_00_00,
    camera_models=_4_0.camera_models | _numbered(16, "EUCM EQUIRECTANGULAR"),
    descriptor_types=_4_0.descriptor_types | _numbered(3, "LOMA_B LOMA_B128"),
)

SCHEMAS = {schema.name: schema for schema in (_3_8, _3_9, _3_10, _3_11, _3_12, _3_13, _4_0, _4_2)}
"""All published schemas by name, the oldest first."""

SOURCE = _4_2
"""The schema of our own database, which pycolmap 4.2 writes."""

_SAME_TABLES = {"4.1": "4.0"}
"""Versions that have the tables of another version."""


def find_schema(name: str) -> Schema:
    """Returns the schema of that name."""
    if name not in SCHEMAS:
        raise InputError("E-OPTION-VALUE", f"schema {name}: unknown; give one of {', '.join(SCHEMAS)}")
    return SCHEMAS[name]


def schema_of_version(version: str) -> str:
    """Returns the schema that a COLMAP program of ``version`` (``3.8``, ``3.11.1``, ``4.0.3``) reads and writes."""
    release = re.fullmatch(r"(\d+\.\d+)(\.\d+)?", version)
    minor = release[1] if release else version
    name = _SAME_TABLES.get(minor, minor)
    if name not in SCHEMAS:
        versions = ", ".join([*SCHEMAS, *_SAME_TABLES])
        raise InputError(
            "E-COLMAP-VERSION", f"COLMAP {version}: its database schema is not known; use a release of {versions}"
        )
    return name
