from .growing import GrowingRun as GrowingRun
from .growing import WatchOptions as WatchOptions
from .growing import watch as watch
from .photographs import capture as capture
