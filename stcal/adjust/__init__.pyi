from .blocks import Block as Block
from .blocks import Huber as Huber
from .blocks import PoseStack as PoseStack
from .blocks import Vector as Vector
from .engine import Adjustment as Adjustment
from .engine import Joined as Joined
from .engine import Solution as Solution
