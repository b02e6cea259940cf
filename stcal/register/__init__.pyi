from .core.liu2017 import Liu2017Options as Liu2017Options
from .core.pairs import Pairs as Pairs
from .core.pairs import read_pairs as read_pairs
from .core.result import Alternative as Alternative
from .core.result import HeldOutPoints as HeldOutPoints
from .core.result import Registration as Registration
from .pipeline import register as register
