from .liu2017 import Liu2017Options as Liu2017Options
from .pairs import Pairs as Pairs
from .pairs import read_pairs as read_pairs
from .pipeline import register as register
from .result import Alternative as Alternative
from .result import HeldOutPoints as HeldOutPoints
from .result import Registration as Registration
