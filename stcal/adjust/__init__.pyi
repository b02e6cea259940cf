from .engine import Adjustment as Adjustment
from .engine import Block as Block
from .engine import Huber as Huber
from .engine import Joined as Joined
from .engine import PoseStack as PoseStack
from .engine import Solution as Solution
from .engine import Vector as Vector
