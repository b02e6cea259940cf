from .engine import Adjustment as Adjustment
from .engine import Block as Block
from .engine import Huber as Huber
from .engine import Solution as Solution
from .engine import Vector as Vector
