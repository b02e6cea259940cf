from .calibrate_camera import calibrate_camera_by_corners as calibrate_camera_by_corners
from .calibrate_camera import calibrate_rig as calibrate_rig
from .from_photos.run import robot_from_photos as robot_from_photos
from .growing import GrowingRun as GrowingRun
from .growing import WatchOptions as WatchOptions
from .growing import watch as watch
from .photographs import capture as capture
