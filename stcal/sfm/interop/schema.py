"""The database schema of each COLMAP version, as SQL.

Each was read from the empty database that the version itself makes: 3.8 from the native program, 3.9 (3.9.1) from
pycolmap 0.6.0 and 0.6.1, 3.10 from pycolmap 3.10.0, 3.11 from 3.11.0 and 3.11.1, 3.12 from 3.12.0 and 3.12.6, 3.13
from 3.13.0, 4.0 from 4.0.0 and 4.0.4, 4.1 from 4.1.0 and 4.1.1, 4.2 from 4.2.0 and 4.2.1; releases of one version
differ in nothing but the last digits of ``user_version``, which 4.x stamps as major, minor and patch. The tables of
4.1 are those of 4.0. COLMAP's source (``src/colmap/scene/database.cc``, from 3.13 on ``database_sqlite.cc``) was read
beside it.
"""

import re
from dataclasses import dataclass, replace

from stcal.errors import InputError


@dataclass(frozen=True, slots=True)
class Schema:
    """The database schema of a COLMAP version."""

    name: str
    user_version: int  # the stamp of the version's first release
    tables: dict[str, str]  # declaration by name
    indices: dict[str, str]  # table and columns of unique indices by name

    def following(self, name: str, tables: dict[str, str], indices: dict[str, str] | None = None) -> "Schema":
        """Returns the schema of a later version, with tables and indices added or replaced."""
        return replace(self, name=name, tables=self.tables | tables, indices=self.indices | (indices or {}))

    def statements(self) -> list[str]:
        """Returns the SQL statements that make an empty database."""
        return [
            *(f"CREATE TABLE {table} ({declaration})" for table, declaration in self.tables.items()),
            *(f"CREATE UNIQUE INDEX {index} ON {columns}" for index, columns in self.indices.items()),
            f"PRAGMA user_version = {self.user_version}",
        ]


_MATRIX = "rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB"
_IMAGE_KEY = "image_id INTEGER NOT NULL PRIMARY KEY"
_OF_IMAGE = "FOREIGN KEY (image_id) REFERENCES images (image_id) ON DELETE CASCADE"
_OF_RIG = "FOREIGN KEY (rig_id) REFERENCES rigs (rig_id) ON DELETE CASCADE"
_SENSOR = "sensor_id INTEGER NOT NULL, sensor_type INTEGER NOT NULL"
_PAIRS = f"pair_id INTEGER NOT NULL PRIMARY KEY, {_MATRIX}"
_GEOMETRIES = f"{_PAIRS}, config INTEGER NOT NULL, F BLOB, E BLOB, H BLOB, qvec BLOB, tvec BLOB"
_IMAGES = (
    "image_id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, name TEXT NOT NULL, camera_id INTEGER NOT NULL{}, "
    "UNIQUE (name), CHECK (image_id >= 0 and image_id < 2147483647), "
    "FOREIGN KEY (camera_id) REFERENCES cameras (camera_id)"
)
_PRIOR_POSES = "".join(f", prior_{name} REAL" for name in ("qw", "qx", "qy", "qz", "tx", "ty", "tz"))
_PRIORS = f"{_IMAGE_KEY}, position BLOB, coordinate_system INTEGER NOT NULL"

_3_8 = Schema(
    "3.8",
    3800,
    {
        "cameras": "camera_id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, model INTEGER NOT NULL, "
        "width INTEGER NOT NULL, height INTEGER NOT NULL, params BLOB, prior_focal_length INTEGER NOT NULL",
        "images": _IMAGES.format(_PRIOR_POSES),
        "keypoints": f"{_IMAGE_KEY}, {_MATRIX}, {_OF_IMAGE}",
        "descriptors": f"{_IMAGE_KEY}, {_MATRIX}, {_OF_IMAGE}",
        "matches": _PAIRS,
        "two_view_geometries": _GEOMETRIES,
    },
    {"index_name": "images (name)"},
)
_3_9 = replace(_3_8, name="3.9", user_version=3900)
_3_10 = _3_9.following("3.10", {"images": _IMAGES.format(""), "pose_priors": f"{_PRIORS}, {_OF_IMAGE}"})
_3_11 = _3_10.following("3.11", {"pose_priors": f"{_PRIORS}, position_covariance BLOB, {_OF_IMAGE}"})
_3_12 = _3_11.following(
    "3.12",
    {
        "rigs": "rig_id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, ref_sensor_id INTEGER NOT NULL, "
        "ref_sensor_type INTEGER NOT NULL",
        "rig_sensors": f"rig_id INTEGER NOT NULL, {_SENSOR}, sensor_from_rig BLOB, {_OF_RIG}",
        "frames": f"frame_id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, rig_id INTEGER NOT NULL, {_OF_RIG}",
        "frame_data": f"frame_id INTEGER NOT NULL, data_id INTEGER NOT NULL, {_SENSOR}, "
        "FOREIGN KEY (frame_id) REFERENCES frames (frame_id) ON DELETE CASCADE",
    },
    {
        "rig_ref_sensor_assignment": "rigs (ref_sensor_id, ref_sensor_type)",
        "rig_sensor_assignment": "rig_sensors (sensor_id, sensor_type)",
        "frame_sensor_assignment": "frame_data (data_id, sensor_type)",
    },
)
_4_0 = replace(_3_12, user_version=4_00_00_00).following(
    "4.0",
    {
        "descriptors": f"{_IMAGE_KEY}, type INTEGER NOT NULL, {_MATRIX}, {_OF_IMAGE}",
        "pose_priors": "pose_prior_id INTEGER NOT NULL PRIMARY KEY, corr_data_id INTEGER NOT NULL, "
        "corr_sensor_id INTEGER NOT NULL, corr_sensor_type INTEGER NOT NULL, position BLOB, position_covariance BLOB, "
        "gravity BLOB, coordinate_system INTEGER NOT NULL",
    },
    {"pose_prior_data_assignment": "pose_priors (corr_data_id, corr_sensor_id, corr_sensor_type)"},
)
_4_2 = replace(_4_0, user_version=4_02_00_00).following(
    "4.2", {"two_view_geometries": f"{_GEOMETRIES}, camera1 BLOB, camera2 BLOB"}
)

SCHEMAS = {schema.name: schema for schema in (_3_8, _3_9, _3_10, _3_11, _3_12, replace(_3_12, name="3.13"), _4_0, _4_2)}
"""All published schemas by name, the oldest first."""

_SAME_TABLES = {"4.1": "4.0"}  # versions that have the tables of another version


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
